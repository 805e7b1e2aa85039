"""Polygons of any number of corners into triangles, concave ones as they are."""

from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, Index
from tkamb.geometry.ragged import counted


@dataclass(frozen=True)
class PolygonSettings:
    """Polygons of a section."""

    area_rounding: float = 1e-12
    """1: a signed area below this share of the polygon's extent is zero. Chosen: above rounding."""
    least_area_share: float = 1e-9
    """1: a polygon that encloses a smaller share of the area that it covers crosses itself. Chosen:
    above rounding."""


POLYGON = PolygonSettings()


class CrossedPolygonError(ValueError):
    """A polygon crosses itself, so that it has no inside."""


def triangulated(vertices: Array, corners: Index, ends: Index) -> Index:
    """Return polygons as triangles (k, 3), wound as the polygons are.

    A polygon is cut into a fan about its first corner, if that covers it. If not, it is concave
    there, and its ears are cut off one after the other (Meisters, Am Math Monthly 82:648, 1975).
    Polygons of fewer than three corners are left out.

    Args:
        vertices: (n, 3).
        corners: (m,) vertices of all polygons, one polygon after the other.
        ends: (p,) where each polygon ends in `corners`.

    Raises:
        CrossedPolygonError: a polygon crosses itself.
    """
    starts = np.concatenate([[0], ends[:-1]]).astype(np.int64)
    polygon, rank = counted(np.maximum(ends - starts - 2, 0))
    first = starts[polygon]
    fans = np.stack([corners[first], corners[first + rank + 1], corners[first + rank + 2]], axis=1)
    many = np.flatnonzero(ends - starts > 3)
    if not len(many):
        return fans
    a, b, c = np.moveaxis(vertices[fans], 1, 0)
    cross = np.cross(b - a, c - a)
    total = np.stack([np.bincount(polygon, part, len(ends)) for part in cross.T], axis=1)
    along = np.einsum("ij,ij->i", cross, total[polygon])
    size = np.einsum("ij,ij->i", total, total)
    concave = np.unique(polygon[along < -POLYGON.area_rounding * size[polygon]])
    longest = np.zeros(len(ends))
    np.maximum.at(longest, polygon, np.einsum("ij,ij->i", c - a, c - a))
    covered = np.bincount(polygon, np.linalg.norm(cross, axis=1), len(ends))
    if (
        (np.sqrt(size) < POLYGON.least_area_share * covered)
        & (covered > POLYGON.least_area_share * longest)
    ).any():
        raise CrossedPolygonError("a polygon crosses itself")
    if not len(concave):
        return fans
    cut = [ears(vertices, corners[starts[p] : ends[p]], total[p]) for p in concave]
    return np.concatenate([fans[~np.isin(polygon, concave)], *cut])


def ears(vertices: Array, ring: Index, normal: Array) -> Index:
    """Return a polygon (m,) cut into triangles (m - 2, 3), ear after ear.

    Args:
        vertices: (n, 3).
        ring: its corners.
        normal: (3,) twice its area along its normal.
    """
    axis = int(np.argmax(np.abs(normal)))
    plane = [(axis + 1) % 3, (axis + 2) % 3]
    points = vertices[ring][:, plane if normal[axis] > 0 else plane[::-1]]
    least = POLYGON.area_rounding * abs(float(normal[axis]))
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
        if tried > len(
            remaining
        ):  # what is left has no ear of an area: collinear corners, or crossed
            if flat_ears:
                raise CrossedPolygonError(f"a polygon of {len(ring)} corners crosses itself")
            tried, flat_ears = 0, True
    triangles.append((remaining[0], remaining[1], remaining[2]))
    return ring[np.array(triangles)]


def _is_ear(
    points: Array, remaining: list[int], ear: tuple[int, int, int], least: float, flat: bool
) -> bool:
    """Say whether a corner can be cut off: it is convex, and no other corner lies in it.

    Args:
        points: (m, 2) all corners.
        remaining: those that are not cut off yet.
        ear: the corner between its neighbours.
        least: twice the area of a triangle that is none.
        flat: whether a corner on the line between its neighbours will do.
    """
    a, b, c = points[list(ear)]
    area = _twice_area(a, b, c)
    if area <= least:
        return bool(flat and abs(area) <= least)
    others = points[remaining]
    corner = (others == a).all(axis=1) | (others == b).all(axis=1) | (others == c).all(axis=1)
    sides = np.stack([_twice_area(p, q, others) for p, q in ((a, b), (b, c), (c, a))])
    return not ((sides >= -least).all(axis=0) & ~corner).any()


def _twice_area(a: Array, b: Array, c: Array) -> Array:
    """Return twice the signed area of the triangles of a, b (2,) and c (2,) or (n, 2)."""
    return (b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0])
