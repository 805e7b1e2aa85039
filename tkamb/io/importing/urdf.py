"""The URDF of docs/patient.md, written from a leg of an OpenSim model."""

from functools import reduce
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import Array, pose, transform
from tkamb.io.importing.links import Links
from tkamb.io.recordings.patient import RigidInertia, combined
from tkamb.io.recordings.urdf_check import KNEE_JOINTS, PATELLA_JOINTS

RESERVED = ("ground", "tibia", "femur", "patella", "hip")
"""Links that docs/patient.md names; a body of one of these names gets `_bone` behind it."""

_LIMIT = '<limit lower="-10" upper="10" effort="1e6" velocity="1e3"/>'


def body_link(body: str) -> str:
    """Return the name of the link that stands for a body of the model."""
    return f"{body}_bone" if body in RESERVED else body


def link_inertias(links: Links, scale: float) -> dict[str, RigidInertia]:
    """Return link -> inertia in the link: tibia with the foot at its neutral angles, and femur.

    Args:
        links: of the leg.
        scale: factor on masses and inertias.
    """
    leg = links.leg
    groups = {
        "tibia": (leg.tibia[0], links.tibia, (*leg.tibia, *leg.foot)),
        "femur": (leg.femur[0], links.femur, leg.femur),
    }
    return {
        link: reduce(combined, (_seen_from(links, b, base, own, scale) for b in bodies))
        for link, (base, own, bodies) in groups.items()
    }


def _seen_from(links: Links, body: str, base: str, own: Array, scale: float) -> RigidInertia:
    """Return the inertia of a body in a link that stands at `own` in the body `base`."""
    pose = np.linalg.inv(own) @ links.leg.in_body(body, base)
    inertia, turn = links.leg.model.bodies[body], pose[:3, :3]
    tensor = scale * turn @ inertia.inertia @ turn.T
    return RigidInertia(scale * inertia.mass_kg, transform(pose, inertia.centre), tensor)


def patient_urdf(links: Links, scale: float, comment: str) -> str:
    """Return the text of the URDF.

    Args:
        links: of the leg.
        scale: factor on the model's masses.
        comment: what stands at the top.
    """
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
    """Return single-axis joints in a row with massless links between them."""
    lines, parent = [], start
    for number, (name, (kind, axis)) in enumerate(joints.items(), 1):
        # a left knee turns the other way about y and x: docs/patient.md
        reversed_axis = side == "left" and kind == "revolute" and axis[2] == 0
        own = tuple(-v for v in axis) if reversed_axis else axis
        child = end if number == len(joints) else f"{name}_link"
        lines += [f'  <link name="{child}"/>'] if child != end else []
        place = first if parent == start else np.eye(4)
        lines += _joint(name, (kind, own), parent, child, place)
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
