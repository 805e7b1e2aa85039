"""The femoral adjustment and the medial-lateral split: pressing, checking, effect and sensitivity.

The medial-lateral split depends on a rotation smaller than the error of fluoroscopy. The recorded
femur is therefore adjusted until both condyles touch (`tkamb.geometry.adjustment`). Sharma (2008),
section 4.3, figure 4-8: "If the final femoral penetration and coronal angle is more than the
adjustments made, the original orientation of the femur is restored and the analysis is
reconducted." `AdjustmentSettings.restore_when` selects one of two readings:

- "both" (Sharma's wording, the default): it is restored if the penetration exceeds the translation
  and the coronal angle of the penetrations exceeds the rotation.
- "either": it is restored if one of the two exceeds its adjustment. The translation of a femur
  recorded at the right height is small, so nearly every load restores the orientation. The split
  then jumps if the recorded height changes by a tenth of a millimetre.

A flag marks a result whose decision may change with `AdjustmentSettings.input_change`.

The adjustment should leave the total force unchanged (Sharma 2008, 5.2.2: less than 0.001 BW); see
`adjustment_effect`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.model import ContactModel
from tkamb.contact.result import ContactResult, ContactStatus, Guess, WarmStart
from tkamb.geometry.adjustment import Adjustment, RestoreRule, moved_to_touch, touches
from tkamb.geometry.closest import ClosestPointQuery
from tkamb.geometry.frames import KNEE_COORDINATES, knee_axes, knee_coordinates, knee_pose
from tkamb.knee.equations import SolvedLoads
from tkamb.knee.unknowns import CondylePoint
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.model import Probe


# rad: step of the finite difference. It shifts about 60 N between the condyles,
# thirty times the lattice's tolerance, but unloads no condyle (0.2 deg or more would).
ADDUCTION_STEP = 0.02 * DEGREE


ADDUCTION, SUPERIOR = (KNEE_COORDINATES.index(name) for name in ("adduction", "si"))


def split_sensitivity(
    probe: "Probe",
    result: ContactResult,
    start: WarmStart | None = None,
) -> float:
    """Return the change of the medial force with the adduction at a constant load, N/rad.

    It is zero if one condyle carries all of the load, and NaN if the press with more adduction
    fails. The load is the force of `result` along -y; `start` was returned with it.
    """
    load = -float(result.wrench_on_insert[1])
    coordinates = knee_coordinates(result.pose)
    coordinates[ADDUCTION] += ADDUCTION_STEP
    warm_start = WarmStart.after(result) if start is None else start
    rotated, _ = probe.pressed(load, knee_pose(coordinates), warm_start)
    if rotated.status is not ContactStatus.OK:
        return float("nan")
    return (_medial(rotated) - _medial(result)) / ADDUCTION_STEP


def split_tangent(probe: "Probe", result: ContactResult) -> float:
    """Return the quantity of `split_sensitivity` from the contact's exact tangent, N/rad.

    Let t_a and t_y (3,) be the derivatives of a condyle's force on the insert by adduction a and
    height y, and n the medial contact normal (upward). At a constant superior-inferior load an
    adduction da moves the femur by dy = -(sum t_a,y / sum t_y,y) da, and the medial force changes
    by -n . (t_a da + t_y dy). The tangent of the `probe` is exact.
    """
    coordinates = knee_coordinates(result.pose)
    condyles = probe.seen(result).condyles
    if len(condyles) < 2:
        return 0.0
    twists = knee_axes(coordinates)[[ADDUCTION, SUPERIOR]].T
    changes = {
        side: condyle.stiffness[:3] @ twists
        for side, condyle in condyles.items()
        if condyle.stiffness is not None
    }
    total = sum(change[1] for change in changes.values())
    # Unit adduction with the change of height that keeps the load constant.
    displacement = np.array([1.0, -total[0] / total[1]])
    return float(-condyles["medial"].normal @ changes["medial"] @ displacement)


def _medial(result: ContactResult) -> float:
    return result.medial.force if result.medial else 0.0


# m: displacement of a contact point above which the text says "jumps" and not "moves".
# A contact point on one dish moves by less from frame to frame.
JUMP_DISTANCE = 5.0 * MILLIMETRE


@dataclass(frozen=True)
class AdjustmentEffect:
    """Difference of a frame with adjustment from the same frame without.

    Args:
        force: N, of the total contact force; NaN if one of the two frames has no solution.
        share: change of the medial share of the normal force.
    """

    force: float
    share: float
    cause: str


def adjustment_effect(
    adjusted: SolvedLoads,
    recorded: SolvedLoads,
    points_adjusted: Mapping[str, CondylePoint],
    points_recorded: Mapping[str, CondylePoint],
) -> AdjustmentEffect:
    """Return the change of the loads from the recorded to the adjusted contact points.

    `points_adjusted` and `points_recorded` are the contact points by side; else the loads are
    equal.
    """
    total, total_recorded = (
        float(np.linalg.norm(one.contact_force)) for one in (adjusted, recorded)
    )
    share = _share(adjusted, points_adjusted) - _share(recorded, points_recorded)
    with_adjustment, without = (
        _name_carriers(loads, points)
        for loads, points in ((adjusted, points_adjusted), (recorded, points_recorded))
    )
    if with_adjustment != without:
        cause = f"with it {with_adjustment}, without it {without}"
    else:
        cause = _largest_move(points_adjusted, points_recorded)
    return AdjustmentEffect(total - total_recorded, share, cause)


def _share(loads: SolvedLoads, points: Mapping[str, CondylePoint]) -> float:
    normal = {side: loads.values.get(f"{side}_normal", 0.0) for side in points}
    total = sum(normal.values())
    return normal["medial"] / total if total > 0 else float("nan")


def _name_carriers(loads: SolvedLoads, points: Mapping[str, CondylePoint]) -> str:
    sides = [side for side in points if side not in loads.lifted]
    return "both condyles carry" if len(sides) > 1 else f"the {sides[0]} condyle alone carries"


def _largest_move(
    adjusted: Mapping[str, CondylePoint], recorded: Mapping[str, CondylePoint]
) -> str:
    distances = {
        side: float(np.linalg.norm(adjusted[side].point - recorded[side].point))
        for side in adjusted
    }
    side = max(distances, key=lambda name: distances[name])
    verb = "jumps" if distances[side] > JUMP_DISTANCE else "moves"
    return f"the {side} contact point {verb} by {distances[side] / MILLIMETRE:.1f} mm"


def press_adjusted(
    model: ContactModel,
    state: Any,
    load: float,
    adjustment: Adjustment,
    query: ClosestPointQuery,
    start: Guess | None = None,
) -> tuple[ContactResult, Adjustment, WarmStart]:
    """Press the adjusted femur in, check the adjustment, and undo its rotation if required.

    Args:
        load: superior-inferior force, N.
        query: closest points of the same pair of bodies.
        start: an earlier result or a warm start, to save time.

    Returns:
        The contact with the adjustment's flags, the checked adjustment, and a warm start.

    Raises:
        ComputationError: the femoral component does not lie over the insert.
    """
    result, start = model.press_from(state, load, adjustment.pose, start)
    final = adjustment.coronal_angle == 0.0 or adjustment.restored
    if result.status is not ContactStatus.OK or final:
        adjustment = replace(adjustment, penetration=float(result.approach))
        return _flagged(result, adjustment), adjustment, start
    checked, restore, decision_flags = _check(query, adjustment, result)
    if restore:
        pose, translation, flags = moved_to_touch(query, checked.recorded, checked.settings)
        checked = replace(checked, pose=pose, translation=translation, restored=True, flags=flags)
        result, start = model.press_from(state, load, pose, start)
    checked = replace(checked, flags=(*checked.flags, *decision_flags))
    return _flagged(result, checked), checked, start


def _flagged(result: ContactResult, adjustment: Adjustment) -> ContactResult:
    if not adjustment.flags:
        return result
    return replace(result, flags=(*result.flags, *adjustment.flags))


def _check(
    query: ClosestPointQuery, adjustment: Adjustment, result: ContactResult
) -> tuple[Adjustment, bool, tuple[str, ...]]:
    """Return the checked adjustment, whether to undo its rotation, and a flag if that is unsure."""
    settings, distance = adjustment.settings, adjustment.intercondylar_distance
    medial, lateral = touches(query, result.pose)
    penetration, angle = -min(medial, lateral), (medial - lateral) / distance
    deeper = penetration - abs(adjustment.translation)
    angle_excess = (abs(angle) - abs(adjustment.coronal_angle)) * distance
    margin = settings.input_change
    # The margin decides only if the two angles are nearly equal. If both are below the resolution
    # of a mesh, it makes no difference whether the rotation is restored.
    tilted = abs(angle) * distance > settings.level_difference
    outcomes = {
        _restored(settings.restore_when, *exceeded)
        for exceeded in product(
            _either_side(deeper, margin), _either_side(angle_excess, margin * tilted)
        )
    }
    decision_flags: tuple[str, ...] = ()
    if len(outcomes) > 1:
        decision_flags = (
            f"femoral adjustment: a change of the recorded pose by {margin / MILLIMETRE:g} mm "
            f"decides "
            "whether the recorded rotation is restored; this changes the medial-lateral split",
        )
    restore = _restored(settings.restore_when, deeper > 0, angle_excess > 0)
    checked = replace(adjustment, penetration=penetration, final_angle=angle)
    return checked, restore, decision_flags


def _either_side(excess: float, margin: float) -> set[bool]:
    """Return the possible values of `excess > 0` if the excess (m) has an error of `margin` (m)."""
    return {excess - margin > 0, excess > 0, excess + margin > 0}


def _restored(rule: RestoreRule, deeper: bool, rotated: bool) -> bool:
    return (deeper and rotated) if rule == "both" else (deeper or rotated)
