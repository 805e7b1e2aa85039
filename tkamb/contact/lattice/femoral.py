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
    def _curved(self) -> CurvedSurface:
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
        start = float(pose[1, 3]) - 2 * float(np.abs(self.surface.bounds).max()) - 1e-2
        below = points.copy()
        below[:, 1] = start
        origins, up = transform(back, below), rotate(back, UP)
        distance, face, weights = self.rays.first_in_face(origins, up)
        hit = np.flatnonzero(face >= 0)
        shift, outward = self._curved.shift(face[hit], weights[hit], up)
        places = np.full((len(points), 3), np.nan)
        normals = np.full((len(points), 3), np.nan)
        below[:, 1] += distance
        below[hit, 1] += shift
        places[hit] = below[hit]
        outward = rotate(pose, outward)
        normals[hit] = np.where(outward[:, 1:2] > 0, -outward, outward)
        return places, normals
