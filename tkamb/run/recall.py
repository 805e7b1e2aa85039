"""The contact of a frame as arrays, from which the next frame of a resumed run begins.

The warm start is the one that the frame left, without what is not kept: the lattice's
displacements, and the contact and muscle forces from which a released knee begins. Answers stay
within the solver's tolerance.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.contact.model import ProbedContact
from tkamb.contact.result import WarmStart
from tkamb.geometry.frames import SIDES, Array
from tkamb.knee.balance import Balance, BalanceStatus
from tkamb.knee.frame_contact import FrameContact
from tkamb.knee.released import KneeEquilibrium
from tkamb.run.contact_side import ContactSide
from tkamb.run.shards import CONTACT_PLACES

if TYPE_CHECKING:
    from tkamb.knee.equations import KneeGeometry
    from tkamb.run.mechanics import Mechanics

RESULT_ARRAYS = ("pose", "pressure", "gap", "nodal_force")
"""What the map of a run and the start of a resumed one need of a result."""


def contact_arrays(
    contact: FrameContact | None, geometry: "KneeGeometry"
) -> dict[str, Array] | None:
    """Return the arrays to keep of a frame's contact, by name; None without a result.

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
    """Return a frame's warm start from its arrays, in a contact that holds no result."""
    none = np.zeros(len(side.state.points), bool)
    if arrays is None:
        return FrameContact(None, none, None, 0.0, "not recalled", ())
    knee = _equilibrium(mechanics, frame, arrays) if "equilibrium_coordinates" in arrays else None
    state = side.state
    start = WarmStart(state.pair, arrays["pose"], state.points, arrays["pressure"], arrays["gap"])
    return FrameContact(None, none, None, 0.0, "", (), equilibrium=knee, start=start)


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
