"""Pressing an adjusted femur in, then checking the adjustment against the deformation.

Where the femur has sunk in deeper than it was moved, or has come to lie at a larger coronal
angle than it was turned by, the load would have brought both condyles into contact anyway:
the recorded rotation is restored and pressed again (Sharma 2008, 4.3, figure 4-8).

Sharma (2008) joins the two conditions by "and"; `restore_when="both"` does so.
"""

from dataclasses import replace
from typing import Any, Literal

from tkamb.contact.model import ContactModel
from tkamb.contact.result import ContactResult, ContactStatus
from tkamb.geometry.adjustment import Adjustment, raised, touches, travel_to_touch
from tkamb.geometry.closest import ClosestPointQuery


def press_adjusted(
    model: ContactModel,
    state: Any,
    load: float,
    adjustment: Adjustment,
    query: ClosestPointQuery,
    guess: ContactResult | None = None,
    restore_when: Literal["either", "both"] = "either",
) -> tuple[ContactResult, Adjustment]:
    """Press the adjusted femur in, check the adjustment, undo its rotation if it must be.

    Args:
        model: any contact model.
        state: what its `prepare` returned.
        load: N, superior-inferior.
        adjustment: of the recorded pose, by `tkamb.geometry.adjustment.adjust`.
        query: closest points of the same pair.
        guess: an earlier result, to save time.
        restore_when: whether one exceeded limit of step 4 restores, or both are needed.

    Raises:
        ComputationError: the femoral component does not lie over the insert.
    """
    result = model.press(state, load, adjustment.pose, guess)
    final = adjustment.coronal_angle == 0.0 or adjustment.restored
    if result.status is not ContactStatus.OK or final:
        return result, replace(adjustment, penetration=float(result.approach))
    checked = _check(query, adjustment, result)
    exceeded = (
        checked.penetration > abs(checked.translation),
        abs(checked.final_angle) > abs(checked.coronal_angle),
    )
    if not (any(exceeded) if restore_when == "either" else all(exceeded)):
        return result, checked
    travel = travel_to_touch(query, adjustment.recorded)
    restored = raised(adjustment.recorded, -travel)
    result = model.press(state, load, restored, result)
    return result, replace(checked, pose=restored, translation=-travel, restored=True)


def _check(query: ClosestPointQuery, adjustment: Adjustment, result: ContactResult) -> Adjustment:
    medial, lateral = touches(query, result.pose)
    angle = (medial - lateral) / adjustment.intercondylar_distance
    return replace(adjustment, penetration=-min(medial, lateral), final_angle=angle)
