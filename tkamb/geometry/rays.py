"""Rays against a triangulated surface, in double precision."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from tkamb.geometry.frames import Array, Index
from tkamb.geometry.tree import TriangleTree, all_crossings, first_crossings, rows

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


EDGE_TOLERANCE = 1e-9
"""How far outside a triangle, in barycentric units, a crossing still belongs to it."""
SAME_CROSSING = 1e-10
"""Crossings of one ray nearer than this, relative to the part's radius, are one crossing."""
USUAL = 4
"""Crossings of a ray that there is room for at first."""


class RayCaster:
    """Crossings of rays with one surface.

    A ray that touches an edge or vertex of the surface's outline may be a hit or a miss; on
    edges and vertices inside the surface there are no leaks. Distances are exact to rounding
    (about 1e-16 m over the sine of the incidence) in the plane of the triangle reported.

    Args:
        surface: (n, 3) vertices in metres, any frame; rays are given in the same frame.
        tree: of its triangles, if there is one.
    """

    def __init__(self, surface: "Surface", tree: TriangleTree | None = None) -> None:
        self.surface = surface
        tree = TriangleTree(surface) if tree is None else tree
        lower, upper = surface.bounds
        self._same = SAME_CROSSING * float(np.linalg.norm(upper - lower)) / 2.0
        rows = surface.barycentric_rows.reshape(-1, 6)
        planes = np.hstack([surface.triangles[:, 0], surface.face_normals, rows])
        self._tree = tree.boxes, tree.faces, planes[tree.faces]

    def first(self, origins: ArrayLike, directions: ArrayLike) -> tuple[Array, Index]:
        """Return the nearest crossing of each ray at or beyond its origin.

        Args:
            origins: (n, 3) m.
            directions: (n, 3) or (3,), any length but zero.

        Returns:
            distance (n,) m, inf where nothing is hit; face (n,), -1 where nothing is hit.
        """
        distance, face, _ = self.first_in_face(origins, directions)
        return distance, face

    def first_in_face(
        self, origins: ArrayLike, directions: ArrayLike
    ) -> tuple[Array, Index, Array]:
        """Return what `first` does, and where in the triangle each ray crosses.

        Returns:
            distance (n,) m, face (n,), barycentric coordinates (n, 3), NaN where nothing is hit.
        """
        rays = _rays(origins, directions)
        return first_crossings(*self._tree, *rays, -self._same, EDGE_TOLERANCE)

    def all(self, origins: ArrayLike, directions: ArrayLike) -> tuple[Index, Array, Index]:
        """Return every crossing of every ray at or beyond its origin.

        A crossing at an edge or vertex shared by triangles that face the same way is reported
        once.

        Args:
            origins: (n, 3) m.
            directions: (n, 3) or (3,), any length but zero.

        Returns:
            ray (m,), distance (m,) m and face (m,), sorted by ray, then by distance.
        """
        rays = _rays(origins, directions)
        number, room = USUAL * len(rays[0]), -1
        while number > room:
            room = number
            ray, distance, face = (np.empty(room, kind) for kind in (np.int64, float, np.int64))
            number = all_crossings(
                *self._tree, *rays, -self._same, EDGE_TOLERANCE, ray, distance, face
            )
        return self._merged(ray[:number], distance[:number], face[:number], rays[1])

    def _merged(
        self, ray: Index, t: Array, face: Index, directions: Array
    ) -> tuple[Index, Array, Index]:
        """Return the crossings sorted, one per place and facing."""
        along = directions[ray] if len(directions) > 1 else directions
        entering = (along * self.surface.face_normals[face]).sum(axis=1) < 0.0
        order = np.lexsort((face, t, entering, ray))
        ray, t, face, entering = ray[order], t[order], face[order], entering[order]
        same = (np.diff(ray) == 0) & (np.diff(t) <= self._same)
        keep = np.ones(len(ray), bool)
        keep[1:] = ~(same & (entering[1:] == entering[:-1]))
        ray, t, face = ray[keep], t[keep], face[keep]
        order = np.lexsort((t, ray))
        return ray[order], t[order], face[order]


def _rays(origins: ArrayLike, directions: ArrayLike) -> tuple[Array, Array]:
    """Return origins (n, 3) and directions (n, 3), or (1, 3) for all."""
    rays = rows(origins), rows(directions)
    if len(rays[1]) not in (1, len(rays[0])):
        raise ValueError(f"{len(rays[1])} directions for {len(rays[0])} rays")
    return rays
