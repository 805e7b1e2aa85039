"""First touch of the two condyles on the dishes, on the exact surfaces (no facets).

The vertical gap of a condyle is the least height of its surface above the dish, over all its
points: it is zero exactly when the two surfaces touch, and moving the femur up by g widens it by g.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from tkamb.geometry.frames import Array, knee_pose
from tkamb.studies.designs.femoral import FemoralComponent
from tkamb.studies.designs.insert import Insert

MEDIAL, LATERAL = -1.0, 1.0
PHI_REACH, Z_REACH = np.radians(30.0), 9.0


@dataclass(frozen=True)
class DesignTouchSettings:
    """Search for the pose at which a design's condyles touch."""

    halvings: int = 18
    """Halvings of the bracket around the adduction. Chosen: 18 leave 3e-7 rad."""
    largest_adduction: float = 0.04
    """rad: largest distance of the adduction from the initial guess. Chosen: both condyles touch
    within it."""


DESIGN_TOUCH = DesignTouchSettings()


@dataclass(frozen=True)
class Touch:
    """Pose at which both condyles touch: mm and rad; contact points (2, 3) medial, lateral."""

    si: float
    adduction: float
    points: Array


@dataclass(frozen=True)
class Articulation:
    """A femoral component on an insert, as exact surfaces.

    Args:
        femoral: femoral component.
        insert: insert.
    """

    femoral: FemoralComponent
    insert: Insert

    def lowest(self, pose: Array, flexion: float, side: float) -> tuple[float, Array]:
        """Return the least vertical gap (mm) of a condyle and the insert point (3,) below it.

        Args:
            pose: pose_femoral_in_insert (4, 4), mm.
            flexion: rad.
            side: MEDIAL or LATERAL.
        """
        phi, z = flexion, side * self.femoral.ridge_half
        reach = np.array([PHI_REACH, Z_REACH])
        step = np.linspace(-1.0, 1.0, 9)
        for _ in range(DESIGN_TOUCH.halvings):
            phis = np.clip(phi + reach[0] * step[:, None], *self.femoral.profile.range)
            zs = z + reach[1] * step[None, :]
            points = self.femoral.surface(phis, zs) @ pose[:3, :3].T + pose[:3, 3]
            gaps = points[..., 1] - self.insert.height(points[..., 0], points[..., 2])
            row, column = np.unravel_index(np.argmin(gaps), gaps.shape)
            phi, z = phis[row, 0], zs[0, column]
            reach = reach * 0.5
        gap, point = float(gaps[row, column]), points[row, column]
        return gap, np.array([point[0], point[1] - gap, point[2]])

    def touch(
        self, ap: float, ml: float, axial_rotation: float, flexion: float, guess: float = 0.0
    ) -> Touch:
        """Return the Touch at the given AP and ML (mm), axial rotation and flexion (rad)."""

        def pose(adduction: float) -> Array:
            return knee_pose([ap, 0.0, ml, axial_rotation, adduction, flexion])

        def difference(adduction: float) -> float:
            femoral = pose(adduction)
            gaps = [self.lowest(femoral, flexion, side)[0] for side in (LATERAL, MEDIAL)]
            return gaps[0] - gaps[1]

        bounds = guess - DESIGN_TOUCH.largest_adduction, guess + DESIGN_TOUCH.largest_adduction
        adduction = brentq(difference, *bounds, xtol=1e-12)
        femoral = pose(adduction)
        medial, lateral = (self.lowest(femoral, flexion, side) for side in (MEDIAL, LATERAL))
        return Touch(-(medial[0] + lateral[0]) / 2.0, adduction, np.stack([medial[1], lateral[1]]))
