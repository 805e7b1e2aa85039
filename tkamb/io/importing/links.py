"""Placement of the links of docs/patient.md on the bodies of an OpenSim model, and their URDF.

Each link is a frame on a body of the model:

- femur: origin of the femoral component's mesh, with the mesh axes turned to x anterior,
  y superior, z right. Without an implant: the knee's centre, with the axes of the femoral body.
- tibia: the ankle joint's centre, with the tibial body's axes.
- patella: the origin of the patella's body. Its axes are those of the body, turned by multiples
  of 90 deg so that they are nearest the axes of the femur link.
"""

from dataclasses import dataclass
from functools import reduce
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, knee_coordinates, pose, transform
from tkamb.io.importing.anatomy import Leg
from tkamb.io.recordings.meshes import axes_rotation
from tkamb.io.recordings.patient import RigidInertia, combined
from tkamb.io.recordings.urdf_check import KNEE_JOINTS, PATELLA_JOINTS
from tkamb.units import DEGREE

# rad: largest rotation between the axes of implant and bone. Wrong mesh axes give
# at least 90 deg and a real implantation gives a few degrees.
MAX_IMPLANT_ROTATION = 35.0 * DEGREE


@dataclass(frozen=True, eq=False)
class MeshFrame:
    """The frame of a mesh in a body of the model.

    Args:
        pose: pose_mesh_in_body, (4, 4); None: at the body's origin, with anatomical axes.
        why: words for the report on how the frame was identified.
    """

    body: str
    pose: Array | None
    why: str


_STEMS = {
    "femoral component": ("femur_implant", "femoral_implant", "femoral_component"),
    "insert": ("tibia_implant", "tibial_implant", "insert", "tibial_tray", "tray"),
    "patellar button": ("patella_implant", "patellar_implant", "button"),
}


def mesh_frame(leg: Leg, part: str, wished_name: str | None) -> MeshFrame:
    """Return the frame of a part's mesh: an offset frame or body of the model.

    Args:
        part: "femoral component", "insert" or "patellar button".
        wished_name: name of the offset frame or body; None: the first frame with the part in its
            name.
    """
    model = leg.model
    group = {
        "femoral component": leg.femur,
        "insert": leg.tibia,
        "patellar button": (leg.patella,),
    }[part]
    frames = {name: (body, at) for name, (body, at) in model.offset_frames.items() if body in group}
    frames |= {body: (body, np.eye(4)) for body in group if body}
    if wished_name is not None:
        if wished_name not in frames:
            raise InputError(
                f"has no frame '{wished_name}' on {', '.join(filter(None, group))}",
                model.name,
                f"it has {', '.join(frames)}",
            )
        return MeshFrame(*frames[wished_name], f"frame '{wished_name}', as given")
    for stem in _STEMS[part]:
        for name in frames:
            if stem in name.lower():
                return MeshFrame(*frames[name], f"'{name}', by its name")
    if part == "patellar button" and leg.patella:
        return MeshFrame(leg.patella, None, "the patella's origin, because there is no frame")
    option = {"femoral component": "--femoral-frame", "insert": "--insert-frame"}.get(
        part, "--patella-frame"
    )
    raise InputError(
        f"does not say how the {part}'s mesh is placed on the bone",
        model.name,
        f"give {option}, one of {', '.join(frames)}",
    )


def quarter_turn(rotation: Array) -> tuple[Array, float]:
    """Return the nearest rotation (3, 3) by multiples of 90 deg, and the angle, rad."""
    turns = Rotation.create_group("O")
    angles = (turns.inv() * Rotation.from_matrix(rotation)).magnitude()
    nearest = int(np.argmin(angles))
    return np.round(turns[nearest].as_matrix()), float(angles[nearest])


@dataclass(frozen=True, eq=False)
class Links:
    """The links of a leg. Poses are (4, 4) matrices, in m, in the link's body.

    Args:
        patella: pose of the patella link; None without a patella.
        button_in_patella: pose of the button's mesh, turned to anatomical axes, in the patella
            link; None without a button.
        patella_error: angle between the axes of the patella link and the femur link in the neutral
            position, rad.
    """

    leg: Leg
    femur: Array
    tibia: Array
    patella: Array | None
    insert_in_tibia: Array
    button_in_patella: Array | None
    patella_error: float
    remarks: tuple[str, ...]

    def body_in_link(self, body: str) -> tuple[str, Array]:
        """Return the link that moves with a body, and the body's pose (4, 4) in it."""
        leg = self.leg
        for link, bodies, link_pose in (
            ("femur", leg.femur, self.femur),
            ("tibia", leg.tibia, self.tibia),
            ("patella", (leg.patella,), self.patella),
        ):
            if body in bodies and link_pose is not None:
                return link, inverse(link_pose) @ leg.in_body(body, str(bodies[0]))
        raise InputError(f"body '{body}' is not part of any link of the leg", leg.model.name)

    def point_in_link(self, body: str, point: Array) -> tuple[str, Array]:
        """Return the link that moves with a body, and the coordinates (3,) m of a point in it."""
        link, offset = self.body_in_link(body)
        return link, transform(offset, point)

    @property
    def neutral(self) -> Array:
        """(6,) knee coordinates (m, rad) in the neutral position."""
        leg = self.leg
        tibia = leg.neutral[leg.tibia[0]] @ self.tibia @ self.insert_in_tibia
        femur = leg.neutral[leg.femur[0]] @ self.femur
        return knee_coordinates(inverse(tibia) @ femur)

    @property
    def hip(self) -> Array:
        """(3,) m, the hip's centre in the femur link."""
        body, point = self.leg.hip_centre
        return self.point_in_link(body, point)[1]

    @property
    def patella_in_femur(self) -> Array | None:
        """(4, 4) neutral pose of the patella link in the femur link; None without a patella."""
        leg = self.leg
        if leg.patella is None or self.patella is None:
            return None
        femur = leg.neutral[leg.femur[0]] @ self.femur
        return inverse(femur) @ leg.neutral[leg.patella] @ self.patella


def find_links(
    leg: Leg,
    placement: Array | None,
    axes: str,
    frames: dict[str, str | None],
    with_button: bool,
) -> Links:
    """Return the links of a leg.

    Args:
        placement: pose of the insert's mesh in the insert frame, after the mesh is turned to
            anatomical axes about its origin, (4, 4); None without an implant.
        axes: axes of the meshes that point anterior, superior and right.
        frames: part of the implant -> name of its mesh's frame; None: inferred from the names.
    """
    turn = pose(axes_rotation(axes), np.zeros(3))
    text: list[str] = []
    if placement is None:
        femur = pose(np.eye(3), transform(inverse(leg.neutral[leg.femur[0]]), leg.knee_centre))
    else:
        result = mesh_frame(leg, "femoral component", frames.get("femoral component"))
        femur = _anatomical(leg, result, leg.femur[0], turn, "femoral component", text)
    body, centre = leg.ankle_centre
    tibia = pose(np.eye(3), transform(leg.in_body(body, leg.tibia[0]), centre))
    if placement is None:
        straight = inverse(leg.neutral[leg.tibia[0]] @ tibia) @ leg.neutral[leg.femur[0]] @ femur
        insert_in_tibia = pose(np.eye(3), straight[:3, 3])
        text.append("no implant: the 'insert' frame has the tibia's axes at the knee's centre")
    else:
        result = mesh_frame(leg, "insert", frames.get("insert"))
        mesh = _anatomical(leg, result, leg.tibia[0], turn, "insert", text)
        insert_in_tibia = inverse(tibia) @ mesh @ inverse(placement)
    patella, button, error = _patella(leg, femur, turn, frames, with_button, text)
    return Links(leg, femur, tibia, patella, insert_in_tibia, button, error, tuple(text))


def _anatomical(
    leg: Leg, frame: MeshFrame, body: str, turn: Array, part: str, remarks: list[str]
) -> Array:
    """Return the pose (4, 4) in a body, turned to anatomical axes."""
    assert frame.pose is not None
    pose = leg.in_body(frame.body, body) @ frame.pose @ inverse(turn)
    nearest, _ = quarter_turn(pose[:3, :3])
    angle = Rotation.from_matrix(pose[:3, :3]).magnitude()
    if not np.allclose(nearest, np.eye(3)) or angle > MAX_IMPLANT_ROTATION:
        raise InputError(
            f"the {part} is rotated by {angle / DEGREE:.0f} deg on '{body}' with these axes "
            f"({frame.why})",
            "--mesh-axes",
            "give the mesh's axes that point anterior, superior and right, like -x,+y,-z",
        )
    place = ", ".join(f"{v * 1e3:.1f}" for v in pose[:3, 3])
    remarks.append(
        f"{part} on '{body}' at ({place}) mm, turned by {angle / DEGREE:.1f} deg ({frame.why})"
    )
    return pose


def _patella(
    leg: Leg,
    femur: Array,
    turn: Array,
    frames: dict[str, str | None],
    with_button: bool,
    remarks: list[str],
) -> tuple[Array | None, Array | None, float]:
    if leg.patella is None:
        return None, None, 0.0
    anatomical = leg.neutral[leg.patella][:3, :3].T @ (leg.neutral[leg.femur[0]] @ femur)[:3, :3]
    axes, error = quarter_turn(anatomical)
    patella = pose(axes, np.zeros(3))
    if not with_button:
        return patella, None, error
    result = mesh_frame(leg, "patellar button", frames.get("patellar button"))
    mesh = patella @ turn if result.pose is None else result.pose
    button = inverse(patella) @ mesh @ inverse(turn)
    place = ", ".join(f"{v * 1e3:.1f}" for v in button[:3, 3])
    remarks.append(f"patellar button on the patella at ({place}) mm ({result.why})")
    return patella, button, error


RESERVED = ("ground", "tibia", "femur", "patella", "hip")
"""Links in docs/patient.md; a body with such a name becomes a link with suffix `_bone`."""

_LIMIT = '<limit lower="-10" upper="10" effort="1e6" velocity="1e3"/>'


def body_link(body: str) -> str:
    """Return the link of a body in the URDF."""
    return f"{body}_bone" if body in RESERVED else body


def link_inertias(links: Links, scale: float) -> dict[str, RigidInertia]:
    """Return link -> its inertia; the tibia includes the foot, with a neutral ankle."""
    leg = links.leg
    groups = {
        "tibia": (leg.tibia[0], links.tibia, (*leg.tibia, *leg.foot)),
        "femur": (leg.femur[0], links.femur, leg.femur),
    }
    return {
        link: reduce(combined, (_body_inertia(links, b, base, link_pose, scale) for b in bodies))
        for link, (base, link_pose, bodies) in groups.items()
    }


def _body_inertia(
    links: Links, body: str, base: str, link_pose: Array, scale: float
) -> RigidInertia:
    pose = np.linalg.inv(link_pose) @ links.leg.in_body(body, base)
    inertia, turn = links.leg.model.bodies[body], pose[:3, :3]
    tensor = scale * turn @ inertia.inertia @ turn.T
    return RigidInertia(scale * inertia.mass_kg, transform(pose, inertia.centre), tensor)


def patient_urdf(links: Links, scale: float, comment: str) -> str:
    """Return the URDF, with masses scaled by `scale`."""
    leg = links.leg
    inertias = link_inertias(links, scale)
    lines = ['<?xml version="1.0"?>', f"<!-- {comment.replace('--', '- -')} -->"]
    lines += [f"<robot name={quoteattr(leg.model.name)}>", '  <link name="ground"/>']
    for name, inertia in inertias.items():
        lines += _link(name, inertia)
    if leg.patella is not None:
        lines.append('  <link name="patella"/>')
    lines += _joint("ankle", ("revolute", (0, 0, 1)), "ground", "tibia", np.eye(4))
    lines += _chain(KNEE_JOINTS, "tibia", "femur", links.insert_in_tibia, leg.side)
    in_femur = links.patella_in_femur
    if in_femur is not None:
        first = pose(np.eye(3), [0.0, 0.0, in_femur[2, 3]])
        lines += _chain(PATELLA_JOINTS, "femur", "patella", first, "right")
    fixed = {"hip": ("femur", pose(np.eye(3), links.hip))}
    for body in (*leg.femur, *leg.tibia, *([leg.patella] if leg.patella else [])):
        fixed[body_link(body)] = links.body_in_link(body)
    for name, (parent, place) in fixed.items():
        lines.append(f"  <link name={quoteattr(name)}/>")
        lines += _joint(f"{name}_mount", ("fixed", None), parent, name, place)
    return "\n".join([*lines, "</robot>", ""])


def _chain(
    joints: dict[str, tuple[str, tuple[int, int, int]]],
    start: str,
    end: str,
    first: Array,
    side: str,
) -> list[str]:
    lines, parent = [], start
    for number, (name, (kind, axis)) in enumerate(joints.items(), 1):
        # In a left knee the rotation axes x and y have the opposite sign (docs/patient.md).
        reversed_axis = side == "left" and kind == "revolute" and axis[2] == 0
        signed_axis = tuple(-v for v in axis) if reversed_axis else axis
        child = end if number == len(joints) else f"{name}_link"
        lines += [f'  <link name="{child}"/>'] if child != end else []
        place = first if parent == start else np.eye(4)
        lines += _joint(name, (kind, signed_axis), parent, child, place)
        parent = child
    return lines


def _link(name: str, inertia: RigidInertia) -> list[str]:
    t = inertia.tensor
    keys = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2)}
    values = " ".join(f'{k}="{t[i]:.9g}"' for k, i in (keys | {"iyz": (1, 2)}).items())
    return [
        f'  <link name="{name}">',
        f"    <inertial>{_origin(pose(np.eye(3), inertia.centre))}"
        f'<mass value="{inertia.mass:.9g}"/>',
        f"      <inertia {values}/></inertial>",
        "  </link>",
    ]


def _joint(
    name: str,
    joint: tuple[str, tuple[int, ...] | None],
    parent: str,
    child: str,
    place: Array,
) -> list[str]:
    kind, axis = joint
    turn = "" if axis is None else f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>{_LIMIT}'
    ends = f"<parent link={quoteattr(parent)}/><child link={quoteattr(child)}/>"
    return [
        f"  <joint name={quoteattr(name)} type={quoteattr(kind)}>{ends}",
        f"    {_origin(place)}{turn}</joint>",
    ]


def _origin(place: Array) -> str:
    angles = Rotation.from_matrix(place[:3, :3]).as_euler("xyz")
    xyz, rpy = (
        " ".join(f"{round(v, 12) + 0.0:.9g}" for v in part) for part in (place[:3, 3], angles)
    )
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'
