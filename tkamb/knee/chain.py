"""The rigid-body chain in Pinocchio: it turns a motion into inertial forces and load columns.

The root is a free joint at the tibia, and the measured ground reaction is a load on it. All joints
other than knee and patella, such as the ankle, are locked.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import (
    KNEE_JOINT_NAMES,
    PATELLA_JOINT_NAMES,
    Array,
    inverse,
    transform,
)
from tkamb.knee.load import PointForces, wrenches
from tkamb.units import STANDARD_GRAVITY


@dataclass(frozen=True, eq=False)
class ChainMotion:
    """The motion of the chain at one instant, SI units.

    Args:
        tibia: pose_tibia_in_laboratory, (4, 4) (x forward, y up, z right).
        tibia_velocity: spatial velocity (linear, angular) in the tibia's frame, (6,).
        tibia_acceleration: spatial acceleration in the tibia's frame, (6,).
        joints: coordinates, rates and accelerations of knee (and patella), (3, 6) or (3, 9).
    """

    tibia: Array
    tibia_velocity: Array
    tibia_acceleration: Array
    joints: Array


class Chain:
    """The patient as a Pinocchio model with a free root.

    Args:
        urdf: text of a checked URDF (`tkamb.io.recordings.patient.load_urdf`).
        with_patella: False: the patella is fixed to the femur at its neutral pose.
        gravity: acceleration, downward in the laboratory, m/s².
    """

    def __init__(self, urdf: str, with_patella: bool, gravity: float = STANDARD_GRAVITY) -> None:
        try:
            full = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
        except (ValueError, RuntimeError) as error:
            raise InputError(f"Pinocchio cannot build the chain ({error})", "URDF") from None
        self.joints = KNEE_JOINT_NAMES + (PATELLA_JOINT_NAMES if with_patella else ())
        keep = {"universe", "root_joint", *self.joints}
        # Other joints of the URDF (toes, wrists) are fixed at zero; their masses stay.
        lock = [full.getJointId(name) for name in full.names if name not in keep]
        model = pin.buildReducedModel(full, lock, pin.neutral(full)) if lock else full
        # The laboratory's y points up.
        model.gravity = pin.Motion(np.array([0.0, -gravity, 0.0]), np.zeros(3))
        self._columns = [model.joints[model.getJointId(name)].idx_v for name in self.joints]
        self._set_model(model)

    def changed(
        self, mass_factor: float, insert_shift: Array, insert_turn: Array | None = None
    ) -> "Chain":
        """Return the chain with other masses and another pose of the insert on the tibia.

        Args:
            mass_factor: factor on the mass and inertia of every segment.
            insert_shift: displacement of insert and femur, insert axes, (3,), m.
            insert_turn: rotation of insert and femur about the insert's origin, insert axes, shape
                (3, 3); None: no rotation.
        """
        other, model = copy.copy(self), pin.Model(self.model)
        for joint in range(1, model.njoints):
            inertia = model.inertias[joint]
            model.inertias[joint] = pin.Inertia(
                mass_factor * inertia.mass, inertia.lever, mass_factor * inertia.inertia
            )
        base = model.getJointId(KNEE_JOINT_NAMES[0])
        placement = model.jointPlacements[base]
        turn = np.eye(3) if insert_turn is None else insert_turn
        model.jointPlacements[base] = placement * pin.SE3(turn, insert_shift)
        other._set_model(model)
        return other

    def scaled(self, length: float) -> "Chain":
        """Return the chain of a similar body, `length` times as long, of the same density."""
        other, model = copy.copy(self), pin.Model(self.model)
        for joint in range(1, model.njoints):
            inertia, placement = model.inertias[joint], model.jointPlacements[joint]
            model.inertias[joint] = pin.Inertia(
                length**3 * inertia.mass, length * inertia.lever, length**5 * inertia.inertia
            )
            model.jointPlacements[joint] = pin.SE3(
                placement.rotation, length * placement.translation
            )
        for frame in model.frames:
            frame.placement = pin.SE3(
                frame.placement.rotation, length * frame.placement.translation
            )
        other._set_model(model)
        return other

    def _set_model(self, model: pin.Model) -> None:
        self.model = model
        frames = enumerate(model.frames)
        self._frames = {frame.name: k for k, frame in frames if frame.type == pin.FrameType.BODY}
        base = model.getJointId(KNEE_JOINT_NAMES[0])
        self._insert_in_root = model.jointPlacements[base].homogeneous
        self._tibia_in_root = model.frames[self.frame_id("tibia")].placement.homogeneous

    def frame_id(self, link: str) -> int:
        """Return Pinocchio's id of a link's frame."""
        if link not in self._frames:
            names = [f.name for f in self.model.frames if f.type == pin.FrameType.BODY]
            raise InputError(f"no link '{link}' in the URDF", None, names_near(link, names))
        return self._frames[link]

    @property
    def insert_in_tibia(self) -> Array:
        """The pose of the insert in the tibia, pose_insert_in_tibia (4, 4)."""
        return inverse(self._tibia_in_root) @ self._insert_in_root

    @property
    def patella_joint_in_femur(self) -> Array:
        """The pose (4, 4) of the patella's joint in the femur."""
        # The patella moves in the x-y plane of this joint.
        return self.model.jointPlacements[self.model.getJointId(PATELLA_JOINT_NAMES[0])].homogeneous

    def link_in(self, link: str, base: str) -> Array:
        """Return pose_link_in_base (4, 4) of two links that are fixed to each other."""
        frames = [self.model.frames[self.frame_id(name)] for name in (link, base)]
        if frames[0].parentJoint != frames[1].parentJoint:
            raise InputError(f"link '{link}' is not fixed to '{base}'", "URDF")
        return inverse(frames[1].placement.homogeneous) @ frames[0].placement.homogeneous

    def carrier(self, link: str) -> str:
        """Return the name of the body that a link is fixed to: tibia, femur or patella."""
        joint = self.model.frames[self.frame_id(link)].parentJoint
        for base in ("tibia", "femur", "patella"):
            if self.model.frames[self.frame_id(base)].parentJoint == joint:
                return base
        raise InputError(f"link '{link}' is fixed to neither tibia, femur nor patella", "URDF")

    def segment(self, link: str) -> tuple[float, Array, Array]:
        """Return the inertia of a link and of all links fixed to it, in the link's frame.

        Returns:
            Mass, kg; centre of mass (3,), m; inertia tensor (3, 3) about that centre, kg·m².
        """
        frame = self.model.frames[self.frame_id(link)]
        inertia = self.model.inertias[frame.parentJoint].se3Action(frame.placement.inverse())
        return float(inertia.mass), np.array(inertia.lever), np.array(inertia.inertia)

    def on_shank(self, link: str) -> bool:
        """Return whether a link is fixed to the tibia."""
        joints = [self.model.frames[self.frame_id(name)].parentJoint for name in (link, "tibia")]
        return bool(joints[0] == joints[1])

    def knee_columns(self) -> list[int]:
        """Return the rows of the six knee coordinates in the generalised force."""
        return self._columns[:6]

    def patella_columns(self) -> list[int]:
        """Return the rows of the three patella coordinates; empty if it is fixed."""
        return self._columns[6:]

    def at(self, motion: ChainMotion) -> "ChainState":
        """Return the chain at one instant, with its inertial forces."""
        return ChainState(self, *self.configuration(motion))

    def configuration(self, motion: ChainMotion) -> tuple[Array, Array, Array]:
        """Return q (nq,), v (nv,) and a (nv,) of the model at one instant."""
        model = self.model
        root_in_tibia = pin.SE3(inverse(self._tibia_in_root))
        q, v, a = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        q[:7] = pin.SE3ToXYZQUAT(pin.SE3(motion.tibia) * root_in_tibia)
        # The recording has the twist in the tibia's axes. Pinocchio's free joint has it in the
        # root's axes.
        v[:6] = root_in_tibia.actInv(pin.Motion(motion.tibia_velocity)).vector
        a[:6] = root_in_tibia.actInv(pin.Motion(motion.tibia_acceleration)).vector
        for name, column, (x, rate, acceleration) in zip(
            self.joints, self._columns, motion.joints.T, strict=True
        ):
            q[model.joints[model.getJointId(name)].idx_q] = x
            v[column], a[column] = rate, acceleration
        return q, v, a


class ChainState:
    """The chain at one instant. Poses and loads are in the insert frame.

    Attributes:
        inertial: RNEA(q, v, a), (nv,): generalised forces that all loads must add up to.
    """

    def __init__(self, chain: Chain, q: Array, v: Array, a: Array) -> None:
        self.chain, self.q, self.v, self.a = chain, q, v, a
        self.data = chain.model.createData()
        # Recursive Newton-Euler: M a + C + gravity. The next call overwrites the data.
        self.inertial: Array = pin.rnea(chain.model, self.data, q, v, a).copy()
        pin.computeJointJacobians(chain.model, self.data, q)
        pin.updateFramePlacements(chain.model, self.data)
        root = self.data.oMi[chain.model.getJointId("root_joint")].homogeneous
        self.insert_in_laboratory: Array = root @ chain._insert_in_root
        self._jacobians: dict[int, Array] = {}

    @cached_property
    def laboratory_in_insert(self) -> Array:
        """The pose of the laboratory in the insert, pose_laboratory_in_insert (4, 4)."""
        return inverse(self.insert_in_laboratory)

    def pose(self, link: str) -> Array:
        """Return pose_link_in_insert (4, 4)."""
        placement = self.data.oMf[self.chain.frame_id(link)].homogeneous
        return self.laboratory_in_insert @ placement

    def point(self, link: str, point: Array) -> Array:
        """Return a point (3,) of a link in the insert frame."""
        return transform(self.pose(link), point)

    def generalised(self, groups: Sequence[Sequence[PointForces]]) -> Array:
        """Return the generalised forces (nv, k) of k groups of loads: each column sums J^T w."""
        loads = [load for group in groups for load in group]
        column = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
        total = np.zeros((self.chain.model.nv, len(groups)))
        if not loads:
            return total
        acting = wrenches(loads)
        links = [load.link for load in loads]
        for link in sorted(set(links)):
            rows = [n for n, name in enumerate(links) if name == link]
            on_link = np.zeros((len(groups), 6))
            np.add.at(on_link, column[rows], acting[rows])
            total += self._jacobian(link).T @ on_link.T
        return total

    def add_need(self, link: str, wrench: Array) -> None:
        """Add a wrench (6,) about the insert's origin to that required on a link."""
        self.inertial = self.inertial + self._jacobian(link).T @ wrench

    def _jacobian(self, link: str) -> Array:
        """Return (6, nv) at the insert's origin, in its axes."""
        joint = self.chain.model.frames[self.chain.frame_id(link)].parentJoint
        if joint not in self._jacobians:
            model, data = self.chain.model, self.data
            local = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL)
            joint_in_insert = pin.SE3(self.laboratory_in_insert) * data.oMi[joint]
            self._jacobians[joint] = joint_in_insert.toActionMatrix() @ local
        return self._jacobians[joint]
