"""The patient's URDF: read, mirrored for a left knee, completed with segment inertias, and checked.

Required links: `tibia` (shank and foot, its origin at the ankle centre), `femur`, `patella`, and
`hip`, a frame fixed to the femur at the hip centre. Required joints: `ankle` (or the tibia as
root), the six single-axis knee joints of `tkamb.io.recordings.urdf_check` in their order, and the
three joints of the patella. The origin of `knee_ap` is the insert frame in the tibia, the femur
link's frame that of the femoral component. Other links that are fixed to these may hold attachment
points.

Links without inertia get the segment inertias of de Leva, J Biomech 29:1223 (1996),
doi:10.1016/0021-9290(95)00178-6, with the shank from the knee to the ankle joint centre.
"""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.files import read_xml
from tkamb.geometry.frames import MIRROR, Array, mirrored_pose, pose
from tkamb.io.recordings.recording_tables import PatientTable
from tkamb.io.recordings.urdf_check import (
    check_chain,
    check_elements,
    check_inertia,
    check_links,
    check_tree,
    numbers_of,
)

Sex = Literal["male", "female"]
Segment = Literal["thigh", "shank", "foot"]


@dataclass(frozen=True)
class SegmentFractions:
    """Fractions of body mass and of segment length.

    Args:
        centre: distance of its centre of mass from the proximal end, share of segment length.
        radii: radii of gyration about the sagittal (AP), transverse (ML) and longitudinal axis,
            shares of segment length.
    """

    mass: float
    centre: float
    radii: tuple[float, float, float]


DE_LEVA: dict[Sex, dict[Segment, SegmentFractions]] = {
    "male": {
        "thigh": SegmentFractions(0.1416, 0.4095, (0.329, 0.329, 0.149)),
        "shank": SegmentFractions(0.0433, 0.4395, (0.251, 0.246, 0.102)),
        "foot": SegmentFractions(0.0137, 0.0, (0.0, 0.0, 0.0)),
    },
    "female": {
        "thigh": SegmentFractions(0.1478, 0.3612, (0.369, 0.364, 0.162)),
        "shank": SegmentFractions(0.0481, 0.4352, (0.267, 0.263, 0.092)),
        "foot": SegmentFractions(0.0129, 0.0, (0.0, 0.0, 0.0)),
    },
}
"""De Leva's fractions; the foot, light and slow, is a point mass at the ankle."""


@dataclass(frozen=True, eq=False)
class RigidInertia:
    """Mass (kg), centre (3,) m and inertia (3, 3) kg·m² about the centre, in one frame."""

    mass: float
    centre: Array
    tensor: Array


def segment_inertia(
    segment: Segment, sex: Sex, body_mass: float, proximal: Array, distal: Array
) -> RigidInertia:
    """Return the inertia of a segment between two joint centres (3,) m, in their frame.

    The longitudinal axis joins the centres; AP and ML axis are nearest to x and z of the frame.
    """
    fractions = DE_LEVA[sex][segment]
    mass = fractions.mass * body_mass
    along = proximal - distal
    length = float(np.linalg.norm(along))
    superior = along / length
    anterior = np.array([1.0, 0.0, 0.0]) - superior[0] * superior
    anterior /= np.linalg.norm(anterior)
    axes = np.stack([anterior, superior, np.cross(anterior, superior)], axis=1)
    sagittal, transverse, longitudinal = fractions.radii
    principal = mass * (length * np.array([sagittal, longitudinal, transverse])) ** 2
    return RigidInertia(
        mass, proximal - fractions.centre * along, axes @ np.diag(principal) @ axes.T
    )


def combined(first: RigidInertia, second: RigidInertia) -> RigidInertia:
    """Return the inertia of two rigidly joined bodies (parallel-axis theorem)."""
    mass = first.mass + second.mass
    centre = (first.mass * first.centre + second.mass * second.centre) / mass
    tensor = np.zeros((3, 3))
    for part in (first, second):
        arm = part.centre - centre
        tensor += part.tensor + part.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return RigidInertia(mass, centre, tensor)


# kg: mass of the patella, at its link's origin, if the URDF states none (assumed).
MASS = 0.1
# m: radius of gyration of this mass about any axis. It is about that of a disc of
# 40 mm diameter and 20 mm thickness.
RADIUS_OF_GYRATION = 0.015
# 1: largest distance of a link's far end from the link's y axis (up), as a share of the link's
# length. A link with a larger distance does not lie along its y axis.
MAX_LATERAL_SHARE = 0.5


THIGH = (0.2, 0.7)
"""m: accepted distances from the femur link's origin to the hip centre, child to very tall
adult.
"""

SHANK = (0.15, 0.65)
"""m: accepted distances from ankle centre to insert frame, child to very tall adult."""

MOST_TURNED = np.radians(40.0)
"""rad: largest angle between the insert's axes and the tibia's, due to slope, torsion and varus of
a deformed leg."""


def load_urdf(patient: PatientTable, with_patella: bool) -> str:
    """Return the URDF text of a right knee (a left one mirrored), complete and checked."""
    path = patient.urdf
    robot = _parse(path)
    check_elements(robot, path)
    check_links(robot, path, with_patella)
    check_tree(robot, path)
    if patient.side == "left":
        _mirror(robot)
    check_chain(robot, path, patient.side, with_patella)
    _check_places(robot, path)
    _complete_inertias(robot, patient, with_patella)
    for link in robot.findall("link"):
        check_inertia(link, path, link.get("name") in {"tibia", "femur", "patella"})
    return ElementTree.tostring(robot, encoding="unicode")


def _parse(path: Path) -> ElementTree.Element:
    robot = read_xml(path, what="URDF")
    if robot.tag != "robot":
        raise InputError(f"is not a URDF: its root is <{robot.tag}>, not <robot>", path)
    return robot


def _origin(element: ElementTree.Element) -> Array:
    origin = element.find("origin")
    rotation = Rotation.from_euler("xyz", numbers_of(origin, "rpy")).as_matrix()
    return pose(rotation, numbers_of(origin, "xyz"))


def _set_origin(element: ElementTree.Element, value: Array) -> None:
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    origin.set("xyz", _text(value[:3, 3]))
    origin.set("rpy", _text(Rotation.from_matrix(value[:3, :3]).as_euler("xyz")))


def _text(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)


def _mirror(robot: ElementTree.Element) -> None:
    """Reflect the chain in the sagittal plane (z to -z): a left knee becomes a right one.

    Prismatic axes are not reflected: the reader of the motion reverses the medial-lateral
    translation instead.
    """
    for joint in robot.findall("joint"):
        _set_origin(joint, mirrored_pose(_origin(joint)))
        axis = joint.find("axis")
        if axis is not None and joint.get("type") != "prismatic":
            axis.set("xyz", _text(-MIRROR @ numbers_of(axis, "xyz")))
    for inertial in robot.iterfind("link/inertial"):
        _set_origin(inertial, mirrored_pose(_origin(inertial)))
        tensor = inertial.find("inertia")
        for key in ("ixz", "iyz"):
            if tensor is not None:
                tensor.set(key, _text(-numbers_of(tensor, key, "0")))


def _check_places(robot: ElementTree.Element, path: Path) -> None:
    """Raise an InputError unless hip and insert lie plausibly above knee and ankle."""
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    checks = (
        ("the hip", "femur", _fixed_pose(robot, "hip", "femur", path)[:3, 3], THIGH),
        ("the origin of knee_ap", "tibia", _origin(joints["knee_ap"])[:3, 3], SHANK),
    )
    for name, link, position, (low, high) in checks:
        distance = float(np.linalg.norm(position))
        if (
            not low <= distance <= high
            or position[1] < 0
            or np.hypot(*position[[0, 2]]) > MAX_LATERAL_SHARE * distance
        ):
            words = ", ".join(f"{value:.4g}" for value in position)
            raise InputError(
                f"{name} is at ({words}) m in '{link}', {distance:.4g} m from its origin",
                path,
                f"place it {low:g} to {high:g} m above this origin, along y, in metres",
            )
    turn = _origin(joints["knee_ap"])[:3, :3]
    if min(turn[0, 0], turn[1, 1]) < np.cos(MOST_TURNED):
        tilts = ", ".join(f"{np.degrees(np.arccos(turn[i, i])):.0f}" for i in range(3))
        raise InputError(
            f"the origin of knee_ap turns the insert's axes by {tilts} deg from the tibia's",
            path,
            "check that rpy is in radians, and that the axes are anterior, superior and right",
        )


def _complete_inertias(
    robot: ElementTree.Element, patient: PatientTable, with_patella: bool
) -> None:
    links = {link.get("name"): link for link in robot.findall("link")}
    missing = [n for n in ("tibia", "femur") if links[n].find("inertial") is None]
    if missing and patient.sex is None:
        raise InputError(
            f"link '{missing[0]}' has no <inertial>",
            patient.urdf,
            "add one, or give [patient] sex for the de Leva table",
        )
    for name in missing:
        assert patient.sex is not None
        _write_inertia(links[name], _segment(robot, name, patient.sex, patient))
    if with_patella and links["patella"].find("inertial") is None:
        tensor = MASS * RADIUS_OF_GYRATION**2 * np.eye(3)
        _write_inertia(links["patella"], RigidInertia(MASS, np.zeros(3), tensor))


def _segment(
    robot: ElementTree.Element, name: str, sex: Sex, patient: PatientTable
) -> RigidInertia:
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    if name == "femur":
        hip = _fixed_pose(robot, "hip", "femur", patient.urdf)[:3, 3]
        return segment_inertia("thigh", sex, patient.mass_kg, hip, np.zeros(3))
    ankle = np.zeros(3)
    knee = _origin(joints["knee_ap"])[:3, 3]
    shank = segment_inertia("shank", sex, patient.mass_kg, knee, ankle)
    foot = segment_inertia("foot", sex, patient.mass_kg, ankle, ankle + np.array([0, -1.0, 0]))
    return combined(shank, foot)


def _fixed_pose(robot: ElementTree.Element, link: str, base: str, path: Path) -> Array:
    parents = {joint.find("child").get("link"): joint for joint in robot.findall("joint")}  # type: ignore[union-attr]
    result, name = np.eye(4), link
    while name != base:
        joint = parents.get(name)
        if joint is None or joint.get("type") != "fixed":
            raise InputError(f"link '{link}' is not fixed to '{base}'", path, "use fixed joints")
        result = _origin(joint) @ result
        name = joint.find("parent").get("link")  # type: ignore[union-attr,assignment]
    return result


def _write_inertia(link: ElementTree.Element, inertia: RigidInertia) -> None:
    inertial = ElementTree.SubElement(link, "inertial")
    _set_origin(inertial, pose(np.eye(3), inertia.centre))
    ElementTree.SubElement(inertial, "mass", value=repr(float(inertia.mass)))
    rows = {
        "ixx": (0, 0),
        "iyy": (1, 1),
        "izz": (2, 2),
        "ixy": (0, 1),
        "ixz": (0, 2),
        "iyz": (1, 2),
    }
    values = {key: repr(float(inertia.tensor[index])) for key, index in rows.items()}
    ElementTree.SubElement(inertial, "inertia", values)
