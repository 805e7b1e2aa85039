"""Surfaces as the graphics card wants them: few enough triangles, smooth but with sharp edges."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.surface import Surface
from tkamb.view.thinning import thinned

MOST_TRIANGLES = 6_000
"""Per surface; a finer one is thinned before it is drawn. With two of that size and the smaller
parts a frame takes less than 100 ms where no graphics card helps."""


@dataclass(frozen=True, eq=False)
class Shaded:
    """A surface with one normal per vertex.

    Args:
        vertices: (n, 3) float32, m.
        normals: (n, 3) float32, unit.
        faces: (k, 3) uint32.
        error: m, how far the drawn surface lies at most from the true one; 0 if not thinned.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.uint32]
    error: float


@lru_cache(maxsize=16)
def shaded(surface: Surface, most_triangles: int = MOST_TRIANGLES) -> Shaded:
    """Return a surface for drawing; vertices on sharp edges are doubled."""
    surface, error = thinned(surface, most_triangles)
    normals = surface.corner_normals
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
