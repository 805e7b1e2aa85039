"""Pressure from a contact model's map points to the vertices of the insert."""

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import Delaunay

from tkamb.geometry.frames import Array


def interpolation(map_points: Array, points: Array) -> csr_array:
    """Return weights (n, m) that interpolate values at map points (m, 3) to points (n, 3).

    Both are seen from above: linear on the Delaunay triangles of the map points' x and z, zero
    outside their hull. Second order in the map's spacing.
    """
    flat = Delaunay(map_points[:, [0, 2]])
    places = points[:, [0, 2]]
    simplex = flat.find_simplex(places)
    inside = np.flatnonzero(simplex >= 0)
    affine = flat.transform[simplex[inside]]
    two = np.einsum("nij,nj->ni", affine[:, :2], places[inside] - affine[:, 2])
    weights = np.column_stack([two, 1.0 - two.sum(axis=1)])
    weights = np.nan_to_num(np.clip(weights, 0.0, 1.0))  # NaN: a triangle without area
    columns = flat.simplices[simplex[inside]]
    rows = np.repeat(inside, 3)
    shape = (len(points), len(map_points))
    return csr_array((weights.ravel(), (rows, columns.ravel())), shape=shape)


def carried(pressure: Array, projected: Array, load: Array) -> tuple[Array, float]:
    """Scale maps (f, n) so that each carries its load, and return the largest change.

    Args:
        pressure: (f, n) Pa.
        projected: (n,) m², the area of each point seen from above.
        load: (f,) N along -y.
    """
    force = pressure @ projected
    scale = np.divide(load, force, out=np.ones_like(force), where=(force > 0) & (load > 0))
    return pressure * scale[:, None], float(np.abs(scale - 1.0).max(initial=0.0))
