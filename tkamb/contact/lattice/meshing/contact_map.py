"""The contact surface of a lattice: nodes, areas and triangles."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.pair import ContactSurface
from tkamb.geometry.curved import CurvedSurface
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

# m: height above a node at which the ray to its triangle begins. Above the rounding of a
# mesh and below the next surface.
RAY_START_HEIGHT = 1e-4
# m: a node this near to a triangle lies on it. Coordinates in single precision are
# rounded by some 1e-9 m.
ON_MESH_DISTANCE = 1e-6


GAUSS_POINTS = 0.5 + np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / (2 * np.sqrt(3.0))
"""The 2 x 2 Gauss points of a face, in [0, 1]². Their weights are equal."""


@dataclass(frozen=True, eq=False)
class ContactMap(ContactSurface):
    """The contact surface of a lattice, with its undeformed contact nodes.

    Normals are area-weighted means over the triangles, areas `consistent_areas`. `lift` (c,), m, is
    the height of the smooth surface, from which gaps are measured, above the node.
    """

    lift: Array

    @cached_property
    def triangle_area(self) -> Array:
        """Areas of the triangles (k,), m²."""
        a, b, c = np.moveaxis(self.points[self.triangles], 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def contact_map(lattice: Lattice, insert: Surface) -> tuple[Index, ContactMap]:
    """Return the contact nodes (c,) that belong to a triangle, and their map."""
    nodes, triangles = np.unique(lattice.contact_triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3).astype(np.int64)
    points = lattice.nodes[nodes]
    area = consistent_areas(points, contact_squares(triangles))
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    cross = np.cross(b - a, c - a)
    normals = np.zeros((len(points), 3))
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], cross)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    rays = insert.rays
    thickness, lift = _thickness(points, rays, lattice.spacing), _lift(points, rays)
    return nodes.astype(np.int64), ContactMap(points, normals, area, thickness, triangles, lift)


def contact_squares(triangles: Index) -> Index:
    """Return the cell faces (k/2, 4) of the contact triangles (k, 3) of a `Lattice`.

    Triangles i and i + k/2 are the halves of face i, with its first and third corner.
    """
    first, second = np.split(triangles, 2)
    if not np.array_equal(first[:, [0, 2]], second[:, [0, 1]]):
        raise ValueError("the contact triangles are not halves of cell faces in the same order")
    return np.column_stack([first, second[:, 2]])


def consistent_areas(points: Array, squares: Index) -> Array:
    """Return the tributary area (n,) of each node, m².

    With the bilinear shape functions N_i of the faces, the area of node i is

        A_i = sum over faces of the integral of N_i dA

    A uniform pressure p has the consistent nodal forces p A_i, so that force over area is p at
    every node, also at corners, oblique outlines and near-triangles. Equal shares of the triangles
    would depend on the diagonals.

    Points (n, 3) are in m, squares (m, 4) the nodes around each face.

    Source:
        Hughes, The Finite Element Method, Dover 2000, section 3.2 (bilinear quadrilateral).
    """
    corners = points[squares]
    result = np.zeros(len(points))
    for u, v in GAUSS_POINTS:
        shape = np.array([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v])
        along_u = np.einsum("i,kix->kx", np.array([v - 1, 1 - v, v, -v]), corners)
        along_v = np.einsum("i,kix->kx", np.array([u - 1, -u, u, 1 - u]), corners)
        size = np.linalg.norm(np.cross(along_u, along_v), axis=1) / len(GAUSS_POINTS)
        for corner in range(4):
            np.add.at(result, squares[:, corner], shape[corner] * size)
    return result


def _thickness(points: Array, rays: RayCaster, spacing: Array) -> Array:
    """Return the insert's thickness below points, m, with voids."""
    inside = points - [0.0, 1e-3 * spacing[1], 0.0]
    distance = rays.last_exit(inside, (0.0, -1.0, 0.0))
    to_lowest = points[:, 1] - rays.surface.bounds[0, 1]
    return np.where(np.isfinite(distance), distance + 1e-3 * spacing[1], to_lowest)


def _lift(points: Array, rays: RayCaster) -> Array:
    up = np.array([0.0, 1.0, 0.0])
    distance, face, weights = rays.first_in_face(points + RAY_START_HEIGHT * up, -up)
    on_mesh = np.abs(distance - RAY_START_HEIGHT) < ON_MESH_DISTANCE
    lift = np.zeros(len(points))
    lift[on_mesh], _ = CurvedSurface.of(rays.surface).shift(face[on_mesh], weights[on_mesh], up)
    return lift
