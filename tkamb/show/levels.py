"""Pressure maps as pictures: interpolation onto a grid, and the edge of contact."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array, Mask
from tkamb.geometry.topology import counted
from tkamb.units import MILLIMETRE

# 1: a grid point belongs to a triangle if no barycentric coordinate is below minus this.
# It is above rounding.
EDGE_TOLERANCE = 1e-9
# m: upper limit of gaps, also of infinite ones. It is far above the gaps beside a
# contact.
LARGEST_GAP = 10 * MILLIMETRE
# Number of grid points around the contacts. The edge of contact is then drawn
# whole.
MARGIN_POINTS = 2


def pressure_levels(
    pressure: Array, gap: Array | None, triangles: NDArray[np.int64], peak: float
) -> Array:
    """Return levels (f, n) for drawing: positive up to 1 in contact, negative outside.

    A loaded point has its pressure divided by `peak`, an unloaded one beside it a level
    proportional to minus its gap. The picture interpolates linearly, so the drawn contact ends at
    level zero, on average halfway between loaded and unloaded points.

    Args:
        pressure: pressures (f, n), any unit; NaN in failed frames.
        gap: gaps (f, n), m; None: unloaded points beside the contact have equal levels.
        triangles: (k, 3) indices into the points.
        peak: pressure of level 1, in the unit of `pressure`; higher pressures have level 1.
    """
    share = np.clip(np.nan_to_num(pressure) / (peak or 1.0), 0.0, 1.0)
    apart = np.ones_like(share) if gap is None else np.clip(np.nan_to_num(gap), 0.0, LARGEST_GAP)
    touched = triangles[share.max(axis=0)[triangles].any(axis=1)]  # only these have an edge
    return np.stack(
        [_frame_levels(one, far, touched) for one, far in zip(share, apart, strict=True)]
    )


def _frame_levels(share: Array, apart: Array, triangles: NDArray[np.int64]) -> Array:
    loaded = share > 0
    level = np.where(loaded, share, -1.0)
    corners = loaded[triangles]
    rim = np.zeros(len(share), bool)
    rim[triangles[corners.any(axis=1) & ~corners.all(axis=1)]] = True
    outside, inside = rim & ~loaded, rim & loaded
    if outside.any():
        mean = float(apart[outside].mean())
        relative = apart[outside] / mean if mean > 0 else np.ones(int(outside.sum()))
        level[outside] = -np.minimum(relative * level[inside].mean(), 1.0)
    return level


class PageGrid:
    """A regular grid over an insert seen from above, in page coordinates (mm).

    Args:
        points: points (n, 3) of the insert's surface, m, insert frame.
        triangles: (k, 3) indices into the points.
        sign: 1.0: the page's right is insert +z; -1.0: it is insert -z.
        step_mm: distance between neighbouring grid points, mm.
    """

    def __init__(
        self, points: Array, triangles: NDArray[np.int64], sign: float, step_mm: float
    ) -> None:
        self._points, self._triangles, self._sign = points, triangles, sign
        self._step = step_mm
        across, up = sign * points[:, 2] / MILLIMETRE, points[:, 0] / MILLIMETRE
        self.across = np.arange(across.min(), across.max() + step_mm, step_mm)
        self.up = np.arange(up.max(), up.min() - step_mm, -step_mm)

    def extent(
        self, rows: slice = slice(None), columns: slice = slice(None)
    ) -> tuple[float, float, float, float]:
        """Return left, right, bottom and top edge of the grid, or of a part of it, mm."""
        half = 0.5 * self._step
        across, up = self.across[columns], self.up[rows]
        return across[0] - half, across[-1] + half, up[-1] - half, up[0] + half

    @cached_property
    def _hits(self) -> tuple[NDArray[np.bool_], NDArray[np.int64], Array]:
        """Mask (rows, columns) of grid points on the insert; indices and weights (m, 3) of three
        points for each.
        """
        step = self._step
        row = (self.up[0] - self._points[:, 0] / MILLIMETRE) / step
        column = (self._sign * self._points[:, 2] / MILLIMETRE - self.across[0]) / step
        corners = np.stack([row, column], axis=1)[self._triangles]
        face, place, weights = _covered(corners, (len(self.up), len(self.across)))
        height = (weights * self._points[self._triangles[face], 1]).sum(axis=1)
        order = np.argsort(height, kind="stable")  # the highest triangle is the visible one
        ids = np.full(len(self.up) * len(self.across), -1)
        ids[place[order]] = order
        over = ids >= 0
        chosen = ids[over]
        shape = len(self.up), len(self.across)
        return over.reshape(shape), self._triangles[face[chosen]], weights[chosen]

    def sample(self, values: Array, every: int = 1) -> Array:
        """Return fields interpolated linearly onto the grid (..., rows, columns).

        Rows run from anterior to posterior, columns to the page's right. Grid points off the
        insert hold -1.

        Args:
            values: values (..., n) at the points, one or more fields.
        """
        over, corners, weights = self._hits
        chosen = np.zeros(over.shape, bool)
        chosen[::every, ::every] = True
        corners, weights = corners[chosen[over]], weights[chosen[over]]
        over = over[::every, ::every]
        result = np.full((*values.shape[:-1], *over.shape), -1.0)
        for place in np.ndindex(values.shape[:-1]):
            result[place][over] = np.einsum("ij,ij->i", weights, values[place][corners])
        return result


def touched_part(touched: Mask) -> tuple[slice, slice]:
    """Return the rows and columns of a grid that enclose the contact, with a margin.

    Args:
        touched: mask (rows, columns) of grid points in contact; if it is empty, a few at the first
            corner are returned.
    """
    rows, columns = (_range(indices) for indices in np.nonzero(touched))
    return rows, columns


def _range(indices: NDArray[np.int64]) -> slice:
    low, high = (int(indices.min()), int(indices.max())) if len(indices) else (0, 1)
    return slice(max(low - MARGIN_POINTS, 0), high + MARGIN_POINTS + 1)


def _covered(
    corners: Array, shape: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return all pairs of a triangle and a grid point inside it.

    They are triangle, flat index of the point, and its barycentric weights (3).

    Args:
        corners: corners (k, 3, 2) in steps of the grid, row and column.
    """
    first = np.maximum(np.ceil(corners.min(axis=1) - EDGE_TOLERANCE), 0.0).astype(np.int64)
    last = np.minimum(np.floor(corners.max(axis=1) + EDGE_TOLERANCE), np.array(shape) - 1)
    size = np.maximum(last.astype(np.int64) - first + 1, 0)
    face, rank = counted(size.prod(axis=1))
    row, column = first[face, 0] + rank // size[face, 1], first[face, 1] + rank % size[face, 1]
    a, b, c = np.moveaxis(corners[face], 1, 0)
    point = np.stack([row, column], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):  # a triangle seen edge-on has no area
        second, third = _area(a, point, c) / _area(a, b, c), _area(a, b, point) / _area(a, b, c)
    weights = np.stack([1.0 - second - third, second, third], axis=1)
    inside = weights.min(axis=1) >= -EDGE_TOLERANCE
    return face[inside], (row * shape[1] + column)[inside], weights[inside]


def _area(a: Array, b: Array, c: Array) -> Array:
    """Return twice the signed areas (n,) of triangles (n, 2)."""
    u, v = b - a, c - a
    return np.asarray(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
