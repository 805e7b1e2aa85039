"""A frame's contact as arrays, and back: what a resumed run starts its next frame from.

It stands in for the frame before as a guess, as good as the frame itself but for its warm
start, which is not kept: answers stay within the solver's tolerance.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.pair import PreparedContact
from tkamb.contact.probe import ProbedContact
from tkamb.contact.result import ContactResult
from tkamb.equilibrium.balance import Balance, BalanceStatus
from tkamb.equilibrium.contact_side import ContactSide
from tkamb.equilibrium.frame_contact import FrameContact
from tkamb.equilibrium.released import SettledKnee
from tkamb.geometry.frames import Array

if TYPE_CHECKING:
    from tkamb.mechanics.mechanics import Mechanics

RESULT_ARRAYS = ("pose", "normals", "pressure", "area", "gap", "nodal_force", "wrench_on_insert")


def contact_arrays(contact: FrameContact | None) -> dict[str, Array] | None:
    """Return what is worth keeping of a frame's contact by name; None without a result."""
    if contact is None or contact.result is None:
        return None
    result, settled = contact.result, contact.settled
    arrays = {name: np.asarray(getattr(result, name), float) for name in RESULT_ARRAYS}
    if settled is not None:
        arrays["settled_coordinates"] = settled.coordinates
        arrays["settled_force"] = settled.balance.force
        arrays["settled_stiffness"] = settled.balance.stiffness
        if settled.patella is not None:
            arrays["settled_patella"] = settled.patella.coordinates
    return arrays


def recalled(
    side: ContactSide, mechanics: "Mechanics", frame: int, arrays: Mapping[str, Array] | None
) -> FrameContact:
    """Return a frame's contact from its arrays, as a guess for the next frame."""
    none = np.zeros(len(side.state.points), bool)
    if arrays is None:
        return FrameContact(None, none, None, 0.0, "not recalled", ())
    settled = _settled(mechanics, frame, arrays) if "settled_coordinates" in arrays else None
    return FrameContact(_result(side.state, arrays), none, None, 0.0, "", (), settled=settled)


def _result(state: PreparedContact, arrays: Mapping[str, Array]) -> ContactResult:
    fields: dict[str, Any] = {name: arrays[name] for name in RESULT_ARRAYS}
    return ContactResult(pair=state.pair, points=state.points, medial=None, lateral=None, **fields)


def _settled(mechanics: "Mechanics", frame: int, arrays: Mapping[str, Array]) -> SettledKnee:
    patella = None
    if mechanics.extensor is not None and "settled_patella" in arrays:
        state = mechanics.extensor.states[frame]
        patella = replace(state, coordinates=arrays["settled_patella"])
    place, nan = arrays["settled_coordinates"], float("nan")
    return SettledKnee(
        coordinates=place,
        placed=mechanics.placed(frame, place, patella),
        patella=patella,
        contact=ProbedContact({}),
        balance=Balance(
            coordinates=place,
            force=arrays["settled_force"],
            stiffness=arrays["settled_stiffness"],
            status=BalanceStatus.OK,
            steps=0,
            trials=0,
            softest=nan,
            work=(),
        ),
        passes=0,
        trials=0,
        change=nan,
        problem="",
    )
