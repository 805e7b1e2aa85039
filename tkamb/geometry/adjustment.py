"""Femoral adjustment: fluoroscopy's coronal error is taken out before contact, then checked.

Fluoroscopy errs by about 0.5 mm and 0.5 deg, which is more than the deformation itself.

1. Gap of each condyle at the recorded pose (closest points); coronal angle = difference of
   the gaps / distance of the contact points in the coronal plane.
2. Below 0.5 deg the femur is turned in the coronal plane, about the component's own centre,
   until both condyles touch together; above it is left: evidence of lift-off. So it is where
   the turn that this takes would exceed 0.5 deg.
3. It is always moved along y to first touch.

Sharma (2008) does not say about which point it turns. Registration places the component's centre
better than any other point, so the centre stays where it was recorded. About the contact
points, 25 mm below, 0.4 deg shift the component sideways by 0.2 mm, and in dishes little
wider than the condyles the contact by 1.3 mm: enough to change the total force by 0.02 BW.

`tkamb.equilibrium.adjusted_press` checks it after the deformation, and restores the recorded
rotation.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.closest import ClosestPointQuery, CondyleGaps
from tkamb.geometry.frames import Array, pose, transform
from tkamb.units import DEGREE, MILLIMETRE

LARGEST_ANGLE = 0.5 * DEGREE
"""rad: coronal angles from here on are taken as lift-off and left alone."""

LARGEST_RECORDED_GAP = 3.0 * MILLIMETRE
"""m: with both condyles farther than this from the insert the pose is no recorded contact."""

LEVEL_DIFFERENCE = 5e-6
"""m: condyles whose gaps differ by less are level as far as a mesh can say; no turn."""

TOUCH_DIFFERENCE = 1e-7
"""m: difference of the condyles' clearances at which they touch together."""

MOST_TURNS = 20


@dataclass(frozen=True, eq=False)
class Adjustment:
    """What was done to a recorded pose before contact.

    Args:
        pose: (4, 4) adjusted pose_femoral_in_insert, at first touch.
        recorded: (4, 4) the pose as recorded.
        translation: m along y, of the component's centre; negative is downwards.
        coronal_angle: rad about the insert's x axis by which the femur was turned.
        measured_angle: rad, coronal angle of the recorded pose that was found.
        intercondylar_distance: m; NaN with one condyle.
        penetration: m, how deep the femur sank in afterwards; NaN before the press.
        final_angle: rad, difference of the penetrations / intercondylar distance.
        restored: the recorded rotation was put back after the press; `coronal_angle` then
            says what had been tried, and `pose` is the restored one at first touch.
    """

    pose: Array
    recorded: Array
    translation: float
    coronal_angle: float
    measured_angle: float
    intercondylar_distance: float
    penetration: float = math.nan
    final_angle: float = math.nan
    restored: bool = False


def adjust(query: ClosestPointQuery, recorded: Array) -> Adjustment:
    """Return the adjusted pose.

    Args:
        query: closest points of the pair.
        recorded: (4, 4) pose_femoral_in_insert.

    Raises:
        InputError: neither condyle is near the insert.
        ComputationError: the femoral component does not lie over the insert.
    """
    recorded = np.asarray(recorded, float)
    gaps = query.at(recorded)
    _check_near(gaps)
    angle, distance = _coronal_angle(gaps)
    turn = 0.0
    if (
        gaps.lateral is not None
        and LEVEL_DIFFERENCE < abs(angle) * distance < LARGEST_ANGLE * distance
    ):
        turn = _levelling_turn(query, recorded, distance)
        turn = turn if abs(turn) < LARGEST_ANGLE else 0.0
    turned = _turned(query, recorded, turn) if turn else recorded
    travel = travel_to_touch(query, turned)
    return Adjustment(raised(turned, -travel), recorded, -travel, turn, angle, distance)


def _check_near(gaps: CondyleGaps) -> None:
    found = [gap.gap for gap in (gaps.medial, gaps.lateral) if gap is not None]
    nearest = min(found, key=abs)
    if abs(nearest) > LARGEST_RECORDED_GAP:
        word = "above" if nearest > 0.0 else "inside"
        raise InputError(
            f"neither condyle is near the insert (nearest {abs(nearest) * 1e3:.1f} mm {word})",
            "femoral adjustment",
            "check the pose, the meshes' units and axes, or leave the adjustment off",
        )


def _coronal_angle(gaps: CondyleGaps) -> tuple[float, float]:
    """Return coronal angle (rad) and intercondylar distance (m); zero and NaN for one condyle."""
    if gaps.lateral is None:
        return 0.0, math.nan
    apart = gaps.lateral.point_on_femoral - gaps.medial.point_on_femoral
    distance = math.hypot(apart[1], apart[2])
    return (gaps.lateral.gap - gaps.medial.gap) / distance, distance


def _levelling_turn(query: ClosestPointQuery, recorded: Array, distance: float) -> float:
    """Return the turn (rad) at which both condyles touch together, by the secant method."""

    def difference(turn: float) -> float:
        medial, lateral = touches(query, _turned(query, recorded, turn))
        return lateral - medial

    last, error = 0.0, difference(0.0)
    turn = error / distance
    for _ in range(MOST_TURNS):
        if abs(error) < TOUCH_DIFFERENCE or turn == last:
            return last
        now = difference(turn)
        slope = (now - error) / (turn - last)
        last, error = turn, now
        turn = last - error / (slope if slope != 0.0 else -distance)
    return last


def touches(query: ClosestPointQuery, at: Array) -> tuple[float, float]:
    """Return travel (m) along -y to touch, medial and lateral; negative once inside."""
    medial, lateral = query.first_touch.at(at)
    if medial is None or lateral is None:
        raise ComputationError("a condyle does not lie over the insert", "femoral adjustment")
    return medial.travel, lateral.travel


def travel_to_touch(query: ClosestPointQuery, at: Array) -> float:
    """Return the travel (m) along -y from a pose (4, 4) to first touch.

    Raises:
        ComputationError: the femur does not lie over the insert.
    """
    travel = query.first_touch.travel(at)
    if not math.isfinite(travel):
        raise ComputationError("the femur does not lie over the insert", "femoral adjustment")
    return travel


def _turned(query: ClosestPointQuery, recorded: Array, turn: float) -> Array:
    """Return the pose turned about the insert's x axis through the component's centre."""
    centre = transform(recorded, query.femoral.bounds.mean(axis=0))
    rotation = Rotation.from_rotvec([turn, 0.0, 0.0]).as_matrix()
    return pose(rotation, centre - rotation @ centre) @ recorded


def raised(at: Array, along_y: float) -> Array:
    """Return the pose (4, 4) moved by `along_y` (m) along the insert's y."""
    moved = np.array(at)
    moved[1, 3] += along_y
    return moved
