"""Change of the medial-lateral split with adduction, at a constant load."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.contact.result import ContactResult, ContactStatus, WarmStart
from tkamb.geometry.frames import KNEE_COORDINATES, knee_axes, knee_coordinates, knee_pose
from tkamb.units import DEGREE

if TYPE_CHECKING:
    from tkamb.contact.model import Probe


@dataclass(frozen=True)
class SplitSensitivitySettings:
    """How the medial share of the force changes with adduction."""

    adduction_step: float = 0.02 * DEGREE
    """rad: step of the finite difference. Chosen: small against the 0.2 to 0.5 deg that unload a
    condyle, and it moves some 60 N, thirty times the lattice's tolerance. Steps of 0.005 to 0.1 deg
    agree within 5 to 15 %."""


SPLIT_SENSITIVITY = SplitSensitivitySettings()


ADDUCTION, SUPERIOR = (KNEE_COORDINATES.index(name) for name in ("adduction", "si"))


def split_sensitivity(
    probe: "Probe",
    result: ContactResult,
    start: WarmStart | None = None,
) -> float:
    """Return the change of the medial force with the adduction at a constant load, N/rad.

    Zero where one condyle carries everything: the value then holds until the other condyle touches.
    NaN where the press with more adduction fails.

    Args:
        probe: of the contact model.
        result: a contact; its load is the force along -y.
        start: that came with it.
    """
    load = -float(result.wrench_on_insert[1])
    place = knee_coordinates(result.pose)
    place[ADDUCTION] += SPLIT_SENSITIVITY.adduction_step
    begin = WarmStart.after(result) if start is None else start
    rotated, _ = probe.pressed(load, knee_pose(place), begin)
    if rotated.status is not ContactStatus.OK:
        return float("nan")
    return (_medial(rotated) - _medial(result)) / SPLIT_SENSITIVITY.adduction_step


def split_tangent(probe: "Probe", result: ContactResult) -> float:
    """Return what `split_sensitivity` does, from the tangent of a model that knows it.

    With the tangents t of the wrenches F on the insert, at a constant superior-inferior load
    the femur follows an adduction da by dy = -(sum t_y,a / sum t_y,y) da, and the medial force
    changes by n . (t_a da + t_y dy).

    Args:
        probe: of the contact model, exact.
        result: a contact.
    """
    place = knee_coordinates(result.pose)
    condyles = probe.seen(result).condyles
    if len(condyles) < 2:
        return 0.0
    twists = knee_axes(place)[[ADDUCTION, SUPERIOR]].T
    changes = {
        side: condyle.stiffness[:3] @ twists
        for side, condyle in condyles.items()
        if condyle.stiffness is not None
    }
    total = sum(change[1] for change in changes.values())
    follow = np.array([1.0, -total[0] / total[1]])
    return float(-condyles["medial"].normal @ changes["medial"] @ follow)


def _medial(result: ContactResult) -> float:
    return result.medial.force if result.medial else 0.0
