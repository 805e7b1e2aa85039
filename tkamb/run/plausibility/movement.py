"""Questions about the recorded movement: ranges, rates, outliers, signs of the pose.

Signs: loaded condyles stay in contact with the insert, so that their gaps at the recorded poses
vary little. With a wrong sign of AP the femur moves up the insert's lips; with one of axial
rotation or adduction, a condyle rises and the other sinks. The check inverts one sign at a time,
and asks if the gaps then vary much less.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_pose
from tkamb.io.recordings.filtering import OddSample
from tkamb.io.recordings.recording_tables import GroundReactionTable
from tkamb.io.scene.case import Case
from tkamb.run.plausibility import Question
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.first_touch import FirstTouch


@dataclass(frozen=True)
class MovementLimitSettings:
    """Limits of plausible movements."""

    max_flexion_as_radians: float = 3.3
    """deg: largest flexion that suggests radians in the file. 190 deg in radians is
    the number 3.3."""
    max_marker_residual: float = 12.0 * MILLIMETRE
    """m: largest root mean square residual of the markers in the median frame. Skin moves by up to
    10 mm in a cluster, and by 5 mm on the stairs of subject JW."""
    min_duration: float = 0.15
    """s: least duration of a motion. No movement of a leg is shorter."""
    odd_sample_window: float = 0.2
    """s: longest time from an outlier to the nearest frame. With a low-pass filter of 6 Hz, the
    effect of an outlier after this time is below 3 % of its largest effect."""
    min_translation: float = 0.1 * MILLIMETRE
    """m: least translation of the femur on the insert in a bend of 20 deg. Metres that are
    read as millimetres give less."""


MOVEMENT_LIMITS = MovementLimitSettings()

LEAN_RADIANS, DEEP = 2.6, 60.0
"""deg: largest lean of the shank that suggests radians (150 deg are 2.6 rad), and range of flexion
from which the shank leans by far more."""
USUAL_DEG = {"flexion": (-15, 160), "adduction": (-12, 12), "axial_rotation": (-40, 40)}
"""deg: limits of the angles, reached in kneeling, dislocation and a rotating platform."""
USUAL_RATE = {"flexion": 20.0, "adduction": 6.0, "axial_rotation": 10.0}
"""rad/s: limits of the rates, reached in a kick (flexion) and a pivoting jump."""
PATELLA_AWAY = (15.0 * MILLIMETRE, 80.0 * MILLIMETRE)
"""m: limits of the distance from the flexion axis to the patella's origin. It is 0.026 to 0.057 in
bends of eight designs."""


def motion_questions(case: Case) -> Iterator[Question]:
    """Ask about unlikely angles, rates, translations, patella or duration of the motion."""
    motion = case.motion
    angles = dict(zip(KNEE_COORDINATES, motion.coordinates.T, strict=True))
    rates = dict(zip(KNEE_COORDINATES, motion.velocity.T, strict=True))
    flexion = angles["flexion"] / DEGREE
    if np.ptp(flexion) > 0.2 and np.abs(flexion).max() < MOVEMENT_LIMITS.max_flexion_as_radians:
        yield Question(
            f"flexion runs from {flexion.min():.2g} to {flexion.max():.2g} deg: is it in radians?",
            "flexion hardly changes",
        )
    table = case.scene.tibia
    if case.tibia is not None and table is not None and table.kind != "markers":
        forward, up = case.tibia.pose[:, 0, 1], case.tibia.pose[:, 1, 1]
        lean = np.arctan2(forward, up) / DEGREE
        moves = np.ptp(lean) > 0.1 and np.ptp(flexion) > DEEP
        if moves and np.abs(lean).max() < LEAN_RADIANS:
            yield Question(
                f"the shank leans from {lean.min():.2g} to {lean.max():.2g} deg in a bend of "
                f"{np.ptp(flexion):.0f} deg: is [tibia]'s angle in radians?",
                "shank hardly leans",
            )
    for name, (low, high) in USUAL_DEG.items():
        angle = angles[name] / DEGREE
        frames = (angle < low) | (angle > high)
        if frames.any():
            worst = angle[int(np.argmax(np.maximum(low - angle, angle - high)))]
            yield Question(
                f"{name} reaches {worst:.0f} deg, where few knees go ({low} to {high}): is its "
                "column, sign ([motion] signs_turned) or axis another one?",
                f"{name} of {worst:.0f} deg",
                frames,
            )
        fast = np.abs(rates[name]) > USUAL_RATE[name]
        if fast.any():
            k = int(np.argmax(np.abs(rates[name])))
            yield Question(
                f"{name} changes by {abs(rates[name][k]) / DEGREE:.0f} deg/s at "
                f"{motion.time[k]:.4g} s: is the time in seconds, or is it noise?",
                f"{name} changes too fast",
                fast,
            )
    if motion.patella is not None:
        away = np.hypot(motion.patella[:, 0], motion.patella[:, 1])
        frames = (away < PATELLA_AWAY[0]) | (away > PATELLA_AWAY[1])
        if frames.any():
            nearest, farthest = away.min() / MILLIMETRE, away.max() / MILLIMETRE
            yield Question(
                f"the patella lies {nearest:.3g} to {farthest:.3g} mm from the flexion axis: are "
                "its ap and si in millimetres, from the femoral component's origin, with the right "
                "sign?",
                "patella too near to or far from the flexion axis",
                frames,
            )
    yield from _translation_questions(case)
    if motion.time[0] == 0.0 and motion.time[-1] == 100.0:
        yield Question(
            "the time runs from 0 to 100 s: is it in per cent of a cycle? Rewrite the column in "
            "seconds; velocities and accelerations follow from it",
            "time may be in per cent",
        )
    duration = float(motion.time[-1] - motion.time[0])
    if duration < MOVEMENT_LIMITS.min_duration:
        yield Question(
            f"the motion lasts {duration:.3g} s: is its time in seconds?", "motion too brief"
        )


def _translation_questions(case: Case) -> Iterator[Question]:
    """Ask about recorded translations that hardly change. Constant ones are prescribed values."""
    motion = case.motion
    names = ("ap", "si", "ml")
    if motion.unrecorded or motion.markers is not None:
        return
    columns = [KNEE_COORDINATES.index(name) for name in names]
    largest = float(np.ptp(motion.coordinates[:, columns], axis=0).max())
    bend = float(np.ptp(motion.coordinates[:, KNEE_COORDINATES.index("flexion")]))
    if bend > 20.0 * DEGREE and 1e-9 < largest < MOVEMENT_LIMITS.min_translation:
        yield Question(
            f"ap, si and ml change by {largest / MILLIMETRE:.2g} mm at most in a bend of "
            f"{bend / DEGREE:.0f} deg: is [motion] length_unit another one?",
            "translations hardly change",
        )


def marker_questions(case: Case) -> Iterator[Question]:
    """Ask about large residuals of the markers after a rigid fit of each segment."""
    if case.motion.markers is not None:
        name, rms = "the markers of shank and thigh", case.motion.markers.rms["segments"]
    elif case.tibia is not None and case.tibia.residual is not None:
        name, rms = "the markers of the shank", case.tibia.residual
    else:
        return
    finite = rms[np.isfinite(rms)]
    if len(finite) and (middle := float(np.median(finite))) > MOVEMENT_LIMITS.max_marker_residual:
        yield Question(
            f"{name} lie {middle / MILLIMETRE:.0f} mm (rms) from their positions on the segments: "
            "is markers_mm of another subject or trial, or are two markers exchanged?",
            "markers do not fit their segments",
        )


def drift_questions(case: Case) -> Iterator[Question]:
    """Ask about force plates with a force while nobody stands on them."""
    if case.ground is None:
        return
    drift = [f"plate {number} {level:.1f} N" for number, level in case.ground.drift.items()]
    if drift:
        yield Question(
            f"force plates drift: {', '.join(drift)} while nobody stands on it, and the same error "
            "under the foot: were they not set to zero before the trial?",
            "force plate drifts",
        )


def sample_questions(case: Case) -> Iterator[Question]:
    """Ask about recorded samples off the curve of their neighbours, once for each file."""
    parts = (case.motion, case.tibia, case.ground)
    time = case.motion.time
    step = float(np.ptp(time)) / max(len(time) - 1, 1)
    window = max(3.0 * step, MOVEMENT_LIMITS.odd_sample_window)
    for part in parts:
        recorded = () if part is None else part.odd
        samples = [one for one in recorded if np.abs(time - one.time).min() <= window]
        if not samples:
            continue
        worst = max(samples, key=lambda sample: sample.away)
        near = np.zeros(len(time), bool)
        for sample in samples:
            near |= np.abs(time - sample.time) <= 3.0 * step
        text = _odd_text(samples, worst, case.scene.ground_reaction)
        yield Question(text, "recorded sample off its neighbours' curve", near)


def _odd_text(
    samples: Sequence[OddSample], worst: OddSample, ground: GroundReactionTable | None
) -> str:
    more = f" and {len(samples) - 1} more" if len(samples) > 1 else ""
    of_plates = (
        ground is not None
        and worst.path == ground.file  # a C3D file holds the markers too
        and bool(ground.plates)
        and "force" in worst.what
    )
    numbers = ", ".join(map(str, ground.plates)) if ground and of_plates else ""
    what = f"{worst.what} of plates {numbers}" if of_plates else worst.what
    in_c3d = worst.path.suffix.lower() == ".c3d"
    mistake = "is it a spike" if in_c3d else "is a cell mistyped"  # a C3D file has no cells
    return (
        f"{worst.path.name}: {what} at {worst.time:.4g} s{more} lies {worst.away:.3g} "
        f"{worst.unit} off its neighbours' curve: {mistake}, or is it noise? cutoff_Hz filters "
        "noise; correct anything else in the file"
    )


@dataclass(frozen=True)
class SignSettings:
    """Criteria for a question about the sign of a coordinate."""

    frames: int = 15
    """1: number of checked frames, evenly spread over the motion. More frames change
    the standard deviations by a few per cent only."""
    ap_spread: float = 0.6 * MILLIMETRE
    """m: standard deviation of the mean gap from which the sign of AP is checked. Fluoroscopy of
    subject DM has 0.3 mm, and 1.3 mm with the wrong sign."""
    ap_share: float = 0.5
    """1: largest ratio of `ap_spread`'s standard deviation with inverted to recorded sign. It is
    0.25 for subject DM with the wrong sign."""
    turn_spread: float = 0.1 * MILLIMETRE
    """m: standard deviation of the difference of the condyles' gaps from which the signs of axial
    rotation and adduction are checked. A mesh of 1 mm facets causes 0.05 mm."""
    turn_share: float = 0.7
    """1: largest ratio of `turn_spread`'s standard deviation with inverted to recorded sign. It is
    0.43 to 0.62 for subject DM with a wrong sign, and at least 1.6 with right signs."""


SIGN = SignSettings()


def sign_questions(case: Case) -> Iterator[Question]:
    """Ask about the signs of AP, axial rotation and adduction of the recorded poses."""
    contact = case.scene.contact
    free = set(KNEE_COORDINATES) if contact is None else set(contact.released)
    if case.femoral is None or case.insert is None or {"ap", "axial_rotation"} <= free:
        return
    coordinates = case.motion.coordinates
    if case.motion.unrecorded or len(coordinates) < SIGN.frames:
        return
    from tkamb.geometry.condyles import condyle_split
    from tkamb.geometry.first_touch import FirstTouch

    rows = np.linspace(0, len(coordinates) - 1, SIGN.frames).astype(int)
    clearance = FirstTouch(case.femoral, case.insert, condyle_split(case.femoral))
    recorded = _gaps(clearance, coordinates[rows])
    if not np.isfinite(recorded).all():
        return
    rides = float(recorded.mean(axis=1).std())
    if not free & {"ap", "si"} and rides > SIGN.ap_spread:
        flipped = float(_turned_gaps(clearance, coordinates[rows], "ap").mean(axis=1).std())
        if flipped < SIGN.ap_share * rides:
            yield Question(
                f"the femur rides up and down by {rides / MILLIMETRE:.1f} mm (rms) over the "
                f"insert, by {flipped / MILLIMETRE:.1f} mm with the sign of AP turned: is "
                'anterior negative in the file? then [motion] signs_turned = ["ap"], or that of '
                "its translation",
                "sign of AP may be turned",
            )
            return
    tilts = _difference(recorded)
    if free & {"axial_rotation", "adduction"} or tilts < SIGN.turn_spread:
        return
    flipped = min(
        _difference(_turned_gaps(clearance, coordinates[rows], name))
        for name in ("axial_rotation", "adduction")
    )
    if flipped < SIGN.turn_share * tilts:
        yield Question(
            f"the condyles' gaps differ by {tilts / MILLIMETRE:.2f} mm (rms about their mean), "
            f"by {flipped / MILLIMETRE:.2f} mm with the sign of axial rotation, or of adduction, "
            "turned: is one of them another way round in the file? then [motion] signs_turned = "
            '["axial_rotation"], or that of its rotation',
            "sign of axial rotation or adduction may be turned",
        )


def _gaps(clearance: "FirstTouch", coordinates: Array) -> Array:
    """Return the condyles' vertical gaps (f, 2), m; NaN beside the insert."""
    touches = [clearance.at(knee_pose(row)) for row in coordinates]
    return np.array([[np.nan if t is None else t.travel for t in pair] for pair in touches])


def _turned_gaps(clearance: "FirstTouch", coordinates: Array, name: str) -> Array:
    flipped = coordinates.copy()
    flipped[:, KNEE_COORDINATES.index(name)] *= -1.0
    return _gaps(clearance, flipped)


def _difference(gaps: Array) -> float:
    return float(np.std(gaps[:, 0] - gaps[:, 1]))
