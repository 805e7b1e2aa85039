"""Surfaces for the graphics card: few triangles, smooth shading, sharp edges."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from fast_simplification import simplify
from numpy.typing import NDArray

from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE


@dataclass(frozen=True)
class ShadingSettings:
    """How surfaces of the viewer are simplified."""

    max_triangles: int = 6_000
    """Triangles per surface; a finer one is decimated before it is drawn. Chosen: with two of that
    size and the smaller parts a frame takes less than 100 ms without a graphics card."""


SHADING = ShadingSettings()

AGGRESSIVENESS = range(5, 11)
"""Values of the simplifier's aggressiveness, tried in turn until few enough triangles remain."""


@dataclass(frozen=True, eq=False)
class Shaded:
    """A surface with one normal per vertex.

    Args:
        vertices: (n, 3) float32, m.
        normals: (n, 3) float32, unit.
        faces: (k, 3) uint32.
        error: m, how far the drawn surface lies at most from the true one; 0 if not decimated.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.uint32]
    error: float


@lru_cache(maxsize=16)
def shade(surface: Surface, most_triangles: int = SHADING.max_triangles) -> Shaded:
    """Return a surface for drawing; vertices on sharp edges are doubled."""
    surface, error = decimate(surface, most_triangles)
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


def decimate(surface: Surface, most_triangles: int) -> tuple[Surface, float]:
    """Return a surface of at most so many triangles, and how far (m) the two lie apart at most.

    Edges collapse in the order of their quadric error (Garland & Heckbert, Proc SIGGRAPH 97,
    209). The distance is measured from the vertices and triangle centres of each to a point of
    the other that is nearly the nearest one: it may be too large by a tenth of a millimetre.
    """
    if len(surface.faces) <= most_triangles:
        return surface, 0.0
    points, faces = surface.vertices / MILLIMETRE, surface.faces.astype(np.int32)
    for aggressiveness in AGGRESSIVENESS:
        fewer, simplified = simplify(points, faces, target_count=most_triangles, agg=aggressiveness)
        if len(simplified) <= most_triangles:
            break
    result = Surface(fewer.astype(float) * MILLIMETRE, simplified.astype(np.int64), surface.name)
    return result, _distance(result, surface)


def _distance(one: Surface, other: Surface) -> float:
    """Return the largest distance (m) of vertices and triangle centres to the other surface."""
    return max(
        float(to.nearest.at(points).distance.max())
        for of, to in ((one, other), (other, one))
        for points in (of.vertices, of.triangles.mean(axis=1))
    )
