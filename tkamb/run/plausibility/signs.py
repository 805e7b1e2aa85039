"""Questions about the signs of a recorded pose: does the femur follow the insert's surface?

A recorded contact keeps its gaps: condyles that bear roll and slide over the dishes without
leaving them or sinking in. With the sign of AP turned they ride up the lips, with that of axial
rotation or adduction turned alone one condyle rises while the other sinks. So each sign is turned
in turn, and asked about where the gaps are much steadier then.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_pose
from tkamb.io.scene.case import Case
from tkamb.run.plausibility.question import Question
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.first_touch import FirstTouch


@dataclass(frozen=True)
class SignSettings:
    """When a sign is asked about."""

    frames: int = 15
    """Looked at, evenly over the motion. Chosen: more change the spreads by some per cent."""
    ap_spread: float = 0.6 * MILLIMETRE
    """M, of the mean gap, below which AP is not asked about. Fluoroscopy of subject DM has 0.3 mm,
    and 1.3 mm with the sign turned."""
    ap_share: float = 0.5
    """Of that spread, what is left with the sign turned: 0.25 for DM."""
    turn_spread: float = 0.1 * MILLIMETRE
    """m: spread of the difference between the condyles' gaps below which rotation is not asked
    about. Chosen: a mesh of 1 mm facets makes 0.05 mm."""
    turn_share: float = 0.7
    """Of that spread, what is left with the sign turned: 0.43 to 0.62 for the two readings of DM;
    1.6 and more where the signs are right."""


SIGN = SignSettings()


def sign_questions(case: Case, settings: SignSettings | None = None) -> Iterator[Question]:
    """Signs of AP, and of axial rotation against adduction, of a recorded pose.

    Args:
        case: the case.
        settings: default: `SignSettings()`.
    """
    settings = SignSettings() if settings is None else settings
    free = _found_by_contact(case)
    if case.femoral is None or case.insert is None or {"ap", "axial_rotation"} <= free:
        return
    coordinates = case.motion.coordinates
    if case.motion.unrecorded or len(coordinates) < settings.frames:
        return
    from tkamb.geometry.condyles import condyle_split
    from tkamb.geometry.first_touch import FirstTouch

    rows = np.linspace(0, len(coordinates) - 1, settings.frames).astype(int)
    clearance = FirstTouch(case.femoral, case.insert, condyle_split(case.femoral))
    recorded = _gaps(clearance, coordinates[rows])
    if not np.isfinite(recorded).all():
        return
    rides = float(recorded.mean(axis=1).std())
    if not free & {"ap", "si"} and rides > settings.ap_spread:
        flipped = float(_turned_gaps(clearance, coordinates[rows], "ap").mean(axis=1).std())
        if flipped < settings.ap_share * rides:
            yield Question(
                f"the femur rides up and down by {rides / MILLIMETRE:.1f} mm (rms) over the "
                f"insert, by {flipped / MILLIMETRE:.1f} mm with the sign of AP turned: is "
                'anterior negative in the file? then [motion] signs_turned = ["ap"], or that of '
                "its translation",
                "sign of AP may be turned",
            )
            return
    tilts = _difference(recorded)
    if free & {"axial_rotation", "adduction"} or tilts < settings.turn_spread:
        return
    flipped = min(
        _difference(_turned_gaps(clearance, coordinates[rows], name))
        for name in ("axial_rotation", "adduction")
    )
    if flipped < settings.turn_share * tilts:
        yield Question(
            f"the condyles' gaps differ by {tilts / MILLIMETRE:.2f} mm (rms about their mean), "
            f"by {flipped / MILLIMETRE:.2f} mm with the sign of axial rotation, or of adduction, "
            "turned: is one of them another way round in the file? then [motion] signs_turned = "
            '["axial_rotation"], or that of its rotation',
            "sign of axial rotation or adduction may be turned",
        )


def _found_by_contact(case: Case) -> set[str]:
    """Return the coordinates that are not recorded: contact and equilibrium find them."""
    contact = case.scene.contact
    return set(KNEE_COORDINATES) if contact is None else set(contact.released)


def _gaps(clearance: "FirstTouch", coordinates: Array) -> Array:
    """Return the vertical clearance (f, 2) m of the condyles; NaN where one is off the insert."""
    touches = [clearance.at(knee_pose(row)) for row in coordinates]
    return np.array([[np.nan if t is None else t.travel for t in pair] for pair in touches])


def _turned_gaps(clearance: "FirstTouch", coordinates: Array, name: str) -> Array:
    """Return the clearances with the sign of one coordinate turned."""
    flipped = coordinates.copy()
    flipped[:, KNEE_COORDINATES.index(name)] *= -1.0
    return _gaps(clearance, flipped)


def _difference(gaps: Array) -> float:
    """Return the spread (m) over the frames of the difference between the condyles' gaps."""
    return float(np.std(gaps[:, 0] - gaps[:, 1]))
