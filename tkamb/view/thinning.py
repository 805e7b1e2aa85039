"""Fewer triangles for drawing: vertices that lie in one plane, or on one edge, become one.

Vertices are gathered in the cells of an octree, from small cells to large. A cell's vertices
become one where a single point keeps close to the planes of all their triangles: the point of
least mean square distance (quadric error, Garland & Heckbert 1997; one per cell of a grid,
Lindstrom 2000). Flat parts so become large triangles, edges and fillets keep their own.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.geometry.nearest import NearestPoints
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

FIRST_TOLERANCE = 0.01 * MILLIMETRE
"""m, root mean square distance of a merged vertex from its planes; grows until few are left."""
GROWTH = 1.5
SMALLEST_CELL = 0.5 * MILLIMETRE
CELL_SIZES = 7
FLAT = 3e-3
"""Eigenvalue, as a share of the largest, below which the planes leave a direction open."""

UPPER = np.triu_indices(4)

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Quadrics:
    """Sums over triangles of area times the squared distance from their planes.

    Args:
        planes: (n, 4, 4) sum of area times p pᵀ with p the plane's normal and offset.
        areas: (n,) sum of the areas.
    """

    planes: Array
    areas: Array

    def gathered(self, groups: Index) -> "Quadrics":
        """Return the sums over groups, numbered from 0 (n,)."""
        count = int(groups.max()) + 1
        planes = np.empty((count, 4, 4))
        for i, j in zip(*UPPER, strict=True):
            planes[:, i, j] = np.bincount(groups, self.planes[:, i, j], count)
            planes[:, j, i] = planes[:, i, j]
        return Quadrics(planes, np.asarray(np.bincount(groups, self.areas, count), float))

    def best_points(self, start: Array) -> tuple[Array, Array]:
        """Return the points (n, 3) nearest to `start` of least error, and that error (n,) m."""
        hessian = self.planes[:, :3, :3]
        slope = np.einsum("nij,nj->ni", hessian, start) + self.planes[:, :3, 3]
        size, axes = np.linalg.eigh(hessian)
        open_ways = size <= FLAT * size[:, -1:]
        step = np.where(open_ways, 0.0, 1.0) / np.where(open_ways, 1.0, size)
        point = start - np.einsum("nij,nj,nkj,nk->ni", axes, step, axes, slope)
        whole = np.column_stack([point, np.ones(len(point))])
        square = np.einsum("ni,nij,nj->n", whole, self.planes, whole)
        area = np.where(self.areas > 0.0, self.areas, 1.0)
        return point, np.sqrt(np.maximum(square, 0.0) / area)


def thinned(surface: Surface, most_triangles: int) -> tuple[Surface, float]:
    """Return a surface of at most so many triangles, and how far (m) the two lie apart at most.

    The distance is measured from the vertices and triangle centres of each to the other.
    """
    if len(surface.faces) <= most_triangles:
        return surface, 0.0
    levels, tolerance = _levels(surface), FIRST_TOLERANCE
    while True:
        fewer = _merged(surface, levels, tolerance)
        if len(fewer.faces) <= most_triangles:
            return _compared(fewer, surface)
        tolerance *= GROWTH


@dataclass(frozen=True, eq=False)
class Level:
    """The cells of one size.

    Args:
        cell: (n,) of each vertex.
        point: (c, 3) m, the vertex that would stand for a cell's.
        error: (c,) m, its root mean square distance from their planes; inf if it lies astray.
    """

    cell: Index
    point: Array
    error: Array


def _levels(surface: Surface) -> list[Level]:
    quadrics, vertices = _of_vertices(surface), surface.vertices
    levels = []
    for size in SMALLEST_CELL * 2.0 ** np.arange(CELL_SIZES):
        places = np.floor((vertices - surface.bounds[0]) / size).astype(np.int64)
        cell = np.unique(places @ (1, 1 << 20, 1 << 40), return_inverse=True)[1].ravel()
        own = np.bincount(cell)
        mean = np.stack([np.bincount(cell, x) / own for x in vertices.T], axis=1)
        point, error = quadrics.gathered(cell).best_points(mean)
        astray = np.abs(point - mean).max(axis=1) > size
        levels.append(Level(cell, point, np.where(astray, np.inf, error)))
    return levels


def _of_vertices(surface: Surface) -> Quadrics:
    corners = surface.triangles
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(across, axis=1)
    offset = -np.einsum("ij,ij->i", surface.face_normals, corners[:, 0])
    plane = np.column_stack([surface.face_normals, offset])
    products = areas[:, None, None] * plane[:, :, None] * plane[:, None, :]
    whole = Quadrics(np.repeat(products, 3, axis=0), np.repeat(areas, 3))
    return whole.gathered(surface.faces.ravel())


def _merged(surface: Surface, levels: list[Level], tolerance: float) -> Surface:
    """Return the surface with the vertices of each good cell made one, the largest it can be."""
    count = len(surface.vertices)
    label, place = np.arange(count), surface.vertices.copy()
    growing = np.ones(count, bool)
    for number, level in enumerate(levels, start=1):
        good = level.error < tolerance
        good[level.cell[~growing]] = False
        growing = good[level.cell]
        label[growing] = count * number + level.cell[growing]
        place[growing] = level.point[level.cell[growing]]
    _, first, vertex = np.unique(label, return_index=True, return_inverse=True)
    faces = vertex.ravel()[surface.faces]
    ends = np.sort(faces, axis=1)
    whole = np.flatnonzero((ends[:, 0] < ends[:, 1]) & (ends[:, 1] < ends[:, 2]))
    _, kept = np.unique(ends[whole] @ (1, count, count**2), return_index=True)
    return Surface(place[first], faces[whole[np.sort(kept)]], surface.name)


def _compared(fewer: Surface, surface: Surface) -> tuple[Surface, float]:
    """Return the thinned surface with every triangle facing outwards, and its distance (m).

    Where vertices of a fold become one a triangle may come to lie face down.
    """
    whole, own = NearestPoints(surface), NearestPoints(fewer)
    near = whole.at(fewer.triangles.mean(axis=1))
    down = np.einsum("ij,ij->i", near.normals, fewer.face_normals) < 0.0
    faces = fewer.faces.copy()
    faces[down] = faces[down, ::-1]
    distances = (
        near.distance,
        whole.at(fewer.vertices).distance,
        own.at(surface.vertices).distance,
        own.at(surface.triangles.mean(axis=1)).distance,
    )
    error = max(float(distance.max()) for distance in distances)
    return Surface(fewer.vertices, faces, fewer.name), error
