"""The rigid femoral component as seen from below along the vertical."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tkamb.geometry.curved import CurvedSurface
from tkamb.geometry.frames import Array, inverse, rotate, transform
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class FemoralFloor:
    """The lowest femoral surface over any x and z of the insert.

    Rays meet the triangles; from there they go on to the curved patches over them
    (`CurvedSurface`), so that facets leave no pattern in the pressure.

    Args:
        surface: femoral component, femoral frame.
        rays: its ray caster.
    """

    surface: Surface
    rays: RayCaster

    @cached_property
    def _patches(self) -> CurvedSurface:
        return CurvedSurface.of(self.surface)

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
        up = rotate(back, UP)
        distance, face = self.rays.first(origins, up)
        hit = face >= 0
        places = np.full((len(points), 3), np.nan)
        normals = np.full((len(points), 3), np.nan)
        local = origins[hit] + distance[hit, None] * up
        shift, outward = self._patches.shift(local, face[hit], up)
        places[hit] = transform(pose, local + shift[:, None] * up)
        places[hit, 0], places[hit, 2] = points[hit, 0], points[hit, 2]
        normals[hit] = rotate(pose, outward)
        inward = normals[:, 1] > 0
        normals[inward] = -normals[inward]
        return places, normals
