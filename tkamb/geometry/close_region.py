"""The centre of the region in which two surfaces are as close as their meshes can tell."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tkamb.geometry.frames import Array, inverse, rotate, transform
from tkamb.geometry.nearest import NearestPoints, sampled
from tkamb.geometry.surface import Surface

RESOLUTION = 3e-5
"""m; gaps that differ by less are the same: facets of 1–2 mm on a condyle cut about this."""
REACH = 1.6e-2
"""m; the region ends this far from the closest point."""
_SPACING = 1e-3
_FACING = 0.7
"""Cosine of the angle between the surfaces, above which they face each other."""
_DOUBT = 1e-4
"""m; how far the quick estimate of a gap may be out on coarse meshes."""


class CloseRegion:
    """Part of one body's surface, prepared to find its close region with another body.

    On conforming surfaces the closest point of two meshes wanders by millimetres from pose
    to pose, for differences in gap of a few micrometres. The centre of the region,

        c = sum w_i p_i / sum w_i,   w_i = A_i exp(-(g_i - g) / RESOLUTION)

    over samples i of area A_i and signed gap g_i (g the smallest gap, p_i the foot on the
    other body), moves smoothly and coincides with the closest point where that is sharp.

    Args:
        surface: the body, own frame.
        faces: (k,) the triangles that belong to the part.
    """

    def __init__(self, surface: Surface, faces: NDArray[np.int64]) -> None:
        part = Surface(surface.vertices, surface.faces[faces], surface.name)
        samples, owner, areas = sampled(part, _SPACING)
        first, self._areas = _thinned(samples, areas)
        self._samples, self._normals = samples[first], part.face_normals[owner[first]]
        self._tree = cKDTree(self._samples)

    def centre(
        self, other: NearestPoints, pose: Array, gap: float, closest: Array
    ) -> tuple[Array, Array]:
        """Return the centre (3,) on the other body and its mean unit normal (3,) there.

        Args:
            other: nearest points of the other body, whose frame all points are in.
            pose: (4, 4) of this body in the other's frame.
            gap: m, the smallest signed gap.
            closest: (3,) m, this body's point with that gap.
        """
        own = transform(inverse(pose), closest)
        near = np.array(self._tree.query_ball_point(own, REACH), dtype=int)
        here = self._normals[self._tree.query(own)[1]]
        near = near[self._normals[near] @ here > 0.5]
        points = transform(pose, self._samples[near])
        within = np.abs(other.heights(points) - gap) < _DOUBT + 5 * RESOLUTION
        near, points = near[within], points[within]
        found = other.at(np.concatenate([points, closest[None]]))
        facing = -_dot(rotate(pose, self._normals[near]), found.normals[:-1])
        above = _dot(points - found.points[:-1], found.normals[:-1])
        excess = np.where(above < 0, -1, 1) * found.distance[:-1] - gap
        excess = np.where(excess < -RESOLUTION, np.inf, np.maximum(excess, 0.0))
        weights = self._areas[near] * (facing > _FACING) * np.exp(-excess / RESOLUTION)
        weights = np.append(weights, self._areas.mean())
        mean = weights @ found.normals
        centre = other.at((weights @ found.points / weights.sum())[None]).points[0]
        return centre, mean / np.linalg.norm(mean)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ij,ij->i", a, b))


def _thinned(samples: Array, areas: Array) -> tuple[NDArray[np.int64], Array]:
    """Keep one sample of each cube of the spacing: its index, and the area of them all."""
    cubes = np.floor(samples / _SPACING).astype(np.int64)
    order = np.argsort(-areas, kind="stable")
    _, first, cube = np.unique(cubes[order], axis=0, return_index=True, return_inverse=True)
    total = np.bincount(cube.reshape(-1), areas[order])
    return order[first].astype(np.int64), np.asarray(total, np.float64)
