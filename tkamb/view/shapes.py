"""Plain closed shapes that stand in for what a scene has no mesh of."""

import numpy as np
from scipy.spatial import ConvexHull

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface

GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
"""rad: successive points of a spiral turned by it cover a sphere evenly."""


def hull(points: Array, name: str) -> Surface:
    """Return the convex hull of points (n, 3), m, its triangles wound outwards."""
    found = ConvexHull(points)
    faces = found.simplices
    a, b, c = np.moveaxis(points[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), found.equations[:, :3]) < 0
    faces = np.where(inward[:, None], faces[:, ::-1], faces)
    place = np.full(len(points), -1)
    place[found.vertices] = np.arange(len(found.vertices))
    return Surface(points[found.vertices], place[faces], name)


def sphere_points(count: int = 640) -> Array:
    """Return points (n, 3) spread evenly over the unit sphere: a spiral of golden angles."""
    k = np.arange(count) + 0.5
    up = 1.0 - 2.0 * k / count
    across = np.sqrt(1.0 - up**2)
    return np.column_stack([across * np.cos(GOLDEN * k), up, across * np.sin(GOLDEN * k)])


def box(size: Array, name: str) -> Surface:
    """Return a box about the origin; size (3,) m."""
    corners = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, 8).T
    return hull(corners * size, name)


def revolved(radius: Array, height: Array, name: str, sections: int = 28) -> Surface:
    """Return a body of revolution about z with flat ends: radius (n,) at rising height (n,), m."""
    count, angle = len(radius), 2.0 * np.pi * np.arange(sections) / sections
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    around = np.concatenate(
        [radius[:, None, None] * ring, np.tile(height[:, None, None], (1, sections, 1))], axis=2
    )
    poles = [[0.0, 0.0, height[0]], [0.0, 0.0, height[-1]]]
    here = np.arange(sections)
    ahead = (here + 1) % sections
    low = (sections * np.arange(count - 1))[:, None]
    a, b, c, d = low + here, low + ahead, low + ahead + sections, low + here + sections
    bottom, top = count * sections, count * sections + 1
    last = (count - 1) * sections
    faces = np.concatenate(
        [
            np.stack([a, b, c], axis=2).reshape(-1, 3),
            np.stack([a, c, d], axis=2).reshape(-1, 3),
            np.column_stack([np.full(sections, bottom), ahead, here]),
            np.column_stack([np.full(sections, top), last + here, last + ahead]),
        ]
    )
    return Surface(np.concatenate([around.reshape(-1, 3), poles]), faces, name)
