"""Sagittal sections of surfaces, and the convex outline of several of them.

A sagittal section is the cut of a surface with a plane z = const of its frame.
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface


def sagittal_section(surface: Surface, z: float) -> Array:
    """Return the cut with the plane at z as segments (k, 2, 2) in x-y, m, unordered."""
    corners = surface.triangles
    height = corners[:, :, 2] - z
    above = height > 0.0
    cut = above.any(axis=1) & ~above.all(axis=1)
    corners, height, above = corners[cut], height[cut], above[cut]
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    rows = np.arange(len(corners))
    ends = []
    for step in (1, 2):
        other = (lone + step) % 3
        share = height[rows, lone] / (height[rows, lone] - height[rows, other])
        a, b = corners[rows, lone, :2], corners[rows, other, :2]
        ends.append(a + share[:, None] * (b - a))
    return np.stack(ends, axis=1)


def convex_outline(points: Array, offset: float = 0.0, step_deg: float = 2.0) -> Array:
    """Return the convex hull of points (n, 2), grown by `offset`, counter-clockwise.

    The grown hull's corners lie on circles about the hull's corners, `step_deg` apart: it is
    inside the exact one by at most offset (1 - cos(step/2)), 0.015 % of the offset.

    Raises:
        InputError: the points span no area.
    """
    try:
        hull = points[ConvexHull(points).vertices]
        if offset > 0.0:
            angle = np.deg2rad(np.arange(0.0, 360.0, step_deg))
            circle = offset * np.column_stack([np.cos(angle), np.sin(angle)])
            offset_points = (hull[:, None] + circle).reshape(-1, 2)
            hull = offset_points[ConvexHull(offset_points).vertices]
    except (QhullError, ValueError, IndexError):
        raise InputError("the section spans no area", "sagittal outline") from None
    return hull


def sagittal_outline(
    surfaces: Sequence[Surface],
    z_values: Iterable[float],
    offset: float = 0.0,
    below: float = np.inf,
) -> Array:
    """Return the convex outline (n, 2) of the sections of surfaces that share one frame.

    Args:
        surfaces: e.g. femur and femoral component, in the femur's frame.
        z_values: m, the planes; the outline is that of all sections laid upon each other.
        offset: m, e.g. half the thickness of the tendon that wraps.
        below: m, leave out what would reach above this y after growing.

    Returns:
        Strictly convex polygon, counter-clockwise, x-y, m.

    Raises:
        InputError: no surface is cut, or the cuts span no area.
    """
    return _outline(tuple(surfaces), tuple(float(z) for z in z_values), offset, below)


@lru_cache(maxsize=4)
def _outline(
    surfaces: tuple[Surface, ...], z_values: tuple[float, ...], offset: float, below: float
) -> Array:
    """Return what `sagittal_outline` does; the last few are cached, for a scene's many samples."""
    cuts = [sagittal_section(surface, z) for surface in surfaces for z in z_values]
    points = _points_below(np.concatenate([*cuts, np.empty((0, 2, 2))]), below - offset)
    if len(points) == 0:
        names = ", ".join(surface.name for surface in surfaces)
        raise InputError(
            "no surface is cut by the sagittal planes of the line",
            f"sagittal outline of {names}",
            "check the line's points and the mesh's unit and place",
        )
    outline = convex_outline(points, offset)
    outline.flags.writeable = False  # shared by all who ask
    return outline


def _points_below(segments: Array, y: float) -> Array:
    """Return the ends (n, 2) of segments (k, 2, 2) cut off at y."""
    if np.isfinite(y):
        low, high = np.sort(segments[:, :, 1], axis=1).T
        a, b = segments[(low < y) & (high > y)].transpose(1, 0, 2)
        share = ((y - a[:, 1]) / (b[:, 1] - a[:, 1]))[:, None]
        crossings = a + share * (b - a)
    else:
        crossings = np.empty((0, 2))
    ends = segments.reshape(-1, 2)
    return np.concatenate([ends[ends[:, 1] <= y], crossings])
