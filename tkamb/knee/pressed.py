"""The contact that `tkamb.Knee` returns: in the frames of the user's knee, right or left."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import pinocchio as pin

from tkamb.contact.result import CondyleContact, ContactResult
from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, Array, inverse, mirrored_pose
from tkamb.knee.canonical import mirrored_spatial, se3

if TYPE_CHECKING:
    from tkamb.knee.button import ButtonPress


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
        left: whether the knee is a left one.
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
        flags: warnings in words.
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

    Args:
        press: press of a right knee, with a contact.
        poses: link -> pose (4, 4) in the insert frame.
        in_patella: pose_button_in_patella (4, 4).
        left: whether the knee is a left one.
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
