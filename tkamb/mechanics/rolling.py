"""Motion after Sharma (2008): rotations as recorded, AP from rolling plus slip, SI from contact."""

from dataclasses import replace
from typing import Literal

import numpy as np

from tkamb.body.slip import condyle_slip, roll_slip_motion
from tkamb.errors import InputError
from tkamb.geometry.condyles import condyle_split
from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.inputs.filtering import differentiate_coordinates
from tkamb.inputs.motion import KneeMotion


def rolling_motion(
    motion: KneeMotion,
    femoral: Surface,
    insert: Surface,
    slip_share: float,
    cutoff: float | Literal["none"],
) -> KneeMotion:
    """Return the motion with its AP and SI coordinates replaced by those of roll and slip.

    SI brings the femur down to first touch, of one condyle; rotations and ML stay. The two
    new coordinates are differentiated like recorded ones; they are no closed cycle even
    where the recorded ones are.

    Args:
        motion: as recorded and filtered.
        femoral: femoral component, femoral frame.
        insert: insert, insert frame.
        slip_share: 1: the mean slip of the condyles that the recorded motion has;
            0: pure rolling.
        cutoff: Hz, low-pass of the differentiation.

    Raises:
        InputError: the femur rolls off the insert.
    """
    split = condyle_split(femoral)
    recorded = condyle_slip(femoral, insert, split, motion.coordinates)
    slip = np.mean([side.slip for side in recorded if side is not None], axis=0)
    rolled = roll_slip_motion(femoral, insert, split, motion.coordinates, slip_share * slip)
    _check_on_insert(rolled, motion.time)
    places, rates, accelerations = differentiate_coordinates(motion.time, rolled[:, :2], cutoff)
    return replace(
        motion,
        coordinates=np.hstack([places, motion.coordinates[:, 2:]]),
        velocity=np.hstack([rates, motion.velocity[:, 2:]]),
        acceleration=np.hstack([accelerations, motion.acceleration[:, 2:]]),
    )


def _check_on_insert(rolled: Array, time: Array) -> None:
    lost = np.flatnonzero(~np.isfinite(rolled).all(axis=1))
    if len(lost):
        raise InputError(
            f"the femur rolls off the insert at {time[lost[0]]:.3g} s",
            "[motion] motion = 'roll-slip'",
            "give it more of the recorded slip (slip_share) or take motion = 'recorded'",
        )
