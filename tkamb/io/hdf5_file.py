"""Writing of HDF5 files with an error message when the disk is full.

The HDF5 library cannot close a file after a failed write: it tries again, fails, and ends the
process. tkamb lets the library write through a Python file object. This object records the first
failure and ignores later writes. The library can then close the file, and `new_hdf5` raises.
"""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from tkamb.errors import InputError


class NotingFile(io.FileIO):
    """A file object for HDF5 that records the first failed write and raises no error.

    Args:
        path: the file. A file or link of this name is removed first, so that nothing is written
            through a link.

    Attributes:
        failure: error of the first failed write; None if every write has succeeded.

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(self, path: str | Path) -> None:
        Path(path).unlink(missing_ok=True)
        super().__init__(path, "x+b")
        self.failure: OSError | None = None

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from the current position; bytes beyond the end of the file are zero."""
        view = memoryview(buffer).cast("B")
        count = super().readinto(view) or 0
        view[count:] = bytes(len(view) - count)
        self.seek(len(view) - count, io.SEEK_CUR)
        return len(view)

    def write(self, content: Any) -> int:
        """Write all bytes; after a failure, only move the position."""
        view = memoryview(content).cast("B")
        written = 0
        while written < len(view) and self.failure is None:
            try:
                written += super().write(view[written:]) or 0
            except OSError as error:
                self.failure = error
        self.seek(len(view) - written, io.SEEK_CUR)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file, bytes; default: the current position."""
        size = self.tell() if size is None else size
        try:
            return size if self.failure is not None else super().truncate(size)
        except OSError as error:
            self.failure = error
            return size


@contextmanager
def new_hdf5(path: Path) -> Iterator[Any]:
    """Provide a new HDF5 file, open for writing.

    Args:
        path: path of a temporary file; after a failure its content is incomplete.
    """
    try:
        stream = NotingFile(path)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", path) from None
    with stream:
        with h5py.File(stream, "w") as file:
            yield file
        check_written(stream, path)


def check_written(stream: NotingFile, path: object) -> None:
    """Raise an InputError if a write has failed."""
    if stream.failure is not None:
        raise InputError(f"cannot be written ({stream.failure.strerror})", path)
