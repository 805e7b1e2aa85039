"""Nearest points of a triangulated surface, and samples that cover one."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from tkamb.geometry.frames import Array, Index
from tkamb.geometry.normals import NO_CREASE, corner_normals, mean_normals
from tkamb.geometry.tree import TriangleTree, nearest_points, rows

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


_MOST_SAMPLES = 150_000


@dataclass(frozen=True, eq=False)
class Nearest:
    """Nearest points of a surface to n points.

    Args:
        distance: (n,) m.
        faces: (n,) triangle of each.
        weights: (n, 3) barycentric coordinates in it.
        surface: whose points they are.
    """

    distance: Array
    faces: Index
    weights: Array
    surface: "NearestPoints"

    @cached_property
    def points(self) -> Array:
        """The points (n, 3), m, on the surface."""
        return np.einsum("ij,ijk->ik", self.weights, self.surface.surface.triangles[self.faces])

    @cached_property
    def normals(self) -> Array:
        """Unit normals (n, 3) there, interpolated from the vertices."""
        return mean_normals(self.weights, self.surface.corner_normals[self.faces])


class NearestPoints:
    """Answers for the nearest points of one surface, exactly.

    Args:
        surface: whose points they are.
        tree: of its triangles, if there is one."""

    def __init__(self, surface: "Surface", tree: TriangleTree | None = None) -> None:
        self.surface = surface
        tree = TriangleTree(surface) if tree is None else tree
        self._tree = tree.boxes, tree.faces, tree.corners

    @cached_property
    def corner_normals(self) -> Array:
        """Unit normals (k, 3, 3) of the vertices, weighted by the areas of their triangles."""
        area = self.surface.areas[:, None] * np.ones(3)
        return corner_normals(self.surface, NO_CREASE, area)

    def at(self, points: ArrayLike) -> Nearest:
        """Return the nearest points to `points` (n, 3), m, in the surface's frame.

        NaN, infinitely far, in the triangle -1, for a point that is not finite.
        """
        return self._found(points, np.inf)

    def within(self, points: Array, reach: float) -> tuple[Index, Nearest]:
        """Return which points (n, 3) have one within `reach`, m, and what `at` says of those."""
        found = self._found(points, reach)
        near = np.flatnonzero(found.faces >= 0)
        return near, Nearest(found.distance[near], found.faces[near], found.weights[near], self)

    def _found(self, points: ArrayLike, reach: float) -> Nearest:
        return Nearest(*nearest_points(*self._tree, rows(points), float(reach)), self)


def sampled(surface: "Surface", spacing: float) -> tuple[Array, Index, Array]:
    """Return samples (n, 3) that cover every triangle, the triangle (n,) and area (n,) of each.

    A triangle is cut into n² like ones so that no edge is longer than the spacing; the
    samples are their centres. The spacing grows where a surface would need more than
    150 000 samples.
    """
    triangles = surface.triangles
    longest = surface.longest_edges
    cuts = np.maximum(np.ceil(longest / spacing).astype(int), 1)
    while (cuts**2).sum() > max(_MOST_SAMPLES, len(triangles)) and cuts.max() > 1:
        spacing *= 1.2
        cuts = np.maximum(np.ceil(longest / spacing).astype(int), 1)
    area = surface.areas / cuts**2
    samples, faces = [], []
    for n in np.unique(cuts):
        members = np.flatnonzero(cuts == n)
        samples.append(np.einsum("sj,kjc->ksc", _centres(int(n)), triangles[members]))
        faces.append(np.repeat(members, n * n))
    owner = np.concatenate(faces)
    return np.concatenate([s.reshape(-1, 3) for s in samples]), owner, area[owner]


def _centres(n: int) -> Array:
    """Return barycentric centres (n², 3) of a triangle cut n times along each edge."""
    i, j = np.divmod(np.arange(n * n), n)
    upright, inverted = i + j < n, i + j < n - 1
    first = np.concatenate([i[upright] + 1 / 3, i[inverted] + 2 / 3]) / n
    second = np.concatenate([j[upright] + 1 / 3, j[inverted] + 2 / 3]) / n
    return np.stack([1 - first - second, first, second], axis=1)
