"""What a case is prepared with before its first frame, and what a sample of it takes over."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import InputError, renamed
from tkamb.geometry.frames import Array
from tkamb.io.scene.case import Case

if TYPE_CHECKING:
    from tkamb.geometry.closest import ClosestPointQuery
    from tkamb.knee.extensor import ExtensorFrames
    from tkamb.run.muscles.shared_muscles import SharedMuscles


@dataclass(frozen=True, eq=False)
class SharedState:
    """State that a sample, a case with changed inputs, shares with the nominal case.

    Args:
        query: closest points between the surfaces, which stay near each other in all samples.
        muscles: those of [muscles]; their strengths may differ from the nominal ones.
        extensor: extensor mechanism of the nominal case. Its patella is the initial guess of the
            search for the patella of the sample.
        frames: frames in which the patella is searched for. In the others it stays where it is.
    """

    query: "ClosestPointQuery | None"
    muscles: "SharedMuscles | None"
    extensor: "ExtensorFrames | None"
    frames: range


def extensor_frames(
    case: Case, poses: Array, shared: SharedState | None = None
) -> "ExtensorFrames":
    """Return the extensor mechanism of a case with [patella].

    Args:
        case: the case.
        poses: (f, 4, 4) pose_femur_in_insert.
        shared: state of the case that this one is a sample of.

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
    if shared is not None and case.scene.patella.motion == "solved":
        assert shared.extensor is not None
        return shared.extensor.moved(parts, poses, shared.frames)
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


def __getattr__(name: str) -> Any:
    """Return a class by its former name, with a warning; until release 0.3."""
    return renamed(__name__, name, {"Known": SharedState})
