"""Lines on a surface: U and V splines with their normals, and arc lengths.

A U line connects the points of a grid with the same z by a cubic spline y(x), a V line the points
with the same x by y(z). The tangents (1, y_x, 0) and (0, y_z, 1) span the tangent plane.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface

Index = NDArray[np.int64]

STEP = 5e-4
"""m: spacing of the samples of an arc."""
LEAST_SAMPLES = 9
"""Smallest number of samples of an arc."""


@dataclass(frozen=True, eq=False)
class UVLines:
    """Points of a height field y(x, z) with the slopes of their U and V lines.

    Args:
        points: (n, 3) m.
        slope_x: (n,) dy/dx along the U line; NaN for a point alone on its line.
        slope_z: (n,) dy/dz along the V line; NaN for a point alone on its line.
    """

    points: Array
    slope_x: Array
    slope_z: Array

    @property
    def normals(self) -> Array:
        """Unit normals (n, 3), up: cross product of the V and the U tangent."""
        return _unit(np.column_stack([-self.slope_x, np.ones(len(self.points)), -self.slope_z]))

    @property
    def mean_line_normals(self) -> Array:
        """Normals (n, 3) of Sharma (2008): the mean of the normals of the U and the V line.

        On a slope along one of the lines the error is half the slope.
        """
        zero, one = np.zeros(len(self.points)), np.ones(len(self.points))
        of_u = _unit(np.column_stack([-self.slope_x, one, zero]))
        of_v = _unit(np.column_stack([zero, one, -self.slope_z]))
        return _unit(of_u + of_v)


def draw_uv_lines(points: Array, i: Index, k: Index) -> UVLines:
    """Return the U and V lines through points of a grid; a missing point interrupts a line.

    Args:
        points: (n, 3) m, at most one per column of the grid.
        i: (n,) index of the column along x.
        k: (n,) index of the column along z.
    """
    return UVLines(
        points,
        _slopes(points[:, 0], points[:, 1], along=i, line=k),
        _slopes(points[:, 2], points[:, 1], along=k, line=i),
    )


def arc_lengths(surface: Surface, start: Array, end: Array, side: float = 1.0) -> Array:
    """Return lengths (n,), m, along the surface from start to end, in vertical planes.

    Rays along y at steps of 0.5 mm meet the surface, which must be a height field. A cubic spline
    connects the crossings, and sqrt(1 + (dy/ds)²) is integrated along it. The length is NaN if a
    ray does not meet the surface.

    Args:
        surface: surface in a frame with a vertical y axis.
        start: (n, 3) m; only x and z are used.
        end: (n, 3) m; only x and z are used.
        side: 1 for the upper surface (an insert), -1 for the lower one (a femur).
    """
    start, end = (np.atleast_2d(np.asarray(p, float)) for p in (start, end))
    across = np.linalg.norm((end - start)[:, [0, 2]], axis=1)
    count = max(int(np.ceil(across.max(initial=0.0) / STEP)) + 1, LEAST_SAMPLES)
    share = np.linspace(0.0, 1.0, count)
    samples = start[:, None] + share[:, None] * (end - start)[:, None]
    heights = _heights(surface, samples.reshape(-1, 3), side).reshape(len(start), count)
    complete = np.isfinite(heights).all(axis=1)
    lengths = np.full(len(start), np.nan)
    if complete.any():
        slope = CubicSpline(share, heights[complete], axis=1).derivative()
        fine, weights = _gauss_points(share)
        rate = np.hypot(across[complete, None], slope(fine))
        lengths[complete] = rate @ weights
    return lengths


def _heights(surface: Surface, points: Array, side: float) -> Array:
    origins = points.copy()
    low, high = surface.bounds[:, 1]
    origins[:, 1] = high + 1e-3 if side > 0 else low - 1e-3
    distance, _ = surface.rays.first(origins, (0.0, -side, 0.0))
    return np.where(np.isfinite(distance), origins[:, 1] - side * distance, np.nan)


def _gauss_points(knots: Array) -> tuple[Array, Array]:
    """Return three Gauss points and weights on every span between knots."""
    node, weight = np.polynomial.legendre.leggauss(3)
    half, middle = np.diff(knots) / 2.0, (knots[1:] + knots[:-1]) / 2.0
    return (middle[:, None] + half[:, None] * node).ravel(), (half[:, None] * weight).ravel()


def _slopes(place: Array, height: Array, along: Index, line: Index) -> Array:
    """Return the slope of the spline at every point; NaN for a point alone on its line."""
    order = np.lexsort((along, line))
    gap = (np.diff(line[order]) != 0) | (np.diff(along[order]) != 1)
    slope = np.full(len(place), np.nan)
    for run in np.split(order, np.flatnonzero(gap) + 1):
        if len(run) > 1:
            slope[run] = CubicSpline(place[run], height[run])(place[run], 1)
    return slope


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
