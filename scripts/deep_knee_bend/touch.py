"""First touch of the two condyles on the dishes, on the exact surfaces (no facets).

The vertical gap of a condyle is the least height of its surface above the dish, over all
its points: it is zero exactly when the two surfaces touch, and moving the femur up by g
widens it by g.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from deep_knee_bend import femoral, insert
from tkamb.geometry.frames import knee_pose

MEDIAL, LATERAL = -1.0, 1.0
PHI_REACH, Z_REACH = np.radians(30.0), 9.0
HALVINGS = 18


@dataclass(frozen=True)
class Touch:
    """Pose at which both condyles touch: mm and rad; contact points (2, 3) medial, lateral."""

    si: float
    adduction: float
    points: np.ndarray


def _rigid(ap, ml, axial_rotation, adduction, flexion):
    return knee_pose([ap, 0.0, ml, axial_rotation, adduction, flexion])


def lowest(pose, flexion, side):
    """Return the least vertical gap (mm) of a condyle and the insert point (3,) below it."""
    phi, z = flexion, side * femoral.d.CONDYLE_SPACING_HALF
    reach = np.array([PHI_REACH, Z_REACH])
    step = np.linspace(-1.0, 1.0, 9)
    for _ in range(HALVINGS):
        phis = np.clip(phi + reach[0] * step[:, None], *femoral.sagittal.PHI_RANGE)
        zs = z + reach[1] * step[None, :]
        points = femoral.surface(phis, zs) @ pose[:3, :3].T + pose[:3, 3]
        gaps = points[..., 1] - insert.height(points[..., 0], points[..., 2])
        row, column = np.unravel_index(np.argmin(gaps), gaps.shape)
        phi, z = phis[row, 0], zs[0, column]
        reach = reach * 0.5
    gap, point = gaps[row, column], points[row, column]
    return gap, np.array([point[0], point[1] - gap, point[2]])


def touch(ap, ml, axial_rotation, flexion, guess=0.0):
    """Return the Touch at the given AP and ML (mm), axial rotation and flexion (rad)."""

    def difference(adduction):
        pose = _rigid(ap, ml, axial_rotation, adduction, flexion)
        return lowest(pose, flexion, LATERAL)[0] - lowest(pose, flexion, MEDIAL)[0]

    adduction = brentq(difference, guess - 0.04, guess + 0.04, xtol=1e-12)
    pose = _rigid(ap, ml, axial_rotation, adduction, flexion)
    medial, lateral = (lowest(pose, flexion, side) for side in (MEDIAL, LATERAL))
    return Touch(-(medial[0] + lateral[0]) / 2.0, adduction, np.stack([medial[1], lateral[1]]))
