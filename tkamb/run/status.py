"""The status of a frame: "ok", the reason of its failure, or flags.

The medial-lateral split has two estimates: by deformation (the contact model at the recorded
rotation), and by coronal equilibrium. A frame is flagged if they differ by much, if equilibrium
needs a large residual, or if only the equations load a condyle. An input is then wrong or unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array, Mask
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.io.scene.case import Case
    from tkamb.knee.frame import Frame


@dataclass(frozen=True)
class AgreementSettings:
    """Limits for a contradiction of two estimates."""

    share_difference: float = 0.25
    """1: largest difference of the two medial shares without a flag. Smaller
    differences are within the errors of both."""
    large_residual_share: float = 0.10
    """1: largest AP and ML residual without a flag, as a share of the superior-inferior contact
    force. Smaller residuals are within the errors of the forces."""
    unloaded_share: float = 0.01
    """1: share of the load below which a condyle counts as unloaded. The errors of
    the split are larger."""
    adduction_error: float = 0.5 * DEGREE
    """rad: error of adduction from fluoroscopy, 0.5 deg."""
    moved_load_share: float = 0.25
    """1: largest share of the load that the error of adduction may shift between condyles. Above
    it, the recorded pose does not determine the split. A quarter may decide which
    condyle carries more."""


AGREEMENT = AgreementSettings()


NAN = float("nan")


def contradictions(case: "Case", frame: "Frame") -> list[str]:
    """Return the contradictions in a frame, in words; empty for a failed frame."""
    if frame.loads.problems:
        return []
    words = []
    values = frame.loads.values
    load = abs(float(frame.loads.contact_force[1]))
    residual = float(np.hypot(values.get("residual_ap", 0.0), values.get("residual_ml", 0.0)))
    if residual > AGREEMENT.large_residual_share * load:
        words.append(f"residual AP and ML force is {_percent(residual, load)} of the contact force")
    if frame.contact is None or case.split is None:
        return words
    share, balanced = share_by_deformation(frame), share_by_equilibrium(frame)
    if abs(share - balanced) > AGREEMENT.share_difference:
        words.append(
            f"medial share {share:.2f} by deformation contradicts {balanced:.2f} by equilibrium"
        )
    for side, condyle_share in (("medial", share), ("lateral", 1.0 - share)):
        if condyle_share < AGREEMENT.unloaded_share and side not in frame.loads.lifted:
            words.append(f"{side} condyle carries nothing by deformation")
    return words


def share_by_deformation(frame: "Frame") -> float:
    """Return the medial share of the contact model; NaN without load."""
    result = frame.contact
    if result is None:
        return NAN
    return share(*(side.force if side else 0.0 for side in (result.medial, result.lateral)))


def share_by_equilibrium(frame: "Frame") -> float:
    """Return the medial share of the equations; NaN without a solution."""
    return share(normal_force(frame, "medial"), normal_force(frame, "lateral"))


def normal_force(frame: "Frame", side: str) -> float:
    """Return a condyle's normal force by the equations, N; zero if it is lifted off."""
    if side in frame.loads.lifted and not np.isnan(frame.loads.contact_force).any():
        return 0.0
    return frame.loads.values.get(f"{side}_normal", NAN)


def share(medial: float, lateral: float) -> float:
    """Return medial / (medial + lateral); NaN without load."""
    total = medial + lateral
    return medial / total if total > 0 else NAN


def split_determined(frame: "Frame") -> float:
    """Return 1 if the recorded adduction determines the split by deformation, else 0.

    It is 0 if 0.5 deg of adduction shifts more than a quarter of the load, or one condyle carries
    the whole load in contrast to equilibrium. NaN: unknown.
    """
    if np.isnan(frame.sensitivity):
        return NAN
    shifted = abs(frame.sensitivity) * AGREEMENT.adduction_error
    load = abs(float(frame.loads.contact_force[1]))
    share, balanced = share_by_deformation(frame), share_by_equilibrium(frame)
    alone = min(share, 1.0 - share) < AGREEMENT.unloaded_share < abs(share - balanced)
    return float(shifted <= AGREEMENT.moved_load_share * load and not alone)


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.0f} %" if whole > 0 else "more than all"


@dataclass(frozen=True)
class StatusSettings:
    """Limits beyond which a frame's status carries a flag."""

    filter_translation: float = 0.5 * MILLIMETRE
    """m: largest translation of a recorded pose by the filter without a flag. The
    error of fluoroscopy is smaller."""
    filter_rotation: float = 0.5 * DEGREE
    """rad: largest rotation of a recorded pose by the filter without a flag, 0.5 deg.
    The error of fluoroscopy is smaller."""
    flank_angle: float = 20.0 * DEGREE
    """rad: largest angle of a condyle's contact normal from the vertical without a flag, 20 deg.
    Steeper contact is on eminence or lip."""
    adjusted_total_BW: float = 0.01
    """BW: largest change of the total force by the femoral adjustment without a flag.
    The adjustment should change the split only."""
    marker_distance: float = 20.0 * MILLIMETRE
    """m: largest distance between the knee centres of shank and thigh markers without a flag.
    It causes 14 N·m at 700 N."""


STATUS = StatusSettings()


PATELLA_ACROSS = 0.03
"""1: largest share of the patellofemoral force across the button's normal without a flag, for a
recorded patella. It corresponds to an error of 2 deg. A patella in equilibrium has 0.002."""
PATELLA_LIGHT = 0.01
"""BW: largest force across the button's normal without a flag."""

FAILED = "failed: "


def frame_status(
    case: "Case",
    k: int,
    frame: "Frame",
    question_flags: Sequence[str] = (),
) -> str:
    """Return "ok", or reasons joined by "; ". The status of a failed frame begins with "failed".

    Args:
        question_flags: flags of the questions on the frame (`tkamb.run.plausibility`).
    """
    words = [*_motion_flags(case, k), *_flank_flags(frame), *_adjustment_flags(case, frame)]
    words += [_lift_off(frame, side) for side in sorted(frame.loads.lifted)]
    words += _patella_flags(case, frame)
    if frame.loads.slack and frame.geometry.share is None:
        words.append("flexors needed, which are not modelled: quadriceps slack")
    if frame.geometry.share is not None and not frame.geometry.share.both_loaded:
        words.append("no muscle forces keep the least share of load on each condyle")
    if frame.loads.ambiguous:
        words.append("several load states are in equilibrium: the one with most loads is used")
    words += contradictions(case, frame)
    words += [*frame.flags, *(frame.post.flags if frame.post else ())]
    words += frame.button.words if frame.button else ()
    words += frame.patella.flags if frame.patella else ()
    words += question_flags
    if frame.failures:
        return FAILED + "; ".join([*frame.failures, *words])
    return "; ".join(words) or "ok"


def _lift_off(frame: "Frame", side: str) -> str:
    if frame.equilibrium is not None:
        return f"{side} condyle lifts off"
    if side in frame.geometry.lifted:
        where = "where the other one touches" if frame.adjustment else "as recorded"
        return f"{side} condyle off the insert {where}"
    return f"{side} condyle unloaded: the other one alone balances the adduction moment"


def _flank_flags(frame: "Frame") -> list[str]:
    result = []
    for side, condyle in frame.geometry.condyles.items():
        lean = float(np.arccos(np.clip(condyle.normal[1], -1.0, 1.0)))
        if lean > STATUS.flank_angle and side not in frame.loads.lifted:
            result.append(
                f"{side} contact on a flank, normal {lean / DEGREE:.0f} deg from vertical"
            )
    return result


def _adjustment_flags(case: "Case", frame: "Frame") -> list[str]:
    if frame.effect is None or frame.loads.problems:
        return []
    change = abs(frame.effect.force) / case.body_weight
    if change <= STATUS.adjusted_total_BW:
        return []
    return [f"femoral adjustment changes the total force by {change:.2f} BW: {frame.effect.cause}"]


def out_of_equilibrium(across: Array | float, normal: Array | float, body_weight: float) -> Mask:
    """Return whether a recorded patella is not in equilibrium with its lines.

    Args:
        across: patellofemoral force across the button's normal, N.
        normal: patellofemoral force along it, N.
        body_weight: body weight, N.
    """
    limit = np.maximum(PATELLA_ACROSS * np.abs(normal), PATELLA_LIGHT * body_weight)
    return np.asarray(np.abs(across) > limit)


def _patella_flags(case: "Case", frame: "Frame") -> list[str]:
    patella = case.scene.patella
    if patella is None or patella.motion != "recorded" or frame.loads.problems:
        return []
    values = frame.loads.values
    across = abs(values.get("patellofemoral_tangential", 0.0))
    normal = abs(values.get("patellofemoral", 0.0))
    if not out_of_equilibrium(across, normal, case.body_weight):
        return []
    return [
        f"recorded patella is not in equilibrium with its lines: {across:.0f} N across the "
        f"button's normal and {normal:.0f} N along it; no part of a knee carries a force across it"
    ]


def _motion_flags(case: "Case", k: int) -> list[str]:
    motion = case.motion
    translated = motion.deviation_translation[k] > STATUS.filter_translation
    rotated = motion.deviation_rotation[k] > STATUS.filter_rotation
    result = (
        ["filter moves the recorded pose beyond 0.5 mm or 0.5 deg"] if translated or rotated else []
    )
    if motion.markers is not None:
        time = motion.time[k : k + 1]
        if motion.markers.at(motion.markers.missing.astype(float), time)[0] > 0:
            result.append("a marker of shank or thigh is missing")
        apart = motion.markers.at(motion.markers.centre_distance, time)[0]
        if apart > STATUS.marker_distance:
            result.append(
                f"knee centres of shank and thigh markers {apart / MILLIMETRE:.0f} mm apart"
            )
    return result
