"""Bounds of two surfaces' heights that spare first touch most of its rays."""

from collections.abc import Iterator
from functools import cached_property

import numpy as np

from tkamb.geometry.frames import Array, Index, rotate, transform
from tkamb.geometry.ragged import Ragged
from tkamb.geometry.surface import Surface

CELL_EDGE = 1e-3
"""m."""
MOST_CELLS = 400
"""Cells along an edge of the grid; a larger surface gets larger ones."""
WIDE_IN_CELLS = 4
"""Cells along an edge; larger triangles are dealt with one by one."""
LARGEST_SLOPE = 3.0
"""Rise over run of a bound's planes."""
PATCH_EDGE = 2e-3
"""m; edge of the cubes that patches are cut by."""
MOST_CUBES = 200
"""Cubes along an edge of the surface's box; a larger surface gets larger ones."""


class HeightBound:
    """Planes over the cells of an x-z grid that the surface, seen from above, stays under.

        y <= c + g . (x, z)      for every upward triangle over the cell

    g is the mean slope over the cell, so that the plane lies closer than the cell's largest
    height where the surface slopes. Such planes are kept for all windows of 1, 2, 4, 8 ...
    cells a side, so that a rectangle of any size is looked up at once.

    Args:
        surface: any surface; its x and z span the grid.
        lift: (n,) m, margin above each vertex that the lifted planes keep; none by default.
    """

    def __init__(self, surface: Surface, lift: Array | None = None) -> None:
        low, high = surface.bounds[:, [0, 2]]
        self._origin = low
        self._edge = max(CELL_EDGE, float((high - low).max()) / MOST_CELLS)
        self._last = ((high - low) // self._edge).astype(np.int64)
        self._cells, self._area = self._cell_planes(surface, lift)
        self._level = np.ceil(np.log2(np.arange(1, self._last.max() + 2))).astype(np.int64)
        number = np.ravel_multi_index(
            tuple(self._place(surface.vertices[:, [0, 2]]).T), tuple(self._last + 1)
        )
        self._vertices = Ragged.by_key(number, int(np.prod(self._last + 1)))

    def over(self, points: Array) -> Array:
        """Return a height (n,), m, that the surface over the points (n, 3) does not exceed."""
        xz = points[:, [0, 2]]
        plane = self._cells[tuple(self._place(xz).T)]
        return np.einsum("ij,ij->i", plane[:, :2], xz) + plane[:, 2]

    def planes(self, low: Array, high: Array) -> Array:
        """Return planes g, c, c' (n, 4) that the surface over rectangles stays under, m.

        c' is that of the lifted surface. -inf where there is none.

        Args:
            low: (n, 2) m, smallest x and z of each rectangle.
            high: (n, 2) m, largest.
        """
        first, last = self._place(low), self._place(high)
        size = np.maximum(last[:, 0] - first[:, 0], last[:, 1] - first[:, 1])
        found = self._planes[self._level[size], first[:, 0], first[:, 1]]
        (x, z), (end_x, end_z) = self._origin, self._origin + (self._last + 1) * self._edge
        outside = (high[:, 0] < x) | (high[:, 1] < z) | (low[:, 0] > end_x) | (low[:, 1] > end_z)
        found[outside] = [0.0, 0.0, -np.inf, -np.inf]
        return found

    def vertices_in_rectangles(self, low: Array, high: Array) -> Index:
        """Return the vertices of the surface that may lie in any of the rectangles."""
        first, last = self._place(low), self._place(high) + 1
        count = np.zeros(tuple(self._last + 2), np.int64)
        for i, j, sign in (
            (first, first, 1),
            (last, last, 1),
            (first, last, -1),
            (last, first, -1),
        ):
            np.add.at(count, (i[:, 0], j[:, 1]), sign)
        marked = count.cumsum(axis=0).cumsum(axis=1)[:-1, :-1].ravel() > 0
        return self._vertices.of(np.flatnonzero(marked))[1]

    def _place(self, xz: Array) -> Index:
        index = np.floor((xz - self._origin) / self._edge).astype(np.int64)
        return np.clip(index, 0, self._last)

    def _cell_planes(self, surface: Surface, lift: Array | None) -> tuple[Array, Array]:
        """Return the planes (i, j, 4) over each cell, and the area vectors (i, j, 3) in it."""
        faces = surface.faces[surface.face_normals[:, 1] > 0]
        triangles = surface.vertices[faces]
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        area, xz, heights = np.cross(b - a, c - a), triangles[:, :, [0, 2]], triangles[:, :, 1]
        lifted = heights if lift is None else heights + lift[faces]
        covered = list(self._covered(xz.min(axis=1), xz.max(axis=1)))
        total = np.zeros((*(self._last + 1), 3))
        for chosen, cells in covered:
            np.add.at(total, cells, area[chosen])
        planes = np.full((*total.shape[:2], 4), -np.inf)
        planes[..., :2] = _slopes(total)
        for chosen, cells in covered:
            rise = (planes[cells][:, None, :2] * xz[chosen]).sum(axis=2)
            np.maximum.at(planes[..., 2], cells, (heights[chosen] - rise).max(axis=1))
            np.maximum.at(planes[..., 3], cells, (lifted[chosen] - rise).max(axis=1))
        return planes, total

    @cached_property
    def _planes(self) -> Array:
        """Planes (k, i, j, 4) of windows of 2^k cells from each cell on.

        Four windows are joined to one of twice the edge, until one covers all.
        """
        planes, area = self._cells, self._area
        all_planes, size = [planes], 1
        corner = np.stack(np.meshgrid(*(np.arange(n + 1) for n in self._last), indexing="ij"), -1)
        low = self._origin + corner * self._edge
        places = [(i, j) for i in (0, 1) for j in (0, 1)]
        while size <= self._last.max():
            steps = [(size * i, size * j) for i, j in places]
            area = np.sum([_shifted(area, *step, 0.0) for step in steps], axis=0)
            joined = np.full_like(planes, -np.inf)
            joined[..., :2] = _slopes(area)
            for step in steps:
                plane = _shifted(all_planes[-1], *step, -np.inf)
                for i, j in places:
                    there = low + self._edge * (np.array(step) + size * np.array([i, j]))
                    rise = ((plane[..., :2] - joined[..., :2]) * there).sum(axis=-1)
                    joined[..., 2:] = np.maximum(joined[..., 2:], plane[..., 2:] + rise[..., None])
            all_planes.append(joined)
            size *= 2
        return np.stack(all_planes)

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


def _slopes(area: Array) -> Array:
    """Return the slopes (..., 2) along x and z of a mean area vector (..., 3)."""
    upward = np.maximum(area[..., 1:2], 1e-300)
    return np.clip(-area[..., ::2] / upward, -LARGEST_SLOPE, LARGEST_SLOPE)


def _shifted(grid: Array, i: int, j: int, beyond: float) -> Array:
    """Return the grid (m, n, d) read from (i, j) cells further on; `beyond` where it ends."""
    result = np.full_like(grid, beyond)
    result[..., :2] = 0.0
    rows, columns = max(grid.shape[0] - i, 0), max(grid.shape[1] - j, 0)
    result[:rows, :columns] = grid[i:, j:]
    return result


class Patches:
    """The triangles of a surface by the cube that holds their middle, each in a flat box.

    Args:
        surface: any surface.
        reach: (n,) m, a margin of each vertex; `self.reach` (p,) is the largest of each patch.
    """

    def __init__(self, surface: Surface, reach: Array) -> None:
        low, high = surface.bounds
        edge = max(PATCH_EDGE, float((high - low).max()) / MOST_CUBES)
        middle = np.maximum(surface.triangles.mean(axis=1) - low, 0.0)  # rounding may fall below
        cube = np.floor(middle / edge).astype(np.int64)
        key = np.ravel_multi_index(tuple(cube.T), tuple(cube.max(axis=0) + 1))
        used, patch = np.unique(key, return_inverse=True)
        self._faces = Ragged.by_key(patch.reshape(-1), len(used))
        faces, begin = self._faces.items, self._faces.first[:-1]
        self._axes = _frames(np.add.reduceat(surface.face_normals[faces], begin))
        axes = np.repeat(self._axes, np.diff(self._faces.first), axis=0)
        along = np.einsum("kij,kcj->kci", axes, surface.triangles[faces])
        lowest = np.minimum.reduceat(along.min(axis=1), begin)
        highest = np.maximum.reduceat(along.max(axis=1), begin)
        self._centre = np.einsum("pij,pi->pj", self._axes, (lowest + highest) / 2)
        self._half = (highest - lowest) / 2
        self.reach = np.maximum.reduceat(reach[surface.faces].max(axis=1)[faces], begin)

    def extent(self, pose: Array) -> tuple[Array, Array]:
        """Return the corners low and high (p, 3), m, of a box about each patch at a pose (4, 4)."""
        turned = np.abs(self._axes @ pose[:3, :3].T)
        centre, half = transform(pose, self._centre), np.einsum("pij,pi->pj", turned, self._half)
        return centre - half, centre + half

    def least(self, pose: Array, chosen: Index, directions: Array) -> Array:
        """Return a lower bound (n,) of d . x over chosen patches, for directions d (n, 3)."""
        own = rotate(pose.T, directions)
        across = np.abs(np.einsum("pij,pj->pi", self._axes[chosen], own))
        middle = np.einsum("ij,ij->i", transform(pose, self._centre[chosen]), directions)
        return middle - np.einsum("ij,ij->i", across, self._half[chosen])

    def faces(self, chosen: Index) -> Index:
        """Return the triangles of the chosen patches."""
        return self._faces.of(chosen)[1]


def _frames(normals: Array) -> Array:
    """Return orthonormal axes (p, 3, 3), rows, the first along each normal (p, 3)."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    first = np.where(length > 0, normals / np.where(length > 0, length, 1.0), [0.0, 1.0, 0.0])
    second = np.cross(first, np.eye(3)[np.abs(first).argmin(axis=1)])
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=1)
