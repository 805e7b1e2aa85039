"""Surfaces as the graphics card wants them: few enough triangles, smooth but with sharp edges."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.corner_normals import corner_normals
from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface

MOST_TRIANGLES = 120_000
"""Per surface; a finer one is thinned before it is drawn."""


@dataclass(frozen=True, eq=False)
class Shaded:
    """A surface with one normal per vertex.

    Args:
        vertices: (n, 3) float32, m.
        normals: (n, 3) float32, unit.
        faces: (k, 3) uint32.
        error: m, how far at most thinning moved a vertex; 0 if it was not thinned.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.uint32]
    error: float


def shaded(surface: Surface, most_triangles: int = MOST_TRIANGLES) -> Shaded:
    """Return a surface for drawing; vertices on sharp edges are doubled."""
    surface, error = thinned(surface, most_triangles)
    normals = corner_normals(surface)
    flat = np.repeat(surface.face_normals[:, None], 3, axis=1)
    normals = np.where(np.linalg.norm(normals, axis=-1, keepdims=True) > 0, normals, flat)
    key = np.round(normals.reshape(-1, 3) * 127.0).astype(np.int64)
    corners = np.column_stack([surface.faces.ravel(), key])
    _, first, inverse = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    return Shaded(
        surface.vertices[surface.faces.ravel()[first]].astype(np.float32),
        normals.reshape(-1, 3)[first].astype(np.float32),
        inverse.reshape(-1, 3).astype(np.uint32),
        error,
    )


def thinned(surface: Surface, most_triangles: int) -> tuple[Surface, float]:
    """Return a surface of at most so many triangles, and how far its vertices were moved (m).

    Vertices in the same cube of a grid become their mean; the cube grows until few enough
    triangles are left (Rossignac & Borrel 1993). Nothing is moved by more than the cube's
    diagonal.
    """
    if len(surface.faces) <= most_triangles:
        return surface, 0.0
    low, high = surface.bounds
    size = float((high - low).max()) / np.sqrt(most_triangles)
    while True:
        merged, moved = _clustered(surface, size, low)
        if len(merged.faces) <= most_triangles:
            return merged, moved
        size *= 1.25


def _clustered(surface: Surface, size: float, low: Array) -> tuple[Surface, float]:
    cells = np.floor((surface.vertices - low) / size).astype(np.int64)
    _, cluster = np.unique(cells, axis=0, return_inverse=True)
    cluster = cluster.ravel()
    count = np.bincount(cluster)
    vertices = np.stack(
        [np.bincount(cluster, column) / count for column in surface.vertices.T], axis=1
    )
    faces = cluster[surface.faces]
    whole = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    moved = np.linalg.norm(vertices[cluster] - surface.vertices, axis=1).max()
    return Surface(vertices, faces[whole], surface.name), float(moved)
