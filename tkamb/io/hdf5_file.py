"""HDF5 files that can be written on a disk that fills up.

The HDF5 library cannot close a file of which a write has failed: it tries again, fails, and ends
the process with it. Here the library writes through a Python file that records the first failure
and ignores all later writes, so that the library can close the file. The failure is raised
afterwards, once, and the caller discards the file.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from tkamb.errors import InputError


class NotingFile:
    """A file for HDF5 that records the first failure of the system instead of raising it.

    Args:
        path: created, or emptied if it exists.

    Attributes:
        failure: the first error of a write; None: all is written.

    Raises:
        OSError: it cannot be opened.
    """

    def __init__(self, path: str | Path) -> None:
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
        self._descriptor = os.open(path, flags, 0o666)
        self._place = 0
        self.failure: OSError | None = None

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a byte; return its number."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size()}[whence]
        self._place = start + offset
        return self._place

    def tell(self) -> int:
        """Return the number of the byte that is next."""
        return self._place

    def read(self, size: int) -> bytes:
        """Return so many bytes, as `readinto` gives them."""
        buffer = bytearray(size)
        self.readinto(buffer)
        return bytes(buffer)

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer; bytes that could not be written are zero."""
        view = memoryview(buffer).cast("B")
        content = os.pread(self._descriptor, len(view), self._place)
        view[: len(content)] = content
        view[len(content) :] = bytes(len(view) - len(content))
        self._place += len(view)
        return len(view)

    def write(self, content: Any) -> int:
        """Write all bytes; after a failure none."""
        view = memoryview(content).cast("B")
        done = 0
        while done < len(view) and self.failure is None:
            try:
                done += os.pwrite(self._descriptor, view[done:], self._place + done)
            except OSError as error:
                self.failure = error
        self._place += len(view)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Make the file so many bytes long."""
        size = self._place if size is None else size
        try:
            if self.failure is None:
                os.ftruncate(self._descriptor, size)
        except OSError as error:
            self.failure = error
        return size

    def flush(self) -> None:
        """Do nothing: written bytes are with the system already."""

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _size(self) -> int:
        return os.fstat(self._descriptor).st_size


@contextmanager
def new_hdf5(path: Path) -> Iterator[Any]:
    """Give a new HDF5 file, open for writing.

    Args:
        path: a temporary one: after a failure the file there is not whole.

    Raises:
        InputError: it cannot be opened or written.
    """
    try:
        stream = NotingFile(path)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", path) from None
    try:
        with h5py.File(stream, "w") as file:
            yield file
        check_written(stream, path)
    finally:
        stream.close()


def check_written(stream: NotingFile, path: object) -> None:
    """Raise an InputError where a write has failed."""
    if stream.failure is not None:
        raise InputError(f"cannot be written ({stream.failure.strerror})", path)
