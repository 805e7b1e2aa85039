"""Normals at the corners of triangles that are smooth on smooth parts and keep sharp edges."""

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.boundary import edge_use
from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface

SHARP = float(np.deg2rad(40.0))
"""rad: neighbouring triangles that turn by more than this meet in a sharp edge."""


def corner_normals(surface: Surface, sharp: float = SHARP) -> Array:
    """Return unit normals (k, 3, 3), one per triangle and corner.

    Each is the angle-weighted mean of the normals of those triangles at the vertex that turn
    by less than `sharp` from the triangle itself, so that a rim does not tilt the normals of
    the surface beside it. They err by a tenth or less of what a facet does.

    Args:
        surface: its triangles share their vertices.
        sharp: rad.
    """
    mesh = surface.mesh
    neighbours = mesh.vertex_faces[surface.faces]
    there = neighbours >= 0
    normals = surface.face_normals
    turn = np.einsum("kcnj,kj->kcn", normals[neighbours], normals)
    at = surface.faces[neighbours] == surface.faces[:, :, None, None]
    angle = (mesh.face_angles[neighbours] * at).sum(axis=-1)
    weight = np.where(there & (turn > np.cos(sharp)), angle, 0.0)
    mean = np.einsum("kcn,kcnj->kcj", weight, normals[neighbours])
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    return np.asarray(np.where(length > 0.0, mean / np.where(length > 0, length, 1.0), 0.0))


def sharp_edges(surface: Surface, sharp: float = SHARP) -> NDArray[np.bool_]:
    """Return (k, 3): whether the edge opposite each corner is sharp, open or shared by many."""
    edge, count = edge_use(surface.faces)
    normals = np.repeat(surface.face_normals, 3, axis=0)
    total = np.stack([np.bincount(edge, column, len(count)) for column in normals.T], axis=1)
    cosine = 0.5 * (total**2).sum(axis=1) - 1.0
    flags = (count != 2) | (cosine < np.cos(sharp))
    return np.asarray(np.roll(flags[edge].reshape(-1, 3), -1, axis=1))
