"""Pressure between a map's points, for the eye: where contact ends, and a grid to draw it on."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

FAR = 10 * MILLIMETRE
"""A gap above this, infinite where nothing lies above, counts as this."""


def pressure_levels(
    pressure: Array, gap: Array | None, triangles: NDArray[np.int64], peak: float
) -> Array:
    """Return pressures as levels (f, n): up to 1 where loaded, negative where not.

    A loaded point holds its share of `peak`. Between a loaded and an unloaded point the contact
    ends where the level, drawn linearly, is zero: an unloaded point at the rim holds minus its
    gap, scaled so that on average the rim lies halfway. At the points themselves the levels are
    the data's.

    Args:
        pressure: (f, n), any unit; NaN where the frame failed.
        gap: (f, n) m, positive when apart; None: the rim lies halfway everywhere.
        triangles: (k, 3) indices into the points.
        peak: top of the scale in the pressure's unit; a higher pressure has level 1.
    """
    share = np.clip(np.nan_to_num(pressure) / (peak or 1.0), 0.0, 1.0)
    apart = np.ones_like(share) if gap is None else np.clip(np.nan_to_num(gap), 0.0, FAR)
    return np.stack(
        [_frame_levels(one, far, triangles) for one, far in zip(share, apart, strict=True)]
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
    """A regular grid over an insert as one looks down on it, in page coordinates (mm).

    Args:
        points: (n, 3) m, insert frame.
        triangles: (k, 3) indices.
        sign: 1.0, or -1.0 where the page's right is insert -z.
        step_mm: between the grid's points.
    """

    def __init__(
        self, points: Array, triangles: NDArray[np.int64], sign: float, step_mm: float
    ) -> None:
        self._surface, self._sign = Surface(points, triangles, "map"), sign
        across, up = sign * points[:, 2] / MILLIMETRE, points[:, 0] / MILLIMETRE
        self.across = np.arange(across.min(), across.max() + step_mm, step_mm)
        self.up = np.arange(up.max(), up.min() - step_mm, -step_mm)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top edge of the outermost cells, mm."""
        half = 0.5 * (self.across[1] - self.across[0])
        across, up = self.across, self.up
        return across[0] - half, across[-1] + half, up[-1] - half, up[0] + half

    @cached_property
    def _hits(self) -> tuple[NDArray[np.bool_], NDArray[np.int64], Array]:
        """Which grid points (rows, columns) lie over the insert, its points there, weights."""
        x, z = np.meshgrid(
            self.up * MILLIMETRE, self._sign * self.across * MILLIMETRE, indexing="ij"
        )
        above = np.full(x.size, self._surface.bounds[1, 1] + MILLIMETRE)
        origins = np.column_stack([x.ravel(), above, z.ravel()])
        _, face, weights = self._surface.rays.first_in_face(origins, (0.0, -1.0, 0.0))
        over = face >= 0
        return over.reshape(x.shape), self._surface.faces[face[over]], weights[over]

    def sample(self, values: Array, every: int = 1) -> Array:
        """Return values (..., n) of the points on the grid (..., rows, columns).

        Linear in a triangle. Rows run from the anterior edge down, columns to the page's right;
        -1 off the insert.

        Args:
            values: (..., n), one or more fields.
            every: which rows and columns: all, every second ...
        """
        over, corners, weights = self._hits
        chosen = np.zeros(over.shape, bool)
        chosen[::every, ::every] = True
        corners, weights = corners[chosen[over]], weights[chosen[over]]
        over = over[::every, ::every]
        found = np.full((*values.shape[:-1], *over.shape), -1.0)
        for here in np.ndindex(values.shape[:-1]):
            found[here][over] = np.einsum("ij,ij->i", weights, values[here][corners])
        return found
