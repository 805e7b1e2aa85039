"""Femoral adjustment: fluoroscopy's coronal error is taken out before contact, then checked.

Fluoroscopy errs by about 0.5 mm and 0.5 deg, which is more than the deformation itself. Sharma
(2008), section 4.3, takes both as cut-offs:

1. Gap of each condyle at the recorded pose (closest points); coronal angle = difference of
   the gaps / distance of the contact points in the coronal plane.
2. Below 0.5 deg the femur is turned in the coronal plane, about the component's own centre,
   until both condyles touch together. Above, it is not turned: that is evidence of lift-off. It is
   not turned either where the turn that this takes would exceed 0.5 deg.
3. It is moved along y to first touch, by 0.5 mm at most. A femur that is farther from touch
   than fluoroscopy errs is flagged. The press moves it on to contact in any case, since it
   moves the femur along y until the load is carried. The height therefore decides nothing
   about the split, and the split has no step at the limit.

Sharma (2008) does not say about which point it turns. Registration places the component's centre
better than any other point, so the centre stays where it was recorded. About the contact
points, 25 mm below, 0.4 deg shift the component sideways by 0.2 mm, and in dishes little
wider than the condyles the contact by 1.3 mm: enough to change the total force by 0.02 BW.

`tkamb.knee.adjustment` compares the adjustment with the deformation, and may
restore the recorded rotation.
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
    """The limits of the adjustment and the rule by which it is undone."""

    largest_angle: float = 0.5 * DEGREE
    """rad: a coronal angle of this size or more is lift-off and is not corrected (Sharma 2008:
    0.5 deg, the error of fluoroscopy)."""
    largest_translation: float = 0.5 * MILLIMETRE
    """m: the adjustment moves the femur by no more than this along y (Sharma 2008: 0.5 mm,
    the error of fluoroscopy)."""
    restore_when: RestoreRule = "both"
    """"both": the recorded rotation is restored if penetration and coronal angle after the
    press exceed the adjustment (Sharma 2008); "either": if one of them does."""
    input_change: float = 0.1 * MILLIMETRE
    """m: if a change of the recorded pose by this much can change the answer by a step, the
    result is flagged. Chosen: a fifth of the error of fluoroscopy."""
    largest_recorded_gap: float = 3.0 * MILLIMETRE
    """m: with both condyles farther than this from the insert the pose is no recorded contact.
    Chosen: it is more than the errors of fluoroscopy."""
    level_difference: float = 5e-6
    """m: condyles whose gaps differ by less count as level, and the femur is not turned. Chosen:
    meshes do not resolve smaller differences."""
    touch_difference: float = 1e-7
    """m: difference of the condyles' clearances below which they touch together. Chosen: far below
    what changes a force."""
    max_turns: int = 20
    """Largest number of steps of the search for the turn at which both condyles touch together.
    Chosen: the search ends after fewer."""


ADJUSTMENT = AdjustmentSettings()


@dataclass(frozen=True, eq=False)
class Adjustment:
    """What was done to a recorded pose before contact.

    Args:
        pose: (4, 4) adjusted pose_femoral_in_insert.
        recorded: (4, 4) the pose as recorded.
        translation: m along y, of the component's centre; negative is downwards.
        coronal_angle: rad about the insert's x axis by which the femur was turned.
        measured_angle: rad, coronal angle of the recorded pose.
        intercondylar_distance: m; NaN with one condyle.
        settings: the limits that it was made with.
        penetration: m, how deep the femur sank in afterwards; NaN before the press.
        final_angle: rad, difference of the penetrations / intercondylar distance.
        restored: the recorded rotation was put back after the press; `coronal_angle` then
            says what had been tried, and `pose` is the restored one.
        flags: in words, why the answer depends on a limit.
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
        query: closest points of the pair.
        recorded: (4, 4) pose_femoral_in_insert.
        settings: the limits, and how the adjustment is undone later.

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
    """Return the turn (rad) that is made, 0 beyond the limit, and a flag close to the limit."""
    limit, margin = settings.largest_angle, settings.input_change / distance
    if abs(angle) > limit + margin:
        return 0.0, ()
    turn = _levelling_turn(query, recorded, distance, settings)
    largest = max(abs(angle), abs(turn))
    flags: tuple[str, ...] = ()
    if abs(largest - limit) <= margin:
        outcome = "turned level" if largest < limit else "left as lift-off"
        flags = (
            f"coronal angle of {largest / DEGREE:.2f} deg is {outcome}: the limit of "
            f"{limit / DEGREE:g} deg is so near that {settings.input_change / MILLIMETRE:g} mm at "
            f"a "
            "condyle would cross it, and the medial-lateral split jumps there",
        )
    return (turn if largest < limit else 0.0), flags


def moved_to_touch(
    query: ClosestPointQuery, at: Array, settings: AdjustmentSettings
) -> tuple[Array, float, tuple[str, ...]]:
    """Return a pose (4, 4) moved along y to first touch, as far as the limit allows.

    Returns:
        The pose, the move along y (m), and a flag where first touch is farther than the limit.

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
    apart = gaps.lateral.point_on_femoral - gaps.medial.point_on_femoral
    distance = math.hypot(apart[1], apart[2])
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
    shifted = np.array(at)
    shifted[1, 3] += along_y
    return shifted
