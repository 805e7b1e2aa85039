"""Heights of nodes that were moved sideways: rays along y are fired again at the new places."""

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.columns import NodeField
from tkamb.geometry.frames import Array
from tkamb.geometry.rays import RayCaster

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Nodes = tuple[Index, ...]

WALL_LEAN = 0.05
"""y of the normal of a triangle that is steeper (87 deg) belongs to a wall."""
GAP = 0.02
"""Cells; a node stays this far inside a wall that rays along y miss at its hit."""
REACH = 0.75
"""Cells: a surface farther than this from where it was is another surface."""


def inside(rays: RayCaster, points: Array) -> Mask:
    """Say which points (n, 3) lie in a closed surface, by counting crossings upwards."""
    ray, _, _ = rays.all(points, (0.0, 1.0, 0.0))
    return np.asarray(np.bincount(ray, minlength=len(points)) % 2 == 1)


def refired_inwards(
    field: NodeField, nodes: Nodes, target: Array, inward: Array, rays: RayCaster
) -> Array:
    """Return the heights (n,) of nodes at places on walls; a miss moves the target inwards.

    A wall is rough by the mesh's noise: a vertical ray on it may pass the part. Where one
    does, it is fired again GAP inside the wall and the target (n, 3) is moved there.

    Args:
        field: nodes.
        nodes: which of them.
        target: (n, 3) m, where they go; y is not used.
        inward: (n, 2) along x and z into the part, of any length but 0.
        rays: of the part.
    """
    height = refired(field, nodes, target, rays)
    missed = np.flatnonzero(~np.isfinite(height))
    if missed.size:
        step = inward[missed] / np.linalg.norm(inward[missed], axis=1, keepdims=True)
        target[missed[:, None], [0, 2]] += GAP * field.spacing[[0, 2]] * step
        again = tuple(index[missed] for index in nodes)
        height[missed] = refired(field, again, target[missed], rays)
    return height


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
        right = rays.surface.face_normals[face, 1] * facing > WALL_LEAN
        ray, y = ray[right], base[ray[right], 1] + t[right]
        off = np.abs(y - height[here[ray]])
        order = np.lexsort((off, ray))
        found, head = np.unique(ray[order], return_index=True)
        value = np.full(len(here), np.nan)
        close = off[order][head] <= REACH * field.spacing[1]
        value[found[close]] = y[order][head][close]
        height[here] = value
    return height
