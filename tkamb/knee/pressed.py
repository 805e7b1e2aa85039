"""The contact that `tkamb.Knee` returns, of one configuration or of many, in the user's frames."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from tkamb.contact.result import CondyleContact, ContactResult, ContactStatus
from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, SIDES, Array, inverse, mirrored_pose
from tkamb.knee.canonical import mirrored_spatial, se3
from tkamb.units import MEGAPASCAL

if TYPE_CHECKING:
    from tkamb.knee.assembled import KneeData
    from tkamb.knee.button import ButtonPress
    from tkamb.knee.knee import Knee
    from tkamb.knee.solution_derivatives import PressDerivatives


@dataclass(frozen=True, eq=False, repr=False)
class KneeContactResult(ContactResult):
    """Contact of a knee from `Knee.press` or `Knee.evaluate`, in the insert frame of the knee.

    The insert frame has x anterior, y superior and z to the patient's right, for left knees too.
    Medial and lateral are the condyles of the patient. The other fields are those of
    `ContactResult`.

    Args:
        pose: `pin.SE3`, pose of the femoral component in the insert frame.
        of_right_knee: the result of the equations, which are those of a right knee: the mirror
            image for a left knee.
    """

    pose: Any
    of_right_knee: ContactResult = field(kw_only=True)
    left: bool = field(kw_only=True)

    @property
    def approach(self) -> float:
        """m, travel along -y since first touch; 0 when apart, NaN when out of range."""
        return self.of_right_knee.approach


@dataclass(frozen=True, eq=False)
class KneePatellaResult:
    """Contact of the patellar button from `Knee.press_patella`.

    Args:
        contact: the contact in the button frame: x superior, y from the button's back to its
            articular surface, z to the patient's right. "Insert" in its names means the button;
            medial and lateral are the facets.
        button_in_patella: `pin.SE3`, pose of the button frame in the frame "patella".
        on_patella: `pin.Force` of the contact on the patella, in the frame "patella".
        on_femoral: `pin.Force` of the contact on the femoral component, in the frame "femoral".
    """

    contact: KneeContactResult
    button_in_patella: Any
    on_patella: Any
    on_femoral: Any
    flags: tuple[str, ...]


def patella_of_user(
    press: "ButtonPress", poses: Mapping[str, Array], in_patella: Array, left: bool
) -> KneePatellaResult:
    """Return a press of the button in the frames of the user's knee.

    `press` is that of a right knee, with a contact. `poses` (4, 4) are those of the links in the
    insert frame, `in_patella` is pose_button_in_patella (4, 4).
    """
    assert press.contact is not None
    on_patella, femoral = pin.Force(press.on_patella), se3(poses["femur"])
    # The wrench acts on the pressed patella, and the frame of the patella moves with it.
    pressed_patella = se3(press.pose @ inverse(in_patella))
    forces = (pressed_patella.actInv(on_patella), femoral.actInv(-on_patella))
    if left:
        in_patella = mirrored_pose(in_patella)
        forces = tuple(pin.Force(mirrored_spatial(force.vector)) for force in forces)
    contact = contact_of_user(replace(press.contact, flags=press.flags), left)
    return KneePatellaResult(contact, se3(in_patella), *forces, press.flags)


def contact_of_user(result: ContactResult, left: bool) -> KneeContactResult:
    """Return a result of the equations in the frames of the user's knee."""
    values = {one.name: getattr(result, one.name) for one in fields(ContactResult)}
    values["pose"] = se3(mirrored_pose(result.pose) if left else result.pose)
    if left:
        for name in ("points", "normals", "nodal_force"):
            values[name] = values[name] @ MIRROR
        values["wrench_on_insert"] = mirrored_spatial(result.wrench_on_insert)
        values["medial"] = _mirrored(result.medial)
        values["lateral"] = _mirrored(result.lateral)
    return KneeContactResult(**values, of_right_knee=result, left=left)


def _mirrored(condyle: CondyleContact | None) -> CondyleContact | None:
    if condyle is None:
        return None
    return replace(condyle, centre_of_pressure=condyle.centre_of_pressure @ MIRROR)


def contact_of_equations(result: ContactResult, left: bool) -> ContactResult:
    """Return the result of the equations that belongs to a result of the user.

    Raises:
        InputError: the result is that of a knee of the other side, or of no knee.
    """
    if isinstance(result, KneeContactResult) and result.left == left:
        return result.of_right_knee
    side, other = ("left", "right") if left else ("right", "left")
    origin = f"a {other} knee" if isinstance(result, KneeContactResult) else "no tkamb.Knee"
    raise InputError(
        f"the contact is that of {origin}, this is a {side} knee",
        "contact",
        "give the result of press or evaluate of this knee",
    )


@dataclass(frozen=True, eq=False)
class PressBatch:
    """The presses of n poses. A press that failed has NaN; an unloaded condyle has zero.

    Args:
        force: contact forces of the medial and lateral condyle, (n, 2), N.
        peak_pressure: their peak pressures, (n, 2), Pa.
        area: their contact areas, (n, 2), m².
        approach: travel along -y since first touch, (n,), m.
        pose: pose of the femoral component, (n, 4, 4).
        pressure: pressure at the map points, (n, p), Pa.
        derivatives: derivatives of each press; empty: not asked for.
    """

    results: tuple[KneeContactResult, ...]
    force: Array
    peak_pressure: Array
    area: Array
    approach: Array
    pose: Array
    pressure: Array
    derivatives: "tuple[PressDerivatives, ...]" = ()

    def __repr__(self) -> str:
        failed = sum(one.failed for one in self.results)
        peak = np.nanmax(self.peak_pressure, initial=0.0) / MEGAPASCAL
        return (
            f"<tkamb.PressBatch: {len(self.results)} poses, {failed} failed; peak {peak:.1f} MPa>"
        )

    @property
    def failed(self) -> Array:
        """Whether each press failed, (n,)."""
        return np.array([one.failed for one in self.results], bool)

    @property
    def status(self) -> tuple[ContactStatus, ...]:
        """Status of each press."""
        return tuple(one.status for one in self.results)


def press_all(
    knee: "Knee", q: Array, load: float | Array, data: "KneeData", derivatives: bool
) -> PressBatch:
    """Return the presses at q (n, nq) under one load or a load per pose (n,), N.

    Each press is the warm start of the next.
    """
    count = len(q)
    if np.shape(load) not in ((), (count,)):
        raise InputError(f"the shape is {np.shape(load)}", "load", f"give a number or ({count},)")
    results, slopes = [], []
    for one, its_load in zip(np.asarray(q, float), np.broadcast_to(load, count), strict=True):
        result, start = knee._press_from(one, float(its_load), data)
        if derivatives:
            slopes.append(knee._press_slopes(result, start))
        results.append(contact_of_user(result, knee.left))
    force, peak, area = (_of_condyles(results, one) for one in ("force", "peak_pressure", "area"))
    return PressBatch(
        tuple(results),
        force,
        peak,
        area,
        np.array([one.approach for one in results]),
        np.array([one.pose.homogeneous for one in results]),
        np.array([one.pressure for one in results]),
        tuple(slopes),
    )


def _of_condyles(results: list[KneeContactResult], name: str) -> Array:
    values = np.zeros((len(results), len(SIDES)))
    for k, result in enumerate(results):
        for i, side in enumerate(SIDES):
            # An unloaded condyle has no contact: its values are zero.
            condyle = getattr(result, side)
            values[k, i] = 0.0 if condyle is None else getattr(condyle, name)
        if result.failed:
            values[k] = np.nan
    return values


def forces_of_all(knee: "Knee", q: Array, v: Array, tensions: Any, data: "KneeData") -> Array:
    """Return the forces (n, njoints, 6) of `Knee.external_forces` at q (n, nq) and v (n, nv)."""
    if np.shape(v) != (len(q), knee.model.nv):
        raise InputError(
            f"the shape is {np.shape(v)}", "v", f"give ({len(q)}, {knee.model.nv}), one per q"
        )
    return np.array(
        [
            [force.vector for force in knee.external_forces(one, rate, tensions, data)]
            for one, rate in zip(q, v, strict=True)
        ]
    )
