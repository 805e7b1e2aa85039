"""Plane polygons: sagittal sections of surfaces, convex outlines, and division into triangles.

A sagittal section is the intersection of a surface with a plane z = const of its frame.
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import counted


def sagittal_section(surface: Surface, z: float) -> Array:
    """Return the section with the plane at z (m) as unordered segments (k, 2, 2) in x-y, m."""
    corners = surface.triangles
    height = corners[:, :, 2] - z
    above = height > 0.0
    cut = above.any(axis=1) & ~above.all(axis=1)
    corners, height, above = corners[cut], height[cut], above[cut]
    single = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    rows = np.arange(len(corners))
    ends = []
    for step in (1, 2):
        other = (single + step) % 3
        share = height[rows, single] / (height[rows, single] - height[rows, other])
        a, b = corners[rows, single, :2], corners[rows, other, :2]
        ends.append(a + share[:, None] * (b - a))
    return np.stack(ends, axis=1)


def convex_outline(points: Array, offset: float = 0.0, step_deg: float = 2.0) -> Array:
    """Return the convex hull of points (n, 2), enlarged by `offset`, counter-clockwise.

    The corners of the enlarged hull lie on circles about the hull's corners, `step_deg` apart. With
    2 deg the hull is too small by at most 0.015 % of the offset.
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
        surfaces: surfaces in one frame, e.g. femur and femoral component.
        z_values: m, planes of the sections; the outline encloses all sections.
        offset: m, enlargement of the outline, e.g. half the thickness of a wrapping tendon.
        below: m, upper limit of y for the enlarged outline.

    Returns:
        Strictly convex polygon, counter-clockwise, x-y, m.
    """
    return _outline(tuple(surfaces), tuple(float(z) for z in z_values), offset, below)


@lru_cache(maxsize=4)
def _outline(
    surfaces: tuple[Surface, ...], z_values: tuple[float, ...], offset: float, below: float
) -> Array:
    """The last four results are cached."""
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
    outline.flags.writeable = False  # the cache returns the same array again
    return outline


def _points_below(segments: Array, y: float) -> Array:
    """Return the ends (n, 2) of the parts of segments (k, 2, 2) below y (m)."""
    if np.isfinite(y):
        low, high = np.sort(segments[:, :, 1], axis=1).T
        a, b = segments[(low < y) & (high > y)].transpose(1, 0, 2)
        share = ((y - a[:, 1]) / (b[:, 1] - a[:, 1]))[:, None]
        crossings = a + share * (b - a)
    else:
        crossings = np.empty((0, 2))
    ends = segments.reshape(-1, 2)
    return np.concatenate([ends[ends[:, 1] <= y], crossings])


# 1: a signed area below this share of the polygon's area is zero. It is above
# rounding.
AREA_ROUNDING = 1e-12
# 1: smallest ratio of a polygon's enclosed area to the total area of its triangles. With a smaller
# ratio the polygon crosses itself. It is above rounding.
LEAST_AREA_SHARE = 1e-9


class CrossedPolygonError(ValueError):
    """A polygon crosses itself."""


def triangulated(vertices: Array, corners: Index, ends: Index) -> Index:
    """Return polygons as triangles (k, 3) with the winding of the polygons.

    A convex polygon becomes a fan about its first corner. From a concave polygon ears are cut off
    one by one (Meisters, Am Math Monthly 82:648, 1975). Polygons with fewer than three corners are
    skipped.

    Args:
        vertices: (n, 3) positions.
        corners: (m,) vertices of all polygons, one polygon after the other.
        ends: (p,) index in `corners` at which each polygon ends.

    Raises:
        CrossedPolygonError: a polygon crosses itself.
    """
    starts = np.concatenate([[0], ends[:-1]]).astype(np.int64)
    polygon, rank = counted(np.maximum(ends - starts - 2, 0))
    first = starts[polygon]
    fans = np.stack([corners[first], corners[first + rank + 1], corners[first + rank + 2]], axis=1)
    larger_polygons = np.flatnonzero(ends - starts > 3)
    if not len(larger_polygons):
        return fans
    a, b, c = np.moveaxis(vertices[fans], 1, 0)
    cross = np.cross(b - a, c - a)
    total = np.stack([np.bincount(polygon, part, len(ends)) for part in cross.T], axis=1)
    along = np.einsum("ij,ij->i", cross, total[polygon])
    size = np.einsum("ij,ij->i", total, total)
    concave = np.unique(polygon[along < -AREA_ROUNDING * size[polygon]])
    longest = np.zeros(len(ends))
    np.maximum.at(longest, polygon, np.einsum("ij,ij->i", c - a, c - a))
    covered = np.bincount(polygon, np.linalg.norm(cross, axis=1), len(ends))
    if (
        (np.sqrt(size) < LEAST_AREA_SHARE * covered) & (covered > LEAST_AREA_SHARE * longest)
    ).any():
        raise CrossedPolygonError("a polygon crosses itself")
    if not len(concave):
        return fans
    cut = [ears(vertices, corners[starts[p] : ends[p]], total[p]) for p in concave]
    return np.concatenate([fans[~np.isin(polygon, concave)], *cut])


def ears(vertices: Array, ring: Index, normal: Array) -> Index:
    """Return a polygon as triangles (m - 2, 3); ears are cut off one by one.

    `normal` (3,) of the polygon (m,) is twice its area long.
    """
    axis = int(np.argmax(np.abs(normal)))
    plane = [(axis + 1) % 3, (axis + 2) % 3]
    points = vertices[ring][:, plane if normal[axis] > 0 else plane[::-1]]
    least = AREA_ROUNDING * abs(float(normal[axis]))
    remaining, triangles = list(range(len(ring))), []
    at = tried = 0
    flat_ears = False
    while len(remaining) > 3:
        at %= len(remaining)
        before, corner, after = (
            remaining[at - 1],
            remaining[at],
            remaining[(at + 1) % len(remaining)],
        )
        if _is_ear(points, remaining, (before, corner, after), least, flat_ears):
            triangles.append((before, corner, after))
            del remaining[at]
            at, tried, flat_ears = max(at - 1, 0), 0, False
            continue
        at, tried = at + 1, tried + 1
        if tried > len(remaining):
            # No ear with an area remains: the corners are collinear, or the polygon crosses itself.
            if flat_ears:
                raise CrossedPolygonError(f"a polygon of {len(ring)} corners crosses itself")
            tried, flat_ears = 0, True
    triangles.append((remaining[0], remaining[1], remaining[2]))
    return ring[np.array(triangles)]


def _is_ear(
    points: Array, remaining: list[int], ear: tuple[int, int, int], least: float, flat: bool
) -> bool:
    """Return whether a corner is convex, and its triangle contains no other.

    `ear` are predecessor, corner and successor, `remaining` the corners not cut off. Below `least`
    twice the area a triangle counts as a line, and with `flat` a corner on a line as an ear.
    """
    a, b, c = points[list(ear)]
    area = _twice_area(a, b, c)
    if area <= least:
        return bool(flat and abs(area) <= least)
    candidates = points[remaining]
    at_corner = (
        (candidates == a).all(axis=1)
        | (candidates == b).all(axis=1)
        | (candidates == c).all(axis=1)
    )
    sides = np.stack([_twice_area(p, q, candidates) for p, q in ((a, b), (b, c), (c, a))])
    return not ((sides >= -least).all(axis=0) & ~at_corner).any()


def _twice_area(a: Array, b: Array, c: Array) -> Array:
    return (b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0])
