"""Femoral adjustment: corrects the errors of fluoroscopy in a recorded pose before contact.

The errors of about 0.5 mm and 0.5 deg exceed the deformation. Both are limits of the correction
(Sharma 2008, section 4.3):

1. The coronal angle is the difference of the condyles' gaps at the recorded pose, divided by the
   distance of the contact points in the coronal plane.
2. Below 0.5 deg, the femur is turned in the coronal plane until both condyles touch together,
   by 0.5 deg at most. A larger angle is evidence of lift-off: no turn.
3. The femur is moved along y to first touch, by 0.5 mm at most; else the frame is flagged. The
   press then moves it along y until the contact carries the load, so that this limit does not
   change the medial-lateral split.

Sharma (2008) does not give the centre of the turn; here it is the component's, which registration
places best. A turn of 0.4 deg about the contact points, 25 mm below, would shift the component by
0.2 mm. In dishes little wider than the condyles the contact would move by 1.3 mm, and the total
force would change by 0.02 BW.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.closest import ClosestPointQuery, CondyleGaps
from tkamb.geometry.frames import Array, pose, transform
from tkamb.units import DEGREE, MILLIMETRE

RestoreRule = Literal["both", "either"]


@dataclass(frozen=True)
class AdjustmentSettings:
    """The limits of the adjustment, and the rule that restores the recorded rotation."""

    largest_angle: float = 0.5 * DEGREE
    """rad: coronal angle from which the frame is a lift-off and is not corrected. From Sharma
    (2008): 0.5 deg, the error of fluoroscopy."""
    largest_translation: float = 0.5 * MILLIMETRE
    """m: largest move of the femur along y. From Sharma (2008): 0.5 mm, the error of
    fluoroscopy."""
    restore_when: RestoreRule = "both"
    """Condition that restores the recorded rotation. "both": penetration and coronal angle after
    the press both exceed the adjustment (Sharma 2008). "either": one of them does."""
    input_change: float = 0.1 * MILLIMETRE
    """m: error of a recorded gap, a fifth of fluoroscopy's. A frame is flagged if it decides
    whether the recorded rotation is changed.
    """
    largest_recorded_gap: float = 3.0 * MILLIMETRE
    """m: if both condyles are farther from the insert, the pose is refused. It is
    more than the errors of fluoroscopy."""
    level_difference: float = 5e-6
    """m: difference of the condyles' gaps below which the femur is not turned.
    Meshes do not resolve smaller differences."""
    touch_difference: float = 1e-7
    """m: difference of the condyles' travel to touch below which both touch together.
    Not studied."""
    max_turns: int = 20
    """Most steps of the search for the turn at which both condyles touch together. Not studied."""


ADJUSTMENT = AdjustmentSettings()


@dataclass(frozen=True, eq=False)
class Adjustment:
    """The adjustment of a recorded pose before contact.

    Args:
        pose: (4, 4) adjusted pose_femoral_in_insert; `recorded` before the adjustment.
        translation: m, move of the component's centre along y; negative is downwards.
        coronal_angle: rad, turn of the femur about the insert's x axis.
        measured_angle: rad, coronal angle of the recorded pose.
        intercondylar_distance: m, between the contact points in the coronal plane; NaN with one
            condyle.
        penetration: m, penetration after the press; NaN before the press.
        final_angle: rad, difference of the penetrations / intercondylar distance.
        restored: whether the recorded rotation was restored after the press. `pose` is then the
            restored pose, and `coronal_angle` the turn that was undone.
    """

    pose: Array
    recorded: Array
    translation: float
    coronal_angle: float
    measured_angle: float
    intercondylar_distance: float
    settings: AdjustmentSettings = ADJUSTMENT
    penetration: float = math.nan
    final_angle: float = math.nan
    restored: bool = False
    flags: tuple[str, ...] = ()


def adjust(
    query: ClosestPointQuery,
    recorded: Array,
    settings: AdjustmentSettings = ADJUSTMENT,
) -> Adjustment:
    """Return the adjusted pose.

    Args:
        recorded: (4, 4) recorded pose_femoral_in_insert.

    Raises:
        InputError: neither condyle is near the insert.
        ComputationError: the femoral component does not lie over the insert.
    """
    recorded = np.asarray(recorded, float)
    gaps = query.at(recorded)
    _check_near(gaps, settings)
    angle, distance = _coronal_angle(gaps)
    turn, flags = 0.0, tuple[str, ...]()
    if gaps.lateral is not None and abs(angle) * distance > settings.level_difference:
        turn, flags = _limited_turn(query, recorded, angle, distance, settings)
    level = _turned(query, recorded, turn) if turn else recorded
    touching, translation, more = moved_to_touch(query, level, settings)
    return Adjustment(
        touching, recorded, translation, turn, angle, distance, settings, flags=(*flags, *more)
    )


def _limited_turn(
    query: ClosestPointQuery,
    recorded: Array,
    angle: float,
    distance: float,
    settings: AdjustmentSettings,
) -> tuple[float, tuple[str, ...]]:
    """Return the turn (rad), 0 beyond the limit, and a flag close to the limit."""
    limit, margin = settings.largest_angle, settings.input_change / distance
    if abs(angle) > limit + margin:
        return 0.0, ()
    turn = _levelling_turn(query, recorded, distance, settings)
    largest = max(abs(angle), abs(turn))
    flags: tuple[str, ...] = ()
    if abs(largest - limit) <= margin:
        outcome = "turned level" if largest < limit else "left as lift-off"
        flags = (
            f"coronal angle of {largest / DEGREE:.2f} deg is {outcome}: an error of "
            f"{settings.input_change / MILLIMETRE:g} mm at a condyle would cross the limit of "
            f"{limit / DEGREE:g} deg, where the medial-lateral split jumps",
        )
    return (turn if largest < limit else 0.0), flags


def moved_to_touch(
    query: ClosestPointQuery, at: Array, settings: AdjustmentSettings
) -> tuple[Array, float, tuple[str, ...]]:
    """Return a pose (4, 4) moved along y to first touch, as far as the limit allows.

    Also returns the move along y (m), and a flag if first touch is farther than the limit.

    Raises:
        ComputationError: the femur does not lie over the insert.
    """
    travel, limit = travel_to_touch(query, at), settings.largest_translation
    translation = min(max(-travel, -limit), limit)
    flags: tuple[str, ...] = ()
    if abs(travel) > limit:
        where = "above" if travel > 0 else "below"
        flags = (
            f"recorded femur is {abs(travel) / MILLIMETRE:.2f} mm {where} first touch: adjusted by "
            f"the {limit / MILLIMETRE:g} mm that fluoroscopy errs by; the press moves it further",
        )
    return raised(at, translation), translation, flags


def _check_near(gaps: CondyleGaps, settings: AdjustmentSettings) -> None:
    condyle_gaps = [gap.gap for gap in (gaps.medial, gaps.lateral) if gap is not None]
    nearest = min(condyle_gaps, key=abs)
    if abs(nearest) > settings.largest_recorded_gap:
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
    separation = gaps.lateral.point_on_femoral - gaps.medial.point_on_femoral
    distance = math.hypot(separation[1], separation[2])
    return (gaps.lateral.gap - gaps.medial.gap) / distance, distance


def _levelling_turn(
    query: ClosestPointQuery, recorded: Array, distance: float, settings: AdjustmentSettings
) -> float:
    """Return the turn (rad) at which both condyles touch together, by the secant method."""

    def difference(turn: float) -> float:
        medial, lateral = touches(query, _turned(query, recorded, turn))
        return lateral - medial

    last, error = 0.0, difference(0.0)
    turn = error / distance
    for _ in range(settings.max_turns):
        if abs(error) < settings.touch_difference or turn == last:
            return last
        next_error = difference(turn)
        slope = (next_error - error) / (turn - last)
        last, error = turn, next_error
        turn = last - error / (slope if slope != 0.0 else -distance)
    return last


def touches(query: ClosestPointQuery, at: Array) -> tuple[float, float]:
    """Return the travel (m) along -y to touch, medial and lateral; negative for an overlap."""
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
    centre = transform(recorded, query.femoral.bounds.mean(axis=0))
    rotation = Rotation.from_rotvec([turn, 0.0, 0.0]).as_matrix()
    return pose(rotation, centre - rotation @ centre) @ recorded


def raised(at: Array, along_y: float) -> Array:
    """Return the pose (4, 4) moved by `along_y` (m) along the insert's y."""
    shifted = np.array(at)
    shifted[1, 3] += along_y
    return shifted
