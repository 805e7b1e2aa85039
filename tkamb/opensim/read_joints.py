"""Frames and joints of an OpenSim document, and the order in which joints lead out from ground."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, pose, transform
from tkamb.opensim.elements import Document, Element
from tkamb.opensim.functions import Linear
from tkamb.opensim.model import GROUND, Coordinate, Joint, JointAxis

X, Y, Z = np.eye(3)

STANDARD_JOINTS: dict[str, tuple[tuple[Array, ...], tuple[Array, ...]]] = {
    "WeldJoint": ((), ()),
    "PinJoint": ((Z,), ()),
    "SliderJoint": ((), (X,)),
    "UniversalJoint": ((X, Y), ()),
    "PlanarJoint": ((Z,), (X, Y)),
    "BallJoint": ((X, Y, Z), ()),
    "GimbalJoint": ((X, Y, Z), ()),
    "FreeJoint": ((X, Y, Z), (X, Y, Z)),
}
"""Rotation and translation axes, one coordinate each, in this order."""


def offset_pose(rotation_xyz: Array, translation: Array) -> Array:
    """Return the pose (4, 4) with body-fixed x, y, z rotations (rad) and a translation (m)."""
    return pose(Rotation.from_euler("XYZ", rotation_xyz).as_matrix(), translation)


@dataclass(frozen=True, eq=False)
class Frames:
    """Bodies and the offset frames that hang on them.

    A frame's name is only unique within its owner: the same name may stand in several joints
    with different values. Frames are therefore kept by owner and name.

    Args:
        document: for messages.
        bodies: names of the bodies, ground among them.
        offsets: (owner, frame) -> the frame's own parent and pose in it.
    """

    document: Document
    bodies: frozenset[str]
    offsets: Mapping[tuple[str, str], tuple[str, Array]]

    @classmethod
    def of(cls, document: Document, model: Element, bodies: Iterable[str]) -> "Frames":
        """Return the frames of a model."""
        offsets: dict[tuple[str, str], tuple[str, Array]] = {}
        for owner, element in _offset_frames(model, ""):
            rotation = document.numbers(element, "orientation", count=3, default="0 0 0")
            translation = document.numbers(element, "translation", count=3, default="0 0 0")
            parent = document.text(element, "socket_parent")
            offsets[owner, document.name(element)] = (parent, offset_pose(rotation, translation))
        return cls(document, frozenset(bodies), offsets)

    def resolve(self, user: Element, socket: str, owner: str = "") -> tuple[str, Array]:
        """Return the body a socket leads to, and the pose (4, 4) of its frame in that body.

        Args:
            user: whose socket it is, for messages.
            socket: "/bodyset/tibia", "tibia", "tibia_offset", "/jointset/knee/tibia_offset" …
            owner: joint whose own frames go first.

        Raises:
            InputError: no such frame.
        """
        steps = [step for step in socket.split("/") if step not in ("", ".", "..")]
        in_body = np.eye(4)
        for _ in range(len(self.offsets) + 1):
            name = steps[-1] if steps else owner  # ".." is who holds the frame
            above = steps[-2] if len(steps) > 1 else owner
            key = (above, name) if (above, name) in self.offsets else ("", name)
            if key not in self.offsets:
                if name in self.bodies:
                    return name, in_body
                break
            parent, pose_in_parent = self.offsets[key]
            in_body = pose_in_parent @ in_body
            steps = [step for step in parent.split("/") if step not in ("", ".", "..")]
            owner = key[0]
        raise InputError(f"names a frame '{socket}' that is not there", self.document.where(user))

    def point(self, user: Element, socket: str, location: Array) -> tuple[str, Array]:
        """Return the body a socket leads to, and a point (3,) of the socket's frame in it."""
        body, in_body = self.resolve(user, socket)
        return body, transform(in_body, location)


def _offset_frames(element: Element, owner: str) -> Iterator[tuple[str, Element]]:
    """Yield every offset frame with the body, joint or frame that holds it."""
    for child in element:
        if child.tag == "PhysicalOffsetFrame":
            yield owner, child
        held = child.tag in ("Body", "PhysicalOffsetFrame") or child.tag.endswith("Joint")
        yield from _offset_frames(child, child.get("name", "") if held else owner)


def read_joints(
    document: Document, model: Element, frames: Frames
) -> tuple[list[Joint], dict[str, Coordinate]]:
    """Return the joints and coordinates in the file's order.

    Raises:
        InputError: a joint that is not read or does not make sense.
    """
    joints: list[Joint] = []
    coordinates: dict[str, Coordinate] = {}
    for element, child in _joint_elements(document, model):
        parent_frame, child_frame = _joint_frames(document, element, frames, child)
        entries = [*document.objects(element, "CoordinateSet"), *element.findall("coordinates/*")]
        names = [document.name(entry) for entry in entries]
        if element.tag == "CustomJoint":
            rotations, translations = _custom_axes(document, element, names)
        else:
            rotations, translations = _standard_axes(document, element, names)
        for entry in entries:
            coordinate = _coordinate(document, entry, document.name(element), rotations)
            if coordinate.name in coordinates:
                raise InputError("is there twice", document.where(entry), "rename one")
            coordinates[coordinate.name] = coordinate
        (parent, in_parent), (body, in_child) = parent_frame, child_frame
        name = document.name(element)
        joints.append(
            Joint(name, element.tag, parent, body, in_parent, in_child, rotations, translations)
        )
    return joints, coordinates


def _joint_elements(document: Document, model: Element) -> Iterator[tuple[Element, str | None]]:
    """Yield each joint; in the old layout with the body that it stands in, its child."""
    for element in document.objects(model, "JointSet"):
        yield element, None
    for body in document.objects(model, "BodySet"):
        for element in (*body.findall("Joint/*"), *body.findall("joint/*")):
            yield element, document.name(body)


def _joint_frames(
    document: Document, element: Element, frames: Frames, child: str | None
) -> tuple[tuple[str, Array], tuple[str, Array]]:
    """Return (body, pose of the joint's frame in it) for parent and child."""
    if child is None:
        name = document.name(element)
        sockets = (document.text(element, f"socket_{end}_frame") for end in ("parent", "child"))
        parent_frame, child_frame = (frames.resolve(element, s, name) for s in sockets)
        return parent_frame, child_frame
    if document.flag(element, "reverse", False):
        raise InputError("has <reverse>, which is not read", document.where(element))
    values = [
        document.numbers(element, tag, count=3, default="0 0 0")
        for tag in ("orientation_in_parent", "location_in_parent", "orientation", "location")
    ]
    parent, _ = frames.resolve(element, document.text(element, "parent_body"))
    return (parent, offset_pose(*values[:2])), (child, offset_pose(*values[2:]))


def _standard_axes(
    document: Document, element: Element, names: list[str]
) -> tuple[tuple[JointAxis, ...], tuple[JointAxis, ...]]:
    axes = STANDARD_JOINTS.get(element.tag)
    if axes is None:
        raise InputError(
            "is a joint that is not read",
            document.where(element),
            f"CustomJoint, {', '.join(STANDARD_JOINTS)} are",
        )
    rotations, translations = axes
    if len(names) != len(rotations) + len(translations):
        wanted = len(rotations) + len(translations)
        raise InputError(f"has {len(names)} coordinates, not {wanted}", document.where(element))
    made = [
        JointAxis(axis, name, Linear(1.0, 0.0))
        for axis, name in zip((*rotations, *translations), names, strict=True)
    ]
    return tuple(made[: len(rotations)]), tuple(made[len(rotations) :])


def _custom_axes(
    document: Document, element: Element, names: list[str]
) -> tuple[tuple[JointAxis, ...], tuple[JointAxis, ...]]:
    """Return the axes of a <SpatialTransform>, those that never move anything left out."""
    kinds: dict[str, list[JointAxis]] = {"rotation": [], "translation": []}
    transform_element = document.find(element, "SpatialTransform")
    if transform_element is None:
        raise InputError("has no <SpatialTransform>", document.where(element))
    used: set[str] = set()
    for k, entry in enumerate(transform_element.findall("TransformAxis")):
        axis = _axis(document, element, entry, names)
        if k >= 6:
            raise InputError("has more than six axes", document.where(element))
        used |= {axis.coordinate} if axis.coordinate else set()
        at_rest = axis.coordinate is None and axis.function(np.zeros(1))[0] == 0.0
        if not at_rest:
            kinds["rotation" if k < 3 else "translation"].append(axis)
    if idle := [name for name in names if name not in used]:
        raise InputError(f"coordinate '{idle[0]}' moves no axis", document.where(element))
    return tuple(kinds["rotation"]), tuple(kinds["translation"])


def _axis(document: Document, joint: Element, entry: Element, names: list[str]) -> JointAxis:
    where = f"{document.where(joint)}: {entry.get('name', 'axis')}"
    used = document.text(entry, "coordinates", "coordinate", default=" ").split()
    direction = document.numbers(entry, "axis", count=3)
    length = float(np.linalg.norm(direction))
    function = document.held_function(entry, "function")
    if length == 0.0:
        raise InputError("has an axis of no length", where)
    if len(used) > 1 or any(name not in names for name in used):
        raise InputError(f"'{' '.join(used)}' is not one of the joint's coordinates", where)
    if function is None:
        function = Linear(1.0 if used else 0.0, 0.0)
    return JointAxis(direction / length, used[0] if used else None, function)


def _coordinate(
    document: Document, entry: Element, joint: str, rotations: tuple[JointAxis, ...]
) -> Coordinate:
    low, high = document.numbers(entry, "range", count=2, default="-10 10")
    return Coordinate(
        name=document.name(entry),
        joint=joint,
        rotational=any(_is_angle_of(axis, entry.get("name", "")) for axis in rotations),
        default=document.number(entry, "default_value", default=0.0),
        range=(float(low), float(high)),
        clamped=document.flag(entry, "clamped", False),
        locked=document.flag(entry, "locked", False),
    )


def _is_angle_of(axis: JointAxis, coordinate: str) -> bool:
    """Say whether a coordinate is a rotation's own angle; one that only drives it is not."""
    function = axis.function
    straight = isinstance(function, Linear) and abs(function.gradient) == 1.0
    return axis.coordinate == coordinate and straight


def outwards(path: Path, joints: list[Joint], bodies: Iterable[str]) -> tuple[Joint, ...]:
    """Return the joints in an order that leads out from ground, each the way it is passed.

    Raises:
        InputError: a loop, or a body that no chain of joints joins to ground.
    """
    reached, waiting, ordered = {GROUND}, list(joints), []
    while waiting:
        for joint in waiting:
            forwards, backwards = joint.parent in reached, joint.child in reached
            if forwards and backwards:
                raise InputError(f"joint '{joint.name}' closes a loop, which is not read", path)
            if forwards or backwards:
                ordered.append(replace(joint, backwards=backwards))
                reached |= {joint.parent, joint.child}
                waiting.remove(joint)
                break
        else:
            raise InputError(f"joint '{waiting[0].name}' is not joined to ground", path)
    for body in bodies:
        if body not in reached:
            raise InputError(f"body '{body}' has no joint", path, "add one")
    return tuple(ordered)
