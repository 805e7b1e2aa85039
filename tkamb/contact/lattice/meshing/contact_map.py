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


@dataclass(frozen=True)
class ContactMapSettings:
    """Which triangle of the insert a contact node lies on."""

    ray_start_height: float = 1e-4
    """m: height above a node at which the ray that looks for its triangle begins. Chosen: above the
    rounding of a mesh, below the next surface."""
    on_mesh_distance: float = 1e-6
    """m: a node this near to a triangle lies on it. Chosen: meshes in single precision round by
    some 1e-9 m."""


CONTACT_MAP = ContactMapSettings()

GAUSS_POINTS = 0.5 + np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / (2 * np.sqrt(3.0))
"""The 2 x 2 Gauss points of a face, in [0, 1]², of equal weight."""


@dataclass(frozen=True, eq=False)
class ContactMap(ContactSurface):
    """The contact surface of a lattice: its undeformed contact nodes.

    Normals are area-weighted over the triangles. A node's area is the consistent one of its
    squares, see `consistent_areas`.

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
    """Return the cell faces (k/2, 4) that the triangles of a `Lattice` halve.

    `Lattice.contact_triangles` holds the first half of every face and then, in the same order,
    the second half; both share the face's first and third corner.
    """
    first, second = np.split(triangles, 2)
    if not np.array_equal(first[:, [0, 2]], second[:, [0, 1]]):
        raise ValueError("the contact triangles are not halves of cell faces, in order")
    return np.column_stack([first, second[:, 2]])


def consistent_areas(points: Array, squares: Index) -> Array:
    """Return the area (n,) that belongs to each node, m².

    A uniform pressure p on the cell faces acts on node i with the consistent nodal force p A_i,
    where N_i is the bilinear shape function of the node on each of its faces:

        A_i = sum over faces of the integral of N_i dA

    The force over this area is therefore p at every node, also at a corner, at an outline that
    crosses the grid at an angle, and where a face is drawn out to a triangle. Equal shares of
    the triangles would give the two corners of a square that its diagonal does not meet half
    the area of the other two.

    Args:
        points: (n, 3) m.
        squares: (m, 4) nodes of the faces, in order around each.

    Reference:
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
    """Return how far down from each point the insert goes, m; to the last exit, voids included."""
    inside = points - [0.0, 1e-3 * spacing[1], 0.0]
    distance = rays.last_exit(inside, (0.0, -1.0, 0.0))
    whole = points[:, 1] - rays.surface.bounds[0, 1]
    return np.where(np.isfinite(distance), distance + 1e-3 * spacing[1], whole)


def _lift(points: Array, rays: RayCaster) -> Array:
    """Return how far the smooth surface is above the points, m; 0 for one not on the mesh."""
    up = np.array([0.0, 1.0, 0.0])
    distance, face, weights = rays.first_in_face(points + CONTACT_MAP.ray_start_height * up, -up)
    on = np.abs(distance - CONTACT_MAP.ray_start_height) < CONTACT_MAP.on_mesh_distance
    lift = np.zeros(len(points))
    lift[on], _ = CurvedSurface.of(rays.surface).shift(face[on], weights[on], up)
    return lift
