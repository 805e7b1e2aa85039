"""The rigid femoral component as seen from below along the vertical."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.corner_normals import corner_normals
from tkamb.geometry.frames import Array, inverse, rotate, transform
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class FemoralFloor:
    """The lowest femoral surface over any x and z of the insert.

    Args:
        surface: femoral component, femoral frame.
        rays: its ray caster.
    """

    surface: Surface
    rays: RayCaster

    @cached_property
    def _corner_normals(self) -> Array:
        return corner_normals(self.surface)

    def over(self, points: Array, pose: Array) -> tuple[Array, Array]:
        """Return the lowest femoral points (n, 3) above or below points, and their normals.

        Vertical rays come from below everything. NaN where there is no femoral surface.

        Args:
            points: (n, 3) m, insert frame; only x and z count.
            pose: (4, 4) pose_femoral_in_insert.

        Returns:
            Points and outward unit normals (n, 3), insert frame. Normals are interpolated
            between vertices, so that they are continuous across the triangles of a smooth
            part; they point down.
        """
        back = inverse(pose)
        lowest = self.surface.bounds
        start = float(pose[1, 3]) - 2 * float(np.abs(lowest).max()) - 1e-2
        origins = transform(
            back, np.column_stack([points[:, 0], np.full(len(points), start), points[:, 2]])
        )
        distance, face = self.rays.first(origins, rotate(back, UP))
        hit = face >= 0
        places = np.full((len(points), 3), np.nan)
        normals = np.full((len(points), 3), np.nan)
        local = origins[hit] + distance[hit, None] * rotate(back, UP)
        places[hit] = transform(pose, local)
        places[hit, 0], places[hit, 2] = points[hit, 0], points[hit, 2]
        normals[hit] = rotate(pose, self._interpolated(local, face[hit]))
        up = normals[:, 1] > 0
        normals[up] = -normals[up]
        return places, normals

    def _interpolated(self, points: Array, face: NDArray[np.int64]) -> Array:
        """Return unit normals (n, 3) at points on triangles `face`, femoral frame."""
        corner = self.surface.triangles[face]
        a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        cross, offset = np.cross(a, b), points - corner[:, 0]
        square = np.einsum("ij,ij->i", cross, cross)
        v = np.einsum("ij,ij->i", np.cross(offset, b), cross) / square
        w = np.einsum("ij,ij->i", np.cross(a, offset), cross) / square
        weights = np.clip(np.stack([1 - v - w, v, w], axis=1), 0, 1)
        normals = np.einsum("ij,ijk->ik", weights, self._corner_normals[face])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))
