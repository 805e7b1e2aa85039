"""What the femoral adjustment does to the forces: the same equations at the recorded pose.

The adjustment is meant to correct the medial-lateral split and to leave the total force unchanged
(Sharma 2008, 5.2.2: less than 0.001 BW). If the total changes, the frame's forces depend on a
rotation and a translation that are smaller than the error of fluoroscopy. The frame is then
flagged."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tkamb.knee.contact_points import CondylePoint
from tkamb.knee.equations import KneeLoads
from tkamb.units import MILLIMETRE


@dataclass(frozen=True)
class AdjustmentEffectSettings:
    """What an adjustment of the pose changes."""

    jump_distance: float = 5.0 * MILLIMETRE
    """m: a contact point that moves farther than this has jumped to or from the eminence or lip.
    Chosen: on one dish a contact point moves by less from frame to frame."""


ADJUSTMENT_EFFECT = AdjustmentEffectSettings()


@dataclass(frozen=True)
class AdjustmentEffect:
    """The adjusted frame against the recorded one.

    Args:
        force: N, change of the total contact force; NaN where one of the frames has no solution.
        share: change of medial / (medial + lateral) by coronal equilibrium.
        cause: in words, the largest change of the contact.
    """

    force: float
    share: float
    cause: str


def adjustment_effect(
    adjusted: KneeLoads,
    recorded: KneeLoads,
    points_adjusted: Mapping[str, CondylePoint],
    points_recorded: Mapping[str, CondylePoint],
) -> AdjustmentEffect:
    """Return what changes from the recorded to the adjusted contact points.

    Args:
        adjusted: loads with the contact points of the adjusted pose.
        recorded: loads with those of the recorded pose; all else is the same.
        points_adjusted: side -> contact point.
        points_recorded: side -> contact point.
    """
    total, before = (float(np.linalg.norm(one.contact_force)) for one in (adjusted, recorded))
    share = _share(adjusted, points_adjusted) - _share(recorded, points_recorded)
    with_adjustment, without = (
        _name_carriers(loads, points)
        for loads, points in ((adjusted, points_adjusted), (recorded, points_recorded))
    )
    if with_adjustment != without:
        cause = f"with it {with_adjustment}, without it {without}"
    else:
        cause = _largest_move(points_adjusted, points_recorded)
    return AdjustmentEffect(total - before, share, cause)


def _share(loads: KneeLoads, points: Mapping[str, CondylePoint]) -> float:
    normal = {side: loads.values.get(f"{side}_normal", 0.0) for side in points}
    total = sum(normal.values())
    return normal["medial"] / total if total > 0 else float("nan")


def _name_carriers(loads: KneeLoads, points: Mapping[str, CondylePoint]) -> str:
    sides = [side for side in points if side not in loads.lifted]
    return "both condyles carry" if len(sides) > 1 else f"the {sides[0]} condyle alone carries"


def _largest_move(now: Mapping[str, CondylePoint], before: Mapping[str, CondylePoint]) -> str:
    """Return which contact point moved most."""
    distances = {side: float(np.linalg.norm(now[side].point - before[side].point)) for side in now}
    side = max(distances, key=lambda name: distances[name])
    word = "jumps" if distances[side] > ADJUSTMENT_EFFECT.jump_distance else "moves"
    return f"the {side} contact point {word} by {distances[side] / MILLIMETRE:.1f} mm"
