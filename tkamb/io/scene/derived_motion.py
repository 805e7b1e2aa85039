"""Partly computed motions: the femur is placed on the insert, or rolls and slips over it."""

from dataclasses import replace

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.condyles import LowestPoints, condyle_split
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_pose
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.filtering import Cutoff, differentiate_coordinates
from tkamb.io.recordings.motion import KneeMotion
from tkamb.knee.slip import condyle_slip, roll_slip_motion


def seated_motion(
    motion: KneeMotion, femoral: Surface, insert: Surface, cutoff: Cutoff
) -> KneeMotion:
    """Return the motion with an initial guess of the coordinates that were not recorded.

    Unrecorded rotations are zero. AP and ML place the mean of the condyles' lowest points above the
    insert's origin, and SI lowers the femur to first touch. The rates of this guess determine
    inertia forces and the direction of sliding.

    Args:
        motion: recorded motion; `motion.unrecorded` names the missing coordinates.
        femoral: femoral component, femoral frame.
        cutoff: cut-off frequency of the low-pass filter, Hz.
    """
    places = motion.coordinates.copy()
    lowest = LowestPoints(femoral, condyle_split(femoral))
    touch = FirstTouch(femoral, insert)
    horizontal_axes = [
        (i, KNEE_COORDINATES.index(name), name) for i, name in ((0, "ap"), (2, "ml"))
    ]
    for place in places:
        points = [point for point in lowest.at(knee_pose(place)) if point is not None]
        for axis, index, name in horizontal_axes:
            if name in motion.unrecorded:
                place[index] -= np.mean(points, axis=0)[axis]
        if "si" in motion.unrecorded:
            place[KNEE_COORDINATES.index("si")] -= touch.travel(knee_pose(place))
    gap = _first_lost(places, motion.time)
    if gap is not None:
        raise InputError(
            f"the femur does not lie over the insert at {gap:.3g} s",
            "[motion]",
            "record ap and ml, or check the meshes' units, axes and origins",
        )
    result = [KNEE_COORDINATES.index(name) for name in motion.unrecorded]
    return _with_coordinates(motion, places, result, cutoff)


def rolling_motion(
    motion: KneeMotion, femoral: Surface, insert: Surface, slip_share: float, cutoff: Cutoff
) -> KneeMotion:
    """Return the motion with AP and SI from rolling and slipping of the femur on the insert.

    SI lowers the femur to first touch; rotations and ML do not change. AP and SI are filtered and
    differentiated like recorded coordinates, but never as a closed cycle.

    Args:
        slip_share: share of the recorded motion's mean slip of the condyles; 0 is pure rolling.
    """
    split = condyle_split(femoral)
    recorded = condyle_slip(femoral, insert, split, motion.coordinates)
    slip = np.mean([side.slip for side in recorded if side is not None], axis=0)
    rolled = roll_slip_motion(femoral, insert, split, motion.coordinates, slip_share * slip)
    gap = _first_lost(rolled, motion.time)
    if gap is not None:
        raise InputError(
            f"the femur rolls off the insert at {gap:.3g} s",
            "[motion] motion = 'roll-slip'",
            "increase slip_share, or take motion = 'recorded'",
        )
    return _with_coordinates(motion, rolled, [0, 1], cutoff)


def _first_lost(places: Array, time: Array) -> float | None:
    """Return the first time, s, of a coordinate (f, 6) that is not finite, or None."""
    missing = np.flatnonzero(~np.isfinite(places).all(axis=1))
    return float(time[missing[0]]) if len(missing) else None


def _with_coordinates(
    motion: KneeMotion, places: Array, columns: list[int], cutoff: Cutoff
) -> KneeMotion:
    """Return the motion with `columns` from `places` (f, 6), filtered."""
    values = (motion.coordinates.copy(), motion.velocity.copy(), motion.acceleration.copy())
    result = differentiate_coordinates(motion.time, places[:, columns], cutoff)
    for value, new in zip(values, result, strict=True):
        value[:, columns] = new
    coordinates, velocity, acceleration = values
    return replace(motion, coordinates=coordinates, velocity=velocity, acceleration=acceleration)
