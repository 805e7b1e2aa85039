"""Surfaces that all tests of a process share.

Reading a mesh, repairing it and building its search trees takes as long as many frames. A mesh with
the same content, read with the same options, is therefore the same `Surface`, and so is its copy in
another frame. A mesh that is read with a warning or an error is read again each time.
"""

import hashlib
import inspect
import logging
import os
from collections import OrderedDict
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import pytest

from tkamb.geometry import closest
from tkamb.geometry.surface import Surface
from tkamb.io import mesh_files
from tkamb.io.importing import patient
from tkamb.io.recordings import meshes
from tkamb.run import press

MOST = 24
"""Number of meshes whose surfaces are kept."""
LARGEST = 100_000_000
"""Bytes of the largest mesh file that is shared."""
MOST_POSES = 4
"""Number of poses in which a surface is kept."""


class _Records(logging.Handler):
    """Counts the records of the logger."""

    count = 0

    def emit(self, record):
        self.count += 1


@contextmanager
def shared_surfaces():
    """Share surfaces of meshes with the same content while the block runs; yield their store."""
    store = OrderedDict()
    with pytest.MonkeyPatch.context() as patch:
        load = _loading(meshes.load_surface, store)
        for module in (meshes, press, mesh_files, patient):
            patch.setattr(module, "load_surface", load)
        patch.setattr(Surface, "moved", _moving(Surface.moved))
        patch.setattr(closest, "ClosestPointQuery", lru_cache(8)(closest.ClosestPointQuery))
        yield store


def _loading(load, store):
    """Return `load_surface` with a store of its surfaces."""
    options = inspect.signature(load)

    def shared(path, *arguments, **named):
        given = options.bind(path, *arguments, **named).arguments
        # A name may be too long, and a file too large to be read.
        if not os.path.isfile(path) or os.path.getsize(path) > LARGEST:
            return load(path, *arguments, **named)
        content = hashlib.sha256(Path(path).read_bytes()).hexdigest()
        key = (content, Path(path).suffix, *(repr(v) for k, v in given.items() if k != "path"))
        if key in store:
            store.move_to_end(key)
            return store[key]
        logging.getLogger("tkamb").addHandler(records := _Records(logging.INFO))
        try:
            surface = load(path, *arguments, **named)
        finally:
            logging.getLogger("tkamb").removeHandler(records)
        if not records.count:
            surface.__dict__["poses"] = OrderedDict()
            store[key] = surface
            while len(store) > MOST:
                store.popitem(last=False)
        return surface

    return shared


def _moving(move):
    """Return `Surface.moved` with a store of the copies of shared surfaces."""

    def shared(surface, pose):
        poses = surface.__dict__.get("poses")
        if poses is None:
            return move(surface, pose)
        key = pose.tobytes()
        if key not in poses:
            poses[key] = move(surface, pose)
            while len(poses) > MOST_POSES:
                poses.popitem(last=False)
        return poses[key]

    return shared
