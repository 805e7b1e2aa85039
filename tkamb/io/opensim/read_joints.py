"""Reading of frames and joints from an OpenSim document, and ordering of the joints."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, pose, transform
from tkamb.io.opensim.document import Document, Element
from tkamb.io.opensim.model import GROUND, Coordinate, Joint, JointAxis, Linear

X, Y, Z = np.eye(3)

FRAMES = ("PhysicalOffsetFrame", "StationDefinedFrame")
"""Classes of frames that are fixed to a body or to another frame."""

AXES = (*(f"rotation{k}" for k in (1, 2, 3)), *(f"translation{k}" for k in (1, 2, 3)))
"""Names of the axes of a CustomJoint, in the order in which they act."""

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
"""Class of a joint -> its rotation and translation axes, with one coordinate each."""


def offset_pose(rotation_xyz: Array, translation: Array) -> Array:
    """Return the pose (4, 4) with intrinsic x, y, z rotations, rad, and a translation, m."""
    return pose(Rotation.from_euler("XYZ", rotation_xyz).as_matrix(), translation)


@dataclass(frozen=True, eq=False)
class Frames:
    """Bodies and the offset frames that are fixed to them.

    They are stored by owner and name, because several joints may have frames of one name.

    Args:
        offsets: (owner, frame) -> the frame's parent, and the frame's pose (4, 4) in the parent.
        unread: frame -> reason for which it could not be read.
        upright: pose (4, 4) of the file's ground in a ground whose y points up.
    """

    document: Document
    bodies: frozenset[str]
    offsets: Mapping[tuple[str, str], tuple[str, Array]]
    unread: Mapping[str, str]
    upright: Array

    @classmethod
    def of(
        cls, document: Document, model: Element, bodies: Iterable[str], upright: Array
    ) -> "Frames":
        """Return the frames of a model. `upright` turns the file's ground, (3, 3)."""
        offsets: dict[tuple[str, str], tuple[str, Array]] = {}
        stations = _stations(document, model)
        unread: dict[str, str] = {}
        for owner, element in _held_frames(model, ""):
            with document.reading(element):
                name = document.name(element)
                if element.tag == "StationDefinedFrame":
                    offsets[owner, name] = _station_defined(document, element, owner, stations)
                    continue
                rotation = document.numbers(element, "orientation", count=3, default="0 0 0")
                translation = document.numbers(element, "translation", count=3, default="0 0 0")
                parent = document.socket(element, "parent")
                offsets[owner, name] = (parent, offset_pose(rotation, translation))
                continue
            unread[element.get("name", "")] = document.unread[-1][1]
        return cls(document, frozenset(bodies), offsets, unread, pose(upright, np.zeros(3)))

    def resolve(self, user: Element, socket: str, owner: str = "") -> tuple[str, Array]:
        """Return the body of a socket's frame, and the pose (4, 4) of the frame in the body.

        The pose in ground is that in the ground whose y points up.

        Args:
            socket: path or name of a frame, such as "/bodyset/tibia", "tibia", "tibia_offset" or
                "/jointset/knee/tibia_offset".
            owner: joint with the frames that are searched first.
        """
        steps = [step for step in socket.split("/") if step not in ("", ".", "..")]
        in_body = np.eye(4)
        for _ in range(len(self.offsets) + 1):
            name = steps[-1] if steps else owner  # ".." is the owner of the frame
            owner_name = steps[-2] if len(steps) > 1 else owner
            key = (owner_name, name) if (owner_name, name) in self.offsets else ("", name)
            if key not in self.offsets:
                if name in self.bodies:
                    return name, self.upright @ in_body if name == GROUND else in_body
                if name in self.unread:
                    raise InputError(self.unread[name])
                break
            parent, pose_in_parent = self.offsets[key]
            in_body = pose_in_parent @ in_body
            steps = [step for step in parent.split("/") if step not in ("", ".", "..")]
            owner = key[0]
        raise InputError(f"names a frame '{socket}' that does not exist", self.document.where(user))

    def point(self, user: Element, socket: str, location: Array) -> tuple[str, Array]:
        """Return body and point (3,), m, of a point of a socket's frame."""
        body, in_body = self.resolve(user, socket)
        return body, transform(in_body, location)


def _held_frames(element: Element, owner: str) -> Iterator[tuple[str, Element]]:
    for child in element:
        if child.tag in FRAMES:
            yield owner, child
        is_body = child.tag in ("Body", "Ground", *FRAMES) or child.tag.endswith("Joint")
        yield from _held_frames(child, child.get("name", "") if is_body else owner)


def _stations(document: Document, model: Element) -> dict[str, list[Element]]:
    result: dict[str, list[Element]] = {}
    for element in model.iter():
        if element.tag in ("Station", "Marker"):
            result.setdefault(element.get("name", ""), []).append(element)
    return result


def _station_defined(
    document: Document, element: Element, owner: str, stations: Mapping[str, list[Element]]
) -> tuple[str, Array]:
    """Return the parent of a frame that four stations define, and the pose (4, 4) in the parent.

    Three stations are the points a, b, c; the fourth is the origin. The frame's axis `ab_axis` is
    along b - a, and its axis `ab_x_ac_axis` is along (b - a) × (c - a). The third axis completes a
    right-handed frame (OpenSim's StationDefinedFrame, https://opensim-org.github.io).
    """
    where, points, parents = document.where(element), [], set()
    for name in ("point_a", "point_b", "point_c", "origin_point"):
        socket = document.socket(element, name)
        candidates = stations.get(socket.rstrip("/").split("/")[-1], [])
        matches = [s for s in candidates if s in element.iter()] or candidates
        if len(matches) != 1:
            what = f"names a station '{socket}', of which there are {len(matches)}"
            raise InputError(what, where)
        points.append(document.numbers(matches[0], "location", count=3))
        parents.add(document.socket(matches[0], "parent_frame", "body", default=".."))
    if len(parents) != 1:
        raise InputError("has stations in different frames, which is not read", where)
    a, b, c, origin = points
    normal = np.cross(b - a, c - a)
    if np.linalg.norm(normal) < 1e-12:
        raise InputError("has its stations on one line", where)
    basis = np.zeros((3, 3))
    named = []
    for tag, default, vector in (("ab_axis", "+x", b - a), ("ab_x_ac_axis", "+y", normal)):
        text = document.text(element, tag, default=default).lower()
        if text.lstrip("+-") not in ("x", "y", "z"):
            raise InputError(f"<{tag}>{text}</{tag}> is no axis", where)
        axis, sign = "xyz".index(text[-1]), -1.0 if text[0] == "-" else 1.0
        basis[:, axis] = sign * vector / np.linalg.norm(vector)
        named.append(axis)
    if named[0] == named[1]:
        raise InputError("gives both axes the same direction", where)
    third = 3 - sum(named)
    basis[:, third] = np.cross(basis[:, (third + 1) % 3], basis[:, (third + 2) % 3])
    parent = parents.pop()
    return owner if parent.strip("/") == ".." else parent, pose(basis, origin)


def read_joints(
    document: Document, model: Element, frames: Frames
) -> tuple[list[Joint], dict[str, Coordinate]]:
    """Return the joints and coordinates in the file's order."""
    joints: list[Joint] = []
    coordinates: dict[str, Coordinate] = {}
    for element, child in _joint_elements(document, model):
        with document.reading(element):
            joint, joint_coordinates = _joint(document, element, frames, child)
            if duplicates := [name for name in joint_coordinates if name in coordinates]:
                where = f"{document.where(element)}: Coordinate '{duplicates[0]}'"
                raise InputError("is defined twice", where, "rename one")
            joints.append(joint)
            coordinates |= joint_coordinates
    return joints, coordinates


def _joint(
    document: Document, element: Element, frames: Frames, child: str | None
) -> tuple[Joint, dict[str, Coordinate]]:
    """A partial reading welds a joint of unreadable motion."""
    (parent, in_parent), (body, in_child) = _joint_frames(document, element, frames, child)
    entries = [*document.objects(element, "CoordinateSet"), *element.findall("coordinates/*")]
    names = [document.name(entry) for entry in entries]
    axes: tuple[tuple[JointAxis, ...], tuple[JointAxis, ...]] = ((), ())
    read_before = len(document.unread)
    with document.reading(element):
        custom = element.tag == "CustomJoint"
        axes = (_custom_axes if custom else _standard_axes)(document, element, names)
    unread = "; ".join(reason for _, reason in document.unread[read_before:])
    name = document.name(element)
    moving = {axis.coordinate for kind in axes for axis in kind}
    coordinates = {}
    for entry in entries:
        coordinate = _coordinate(document, entry, name, axes[0])
        if coordinate.name in coordinates:
            raise InputError("is defined twice", document.where(entry), "rename one")
        # A coordinate without an axis moves no body. It is treated as locked.
        is_idle = coordinate.name not in moving
        coordinates[coordinate.name] = replace(coordinate, locked=True) if is_idle else coordinate
    joint = Joint(name, element.tag, parent, body, in_parent, in_child, *axes, unread=unread)
    return joint, coordinates


def _joint_elements(document: Document, model: Element) -> Iterator[tuple[Element, str | None]]:
    for element in document.objects(model, "JointSet"):
        yield element, None
    for body in document.objects(model, "BodySet"):
        for element in (*body.findall("Joint/*"), *body.findall("joint/*")):
            yield element, document.name(body)


def _joint_frames(
    document: Document, element: Element, frames: Frames, child: str | None
) -> tuple[tuple[str, Array], tuple[str, Array]]:
    """Return, for parent and child, the body and the pose (4, 4) of the joint's frame in it."""
    if child is None:
        name = document.name(element)
        sockets = (document.socket(element, f"{end}_frame") for end in ("parent", "child"))
        parent_frame, child_frame = (frames.resolve(element, s, name) for s in sockets)
        return parent_frame, child_frame
    if document.flag(element, "reverse", False):
        raise InputError("has <reverse>, which is not read", document.where(element))
    values = [
        document.numbers(element, tag, count=3, default="0 0 0")
        for tag in ("orientation_in_parent", "location_in_parent", "orientation", "location")
    ]
    parent, base = frames.resolve(element, document.socket(element, "parent_body", "parent_body"))
    return (parent, base @ offset_pose(*values[:2])), (child, offset_pose(*values[2:]))


def _standard_axes(
    document: Document, element: Element, names: list[str]
) -> tuple[tuple[JointAxis, ...], tuple[JointAxis, ...]]:
    axes = STANDARD_JOINTS.get(element.tag)
    if axes is None:
        raise InputError(
            "is a joint that is not read",
            document.where(element),
            f"tkamb reads CustomJoint, {', '.join(STANDARD_JOINTS)}",
        )
    rotations, translations = axes
    if len(names) != len(rotations) + len(translations):
        count = len(rotations) + len(translations)
        raise InputError(f"has {len(names)} coordinates, not {count}", document.where(element))
    functions = [
        JointAxis(axis, name, Linear(1.0, 0.0))
        for axis, name in zip((*rotations, *translations), names, strict=True)
    ]
    return tuple(functions[: len(rotations)]), tuple(functions[len(rotations) :])


def _custom_axes(
    document: Document, element: Element, names: list[str]
) -> tuple[tuple[JointAxis, ...], tuple[JointAxis, ...]]:
    kinds: dict[str, list[JointAxis]] = {"rotation": [], "translation": []}
    transform_element = document.find(element, "SpatialTransform")
    if transform_element is None:
        raise InputError("has no <SpatialTransform>", document.where(element))
    for name, entry in _named_axes(document, element, transform_element):
        axis = _axis(document, element, entry, names)
        no_effect = axis.coordinate is None and axis.function(np.zeros(1))[0] == 0.0
        if not no_effect:
            kinds[name[:-1]].append(axis)
    return tuple(kinds["rotation"]), tuple(kinds["translation"])


def _named_axes(
    document: Document, joint: Element, spatial_transform: Element
) -> list[tuple[str, Element]]:
    """Return a joint's axes in the order in which they act.

    As in OpenSim, an axis' name decides its place, not its position in the file. Axes without any
    are in the order of `AXES`.
    """
    entries: dict[str, Element] = {}
    found: list[tuple[str, Element]] = []
    for child in spatial_transform:
        inner = child if child.tag == "TransformAxis" else child.find("TransformAxis")
        if inner is not None:
            name = child.get("name", "") if inner is child else child.tag
            found.append((name.strip(), inner))
    if len(found) > len(AXES):
        raise InputError("has more than six axes", document.where(joint))
    if not any(name for name, _ in found):
        return [(name, entry) for name, (_, entry) in zip(AXES, found, strict=False)]
    for name, entry in found:
        if name not in AXES or name in entries:
            what = "two axes" if name in entries else "an axis"
            hint = f"name each axis once: {', '.join(AXES)}"
            raise InputError(f"has {what} '{name}'", document.where(joint), hint)
        entries[name] = entry
    return [(name, entries[name]) for name in AXES if name in entries]


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
    """Return whether an angle equals a coordinate, apart from sign and offset."""
    function = axis.function
    straight = isinstance(function, Linear) and abs(function.gradient) == 1.0
    return axis.coordinate == coordinate and straight


def outwards(document: Document, joints: list[Joint], bodies: Iterable[str]) -> tuple[Joint, ...]:
    """Return the joints in order from ground outwards, with `backwards` set.

    A partial reading leaves out a joint that closes a loop. It welds a body that no chain of joints
    connects with ground to ground, and marks the weld as unread.
    """
    path = document.path
    reached, waiting, ordered = {GROUND}, list(joints), []
    while waiting:
        for joint in waiting:
            forwards, backwards = joint.parent in reached, joint.child in reached
            if forwards or backwards:
                waiting.remove(joint)
                if not (forwards and backwards):
                    ordered.append(replace(joint, backwards=backwards))
                    reached |= {joint.parent, joint.child}
                    break
                closing = Element(joint.kind, {"name": joint.name})
                closing.text = f"{joint.parent} {joint.child}"
                with document.reading(closing):
                    raise InputError(f"joint '{joint.name}' closes a loop, which is not read", path)
                break
        else:
            joint = waiting[0]
            reason = f"joint '{joint.name}' is not joined to ground"
            _hold_still(document, joint.parent, reason, ordered)
            reached.add(joint.parent)
    for body in bodies:
        if body not in reached:
            _hold_still(document, body, f"body '{body}' has no joint", ordered, "add one")
    return tuple(ordered)


def _hold_still(
    document: Document, body: str, reason: str, ordered: list[Joint], hint: str | None = None
) -> None:
    """Weld a body to ground and record the reason, an error unless `partial`."""
    weld = Element("WeldJoint", {"name": f"{body} held still"})
    weld.text = body
    with document.reading(weld):
        raise InputError(reason, document.path, hint)
    why = document.unread[-1][1]
    name = weld.get("name", "")
    ordered.append(Joint(name, weld.tag, GROUND, body, np.eye(4), np.eye(4), (), (), unread=why))
