"""What a case is prepared with before its first frame, and what a sample of it takes over."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.scene.case import Case

if TYPE_CHECKING:
    from tkamb.geometry.closest import ClosestPointQuery
    from tkamb.knee.extensor import ExtensorFrames
    from tkamb.run.muscles.shared_muscles import SharedMuscles


@dataclass(frozen=True, eq=False)
class Known:
    """What a case with moved inputs takes over from the case as it stands.

    Args:
        query: of closest points between the surfaces, which are known to be near each other.
        muscles: those of [muscles], perhaps with other strengths.
        extensor: the mechanism; a patella that is to be found is looked for from where it is
            there.
        frames: in which it is; it stays elsewhere.
    """

    query: "ClosestPointQuery | None"
    muscles: "SharedMuscles | None"
    extensor: "ExtensorFrames | None"
    frames: range


def extensor_frames(case: Case, poses: Array, known: Known | None = None) -> "ExtensorFrames":
    """Return the extensor mechanism of a case with [patella].

    Args:
        case: the case.
        poses: (f, 4, 4) pose_femur_in_insert.
        known: what is known already of a case that this one is a sample of.

    Raises:
        InputError: no patella was recorded, or see `ExtensorFrames`.
    """
    from tkamb.knee.extensor import ExtensorFrames, ExtensorParts

    assert case.patellar_ligament is not None and case.scene.patella is not None
    assert case.femoral is not None and case.patella is not None
    (muscle,) = case.muscles
    parts = ExtensorParts(
        muscle, case.patellar_ligament, case.chain, case.femoral, case.patella, case.insert
    )
    motion, recorded = case.motion, None
    if known is not None and case.scene.patella.motion == "solved":
        assert known.extensor is not None
        return known.extensor.moved(parts, poses, known.frames)
    if case.scene.patella.motion == "recorded":
        if motion.patella is None:
            raise InputError(
                "has no patella columns",
                case.scene.motion.file,
                "record patella_ap, patella_si, patella_rotation or set [patella] motion = "
                "'solved'",
            )
        assert motion.patella_velocity is not None and motion.patella_acceleration is not None
        rates = (motion.patella_velocity, motion.patella_acceleration)
        recorded = np.stack([motion.patella, *rates], axis=1)
    return ExtensorFrames(parts, motion.time, poses, recorded, case.rates)


def contact_query(case: Case) -> "ClosestPointQuery | None":
    """Return closest points of the two surfaces; None without [contact]."""
    if case.scene.contact is None:
        return None
    from tkamb.geometry.closest import ClosestPointQuery

    assert case.femoral is not None and case.insert is not None
    return ClosestPointQuery(case.femoral, case.insert, case.split)
