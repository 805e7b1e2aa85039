"""Pressing an adjusted femur in, then comparing the adjustment with the deformation.

Sharma (2008), section 4.3, figure 4-8: "If the final femoral penetration and coronal angle is more
than the adjustments made, the original orientation of the femur is restored and the analysis is
reconducted." The rule has two readings, `AdjustmentSettings.restore_when`:

- "both" (the wording, and the default): restored if the penetration exceeds the translation
  and the coronal angle of the penetrations exceeds the turn.
- "either": restored if one of them does. Penetration then decides almost alone. A femur that was
  recorded at the right height is hardly moved, so that nearly every load restores it, and
  the split steps where the recorded height changes by a tenth of a millimetre.

Where a change of the recorded pose by `AdjustmentSettings.input_change` may change that decision,
the result carries a flag.
"""

from dataclasses import replace
from itertools import product
from typing import Any

from tkamb.contact.model import ContactModel
from tkamb.contact.result import ContactResult, ContactStatus, Guess, WarmStart
from tkamb.geometry.adjustment import Adjustment, RestoreRule, moved_to_touch, touches
from tkamb.geometry.closest import ClosestPointQuery
from tkamb.units import MILLIMETRE


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
        model: any contact model.
        state: what its `prepare` returned.
        load: N, superior-inferior.
        adjustment: of the recorded pose, by `tkamb.geometry.adjustment.adjust`.
        query: closest points of the same pair.
        start: an earlier result or warm start, to save time.

    Returns:
        The contact, whose flags hold those of the adjustment, the adjustment as it was checked,
        and the start of the next press.

    Raises:
        ComputationError: the femoral component does not lie over the insert.
    """
    result, start = model.press_from(state, load, adjustment.pose, start)
    final = adjustment.coronal_angle == 0.0 or adjustment.restored
    if result.status is not ContactStatus.OK or final:
        adjustment = replace(adjustment, penetration=float(result.approach))
        return _flagged(result, adjustment), adjustment, start
    checked, restore, doubts = _check(query, adjustment, result)
    if restore:
        # At the recorded rotation the limit of the turn has no effect.
        pose, translation, flags = moved_to_touch(query, checked.recorded, checked.settings)
        checked = replace(checked, pose=pose, translation=translation, restored=True, flags=flags)
        result, start = model.press_from(state, load, pose, start)
    checked = replace(checked, flags=(*checked.flags, *doubts))
    return _flagged(result, checked), checked, start


def _flagged(result: ContactResult, adjustment: Adjustment) -> ContactResult:
    """Return the contact with the adjustment's flags after its own."""
    if not adjustment.flags:
        return result
    return replace(result, flags=(*result.flags, *adjustment.flags))


def _check(
    query: ClosestPointQuery, adjustment: Adjustment, result: ContactResult
) -> tuple[Adjustment, bool, tuple[str, ...]]:
    """Return the checked adjustment, whether to undo it, and a flag where that is in doubt."""
    settings, distance = adjustment.settings, adjustment.intercondylar_distance
    medial, lateral = touches(query, result.pose)
    penetration, angle = -min(medial, lateral), (medial - lateral) / distance
    deeper = penetration - abs(adjustment.translation)
    angle_excess = (abs(angle) - abs(adjustment.coronal_angle)) * distance
    margin = settings.input_change
    # Where the final angle is about as large as the turn and both are below what a mesh resolves,
    # restoring the rotation changes nothing.
    tilted = abs(angle) * distance > settings.level_difference
    outcomes = {
        _restored(settings.restore_when, *exceeded)
        for exceeded in product(
            _either_side(deeper, margin), _either_side(angle_excess, margin * tilted)
        )
    }
    doubts: tuple[str, ...] = ()
    if len(outcomes) > 1:
        doubts = (
            f"femoral adjustment: a change of the recorded pose by {margin / MILLIMETRE:g} mm "
            f"decides "
            "whether the recorded rotation is restored; the medial-lateral split depends on it",
        )
    restore = _restored(settings.restore_when, deeper > 0, angle_excess > 0)
    checked = replace(adjustment, penetration=penetration, final_angle=angle)
    return checked, restore, doubts


def _either_side(excess: float, margin: float) -> set[bool]:
    """Return what `excess > 0` may be where the excess is known to within a margin, both m."""
    return {excess - margin > 0, excess > 0, excess + margin > 0}


def _restored(rule: RestoreRule, deeper: bool, rotated: bool) -> bool:
    return (deeper and rotated) if rule == "both" else (deeper or rotated)
