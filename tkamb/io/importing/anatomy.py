"""Search of an OpenSim model for the joints and bodies of one leg."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, transform
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.model import GROUND, Coordinate, Joint, OpenSimModel

OTHER = {"right": "left", "left": "right"}
SEGMENT_LENGTH = (0.15, 0.75)
"""m: accepted lengths of thigh and shank, with a margin around 0.25 m (a child of six) and 0.6 m
(the tallest adults).
"""
SUFFIX = {"right": ("_r", "_R", ".r"), "left": ("_l", "_L", ".l")}


@dataclass(frozen=True, eq=False)
class Leg:
    """A leg of a model.

    Args:
        side: "right" or "left".
        knee: the femorotibial joint.
        flexion: name of the knee's flexion coordinate; None if the knee has no rotation coordinate.
        ankle: the joint below the tibia.
        hip: the joint above the femur.
        femur: names of the femur and of the bodies welded to it, the femur first.
        tibia: names of the tibia and of the bodies welded to it, the tibia first.
        patella: name of the patella; None if the model has no patella.
        neutral: body -> (4, 4) pose in ground in the neutral position. There the knee flexion is
            zero, and all other coordinates have their default values.
    """

    model: OpenSimModel
    side: str
    knee: Joint
    flexion: str | None
    ankle: Joint
    hip: Joint
    femur: tuple[str, ...]
    tibia: tuple[str, ...]
    foot: tuple[str, ...]
    patella: str | None
    pelvis: str
    neutral: dict[str, Array]

    def in_body(self, body: str, other: str) -> Array:
        """Return pose_body_in_other (4, 4) in the neutral position."""
        return inverse(self.neutral[other]) @ self.neutral[body]

    @property
    def knee_centre(self) -> Array:
        """(3,) m, the knee's centre in ground in the neutral position.

        It is the origin of the knee joint's frame on the femur. In Delp's models this is at the
        hip, because the joint's translation includes the thigh's length. There it is the origin of
        the frame on the tibia.
        """
        hip = transform(self.neutral[self.hip_centre[0]], self.hip_centre[1])
        for group in (self.femur, self.tibia):
            body, point = _end(self.knee, group)
            centre = transform(self.neutral[body], point)
            if np.linalg.norm(centre - hip) > SEGMENT_LENGTH[0]:
                break
        return np.asarray(centre)

    @property
    def hip_centre(self) -> tuple[str, Array]:
        """Name of a femoral body, and the hip centre (3,) m in that body."""
        return _end(self.hip, self.femur)

    @property
    def ankle_centre(self) -> tuple[str, Array]:
        """Name of a tibial body, and the ankle centre (3,) m in that body."""
        return _end(self.ankle, self.tibia)


def find_leg(model: OpenSimModel, side: str, knee: str | None = None) -> Leg:
    """Return the left or right leg of a model.

    Args:
        knee: name of the femorotibial joint; None: the joint with "knee" or "femorotibial" in its
            name.
    """
    try:
        joint, hip, ankle, femur, tibia = _joints(model, side, knee)
    except InputError as error:
        # The leg may lack a joint because that joint could not be read.
        raise _unread_joint(model) or error from None
    patellas = [
        body
        for body in model.bodies
        if "pat" in body.lower()
        and {*femur, *tibia} & {end for j in model.joints for end in _ends(j) if body in _ends(j)}
    ]
    foot = tuple(_carried(model, ankle.outboard))
    _refuse_unread(model, (hip, joint, ankle), {*femur, *tibia, *foot, *patellas[:1]})
    flexion = _flexion(model, joint)
    q = {flexion.name: 0.0} if flexion else {}
    kinematics = Kinematics(model)
    poses = kinematics.poses(kinematics.coupled(q))
    leg = Leg(
        model,
        side,
        joint,
        flexion.name if flexion else None,
        ankle,
        hip,
        femur,
        tibia,
        foot,
        patellas[0] if patellas else None,
        hip.inboard,
        {name: poses[k] for name, k in kinematics.bodies.items()},
    )
    _check_lengths(leg)
    return leg


def _joints(
    model: OpenSimModel, side: str, name: str | None
) -> tuple[Joint, Joint, Joint, tuple[str, ...], tuple[str, ...]]:
    knee = _knee(model, side, name)
    groups = _rigid_groups(model)
    for body in (knee.inboard, knee.outboard):
        if GROUND in groups[body]:
            raise InputError(
                f"has '{body}' of the knee '{knee.name}' welded to ground, so that it cannot move "
                "in the laboratory",
                model.name,
                "give hip and ankle their joints, or another joint with --knee",
            )
    femur = _ordered(model, groups[knee.inboard], "fem")
    tibia = _ordered(model, groups[knee.outboard], "tib")
    hip = _single_joint(
        model, [j for j in _moving(model) if j.outboard in femur], "above the femur", femur
    )
    below = [j for j in _moving(model) if j.inboard in tibia]
    ankles = [j for j in below if "ankle" in j.name.lower()]
    ankle = _single_joint(
        model, ankles or [j for j in below if not _is_patella(j)], "below the tibia", tibia
    )
    return knee, hip, ankle, femur, tibia


def _unread_joint(model: OpenSimModel, bodies: Iterable[str] = ()) -> InputError | None:
    """Return the error of the first unread joint, which concerns one of some bodies (any if empty),
    or None.
    """
    names = {joint.name for joint in model.joints}
    for element in model.unread:
        concerned = not bodies or element.concerns & {*bodies}
        if element.kind.endswith("Joint") and element.name not in names and concerned:
            return InputError(element.reason)
    return None


def _refuse_unread(model: OpenSimModel, joints: Iterable[Joint], bodies: set[str]) -> None:
    for joint in model.joints:
        if joint.unread and (joint in joints or {*_ends(joint)} <= bodies):
            raise _unread_joint(model, [joint.outboard]) or InputError(joint.unread)
    within = {j.name for j in model.joints if {*_ends(j)} & bodies}
    coordinates = {c.name for c in model.coordinates.values() if c.joint in within}
    tree_joints = {joint.name for joint in model.joints}
    for element in model.unread:
        is_in_tree = element.name in tree_joints
        if element.constrains and not is_in_tree and element.concerns & (bodies | coordinates):
            raise InputError(element.reason)


def way_to_pelvis(leg: Leg) -> list[Joint]:
    """Return the joints from the body above the hip down to ground."""
    carrier = {joint.outboard: joint for joint in leg.model.joints}
    joints, body = [], leg.pelvis
    while body in carrier:
        joints.append(carrier[body])
        body = carrier[body].inboard
    return joints


def _check_lengths(leg: Leg) -> None:
    centre = leg.knee_centre
    for name, (other, point) in {"thigh": leg.hip_centre, "shank": leg.ankle_centre}.items():
        length = float(np.linalg.norm(transform(leg.neutral[other], point) - centre))
        if not SEGMENT_LENGTH[0] < length < SEGMENT_LENGTH[1]:
            raise InputError(
                f"has a {name} of {length * 1e3:.0f} mm with joint '{leg.knee.name}' as the knee",
                leg.model.name,
                "give the femorotibial joint with --knee, or correct the model's lengths",
            )


def _knee(model: OpenSimModel, side: str, name: str | None) -> Joint:
    joints = {j.name: j for j in model.joints}
    if name is not None:
        if name not in joints:
            raise InputError(f"has no joint '{name}'", model.name, f"it has {', '.join(joints)}")
        return joints[name]
    named = [
        j for j in _moving(model) if "knee" in j.name.lower() or "femorotibial" in j.name.lower()
    ]
    matches = [j for j in named if j.name.endswith(SUFFIX[side])]
    if not matches:  # names in a model of one leg may have no suffix
        matches = [j for j in named if not j.name.endswith(SUFFIX["right"] + SUFFIX["left"])]
    if len(matches) != 1:
        result = f"{len(matches)} joints" if matches else "no joint"
        listed = ", ".join(j.name for j in named) or ", ".join(joints)
        raise InputError(
            f"has {result} that could be the {side} knee",
            model.name,
            f"give --knee, one of {listed}",
        )
    return matches[0]


def _flexion(model: OpenSimModel, knee: Joint) -> Coordinate | None:
    angles = [model.coordinates[a.coordinate] for a in knee.rotations if a.coordinate]
    for coordinate in angles:
        if "flex" in coordinate.name or "angle" in coordinate.name:
            return coordinate
    return angles[0] if angles else None


def _moving(model: OpenSimModel) -> list[Joint]:
    return [
        joint
        for joint in model.joints
        if joint.unread or any(a.coordinate for a in (*joint.rotations, *joint.translations))
    ]


def _rigid_groups(model: OpenSimModel) -> dict[str, set[str]]:
    """Return body -> the bodies welded to it, with itself."""
    groups = {body: {body} for body in (GROUND, *model.bodies)}
    moving = _moving(model)
    for joint in model.joints:
        if joint not in moving:
            union = groups[joint.parent] | groups[joint.child]
            for body in union:
                groups[body] = union
    return groups


def _ordered(model: OpenSimModel, group: set[str], stem: str) -> tuple[str, ...]:
    return tuple(sorted(group, key=lambda b: (stem not in b.lower(), -model.bodies[b].mass_kg, b)))


def _carried(model: OpenSimModel, body: str) -> list[str]:
    result = [body]
    for joint in model.joints:  # from ground outwards
        if joint.inboard in result:
            result.append(joint.outboard)
    return result


def _is_patella(joint: Joint) -> bool:
    return any("pat" in body.lower() for body in _ends(joint))


def _ends(joint: Joint) -> tuple[str, str]:
    return joint.parent, joint.child


def _single_joint(
    model: OpenSimModel, joints: list[Joint], where: str, bodies: Iterable[str]
) -> Joint:
    joints = [joint for joint in joints if not _is_patella(joint)]
    if len(joints) != 1:
        result = ", ".join(j.name for j in joints) or "none"
        raise InputError(
            f"must have one joint {where} ({', '.join(bodies)}), but has {result}",
            model.name,
            "give the femorotibial joint with --knee",
        )
    return joints[0]


def _end(joint: Joint, group: tuple[str, ...]) -> tuple[str, Array]:
    """Return the body of a group that a joint connects, and its origin (3,) m there."""
    if joint.parent in group:
        return joint.parent, joint.pose_parent_frame[:3, 3]
    return joint.child, joint.pose_child_frame[:3, 3]
