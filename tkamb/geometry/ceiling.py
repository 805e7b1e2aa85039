"""A coarse upper bound of a surface's height over x and z, for sparing rays."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

CELL = 2e-3
"""m; edge of the cells."""
WIDEST = 4
"""Cells along an edge; larger rectangles are dealt with one by one."""


class Ceiling:
    """The largest y of the triangles over each cell of an x-z grid.

    Rectangles are given by their corners `low` and `high` (n, 2), m, as x and z.

    Args:
        surface: any surface; its x and z span the grid.
    """

    def __init__(self, surface: Surface) -> None:
        low, high = surface.bounds[:, [0, 2]]
        self._origin = low
        self._shape = (int((high - low)[0] // CELL) + 1, int((high - low)[1] // CELL) + 1)
        self._height = np.full(self._shape, -np.inf)
        flat = surface.triangles[:, :, [0, 2]]
        tops = surface.triangles[:, :, 1].max(axis=1)
        for chosen, cells in self._covered(flat.min(axis=1), flat.max(axis=1)):
            np.maximum.at(self._height, cells, tops[chosen])
        self._cell = self._place(surface.vertices[:, [0, 2]])

    def over(self, points: Array) -> Array:
        """Return a height (n,), m, that the surface over the points (n, 3) does not exceed."""
        return np.asarray(self._height[tuple(self._place(points[:, [0, 2]]).T)])

    def over_rectangles(self, low: Array, high: Array) -> Array:
        """Return a height (n,), m, that the surface over each rectangle does not exceed."""
        heights = np.full(len(low), -np.inf)
        for chosen, cells in self._covered(low, high):
            np.maximum.at(heights, chosen, self._height[cells])
        return heights

    def vertices_in_rectangles(self, low: Array, high: Array) -> Mask:
        """Say which vertices of the surface may lie in any of the rectangles."""
        marked = np.zeros(self._shape, bool)
        for _, cells in self._covered(low, high):
            marked[cells] = True
        return np.asarray(marked[tuple(self._cell.T)])

    def _place(self, xz: Array) -> Index:
        index = np.floor((xz - self._origin) / CELL).astype(np.int64)
        return np.clip(index, 0, np.array(self._shape) - 1)

    def _covered(self, low: Array, high: Array) -> Iterator[tuple[Index, tuple[Index, Index]]]:
        """Yield rectangles (m,) and one cell (m,), (m,) that each of them covers."""
        first, last = self._place(low), self._place(high)
        wide = (last - first >= WIDEST).any(axis=1)
        for t in np.flatnonzero(wide):
            rows, columns = (np.arange(first[t, k], last[t, k] + 1) for k in (0, 1))
            cells = np.repeat(rows, len(columns)), np.tile(columns, len(rows))
            yield np.full(len(cells[0]), t), cells
        small = np.flatnonzero(~wide)
        first, last = first[small], last[small]
        for i in range(WIDEST):
            for j in range(WIDEST):
                inside = (first[:, 0] + i <= last[:, 0]) & (first[:, 1] + j <= last[:, 1])
                yield small[inside], (first[inside, 0] + i, first[inside, 1] + j)
