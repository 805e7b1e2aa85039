"""Simulated failure of one file operation, as on a full or broken disk."""

import builtins
import io
import os
import shutil
from contextlib import contextmanager
from errno import EACCES, EIO, ENOSPC
from pathlib import Path

import h5py

ERRORS = (ENOSPC, EIO, EACCES)


class Faults:
    """Counts the opens, writes, flushes, syncs and renames in one folder, and makes one fail.

    Args:
        folder: folder in which calls are counted; calls on other files are not changed.
        number: number of the call that fails, from 0; None: no call fails.
        error: errno of the failure.
    """

    def __init__(self, folder, number=None, error=ENOSPC):
        self.folder, self.number, self.error = str(folder), number, error
        self.calls = []

    def hit(self, what, path):
        if not str(path).startswith(self.folder):
            return
        self.calls.append((what, Path(str(path)).name))
        if len(self.calls) - 1 == self.number:
            raise OSError(self.error, os.strerror(self.error), str(path))

    @contextmanager
    def injected(self, patch):
        """Replace the calls, while the block runs, by versions that count and may fail."""
        opened, path_of = io.open, {}

        def opening(file, mode="r", *args, **options):
            path = path_of.get(file, file) if isinstance(file, int) else file
            if not isinstance(file, int):  # a descriptor is open already
                self.hit("open", path)
            stream = opened(file, mode, *args, **options)
            if any(letter in mode for letter in "wxa+"):
                self.watch(stream, path)
            return stream

        def low(path, flags, *args, opened=os.open, **options):
            self.hit("open", path)
            descriptor = opened(path, flags, *args, **options)
            path_of[descriptor] = path
            return descriptor

        def synced(descriptor):  # counted but not executed: tests have no power cuts
            self.hit("fsync", os.readlink(f"/proc/self/fd/{descriptor}"))

        with patch.context() as inner:
            inner.setattr(builtins, "open", opening)
            inner.setattr(io, "open", opening)
            inner.setattr(os, "open", low)
            inner.setattr(os, "fsync", synced)
            for name in ("replace", "rename", "mkdir"):
                inner.setattr(os, name, self.named(name, getattr(os, name)))
            inner.setattr(shutil, "copyfile", self.named("copy", shutil.copyfile, at=1))
            inner.setattr(h5py, "File", self.hdf5())
            yield self

    def watch(self, stream, path):
        for name in ("write", "flush"):
            inner = getattr(stream, name)

            def call(*args, name=name, inner=inner):
                self.hit(name, path)
                return inner(*args)

            setattr(stream, name, call)

    def named(self, name, call, at=0):
        def calling(*args, **options):
            self.hit(name, args[at])
            return call(*args, **options)

        return calling

    def hdf5(self):
        faults, opened = self, h5py.File

        class File(opened):
            def __init__(self, name, mode="r", **options):
                faults.hit("open", name)
                super().__init__(name, mode, **options)

            def flush(self):
                faults.hit("flush", self.filename)
                super().flush()

        return File
