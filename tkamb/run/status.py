"""The status of a frame in words: "ok", why it failed, or what a reader must know.

Two estimates of the medial/lateral split stand side by side: by deformation (the contact model at
the recorded rotation) and by coronal equilibrium. A frame is flagged where they differ by much,
where equilibrium needs a large force that no modelled part gives, or where a condyle has no
contact force although the equations load it: an input is then wrong or unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.io.scene.case import Case
    from tkamb.knee.frame_contact import FrameContact
    from tkamb.run.mechanics import FrameLoads


@dataclass(frozen=True)
class AgreementSettings:
    """When two estimates contradict each other."""

    share_difference: float = 0.25
    """Two estimates of the medial share that differ by more contradict each other. Chosen: smaller
    differences are within the errors of both."""
    large_residual_share: float = 0.10
    """1: share of the superior-inferior contact force; a larger AP and ML residual is flagged.
    Chosen: a smaller one is within the errors of the forces."""
    unloaded_share: float = 0.01
    """1: share of the load; a condyle that carries less counts as unloaded. Chosen: it is below the
    errors of the split."""
    adduction_error: float = 0.5 * DEGREE
    """rad: error of the recorded adduction, 0.5 deg. Chosen: that of fluoroscopy."""
    moved_load_share: float = 0.25
    """1: share of the load; where the adduction's error moves more of it, the recorded pose does
    not determine the split by deformation. Chosen: a quarter decides which condyle carries more."""


AGREEMENT = AgreementSettings()


NAN = float("nan")


def contradictions(case: "Case", body: "FrameLoads", contact: "FrameContact | None") -> list[str]:
    """Return what contradicts itself in a frame, in words; empty for a frame without numbers."""
    if body.loads.problems:
        return []
    words = []
    values = body.loads.values
    load = abs(float(body.loads.contact_force[1]))
    residual = float(np.hypot(values.get("residual_ap", 0.0), values.get("residual_ml", 0.0)))
    if residual > AGREEMENT.large_residual_share * load:
        words.append(f"residual AP and ML force is {_percent(residual, load)} of the contact force")
    if contact is None or contact.result is None or case.split is None:
        return words
    share, balanced = share_by_deformation(contact), share_by_equilibrium(body)
    if abs(share - balanced) > AGREEMENT.share_difference:
        words.append(
            f"medial share {share:.2f} by deformation contradicts {balanced:.2f} by equilibrium"
        )
    for side, own in (("medial", share), ("lateral", 1.0 - share)):
        if own < AGREEMENT.unloaded_share and side not in body.loads.lifted:
            words.append(f"{side} condyle carries nothing by deformation")
    return words


def share_by_deformation(contact: "FrameContact") -> float:
    """Return medial / (medial + lateral) of the contact model; NaN where nothing is carried."""
    result = contact.result
    if result is None:
        return NAN
    return share(*(side.force if side else 0.0 for side in (result.medial, result.lateral)))


def share_by_equilibrium(body: "FrameLoads") -> float:
    """Return medial / (medial + lateral) of the equations; NaN where they are not solved."""
    return share(normal_force(body, "medial"), normal_force(body, "lateral"))


def normal_force(body: "FrameLoads", side: str) -> float:
    """Return a condyle's normal force by the equations, N: zero where it is lifted."""
    if side in body.loads.lifted and not np.isnan(body.loads.contact_force).any():
        return 0.0
    return body.loads.values.get(f"{side}_normal", NAN)


def share(medial: float, lateral: float) -> float:
    """Return medial / (medial + lateral); NaN where nothing is carried."""
    total = medial + lateral
    return medial / total if total > 0 else NAN


def split_determined(body: "FrameLoads", contact: "FrameContact") -> float:
    """Return 1 where the recorded adduction determines the split by deformation, else 0.

    It does not where 0.5 deg moves more than a quarter of the load from one condyle to the
    other, or where one condyle carries all of it and equilibrium says otherwise. NaN where there is
    no sensitivity.
    """
    if np.isnan(contact.sensitivity):
        return NAN
    moved = abs(contact.sensitivity) * AGREEMENT.adduction_error
    load = abs(float(body.loads.contact_force[1]))
    share, balanced = share_by_deformation(contact), share_by_equilibrium(body)
    alone = min(share, 1.0 - share) < AGREEMENT.unloaded_share < abs(share - balanced)
    return float(moved <= AGREEMENT.moved_load_share * load and not alone)


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.0f} %" if whole > 0 else "more than all"


@dataclass(frozen=True)
class StatusSettings:
    """Limits beyond which a frame's status carries a flag."""

    filter_translation: float = 0.5 * MILLIMETRE
    """m; where filtering moves a pose by more, the frame is flagged. Chosen: fluoroscopy errs by
    less."""
    filter_rotation: float = 0.5 * DEGREE
    """rad; where filtering turns a pose by more (0.5 deg), the frame is flagged. Chosen:
    fluoroscopy errs by less."""
    flank_angle: float = 20.0 * DEGREE
    """rad; where the contact normal of a condyle leans by more (20 deg) the frame is flagged.
    Chosen: the condyle then runs against eminence or lip; check the recorded position, above all
    ML."""
    adjusted_total_BW: float = 0.01
    """BW: a femoral adjustment that changes the total force by more is flagged. Chosen: it then
        decides more than the split."""
    marker_distance: float = 20.0 * MILLIMETRE
    """m; skin that has moved by more against the other segment's is flagged. Chosen: at 700 N it is
    14 N·m."""


STATUS = StatusSettings()


PATELLA_ACROSS = 0.03
"""Share of the patellofemoral force that may act across the button's normal where the patella's
place was recorded: 2 deg between that normal and what the lines hold. A place that suits the
lines leaves 0.002."""
PATELLA_LIGHT = 0.01
"""BW: a smaller force across the normal is not flagged."""

FAILED = "failed: "


def frame_status(
    case: "Case",
    k: int,
    body: "FrameLoads",
    contact: "FrameContact | None",
    doubts: Sequence[str] = (),
) -> str:
    """Return "ok", or reason words joined by "; ". A frame without force begins with failed.

    Args:
        case: the case.
        k: frame.
        body: its body side.
        contact: its contact side; None when not modelled.
        doubts: flags of the questions that concern it (`tkamb.run.plausibility`).
    """
    failures = failures_of(body, contact)
    words = [*_motion_flags(case, k), *_flank_flags(body), *_adjustment_flags(case, body)]
    released = contact is not None and contact.equilibrium is not None
    words += [_lift_off(body, side, released) for side in sorted(body.loads.lifted)]
    words += _patella_flags(case, body)
    if body.loads.slack and body.geometry.share is None:
        words.append("flexors needed, which are not modelled: quadriceps slack")
    if body.loads.ambiguous:
        words.append("several load states balance: the one that leaves out fewest is taken")
    words += contradictions(case, body, contact)
    words += [*contact.flags, *(contact.post.flags if contact.post else ())] if contact else []
    words += doubts
    if failures:
        return FAILED + "; ".join([*failures, *words])
    return "; ".join(words) or "ok"


def failures_of(body: "FrameLoads", contact: "FrameContact | None") -> list[str]:
    """Return why a frame has no force, in words; empty if it has."""
    result = list(body.loads.problems)
    if contact and contact.problem and not result:
        result.append(contact.problem)
    return result


def _lift_off(body: "FrameLoads", side: str, released: bool) -> str:
    if released:
        return f"{side} condyle lifts off"
    if side in body.geometry.lifted:
        where = "where the other one touches" if body.adjustment else "as recorded"
        return f"{side} condyle off the insert {where}"
    return f"{side} condyle unloaded: the other one alone balances the adduction moment"


def _flank_flags(body: "FrameLoads") -> list[str]:
    """Return a flag for each condyle whose contact normal leans far from the vertical."""
    result = []
    for side, condyle in body.geometry.condyles.items():
        lean = float(np.arccos(np.clip(condyle.normal[1], -1.0, 1.0)))
        if lean > STATUS.flank_angle and side not in body.loads.lifted:
            result.append(
                f"{side} contact on a flank, normal {lean / DEGREE:.0f} deg from vertical"
            )
    return result


def _adjustment_flags(case: "Case", body: "FrameLoads") -> list[str]:
    if body.effect is None or body.loads.problems:
        return []
    change = abs(body.effect.force) / case.body_weight
    if change <= STATUS.adjusted_total_BW:
        return []
    return [f"femoral adjustment changes the total force by {change:.2f} BW: {body.effect.cause}"]


def _patella_flags(case: "Case", body: "FrameLoads") -> list[str]:
    """Return a flag where the lines do not hold a recorded patella at its place."""
    patella = case.scene.patella
    if patella is None or patella.motion != "recorded" or body.loads.problems:
        return []
    values = body.loads.values
    across = abs(values.get("patellofemoral_tangential", 0.0))
    normal = abs(values.get("patellofemoral", 0.0))
    if not across > max(PATELLA_ACROSS * normal, PATELLA_LIGHT * case.body_weight):
        return []
    return [
        f"recorded patella is not held by its lines: {across:.0f} N across the button's normal, "
        f"beside {normal:.0f} N along it; no part of a knee carries that"
    ]


def _motion_flags(case: "Case", k: int) -> list[str]:
    motion = case.motion
    far = motion.deviation_translation[k] > STATUS.filter_translation
    rotated = motion.deviation_rotation[k] > STATUS.filter_rotation
    result = ["filter moves the recorded pose beyond 0.5 mm or 0.5 deg"] if far or rotated else []
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
