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
    here, there = _corners_that_meet(surface.faces)
    normals = surface.face_normals
    turn = np.einsum("pj,pj->p", normals[here // 3], normals[there // 3])
    angle = surface.mesh.face_angles.ravel()
    weight = np.where(turn > np.cos(sharp), angle[there], 0.0)
    mean = np.stack(
        [
            np.bincount(here, weight * column[there // 3], surface.faces.size)
            for column in normals.T
        ],
        axis=1,
    )
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    unit = np.where(length > 0.0, mean / np.where(length > 0, length, 1.0), 0.0)
    return np.asarray(unit.reshape(-1, 3, 3))


def _corners_that_meet(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pairs of corners (3 face + corner) that share a vertex, each with itself too."""
    vertex = faces.ravel()
    order = np.argsort(vertex, kind="stable")
    count = np.bincount(vertex)
    first = np.cumsum(count) - count
    here = np.repeat(np.arange(len(vertex)), count[vertex])
    begins = np.cumsum(count[vertex]) - count[vertex]
    within = np.arange(len(here)) - np.repeat(begins, count[vertex])
    return here, order[first[vertex[here]] + within]


def sharp_edges(surface: Surface, sharp: float = SHARP) -> NDArray[np.bool_]:
    """Return (k, 3): whether the edge opposite each corner is sharp, open or shared by many."""
    edge, count = edge_use(surface.faces)
    normals = np.repeat(surface.face_normals, 3, axis=0)
    total = np.stack([np.bincount(edge, column, len(count)) for column in normals.T], axis=1)
    cosine = 0.5 * (total**2).sum(axis=1) - 1.0
    flags = (count != 2) | (cosine < np.cos(sharp))
    return np.asarray(np.roll(flags[edge].reshape(-1, 3), -1, axis=1))
