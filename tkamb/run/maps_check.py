"""Checks of a contact.h5 before it is read.

An HDF5 file can refer to arrays in other files (external storage, external links, virtual
datasets). A results folder from someone else could thereby make tkamb read private files. All such
references are refused.
"""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.memory import available_memory

WRITTEN = "run it again, or ask whoever sent it for a folder that `tkamb run` wrote"
FILTERS = frozenset({h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE})
"""Compression filters that tkamb uses. Any other filter could load a library."""
SHARE_OF_MEMORY = 0.25
"""1: largest size of an array as a share of the available memory. A report reads about three."""
FARTHEST = 10.0
"""m: largest distance of a point from the insert's origin."""

SHAPES = {
    "pressure_Pa": ("frames", "points"),
    "gap_m": ("frames", "points"),
    "nodal_force_N": ("frames", "points", 3),
    "femoral_pose": ("frames", 4, 4),
    "contact_points_m": ("frames", 3, 3),
    "contact_normals": ("frames", 3, 3),
}
"""Name of an array with one row per frame -> its shape."""
SINCE_LATER = ("contact_points_m", "contact_normals")
"""Arrays that files of early releases lack."""


def check_maps_file(file: Any, path: str | Path) -> None:
    """Raise unless an open HDF5 file itself contains the arrays that tkamb writes.

    Args:
        file: open `h5py.File`.
        path: path of the file, for the message.

    Raises:
        InputError: an array is missing, too large, stored in another file, or has another shape or
            type.
    """
    for name in file:
        _check_link(file, name, path)
    points = _dataset(file, "points_m", path)
    triangles = _dataset(file, "triangles", path)
    times = _dataset(file, "time_s", path)
    _check(len(points.shape) == 2 and points.shape[1] == 3, "points_m", points, path)
    _check(len(triangles.shape) == 2 and triangles.shape[1] == 3, "triangles", triangles, path)
    _check(triangles.dtype.kind in "iu", "triangles", triangles, path)
    _check(len(times.shape) == 1, "time_s", times, path)
    frames = times.shape[0]
    for name, sizes in SHAPES.items():
        if name in SINCE_LATER and name not in file:
            continue
        dataset = _dataset(file, name, path)
        shape = tuple(points.shape[0] if size == "points" else size for size in sizes[1:])
        # a killed run has more rows than times: the last frames were not completed
        is_complete = len(dataset.shape) == len(sizes) and dataset.shape[0] >= frames
        _check(is_complete and dataset.shape[1:] == shape, name, dataset, path)


def check_values(file: Any, path: str | Path) -> None:
    """Raise unless points are near the insert, triangles have valid indices, and times increase.

    Args:
        file: open `h5py.File` after `check_maps_file`.
        path: path of the file, for the message.

    Raises:
        InputError: a value is out of range.
    """
    points, triangles, times = (file[name][()] for name in ("points_m", "triangles", "time_s"))
    if not (np.abs(points) <= FARTHEST).all():
        raise InputError(f"'points_m' holds points beyond {FARTHEST:g} m", path, WRITTEN)
    if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
        raise InputError("'triangles' refers to points that do not exist", path, WRITTEN)
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise InputError("'time_s' does not increase from frame to frame", path, WRITTEN)


def _check_link(file: Any, name: str, path: str | Path) -> None:
    """Raise unless a name refers to an array or a group in the file itself."""
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise InputError(f"'{name}' is a link, which tkamb does not follow", path, WRITTEN)


def _dataset(file: Any, name: str, path: str | Path) -> Any:
    """Return an array of numbers in the file itself; raise an InputError for anything else."""
    if name not in file:
        raise InputError(f"has no '{name}'", path, "give a contact.h5 that tkamb wrote")
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"'{name}' is not an array", path, WRITTEN)
    properties = dataset.id.get_create_plist()
    if dataset.is_virtual or properties.get_external_count():
        raise InputError(f"'{name}' is stored in another file, which is not read", path, WRITTEN)
    filters = {properties.get_filter(k)[0] for k in range(properties.get_nfilters())}
    if not filters <= FILTERS:
        raise InputError(f"'{name}' has a compression that tkamb does not use", path, WRITTEN)
    if dataset.dtype.kind not in "fiu" or dataset.shape is None:
        raise InputError(f"'{name}' does not hold numbers", path, WRITTEN)
    size, most = 8.0 * dataset.size, SHARE_OF_MEMORY * available_memory()
    if size > most:
        what = f"'{name}' has {size / 1e9:.3g} GB; the limit is {most / 1e9:.3g} GB"
        raise InputError(what, path, "free memory, or run fewer frames")
    return dataset


def _check(valid: bool, name: str, dataset: Any, path: str | Path) -> None:
    if not valid:
        shape = " x ".join(map(str, dataset.shape))
        what = f"'{name}' has a wrong type or shape: {dataset.dtype}, {shape}"
        raise InputError(what, path, WRITTEN)
