"""A frame's contact as arrays, and back: what a resumed run starts its next frame from.

It stands in for the frame before as a guess, as good as the frame itself but for what is not
kept: the warm start, the contact and muscle forces that a released knee begins from, and the
turned contact. Answers stay within the solver's tolerance.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.pair import PreparedContact
from tkamb.contact.probe import ProbedContact
from tkamb.contact.result import ContactResult
from tkamb.geometry.frames import SIDES, Array
from tkamb.knee.equilibrium.balance import Balance, BalanceStatus
from tkamb.knee.equilibrium.frame_contact import FrameContact
from tkamb.knee.equilibrium.released import KneeEquilibrium
from tkamb.run.contact_side import ContactSide
from tkamb.run.shards import CONTACT_PLACES

if TYPE_CHECKING:
    from tkamb.knee.equations import KneeGeometry
    from tkamb.run.mechanics import Mechanics

RESULT_ARRAYS = ("pose", "normals", "pressure", "area", "gap", "nodal_force", "wrench_on_insert")


def contact_arrays(
    contact: FrameContact | None, geometry: "KneeGeometry"
) -> dict[str, Array] | None:
    """Return what is worth keeping of a frame's contact by name; None without a result.

    Args:
        contact: of the frame.
        geometry: what the equations worked on.
    """
    if contact is None or contact.result is None:
        return None
    result, knee = contact.result, contact.equilibrium
    arrays = {name: np.asarray(getattr(result, name), float) for name in RESULT_ARRAYS}
    points, normals = np.full((2, 3, 3), np.nan)
    for side, condyle in geometry.condyles.items():
        points[SIDES.index(side)], normals[SIDES.index(side)] = condyle.point, condyle.normal
    if geometry.extensor is not None:
        points[2] = geometry.extensor.contact_point
        normals[2] = geometry.extensor.contact_normal
    arrays |= zip(CONTACT_PLACES, (points, normals), strict=True)
    if knee is not None:
        arrays["equilibrium_coordinates"] = knee.coordinates
        arrays["equilibrium_force"] = knee.balance.force
        arrays["equilibrium_stiffness"] = knee.balance.stiffness
        if knee.patella is not None:
            arrays["equilibrium_patella"] = knee.patella.coordinates
    return arrays


def recalled(
    side: ContactSide, mechanics: "Mechanics", frame: int, arrays: Mapping[str, Array] | None
) -> FrameContact:
    """Return a frame's contact from its arrays, as a guess for the next frame."""
    none = np.zeros(len(side.state.points), bool)
    if arrays is None:
        return FrameContact(None, none, None, 0.0, "not recalled", ())
    knee = _equilibrium(mechanics, frame, arrays) if "equilibrium_coordinates" in arrays else None
    return FrameContact(_result(side.state, arrays), none, None, 0.0, "", (), equilibrium=knee)


def _result(state: PreparedContact, arrays: Mapping[str, Array]) -> ContactResult:
    fields: dict[str, Any] = {name: arrays[name] for name in RESULT_ARRAYS}
    return ContactResult(pair=state.pair, points=state.points, medial=None, lateral=None, **fields)


def _equilibrium(
    mechanics: "Mechanics", frame: int, arrays: Mapping[str, Array]
) -> KneeEquilibrium:
    patella = None
    if mechanics.extensor is not None and "equilibrium_patella" in arrays:
        state = mechanics.extensor.states[frame]
        patella = replace(state, coordinates=arrays["equilibrium_patella"])
    place, nan = arrays["equilibrium_coordinates"], float("nan")
    return KneeEquilibrium(
        coordinates=place,
        geometry=mechanics.geometry(frame, place, patella),
        patella=patella,
        contact=ProbedContact({}),
        balance=Balance(
            coordinates=place,
            force=arrays["equilibrium_force"],
            stiffness=arrays["equilibrium_stiffness"],
            status=BalanceStatus.OK,
            steps=0,
            trials=0,
            smallest_stiffness=nan,
            work=(),
        ),
        passes=0,
        trials=0,
        change=nan,
        problem="",
    )
