"""The patient's URDF: read, mirrored if left, completed with segment inertias, checked.

Links that must exist: `tibia` (shank and foot, its origin at the ankle centre), `femur`,
`patella`, and `hip`, a frame fixed to the femur at the hip centre. Joints: `ankle` (or the
tibia as root), the six single-axis knee joints in the order of `KNEE_JOINTS`, and the three of
`PATELLA_JOINTS`.
The origin of `knee_ap` is the insert frame in the tibia; the femur link's frame is that of
the femoral component. Any other link fixed to these may carry attachment points.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, Array, mirrored_pose, pose
from tkamb.inputs.safe_xml import parse_xml
from tkamb.inputs.segments import RigidInertia, Sex, combined, segment_inertia
from tkamb.scene_tables import PatientTable

KNEE_JOINTS = {
    "knee_ap": ("prismatic", (1, 0, 0)),
    "knee_si": ("prismatic", (0, 1, 0)),
    "knee_ml": ("prismatic", (0, 0, 1)),
    "knee_axial_rotation": ("revolute", (0, -1, 0)),
    "knee_adduction": ("revolute", (-1, 0, 0)),
    "knee_flexion": ("revolute", (0, 0, 1)),
}
"""Knee joints of a right knee, tibia to femur; a left one has (0 1 0) and (1 0 0) instead."""

PATELLA_JOINTS = {
    "patella_ap": ("prismatic", (1, 0, 0)),
    "patella_si": ("prismatic", (0, 1, 0)),
    "patella_rotation": ("revolute", (0, 0, 1)),
}

PATELLA_MASS = 0.1
"""kg, at the patella link's origin unless the URDF says otherwise."""

PATELLA_RADIUS_OF_GYRATION = 0.015
"""m: about that of a disc 40 mm across and 20 mm thick."""


def load_urdf(table: PatientTable, with_patella: bool) -> str:
    """Return the URDF text of a right knee (a left one mirrored), complete and checked.

    Args:
        table: the scene's [patient].
        with_patella: whether the patella and its joints are needed.

    Raises:
        InputError: missing file, link or joint, wrong axis, singular inertia.
    """
    robot = _parsed(table.urdf)
    _check_numbers(robot, table.urdf)
    if table.side == "left":
        _mirror(robot)
    wanted = KNEE_JOINTS | (PATELLA_JOINTS if with_patella else {})
    _require_chain(robot, table, wanted, with_patella)
    _check_tree(robot, table.urdf)
    _complete_inertias(robot, table, with_patella)
    for link in robot.findall("link"):
        _check_inertia(link, table.urdf, link.get("name") in {"tibia", "femur", "patella"})
    return ElementTree.tostring(robot, encoding="unicode")


def _parsed(path: Path) -> ElementTree.Element:
    robot = parse_xml(path, "URDF", "mend [patient] urdf")
    if robot.tag != "robot":
        raise InputError(f"is not a URDF: its root is <{robot.tag}>, not <robot>", path)
    return robot


def _check_numbers(robot: ElementTree.Element, path: Path) -> None:
    """Raise where a place, an axis or an inertia is not numbers; parsers drop those silently."""
    inertia = [("inertia", key, 1) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")]
    wanted = [("origin", "xyz", 3), ("origin", "rpy", 3), ("axis", "xyz", 3), ("mass", "value", 1)]
    for tag, key, count in [*wanted, *inertia]:
        for element in robot.iter(tag):
            text = element.get(key)
            if text is not None and not _finite(text, count):
                numbers = "a number" if count == 1 else f"{count} numbers"
                raise InputError(f'<{tag} {key}="{text}"> is not {numbers}', path)


def _finite(text: str, count: int) -> bool:
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        return False
    return len(values) == count and bool(np.isfinite(values).all())


def _check_tree(robot: ElementTree.Element, path: Path) -> None:
    """Raise unless the joints make one tree of all the links."""
    links = [str(link.get("name")) for link in robot.findall("link")]
    parents: dict[str, str] = {}
    for joint in robot.findall("joint"):
        ends = (joint.find("parent"), joint.find("child"))
        parent, child = ("" if end is None else end.get("link", "") for end in ends)
        where = f"{path}: joint '{joint.get('name')}'"
        for end in (parent, child):
            if end not in links:
                raise InputError(f"names a link '{end}' that is not there", where, "add it")
        if child in parents:
            raise InputError(f"link '{child}' hangs on a second joint", where, "keep one")
        parents[child] = parent
    if repeated := sorted({name for name in links if links.count(name) > 1}):
        raise InputError(f"has two links '{repeated[0]}'", path, "rename one")
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        found = f"{len(roots)} roots ({', '.join(roots)})" if roots else "a loop and no root"
        raise InputError(f"has {found}", path, "a leg is one tree: docs/patient.md")


def _numbers(element: ElementTree.Element | None, key: str, default: str = "0 0 0") -> Array:
    text = default if element is None else element.get(key, default)
    return np.array([float(part) for part in text.split()])


def _origin(element: ElementTree.Element) -> Array:
    """Return the 4x4 pose of the <origin> of a joint or inertial."""
    origin = element.find("origin")
    rotation = Rotation.from_euler("xyz", _numbers(origin, "rpy")).as_matrix()
    return pose(rotation, _numbers(origin, "xyz"))


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

    Prismatic axes stay: along z the coordinate changes sign instead, at the motion's input.
    """
    for joint in robot.findall("joint"):
        _set_origin(joint, mirrored_pose(_origin(joint)))
        axis = joint.find("axis")
        if axis is not None and joint.get("type") != "prismatic":
            axis.set("xyz", _text(-MIRROR @ _numbers(axis, "xyz")))
    for inertial in robot.iterfind("link/inertial"):
        _set_origin(inertial, mirrored_pose(_origin(inertial)))
        tensor = inertial.find("inertia")
        for key in ("ixz", "iyz"):
            if tensor is not None:
                tensor.set(key, _text(-_numbers(tensor, key, "0")))


def _require_chain(
    robot: ElementTree.Element,
    table: PatientTable,
    wanted: dict[str, tuple[str, tuple[int, int, int]]],
    with_patella: bool,
) -> None:
    links = {link.get("name") for link in robot.findall("link")}
    for name in ("tibia", "femur", "hip") + (("patella",) if with_patella else ()):
        if name not in links:
            raise InputError(f"has no link '{name}'", table.urdf, "add it: docs/patient.md")
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    for name, (kind, axis) in wanted.items():
        joint = joints.get(name)
        if joint is None:
            raise InputError(f"has no joint '{name}'", table.urdf, "add it: docs/patient.md")
        is_kind = joint.get("type") == kind or (kind, joint.get("type")) == (
            "revolute",
            "continuous",
        )
        found = _numbers(joint.find("axis"), "xyz", "1 0 0")
        if not is_kind or not np.allclose(found, axis, atol=1e-9):
            side = "after mirroring " if table.side == "left" else ""
            raise InputError(
                f"joint '{name}' is {joint.get('type')} about {_text(found)}",
                table.urdf,
                f"{side}it must be {kind} about {' '.join(map(str, axis))}",
            )


def _complete_inertias(robot: ElementTree.Element, table: PatientTable, with_patella: bool) -> None:
    links = {link.get("name"): link for link in robot.findall("link")}
    missing = [n for n in ("tibia", "femur") if links[n].find("inertial") is None]
    if missing and table.sex is None:
        raise InputError(
            f"link '{missing[0]}' has no <inertial>",
            table.urdf,
            "add one, or give [patient] sex for the de Leva table",
        )
    for name in missing:
        assert table.sex is not None
        _write_inertia(links[name], _segment(robot, name, table.sex, table))
    if with_patella and links["patella"].find("inertial") is None:
        tensor = PATELLA_MASS * PATELLA_RADIUS_OF_GYRATION**2 * np.eye(3)
        _write_inertia(links["patella"], RigidInertia(PATELLA_MASS, np.zeros(3), tensor))


def _segment(robot: ElementTree.Element, name: str, sex: Sex, table: PatientTable) -> RigidInertia:
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    if name == "femur":
        hip = _fixed_pose(robot, "hip", "femur", table.urdf)[:3, 3]
        return segment_inertia("thigh", sex, table.mass_kg, hip, np.zeros(3))
    ankle = np.zeros(3)
    knee = _origin(joints["knee_ap"])[:3, 3]
    shank = segment_inertia("shank", sex, table.mass_kg, knee, ankle)
    foot = segment_inertia("foot", sex, table.mass_kg, ankle, ankle + np.array([0, -1.0, 0]))
    return combined(shank, foot)


def _fixed_pose(robot: ElementTree.Element, link: str, base: str, path: Path) -> Array:
    """Return the pose of `link` in `base`, which must be joined to it by fixed joints."""
    parents = {joint.find("child").get("link"): joint for joint in robot.findall("joint")}  # type: ignore[union-attr]
    result = np.eye(4)
    while link != base:
        joint = parents.get(link)
        if joint is None or joint.get("type") != "fixed":
            raise InputError(f"link '{link}' is not fixed to '{base}'", path, "use fixed joints")
        result = _origin(joint) @ result
        link = joint.find("parent").get("link")  # type: ignore[union-attr,assignment]
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


def _check_inertia(link: ElementTree.Element, path: Path, needed: bool) -> None:
    """Raise unless the mass is positive and the tensor is that of a real body."""
    inertial = link.find("inertial")
    if inertial is None:
        return
    where = f"{path}: link '{link.get('name')}'"
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or tensor is None:
        raise InputError("has an incomplete <inertial>", where, "give <mass> and <inertia>")
    kilograms = float(_numbers(mass, "value", "nan")[0])
    rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
    matrix = np.array([[_numbers(tensor, key, "0")[0] for key in row] for row in rows])
    if not needed and kilograms == 0 and not matrix.any():
        return
    principal = np.linalg.eigvalsh(matrix) if np.isfinite(matrix).all() else np.full(3, np.nan)
    is_body = principal[0] > 0 and principal[2] <= (principal[0] + principal[1]) * (1 + 1e-9)
    if not (kilograms > 0 and is_body):
        moments = ", ".join(f"{p:.3g}" for p in principal)
        raise InputError(
            f"singular inertia: mass {kilograms:g} kg, principal moments {moments} kg·m²",
            where,
            "a body needs mass > 0 and moments > 0, none larger than the sum of the others",
        )
