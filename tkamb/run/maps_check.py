"""Checks of a contact.h5 before it is read.

An HDF5 file can refer to arrays in other files (external storage, external links, virtual
datasets). A results folder from someone else could thereby make tkamb read private files. All such
references are refused.
"""

from typing import Any

import h5py
import numpy as np

FILTERS = frozenset({h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE})
"""Compression filters that tkamb uses. Any other filter could load a library."""
FARTHEST = 10.0
"""m: largest distance of a point from the insert's origin."""

SHAPES = {
    "points_m": ("points", 3),
    "triangles": (None, 3),
    "time_s": ("frames",),
    "pressure_Pa": ("frames", "points"),
    "gap_m": ("frames", "points"),
    "nodal_force_N": ("frames", "points", 3),
    "femoral_pose": ("frames", 4, 4),
    "contact_points_m": ("frames", 3, 3),
    "contact_normals": ("frames", 3, 3),
}
"""Name of an array -> its shape. A killed run has more rows than times: its last frames."""
SINCE_LATER = ("contact_points_m", "contact_normals")
"""Arrays that files of early releases lack."""


def check_maps_file(file: Any) -> None:
    """Raise unless an open HDF5 file itself contains the arrays that tkamb writes.

    Raises:
        ValueError: an array is missing, stored in another file, or has another shape or type.
    """
    arrays = {name: _array(file, name) for name in SHAPES if name in file or not _is_later(name)}
    sizes = {"points": arrays["points_m"].shape[:1], "frames": arrays["time_s"].shape[:1]}
    for name, dataset in arrays.items():
        shape, expected = dataset.shape, SHAPES[name]
        fits = len(shape) == len(expected) and all(
            size in (None, n, "frames") or (n,) == sizes.get(str(size))
            for n, size in zip(shape, expected, strict=True)
        )
        if not fits or (expected[0] == "frames" and shape[:1] < sizes["frames"]):
            raise ValueError(f"'{name}' has the shape {shape}")
    if arrays["triangles"].dtype.kind not in "iu":
        raise ValueError("'triangles' are not numbers of points")


def check_values(file: Any) -> None:
    """Raise unless points are near the insert, triangles have valid indices, and times increase.

    Args:
        file: open `h5py.File` after `check_maps_file`.

    Raises:
        ValueError: a value is out of range.
    """
    points, triangles, times = (file[name][()] for name in ("points_m", "triangles", "time_s"))
    if not (np.abs(points) <= FARTHEST).all():
        raise ValueError(f"'points_m' holds points beyond {FARTHEST:g} m")
    if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
        raise ValueError("'triangles' refers to points that do not exist")
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise ValueError("'time_s' does not increase from frame to frame")


def _is_later(name: str) -> bool:
    return name in SINCE_LATER


def _array(file: Any, name: str) -> Any:
    """Return an array of numbers in the file itself."""
    if name not in file and file.get(name, getlink=True) is None:
        raise ValueError(f"has no '{name}'")
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"'{name}' is a link, which tkamb does not follow")
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiu":
        raise ValueError(f"'{name}' is no array of numbers")
    properties = dataset.id.get_create_plist()
    if dataset.is_virtual or properties.get_external_count():
        raise ValueError(f"'{name}' is stored in another file, which is not read")
    filters = {properties.get_filter(k)[0] for k in range(properties.get_nfilters())}
    if not filters <= FILTERS:
        raise ValueError(f"'{name}' has a compression that tkamb does not use")
    return dataset
