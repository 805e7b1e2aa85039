"""Fewer triangles for drawing, and how far they lie from the true surface."""

import numpy as np
from fast_simplification import simplify

from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

AGGRESSIVENESS = range(5, 11)
"""How soon far vertices may be merged: tried until few enough triangles are left."""


def thinned(surface: Surface, most_triangles: int) -> tuple[Surface, float]:
    """Return a surface of at most so many triangles, and how far (m) the two lie apart at most.

    Edges collapse in the order of their quadric error (Garland & Heckbert, Proc SIGGRAPH 97,
    209). The distance is measured from the vertices and triangle centres of each to a point of
    the other that is nearly the nearest one: it may be too large by a tenth of a millimetre.
    """
    if len(surface.faces) <= most_triangles:
        return surface, 0.0
    points, faces = surface.vertices / MILLIMETRE, surface.faces.astype(np.int32)
    for aggressiveness in AGGRESSIVENESS:
        fewer, kept = simplify(points, faces, target_count=most_triangles, agg=aggressiveness)
        if len(kept) <= most_triangles:
            break
    found = Surface(fewer.astype(float) * MILLIMETRE, kept.astype(np.int64), surface.name)
    return found, _distance(found, surface)


def _distance(one: Surface, other: Surface) -> float:
    """Return the largest distance (m) of vertices and triangle centres to the other surface."""
    return max(
        float(to.nearest.at(points).distance.max())
        for of, to in ((one, other), (other, one))
        for points in (of.vertices, of.triangles.mean(axis=1))
    )
