"""Heights of nodes that were moved sideways: rays along y are fired again at the new places."""

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.columns import NodeField
from tkamb.geometry.frames import Array
from tkamb.geometry.rays import RayCaster

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Nodes = tuple[Index, ...]

REACH = 0.75
"""Cells: a surface farther than this from where it was is another surface."""


def inside(rays: RayCaster, points: Array) -> Mask:
    """Say which points (n, 3) lie in a closed surface, by counting crossings upwards."""
    ray, _, _ = rays.all(points, (0.0, 1.0, 0.0))
    return np.asarray(np.bincount(ray, minlength=len(points)) % 2 == 1)


def refired(field: NodeField, nodes: Nodes, target: Array, rays: RayCaster) -> Array:
    """Return the heights (n,) of nodes at new places: on the surface for ends of intervals.

    NaN where the surface is farther than REACH from where it was.
    """
    height = field.points[..., 1][nodes]
    for end, facing in ((field.upper_end[nodes], 1.0), (field.lower_end[nodes], -1.0)):
        here = np.flatnonzero(end)
        base = target[here].copy()
        base[:, 1] = rays.surface.bounds[0, 1] - field.spacing[1]
        ray, t, face = rays.all(base, (0.0, 1.0, 0.0))
        right = rays.surface.face_normals[face, 1] * facing > 0.0
        ray, y = ray[right], base[ray[right], 1] + t[right]
        off = np.abs(y - height[here[ray]])
        order = np.lexsort((off, ray))
        found, head = np.unique(ray[order], return_index=True)
        value = np.full(len(here), np.nan)
        close = off[order][head] <= REACH * field.spacing[1]
        value[found[close]] = y[order][head][close]
        height[here] = value
    return height
