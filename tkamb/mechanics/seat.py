"""Where the femur begins in coordinates that nobody recorded and that the scene releases."""

from dataclasses import replace
from typing import Literal

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.condyles import LowestPoints, condyle_split
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_pose
from tkamb.geometry.surface import Surface
from tkamb.inputs.filtering import differentiate_coordinates
from tkamb.inputs.motion import KneeMotion


def seated_motion(
    motion: KneeMotion, femoral: Surface, insert: Surface, cutoff: float | Literal["none"]
) -> KneeMotion:
    """Return the motion with a first guess for the coordinates that were not recorded.

    Rotations stay at zero. AP and ML bring the mean of the condyles' lowest points over the
    insert's origin, SI brings the femur down to first touch, all at the other coordinates.
    They are where the search for the released coordinates begins in each frame; their rates,
    which enter inertia and the direction of sliding, are those of this guess.

    Args:
        motion: as recorded; `motion.unrecorded` names what is missing.
        femoral: femoral component, femoral frame.
        insert: insert, insert frame.
        cutoff: Hz, low-pass of the differentiation.

    Raises:
        InputError: the femur does not come to lie over the insert.
    """
    places = motion.coordinates.copy()
    lowest = LowestPoints(femoral, condyle_split(femoral))
    touch = FirstTouch(femoral, insert)
    over = [(i, KNEE_COORDINATES.index(name), name) for i, name in ((0, "ap"), (2, "ml"))]
    for place in places:
        points = [point for point in lowest.at(knee_pose(place)) if point is not None]
        for axis, index, name in over:
            if name in motion.unrecorded:
                place[index] -= np.mean(points, axis=0)[axis]
        if "si" in motion.unrecorded:
            place[KNEE_COORDINATES.index("si")] -= touch.travel(knee_pose(place))
    _check_over_insert(places, motion.time)
    x, v, a = differentiate_coordinates(motion.time, places, cutoff)
    found = [KNEE_COORDINATES.index(name) for name in motion.unrecorded]
    coordinates, velocity, acceleration = (
        _with_columns(old, new, found)
        for old, new in (
            (motion.coordinates, x),
            (motion.velocity, v),
            (motion.acceleration, a),
        )
    )
    return replace(motion, coordinates=coordinates, velocity=velocity, acceleration=acceleration)


def _with_columns(old: Array, new: Array, columns: list[int]) -> Array:
    mixed = old.copy()
    mixed[:, columns] = new[:, columns]
    return mixed


def _check_over_insert(places: Array, time: Array) -> None:
    lost = np.flatnonzero(~np.isfinite(places).all(axis=1))
    if len(lost):
        raise InputError(
            f"the femur does not lie over the insert at {time[lost[0]]:.3g} s",
            "[motion]",
            "record ap and ml, or check the meshes' units, axes and origins",
        )
