"""A surface in small patches, whose extent at any pose is known without its vertices."""

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.ceiling import rows_of
from tkamb.geometry.frames import Array, rotate, transform
from tkamb.geometry.surface import Surface

Index = NDArray[np.int64]

EDGE = 2e-3
"""m; edge of the cubes that patches are cut by."""
MOST_CUBES = 200
"""Cubes along an edge of the surface's box; a larger surface gets larger ones."""


class Patches:
    """The triangles of a surface by the cube that holds their middle, each in a flat box.

    Args:
        surface: any surface.
        reach: (n,) m, a margin of each vertex; `self.reach` (p,) is the largest of each patch.
    """

    def __init__(self, surface: Surface, reach: Array) -> None:
        low, high = surface.bounds
        edge = max(EDGE, float((high - low).max()) / MOST_CUBES)
        middle = np.maximum(surface.triangles.mean(axis=1) - low, 0.0)  # rounding may fall below
        cube = np.floor(middle / edge).astype(np.int64)
        key = np.ravel_multi_index(tuple(cube.T), tuple(cube.max(axis=0) + 1))
        self._faces = np.argsort(key, kind="stable")
        begin = np.flatnonzero(np.diff(key[self._faces], prepend=-1))
        self._first = np.append(begin, len(key))
        self._axes = _frames(np.add.reduceat(surface.face_normals[self._faces], begin))
        axes = np.repeat(self._axes, np.diff(self._first), axis=0)
        along = np.einsum("kij,kcj->kci", axes, surface.triangles[self._faces])
        lowest = np.minimum.reduceat(along.min(axis=1), begin)
        highest = np.maximum.reduceat(along.max(axis=1), begin)
        self._centre = np.einsum("pij,pi->pj", self._axes, (lowest + highest) / 2)
        self._half = (highest - lowest) / 2
        self.reach = np.maximum.reduceat(reach[surface.faces].max(axis=1)[self._faces], begin)

    def extent(self, pose: Array) -> tuple[Array, Array]:
        """Return the corners low and high (p, 3), m, of a box about each patch at a pose (4, 4)."""
        turned = np.abs(self._axes @ pose[:3, :3].T)
        centre, half = transform(pose, self._centre), np.einsum("pij,pi->pj", turned, self._half)
        return centre - half, centre + half

    def least(self, pose: Array, chosen: Index, directions: Array) -> Array:
        """Return a lower bound (n,) of d . x over chosen patches, for directions d (n, 3)."""
        own = rotate(pose.T, directions)
        across = np.abs(np.einsum("pij,pj->pi", self._axes[chosen], own))
        middle = np.einsum("ij,ij->i", transform(pose, self._centre[chosen]), directions)
        return np.asarray(middle - np.einsum("ij,ij->i", across, self._half[chosen]))

    def faces(self, chosen: Index) -> Index:
        """Return the triangles of the chosen patches."""
        return rows_of(self._first, self._faces, chosen)


def _frames(normals: Array) -> Array:
    """Return orthonormal axes (p, 3, 3), rows, the first along each normal (p, 3)."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    first = np.where(length > 0, normals / np.where(length > 0, length, 1.0), [0.0, 1.0, 0.0])
    second = np.cross(first, np.eye(3)[np.abs(first).argmin(axis=1)])
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=1)
