"""Bounds of a surface's height, which save most of the rays of a closest-point search."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, Index
from tkamb.geometry.surface import Surface


@dataclass(frozen=True)
class HeightBoundSettings:
    """The grid of planes that bounds a surface's height from below."""

    cell_edge: float = 1e-3
    """m: edge of a cell. Chosen: about the edge of a mesh's triangles."""
    most_cells: int = 400
    """Largest number of cells along an edge of the grid; a larger surface gets larger cells.
    Chosen: it bounds memory."""
    wide_triangle_cells: int = 4
    """Cells along an edge: triangles that span more are processed one by one. Chosen: such
    triangles are few."""
    largest_slope: float = 3.0
    """1: largest slope of a plane that bounds the height. Chosen: a steeper plane bounds too
    loosely."""


HEIGHT_BOUND = HeightBoundSettings()


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
        self._edge = max(
            HEIGHT_BOUND.cell_edge, float((high - low).max()) / HEIGHT_BOUND.most_cells
        )
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
        planes[..., :2] = np.clip(
            -total[..., ::2] / upward, -HEIGHT_BOUND.largest_slope, HEIGHT_BOUND.largest_slope
        )
        for chosen, cells in covered:
            rise = (planes[cells][:, None, :2] * xz[chosen]).sum(axis=2)
            np.maximum.at(planes[..., 2], cells, (heights[chosen] - rise).max(axis=1))
        return planes

    def _covered(self, low: Array, high: Array) -> Iterator[tuple[Index, tuple[Index, Index]]]:
        """Yield rectangles (m,) and one cell (m,), (m,) that each of them covers."""
        first, last = self._place(low), self._place(high)
        wide = (last - first >= HEIGHT_BOUND.wide_triangle_cells).any(axis=1)
        for t in np.flatnonzero(wide):
            rows, columns = (np.arange(first[t, k], last[t, k] + 1) for k in (0, 1))
            cells = np.repeat(rows, len(columns)), np.tile(columns, len(rows))
            yield np.full(len(cells[0]), t), cells
        small = np.flatnonzero(~wide)
        first, last = first[small], last[small]
        for i in range(HEIGHT_BOUND.wide_triangle_cells):
            for j in range(HEIGHT_BOUND.wide_triangle_cells):
                inside = (first[:, 0] + i <= last[:, 0]) & (first[:, 1] + j <= last[:, 1])
                yield small[inside], (first[inside, 0] + i, first[inside, 1] + j)
