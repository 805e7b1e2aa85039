"""Bounds of a surface's height that spare closest points most of their rays."""

from collections.abc import Iterator

import numpy as np

from tkamb.geometry.frames import Array, Index
from tkamb.geometry.surface import Surface

CELL_EDGE = 1e-3
"""m."""
MOST_CELLS = 400
"""Cells along an edge of the grid; a larger surface gets larger ones."""
WIDE_IN_CELLS = 4
"""Cells along an edge; larger triangles are dealt with one by one."""
LARGEST_SLOPE = 3.0
"""Rise over run of a bound's planes."""


class HeightBound:
    """Planes over the cells of an x-z grid that the surface, seen from above, stays under.

        y <= c + g . (x, z)      for every upward triangle over the cell

    g is the mean slope over the cell, so that the plane lies closer than the cell's largest
    height where the surface slopes.

    Args:
        surface: any surface; its x and z span the grid.
    """

    def __init__(self, surface: Surface) -> None:
        low, high = surface.bounds[:, [0, 2]]
        self._origin = low
        self._edge = max(CELL_EDGE, float((high - low).max()) / MOST_CELLS)
        self._last = ((high - low) // self._edge).astype(np.int64)
        self._cells = self._cell_planes(surface)

    def over(self, points: Array) -> Array:
        """Return a height (n,), m, that the surface over the points (n, 3) does not exceed."""
        xz = points[:, [0, 2]]
        plane = self._cells[tuple(self._place(xz).T)]
        return np.einsum("ij,ij->i", plane[:, :2], xz) + plane[:, 2]

    def _place(self, xz: Array) -> Index:
        index = np.floor((xz - self._origin) / self._edge).astype(np.int64)
        return np.clip(index, 0, self._last)

    def _cell_planes(self, surface: Surface) -> Array:
        """Return the planes (i, j, 3) over each cell."""
        faces = surface.faces[surface.face_normals[:, 1] > 0]
        triangles = surface.vertices[faces]
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        area, xz, heights = np.cross(b - a, c - a), triangles[:, :, [0, 2]], triangles[:, :, 1]
        covered = list(self._covered(xz.min(axis=1), xz.max(axis=1)))
        total = np.zeros((*(self._last + 1), 3))
        for chosen, cells in covered:
            np.add.at(total, cells, area[chosen])
        planes = np.full(total.shape, -np.inf)
        upward = np.maximum(total[..., 1:2], 1e-300)
        planes[..., :2] = np.clip(-total[..., ::2] / upward, -LARGEST_SLOPE, LARGEST_SLOPE)
        for chosen, cells in covered:
            rise = (planes[cells][:, None, :2] * xz[chosen]).sum(axis=2)
            np.maximum.at(planes[..., 2], cells, (heights[chosen] - rise).max(axis=1))
        return planes

    def _covered(self, low: Array, high: Array) -> Iterator[tuple[Index, tuple[Index, Index]]]:
        """Yield rectangles (m,) and one cell (m,), (m,) that each of them covers."""
        first, last = self._place(low), self._place(high)
        wide = (last - first >= WIDE_IN_CELLS).any(axis=1)
        for t in np.flatnonzero(wide):
            rows, columns = (np.arange(first[t, k], last[t, k] + 1) for k in (0, 1))
            cells = np.repeat(rows, len(columns)), np.tile(columns, len(rows))
            yield np.full(len(cells[0]), t), cells
        small = np.flatnonzero(~wide)
        first, last = first[small], last[small]
        for i in range(WIDE_IN_CELLS):
            for j in range(WIDE_IN_CELLS):
                inside = (first[:, 0] + i <= last[:, 0]) & (first[:, 1] + j <= last[:, 1])
                yield small[inside], (first[inside, 0] + i, first[inside, 1] + j)
