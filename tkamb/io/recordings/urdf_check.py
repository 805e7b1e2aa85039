"""Checks of a patient's URDF: numbers, one tree, the exact knee chain, physical inertias.

Parsers of URDF silently ignore unknown attributes and fill in missing ones: a misspelt one becomes
zero, and a joint without limits gets another type. These checks raise errors instead.
"""

import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path
from typing import Literal

import numpy as np

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import KNEE_JOINT_NAMES, PATELLA_JOINT_NAMES, Array

Axis = tuple[int, int, int]

KNEE_JOINTS: dict[str, tuple[str, Axis]] = dict(
    zip(
        KNEE_JOINT_NAMES,
        (
            ("prismatic", (1, 0, 0)),
            ("prismatic", (0, 1, 0)),
            ("prismatic", (0, 0, 1)),
            ("revolute", (0, -1, 0)),
            ("revolute", (-1, 0, 0)),
            ("revolute", (0, 0, 1)),
        ),
        strict=True,
    )
)
"""Type and axis of the joints of a right knee, from tibia to femur. The axes of axial rotation and
adduction of a left knee are (0 1 0) and (1 0 0)."""

PATELLA_JOINTS: dict[str, tuple[str, Axis]] = dict(
    zip(
        PATELLA_JOINT_NAMES,
        (("prismatic", (1, 0, 0)), ("prismatic", (0, 1, 0)), ("revolute", (0, 0, 1))),
        strict=True,
    )
)

CHAINS = (("tibia", KNEE_JOINTS, "femur"), ("femur", PATELLA_JOINTS, "patella"))
"""First link, joints and last link of each chain."""

_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_ATTRIBUTES = {
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "mass": {"value": 1},
    "inertia": dict.fromkeys(_INERTIA, 1),
    "limit": dict.fromkeys(("lower", "upper", "effort", "velocity"), 1),
}
"""Element -> attribute -> number of values."""
_CHILDREN = {
    "joint": {"parent", "child", "origin", "axis", "limit", "calibration", "dynamics"}
    | {"safety_controller", "mimic"},
    "link": {"inertial", "visual", "collision"},
    "inertial": {"origin", "mass", "inertia"},
}
_MANY = {"visual", "collision"}
_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_ANKLE_JOINT = "ankle"
_AXIS_ROUNDING = 1e-6
"""1: largest difference of a unit axis from its nominal axis, which replaces it, that counts as
rounding to six digits.
"""


# rad: a larger angle is assumed to be in degrees. Angles in a URDF are below one
# turn.
MAX_ANGLE = 8.0 * np.pi


def check_elements(robot: ElementTree.Element, path: Path) -> None:
    """Raise an InputError if an element is unknown, doubled or has invalid attributes."""
    for parent in (*robot.iter("joint"), *robot.iter("link"), *robot.iter("inertial")):
        where = f"{path}: {parent.tag} '{parent.get('name', '')}'"
        counts = Counter(child.tag for child in parent if isinstance(child.tag, str))
        for tag, count in counts.items():
            if tag not in _CHILDREN[parent.tag]:
                hint = names_near(tag, sorted(_CHILDREN[parent.tag]))
                raise InputError(f"unknown element <{tag}>", where, hint)
            if count > 1 and tag not in _MANY:
                raise InputError(f"has {count} elements <{tag}>", where, "keep one")
        for child in parent:
            if child.tag in _ATTRIBUTES:
                _check_attributes(child, where)
    for joint in robot.findall("joint"):
        if joint.get("type") not in _TYPES:
            where, kind = f"{path}: joint '{joint.get('name', '')}'", joint.get("type")
            raise InputError(f"unknown type '{kind}'", where, names_near(str(kind), _TYPES))
    names = Counter(str(joint.get("name")) for joint in robot.findall("joint"))
    if twice := [name for name, count in names.items() if count > 1]:
        raise InputError(f"has two joints '{twice[0]}'", path, "rename one")


_FARTHEST = 10.0
"""m: largest coordinate on a link, several times the height of a person."""
_HEAVIEST = 1000.0
"""kg and kg·m²: largest mass and inertia, far above those of a segment of a person."""


def _check_attributes(element: ElementTree.Element, where: str) -> None:
    attributes = _ATTRIBUTES[element.tag]
    for key, text in element.attrib.items():
        if key not in attributes:
            raise InputError(
                f"unknown attribute {key} of <{element.tag}>", where, names_near(key, attributes)
            )
        if not _finite(text, attributes[key]):
            numbers = "a number" if attributes[key] == 1 else f"{attributes[key]} numbers"
            raise InputError(f'<{element.tag} {key}="{text}"> is not {numbers}', where)
        is_position = element.tag == "origin" and key == "xyz"
        if is_position and np.abs(numbers_of(element, key)).max() > _FARTHEST:
            hint = "give xyz in metres, not in millimetres"
            raise InputError(f'<origin xyz="{text}"> is beyond {_FARTHEST:g} m', where, hint)
        if key in ("value", *_INERTIA) and abs(float(text)) > _HEAVIEST:
            hint = f"give at most {_HEAVIEST:g} (kg, kg·m²)"
            raise InputError(f'<{element.tag} {key}="{text}"> is too large for a body', where, hint)
        if key == "rpy" and np.abs(numbers_of(element, key)).max() > MAX_ANGLE:
            hint = "give rpy in radians, not in degrees"
            raise InputError(f'<origin rpy="{text}"> is a rotation by several turns', where, hint)


def _finite(text: str, count: int) -> bool:
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        return False
    return len(values) == count and bool(np.isfinite(values).all())


def numbers_of(element: ElementTree.Element | None, key: str, default: str = "0 0 0") -> Array:
    """Return the numbers of an attribute; those of `default` if it is missing."""
    text = default if element is None else element.get(key, default)
    return np.array([float(part) for part in text.split()])


def check_links(robot: ElementTree.Element, path: Path, with_patella: bool) -> None:
    """Raise an InputError if a required link is missing."""
    links = [str(link.get("name")) for link in robot.findall("link")]
    for name in ("tibia", "femur", "hip") + (("patella",) if with_patella else ()):
        if name not in links:
            raise InputError(
                f"has no link '{name}'", path, f"add it, or rename one: {names_near(name, links)}"
            )


def check_tree(robot: ElementTree.Element, path: Path) -> None:
    """Raise an InputError unless the joints connect all links to one tree."""
    links = [str(link.get("name")) for link in robot.findall("link")]
    parents: dict[str, str] = {}
    for joint in robot.findall("joint"):
        parent, child = ends_of(joint)
        where = f"{path}: joint '{joint.get('name')}'"
        for end in (parent, child):
            if end not in links:
                hint = f"add it, or {names_near(end, links)}"
                raise InputError(f"names a link '{end}' that does not exist", where, hint)
        if child in parents:
            raise InputError(f"link '{child}' is the child of a second joint", where, "keep one")
        parents[child] = parent
    if repeated := sorted({name for name in links if links.count(name) > 1}):
        raise InputError(f"has two links '{repeated[0]}'", path, "rename one")
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        result = f"{len(roots)} roots ({', '.join(roots)})" if roots else "a loop and no root"
        raise InputError(
            f"has {result}",
            path,
            "connect all links by joints to one tree with one root, without a loop",
        )
    for name in links:
        ancestor, steps = name, 0
        while ancestor in parents and steps <= len(links):
            ancestor, steps = parents[ancestor], steps + 1
        if ancestor != roots[0]:
            raise InputError(
                f"link '{name}' is part of a loop", path, "connect the links to one tree"
            )


def ends_of(joint: ElementTree.Element) -> tuple[str, str]:
    """Return the names of a joint's parent and child."""
    parent, child = joint.find("parent"), joint.find("child")
    return (
        "" if parent is None else parent.get("link", ""),
        "" if child is None else child.get("link", ""),
    )


def check_chain(
    robot: ElementTree.Element, path: Path, side: Literal["right", "left"], with_patella: bool
) -> None:
    """Raise an InputError unless the joints are exactly those of docs/patient.md.

    The six knee joints and the three joints of the patella must have the right type, axis, limits,
    order and origin (the identity inside a chain). Links between them must have no mass. Except the
    ankle, no other joint may move.

    Args:
        robot: tree of a right leg, or of a mirrored left leg.
        with_patella: whether the patella is required; if not, it is checked if present.
    """
    joints = {str(joint.get("name")): joint for joint in robot.findall("joint")}
    for start, chain_joints, end in CHAINS:
        if end == "patella" and not with_patella and not set(chain_joints) & set(joints):
            continue
        for name in chain_joints:
            if name not in joints:
                hint = f"add it, or rename one: {names_near(name, joints)}"
                raise InputError(f"has no joint '{name}'", path, hint)
        _check_axes(joints, chain_joints, path, side)
        _check_order(robot, joints, list(chain_joints), (start, end), path)
    names = [_ANKLE_JOINT, *KNEE_JOINTS, *PATELLA_JOINTS]
    for name, joint in joints.items():
        if joint.get("type") in ("revolute", "prismatic"):
            _check_limit(joint, path)
        if name not in names and joint.get("type") != "fixed":
            raise InputError(
                f"joint '{name}' is {joint.get('type')}",
                path,
                f"only ankle and knee move: make it fixed, or {names_near(name, names)}",
            )


def _check_axes(
    joints: dict[str, ElementTree.Element],
    expected: dict[str, tuple[str, Axis]],
    path: Path,
    side: str,
) -> None:
    """Raise an InputError for another type or axis, or a joint that mimics another."""
    axes = {name: numbers_of(joints[name].find("axis"), "xyz", "1 0 0") for name in expected}
    for name, (_, axis) in expected.items():
        length = float(np.linalg.norm(axes[name]))
        for nominal in (np.array(axis, float), -np.array(axis, float)):
            if length > 0 and np.abs(axes[name] / length - nominal).max() <= _AXIS_ROUNDING:
                axes[name] = nominal
                if (element := joints[name].find("axis")) is not None:
                    element.set("xyz", " ".join(f"{value:g}" for value in nominal))
    flipped = [
        name
        for name, (kind, axis) in expected.items()
        if kind == "revolute" and np.array_equal(axes[name], -np.array(axis))
    ]
    if {"knee_axial_rotation", "knee_adduction"} <= set(flipped) and len(flipped) == 2:
        other = "left" if side == "right" else "right"
        raise InputError(
            f"its axes of knee_axial_rotation and knee_adduction are those of a {other} knee",
            path,
            f"correct [patient] side, which is '{side}', or the axes",
        )
    for name, (kind, axis) in expected.items():
        joint = joints[name]
        if joint.get("type") != kind or not np.array_equal(axes[name], axis):
            about = " ".join(f"{value:g}" for value in axes[name])
            mirrored = "after mirroring " if side == "left" else ""
            raise InputError(
                f"joint '{name}' is {joint.get('type')} about {about}",
                path,
                f"{mirrored}it must be {kind} about {' '.join(map(str, axis))}",
            )
        if joint.find("mimic") is not None:
            raise InputError(f"joint '{name}' mimics another", path, "remove <mimic>")


def _check_limit(joint: ElementTree.Element, path: Path) -> None:
    limit, name = joint.find("limit"), joint.get("name")
    if limit is None or not {"lower", "upper", "effort", "velocity"} <= set(limit.keys()):
        hint = "give lower, upper, effort and velocity"
        raise InputError(f"joint '{name}' has no complete <limit>", path, hint)
    low, high = (float(numbers_of(limit, key)[0]) for key in ("lower", "upper"))
    if low > high:
        raise InputError(f"joint '{name}' has limits {low:g} to {high:g}", path, "exchange them")


def _check_order(
    robot: ElementTree.Element,
    joints: dict[str, ElementTree.Element],
    names: list[str],
    between: tuple[str, str],
    path: Path,
) -> None:
    """Raise an InputError unless joints form a chain at one point, without mass."""
    masses = {str(link.get("name")): link.find("inertial/mass") for link in robot.findall("link")}
    order = f"the order is {between[0]}, {', '.join(names)}, {between[1]}"
    link = between[0]
    for name in names:
        parent, child = ends_of(joints[name])
        if parent != link:
            raise InputError(f"joint '{name}' has parent '{parent}', not '{link}'", path, order)
        link = child
        origin = joints[name].find("origin")
        numbers = np.concatenate([numbers_of(origin, "xyz"), numbers_of(origin, "rpy")])
        if name != names[0] and numbers.any():
            words = " ".join(f"{value:g}" for value in numbers)
            hint = f"give it the identity; only '{names[0]}' has another origin"
            raise InputError(f"joint '{name}' has an origin {words} in the chain", path, hint)
        mass = masses.get(child)
        if name != names[-1] and mass is not None and numbers_of(mass, "value", "0").any():
            hint = "move the mass to tibia or femur; links inside the chain have none"
            raise InputError(f"link '{child}' has a mass", path, hint)
    if link != between[1]:
        raise InputError(f"joint '{names[-1]}' leads to '{link}'", path, order)


def check_inertia(link: ElementTree.Element, path: Path, needed: bool) -> None:
    """Raise an InputError unless mass and inertia are possible for a body.

    Args:
        needed: whether the link must have a mass; otherwise zero is accepted.
    """
    inertial = link.find("inertial")
    if inertial is None:
        return
    where = f"{path}: link '{link.get('name')}'"
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or tensor is None or mass.get("value") is None:
        raise InputError("has an incomplete <inertial>", where, "give <mass> and <inertia>")
    if missing := [key for key in _INERTIA if tensor.get(key) is None]:
        raise InputError(f"has no {', '.join(missing)}", where, "give all six terms of <inertia>")
    kilograms = float(numbers_of(mass, "value")[0])
    rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
    matrix = np.array([[numbers_of(tensor, key)[0] for key in row] for row in rows])
    if not needed and kilograms == 0 and not matrix.any():
        return
    principal = np.linalg.eigvalsh(matrix)
    is_body = principal[0] > 0 and principal[2] <= (principal[0] + principal[1]) * (1 + 1e-9)
    if not (kilograms > 0 and is_body):
        moments = ", ".join(f"{p:.3g}" for p in principal)
        raise InputError(
            f"impossible inertia: mass {kilograms:g} kg, principal moments {moments} kg·m²",
            where,
            "a body needs mass > 0 and moments > 0, none larger than the sum of the others",
        )
