"""Writing of HDF5 files with an error message when the disk is full.

The HDF5 library cannot close a file after a failed write: it tries again, fails, and ends the
process. tkamb lets the library write through a Python file object. This object records the first
failure and ignores later writes. The library can then close the file, and `new_hdf5` raises.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from tkamb.errors import InputError


class NotingFile:
    """A file object for HDF5 that records the first failed write and raises no error.

    Args:
        path: the file; it is created, or emptied if it exists.

    Attributes:
        failure: error of the first failed write; None if every write has succeeded.

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(self, path: str | Path) -> None:
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
        self._descriptor = os.open(path, flags, 0o666)
        self._place = 0
        self.failure: OSError | None = None

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a position and return it, in bytes from the beginning."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size()}[whence]
        self._place = start + offset
        return self._place

    def tell(self) -> int:
        """Return the current position, in bytes from the beginning."""
        return self._place

    def read(self, size: int) -> bytes:
        """Return `size` bytes from the current position, zeros beyond the end of the file."""
        buffer = bytearray(size)
        self.readinto(buffer)
        return bytes(buffer)

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from the current position; bytes beyond the end of the file are zero."""
        view = memoryview(buffer).cast("B")
        content = os.pread(self._descriptor, len(view), self._place)
        view[: len(content)] = content
        view[len(content) :] = bytes(len(view) - len(content))
        self._place += len(view)
        return len(view)

    def write(self, content: Any) -> int:
        """Write all bytes; after a failure, only move the position."""
        view = memoryview(content).cast("B")
        written = 0
        while written < len(view) and self.failure is None:
            try:
                written += os.pwrite(self._descriptor, view[written:], self._place + written)
            except OSError as error:
                self.failure = error
        self._place += len(view)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file, bytes; default: the current position."""
        size = self._place if size is None else size
        try:
            if self.failure is None:
                os.ftruncate(self._descriptor, size)
        except OSError as error:
            self.failure = error
        return size

    def flush(self) -> None:
        """Do nothing: this object has no buffer."""

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _size(self) -> int:
        return os.fstat(self._descriptor).st_size


@contextmanager
def new_hdf5(path: Path) -> Iterator[Any]:
    """Provide a new HDF5 file, open for writing.

    Args:
        path: path of a temporary file; after a failure its content is incomplete.

    Raises:
        InputError: the file cannot be opened or written.
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
    """Raise an InputError if a write has failed."""
    if stream.failure is not None:
        raise InputError(f"cannot be written ({stream.failure.strerror})", path)
