"""Finds the knee in a Pinocchio model: its frames, its joints, and the bodies of the shank.

The shank is every body on the tibia's side of the knee, including the foot; the thigh the body to
which the frame "femur" is fixed. The pelvis acts on it by the load at the hip. The same equations
therefore hold for a leg that stands on its foot, one that hangs from a pelvis, and a whole body.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

from tkamb.errors import InputError, must_be, names_near

NEEDED = ("femur", "tibia")
"""Parts of the knee whose frames a model must have."""
PARTS = (*NEEDED, "femoral", "insert", "patella", "hip")
"""Parts of the knee for which a user may name a frame."""
INSERT_JOINT, PLANE_JOINT = "knee_ap", "patella_ap"
"""Joints of a tkamb URDF whose placements are the insert frame and the patella's plane."""


@dataclass(frozen=True, eq=False)
class FixedFrame:
    """A frame that is fixed to a joint of the model, by the joint's index and a pose in it."""

    joint: int
    placement: pin.SE3


@dataclass(frozen=True, eq=False)
class Anatomy:
    """The knee in a model.

    Args:
        femoral: axes of the femoral component's mesh, fixed to the femur.
        insert: axes of the insert's mesh, fixed to the tibia.
        patella: frame of a patella that moves against the femur; None: the model has none.
        plane: frame of the patella's sagittal plane, fixed to the femur.
        knee_joints: indices of the joints between tibia and femur, ascending.
        shank: indices of the joints whose bodies are on the tibia's side.
    """

    model: pin.Model
    tibia: FixedFrame
    femur: FixedFrame
    femoral: FixedFrame
    insert: FixedFrame
    hip: FixedFrame
    patella: FixedFrame | None
    plane: FixedFrame
    knee_joints: tuple[int, ...]
    shank: tuple[int, ...]
    names: Mapping[str, str]

    @cached_property
    def fixed(self) -> bool:
        """Whether the tibia is fixed to the universe."""
        return self.tibia.joint == 0

    @cached_property
    def angles(self) -> dict[int, str]:
        """Index in q -> name of a joint of the knee whose coordinate is an angle."""
        joints = {joint: self.model.joints[joint] for joint in self.knee_joints}
        return {
            joint.idx_q: self.model.names[index]
            for index, joint in joints.items()
            if joint.nq == 1 and joint.shortname().startswith(("JointModelR", "JointModelH"))
        }

    @cached_property
    def patella_q(self) -> frozenset[int]:
        """Indices in q of the patella's joints."""
        joints = self._patella_joints
        return frozenset(k for one in joints for k in range(one.idx_q, one.idx_q + one.nq))

    @cached_property
    def patella_v(self) -> frozenset[int]:
        """Indices in v of the patella's joints."""
        joints = self._patella_joints
        return frozenset(k for one in joints for k in range(one.idx_v, one.idx_v + one.nv))

    @property
    def _patella_joints(self) -> list[pin.JointModel]:
        if self.patella is None:
            return []
        path = _path(self.model, self.femur.joint, self.patella.joint)
        return [self.model.joints[joint] for joint in path]

    def frame(self, name: str) -> FixedFrame:
        """Return the frame of a part of the knee, or of a name in the model."""
        names = {
            "femur": self.femur,
            "tibia": self.tibia,
            "femoral": self.femoral,
            "insert": self.insert,
            "hip": self.hip,
        }
        if name in names:
            return names[name]
        if name == "patella" and self.patella is not None:
            return self.patella
        return _frame(self.model, self.names.get(name, name))


def find_anatomy(
    model: pin.Model,
    names: Mapping[str, str | None],
    joints: Sequence[str],
    plane: pin.SE3 | None,
) -> Anatomy:
    """Find the frames and joints of the knee in a model.

    Args:
        names: part of `PARTS` -> name of its frame in the model; None: its default.
        joints: expected names of the knee's joints; empty: no check.
        plane: pose of the patella's sagittal plane in the frame "femur"; None: the default of
            `tkamb.knee.parts.Extensor`.
    """
    for part in names:
        if part not in PARTS:
            raise InputError(f"no part '{part}' of the knee", "frames", names_near(part, PARTS))
    frames = {}
    for part in PARTS:
        name = names.get(part, part if _offers(model, part) else None)
        if name is not None:
            frames[part] = _frame(model, name, part)
        elif part in NEEDED:
            raise _missing(model, part)
    tibia, femur = frames["tibia"], frames["femur"]
    path = _path(model, tibia.joint, femur.joint)
    if not path:
        raise InputError(
            "are fixed to each other", "frames femur and tibia", "no joint lies between them"
        )
    if tibia.joint in path and femur.joint in path:
        raise InputError(
            "are both carried by another body",
            "frames femur and tibia",
            "one must carry the other",
        )
    _check_joints(model, joints, path)
    patella = frames.get("patella")
    if patella is not None and patella.joint == femur.joint:
        patella = None
    shank = _shank(model, tibia.joint, femur.joint, path, patella)
    for part, base in (("insert", tibia), ("femoral", femur), ("hip", femur)):
        if part in frames and frames[part].joint != base.joint:
            raise InputError(
                f"is not fixed to the {'tibia' if base is tibia else 'femur'}",
                f"frame {names.get(part, part)}",
                f"name another frame: frames={{'{part}': ...}}",
            )
    insert = frames.get("insert") or _joint_placement(model, INSERT_JOINT, tibia) or tibia
    if plane is not None:
        sagittal = FixedFrame(femur.joint, femur.placement * plane)
    else:
        sagittal = _joint_placement(model, PLANE_JOINT, femur) or femur
    return Anatomy(
        model,
        tibia,
        femur,
        frames.get("femoral") or femur,
        insert,
        frames.get("hip") or _hip(femur, path),
        patella,
        sagittal,
        path,
        shank,
        {part: name for part, name in names.items() if name is not None},
    )


def _offers(model: pin.Model, part: str) -> bool:
    """Return whether the model has a frame with the name of a part. Frames of joints do not count:
    a joint "hip" need not lie in the hip centre.
    """
    return any(f.name == part and f.type != pin.FrameType.JOINT for f in model.frames)


def _missing(model: pin.Model, part: str) -> InputError:
    names = [frame.name for frame in model.frames]
    hint = f"name it: frames={{'{part}': ...}}; {names_near(part, names)}"
    what = f"no frame '{part}' in the model"
    if model.existFrame(part):
        what, hint = f"'{part}' is a joint", f"if it is meant: frames={{'{part}': '{part}'}}"
    return InputError(what, "frames", hint)


def _frame(model: pin.Model, name: str, part: str | None = None) -> FixedFrame:
    """Return the frame with a name, preferably of a body."""
    must_be(name, str, "frames", "give names of frames of the model")
    if not model.existFrame(name):
        names = [frame.name for frame in model.frames]
        hint = names_near(name, names)
        if part is not None:
            hint = f"name it: frames={{'{part}': ...}}; {hint}"
        raise InputError(f"no frame '{name}' in the model", "frames", hint)
    candidates = [frame for frame in model.frames if frame.name == name]
    bodies = [frame for frame in candidates if frame.type == pin.FrameType.BODY]
    frame = (bodies or candidates)[0]
    return FixedFrame(frame.parentJoint, frame.placement)


def _joint_placement(model: pin.Model, name: str, base: FixedFrame) -> FixedFrame | None:
    """Return the placement of a joint on a frame's body; None on another one."""
    if not model.existJointName(name):
        return None
    joint = model.getJointId(name)
    if model.parents[joint] != base.joint:
        return None
    return FixedFrame(base.joint, model.jointPlacements[joint])


def _ancestors(model: pin.Model, joint: int) -> list[int]:
    joints = [joint]
    while joints[-1]:
        joints.append(int(model.parents[joints[-1]]))
    return joints


def _path(model: pin.Model, one: int, other: int) -> tuple[int, ...]:
    first, second = set(_ancestors(model, one)), set(_ancestors(model, other))
    return tuple(sorted(first ^ second))


def _check_joints(model: pin.Model, joints: Sequence[str], path: tuple[int, ...]) -> None:
    joint_names = [model.names[joint] for joint in path]
    for name in joints:
        if name not in joint_names:
            words = f"the joints between tibia and femur are {', '.join(joint_names)}"
            raise InputError(f"joint '{name}' is not part of the knee", "joints", words)
    if joints and len(joints) != len(path):
        left_out = ", ".join(name for name in joint_names if name not in joints)
        raise InputError(f"leaves out {left_out}", "joints", "name all joints of the knee")


def _shank(
    model: pin.Model, tibia: int, femur: int, path: tuple[int, ...], patella: FixedFrame | None
) -> tuple[int, ...]:
    """Return the joints of all bodies that stay connected to the tibia if the knee is cut.

    A body between femur and tibia belongs to the shank, those attached to femur, patella or
    universe do not.
    """
    shank = {tibia, *path} - {femur}
    excluded = {0, femur} | (set() if patella is None else {patella.joint})
    # Parents and children join the shank until no body is added.
    grows = True
    while grows:
        count = len(shank)
        shank |= {int(model.parents[joint]) for joint in shank if joint} - excluded
        shank |= {
            joint for joint in range(1, model.njoints) if int(model.parents[joint]) in shank - {0}
        } - excluded
        grows = len(shank) > count
    return tuple(sorted(shank - {0}))


def _hip(femur: FixedFrame, path: tuple[int, ...]) -> FixedFrame:
    return femur if femur.joint in path else FixedFrame(femur.joint, pin.SE3.Identity())


# m: a thigh whose centre of mass lies farther below the femoral component, with a shank whose
# centre of mass lies farther above the insert, are exchanged. The centres of mass
# of thigh and shank lie 0.15 to 0.3 m from the knee.
LEAST_LEVER = 0.05


def check_not_exchanged(anatomy: Anatomy) -> None:
    """Raise an InputError if femur and tibia are exchanged: the femur's centre of mass lies below
    the knee, the tibia's above it.
    """
    levers = [_centre_height(anatomy.model, frame) for frame in (anatomy.femoral, anatomy.insert)]
    if -levers[0] > LEAST_LEVER and levers[1] > LEAST_LEVER:
        raise InputError(
            f"femur and tibia are exchanged: the femur's centre of mass lies {-levers[0]:.2f} m "
            f"below the femoral component, the tibia's {levers[1]:.2f} m above the insert",
            "frames",
            "name the frames: frames={'femur': ..., 'tibia': ...}; y points up in both",
        )


def _centre_height(model: pin.Model, frame: FixedFrame) -> float:
    """Return the height of a body's centre of mass along a frame's y, m; 0 without mass."""
    inertia = model.inertias[frame.joint]
    if not frame.joint or not inertia.mass > 0.0:
        return 0.0
    return float(frame.placement.actInv(inertia.lever)[1])


def knee_size(anatomy: Anatomy) -> int:
    """Return the number of degrees of freedom between tibia and femur."""
    return int(np.sum([anatomy.model.joints[joint].nv for joint in anatomy.knee_joints]))
