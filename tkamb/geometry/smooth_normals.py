"""Normals of the smooth surface that a triangulation stands for."""

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface

Indices = NDArray[np.int64]

CREASE = np.radians(30.0)
"""rad; triangles that meet at a larger angle belong to different smooth surfaces."""


def smooth_normals(surface: Surface, points: Array, faces: Indices) -> Array:
    """Return unit normals (n, 3) at points (n, 3), m, on triangles `faces` (n,).

    At each corner of a triangle the angle-weighted mean of the normals of the triangles
    about that vertex, without those beyond a crease of 30 deg; in between interpolated. A
    box keeps its face normals, a faceted sphere gets radial ones to second order.
    """
    chosen, row = np.unique(faces, return_inverse=True)
    normals = _corner_normals(surface, chosen)[row.reshape(-1)]
    weights = surface.barycentric(points, faces)
    mixed = np.einsum("ij,ijk->ik", weights, normals)
    return np.asarray(mixed / np.linalg.norm(mixed, axis=1, keepdims=True))


def _corner_normals(surface: Surface, chosen: Indices) -> Array:
    """Return the normals (m, 3, 3) at the corners of the chosen triangles (m,)."""
    _, merged = np.unique(surface.vertices, axis=0, return_inverse=True)
    vertex = merged.reshape(-1)[surface.faces].ravel()
    order = np.argsort(vertex, kind="stable")
    start = np.searchsorted(vertex[order], np.arange(vertex.max() + 2))
    wanted = (3 * chosen[:, None] + np.arange(3)).ravel()
    first, count = start[vertex[wanted]], np.diff(start)[vertex[wanted]]
    corner = np.repeat(np.arange(len(wanted)), count)
    offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    other = order[np.repeat(first, count) + offset]
    own = surface.face_normals[chosen][corner // 3]
    theirs = surface.face_normals[other // 3]
    smooth = np.einsum("ij,ij->i", own, theirs) >= np.cos(CREASE)
    weight = np.where(smooth, _corner_angles(surface).ravel()[other], 0.0)
    total = np.stack([np.bincount(corner, weight * n, len(wanted)) for n in theirs.T], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    plain = np.repeat(surface.face_normals[chosen], 3, axis=0)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), plain).reshape(-1, 3, 3)


def _corner_angles(surface: Surface) -> Array:
    """Return the angles (k, 3), rad, of the triangles."""
    corners = surface.triangles
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(ahead, behind), axis=2)
    return np.arctan2(sine, np.einsum("ijk,ijk->ij", ahead, behind))
