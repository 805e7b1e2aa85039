"""The contact surface of a lattice: its nodes, areas and triangles."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.pair import ContactSurface
from tkamb.geometry.curved import CurvedSurface
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

ABOVE = 1e-4
"""m: rays that ask which triangle a node lies on start so far above it."""
ON_MESH = 1e-6
"""m: a node this near to a triangle lies on it."""


@dataclass(frozen=True, eq=False)
class ContactMap(ContactSurface):
    """The contact surface of a lattice: its undeformed contact nodes.

    Normals are area-weighted over the triangles, a node's area is a third of each of its
    triangles.

    Args:
        lift: (c,) m along y, from the node on the mesh to the smooth surface that the mesh
            stands for; the contact sees the node there.
    """

    lift: Array

    @cached_property
    def triangle_area(self) -> Array:
        """Areas of the triangles (k,), m²."""
        a, b, c = np.moveaxis(self.points[self.triangles], 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def contact_map(lattice: Lattice, insert: Surface) -> tuple[Index, ContactMap]:
    """Return the contact nodes (c,) that carry a triangle, and their map."""
    nodes, triangles = np.unique(lattice.contact_triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3).astype(np.int64)
    points = lattice.nodes[nodes]
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    cross = np.cross(b - a, c - a)
    area, normals = np.zeros(len(points)), np.zeros((len(points), 3))
    for corner in range(3):
        np.add.at(area, triangles[:, corner], np.linalg.norm(cross, axis=1) / 6)
        np.add.at(normals, triangles[:, corner], cross)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    rays = insert.rays
    thickness, lift = _thickness(points, rays, lattice.spacing), _lift(points, rays)
    return nodes.astype(np.int64), ContactMap(points, normals, area, thickness, triangles, lift)


def _thickness(points: Array, rays: RayCaster, spacing: Array) -> Array:
    """Return how far down from each point the insert goes, m; to the last exit, voids included."""
    inside = points - [0.0, 1e-3 * spacing[1], 0.0]
    ray, distance, _ = rays.all(inside, (0.0, -1.0, 0.0))
    last = np.full(len(points), -np.inf)
    np.maximum.at(last, ray, distance)
    whole = points[:, 1] - rays.surface.bounds[0, 1]
    return np.where(np.isfinite(last), last + 1e-3 * spacing[1], whole)


def _lift(points: Array, rays: RayCaster) -> Array:
    """Return how far the smooth surface is above the points, m; 0 for one not on the mesh."""
    up = np.array([0.0, 1.0, 0.0])
    distance, face, weights = rays.first_in_face(points + ABOVE * up, -up)
    on = np.abs(distance - ABOVE) < ON_MESH
    lift = np.zeros(len(points))
    lift[on], _ = CurvedSurface.of(rays.surface).shift(face[on], weights[on], up)
    return lift
