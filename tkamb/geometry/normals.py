"""Normals of the smooth surface that a triangulation stands for: at corners, and in between."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.topology import edge_use

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


SHARP_EDGE = float(np.deg2rad(40.0))
"""rad: neighbouring triangles that turn by more than this meet in a sharp edge."""
NO_CREASE = float(np.pi)
"""rad: all triangles at a vertex count, however they turn."""


@dataclass(frozen=True)
class NormalSettings:
    """Normals of a mesh."""

    cosine_rounding: float = 1e-9
    """1: difference of two cosines that is rounding. Chosen: above rounding."""


NORMAL = NormalSettings()


def corner_normals(surface: "Surface", crease: float, weights: Array) -> Array:
    """Return unit normals (k, 3, 3), one per triangle and corner.

    Each is the weighted mean of the normals of those triangles at the vertex that turn by at
    most `crease` from the triangle itself, so that a rim does not tilt the normals of the
    surface beside it. A triangle without area has zero normals.

    Args:
        surface: vertices at the same place count as one.
        crease: rad; `NO_CREASE`: the same normal for all corners at a vertex.
        weights: (k, 3) of each triangle at its corners: `corner_angles`, or its area.
    """
    normals, vertex = np.repeat(surface.face_normals, 3, axis=0), surface.corner_vertices.ravel()
    weighted = weights.reshape(-1, 1) * normals
    mean = _sums(vertex, weighted)
    total = mean[vertex]
    if crease < NO_CREASE:
        # Normals within half the crease angle of their mean are within the crease angle of each
        # other, so they need no comparison in pairs.
        lean = np.einsum("cj,cj->c", normals, _unit(mean)[vertex])
        rough = np.zeros(len(mean), bool)
        rough[vertex[~(lean > np.cos(crease / 2) + NORMAL.cosine_rounding)]] = True
        corners = np.flatnonzero(rough[vertex])
        corner_of_pair, neighbour = surface.corners_at_vertices.of(vertex[corners])
        turn = np.einsum("pj,pj->p", normals[corners[corner_of_pair]], normals[neighbour])
        counts = (turn >= np.cos(crease))[:, None]
        total[corners] = _sums(
            corner_of_pair, np.where(counts, weighted[neighbour], 0.0), len(corners)
        )
    return _unit(total).reshape(-1, 3, 3)


def corner_angles(surface: "Surface") -> Array:
    """Return the angles (k, 3), rad, of the triangles."""
    corners = surface.triangles
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(ahead, behind), axis=2)
    return np.arctan2(sine, np.einsum("ijk,ijk->ij", ahead, behind))


def interpolated(surface: "Surface", normals: Array, points: Array, faces: Index) -> Array:
    """Return unit normals (n, 3) at points on triangles, from those at the corners.

    Args:
        surface: whose triangles they are.
        normals: (k, 3, 3), see `corner_normals`.
        points: (n, 3) m.
        faces: (n,) the triangle of each point.
    """
    return mean_normals(surface.barycentric(points, faces), normals[faces])


def mean_normals(weights: Array, normals: Array) -> Array:
    """Return the unit means (n, 3) of three normals (n, 3, 3), by barycentric weights (n, 3)."""
    return _unit(np.einsum("ij,ijk->ik", weights, normals))


def sharp_edges(surface: "Surface", sharp: float = SHARP_EDGE) -> Mask:
    """Return (k, 3): whether the edge opposite each corner is sharp, open or shared by many."""
    edge, count = edge_use(surface.faces)
    cosine = 0.5 * (_sums(edge, np.repeat(surface.face_normals, 3, axis=0)) ** 2).sum(axis=1) - 1
    flags = (count != 2) | (cosine < np.cos(sharp))
    return np.roll(flags[edge].reshape(-1, 3), -1, axis=1)


def _sums(index: Index, rows: Array, count: int = 0) -> Array:
    """Return the sums (count or more, n) of the rows (m, n) with each index (m,)."""
    return np.stack([np.bincount(index, column, count) for column in rows.T], axis=1)


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
