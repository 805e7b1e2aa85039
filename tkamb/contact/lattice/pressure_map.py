"""From a solution to the contract's result: pressures, sums and flags."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.grid import Lattice
from tkamb.geometry.frames import Array
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ContactMap:
    """The contact surface of a lattice.

    Args:
        points: (c, 3) m, undeformed contact nodes.
        normals: (c, 3) outward unit normals, area-weighted over the triangles.
        area: (c,) m², tributary: a third of each triangle at the node.
        thickness: (c,) m, insert below the node along y.
        triangles: (k, 3) positions among the contact nodes.
    """

    points: Array
    normals: Array
    area: Array
    thickness: Array
    triangles: Indices


def contact_map(lattice: Lattice, insert: Surface) -> tuple[Indices, ContactMap]:
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
    return nodes.astype(np.int64), ContactMap(
        points, normals, area, _thickness(points, insert, lattice.spacing), triangles
    )


def _thickness(points: Array, insert: Surface, spacing: Array) -> Array:
    """Return how far down from each point the insert goes, m."""
    inside = points - [0.0, 1e-3 * spacing[1], 0.0]
    distance, _ = RayCaster(insert).first(inside, (0.0, -1.0, 0.0))
    whole = points[:, 1] - insert.bounds[0, 1]
    return np.where(np.isfinite(distance), distance + 1e-3 * spacing[1], whole)
