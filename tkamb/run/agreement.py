"""Checks of a frame: whether its two estimates of the split contradict each other.

Two estimates of the medial/lateral split stand side by side, by deformation (the contact model
at the recorded rotation) and by coronal equilibrium. Where they differ by much, where balance
needs a large force that no modelled part gives, or where a condyle carries nothing though
the load state leaves it loaded, something in the input is wrong or unknown: the frame is flagged.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.units import DEGREE

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
