"""The canonical chain: the knee of any model, as the equations need it.

    tibia -> (six knee coordinates) -> femur -> (patella's sagittal plane) -> patella

The chain contains the inertia of thigh and patella. The shank and all bodies attached to it stay in
the user's model, whose equations of motion give the wrench that the knee must exert on it. A left
knee is mirrored at input, and its loads are mirrored back.

With the spatial velocities v and accelerations a of femur (F) and tibia (T), the femur's twist s
relative to the tibia and its rate s', in the femur's axes,

    s = v_F - X v_T,    s' = a_F - X a_T - v_F x s,    J qd = s,    J qdd = s' - J' qd

these equations give the rates qd and qdd of the knee coordinates, for any joints of the user's
model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from tkamb.errors import InputError
from tkamb.geometry.frames import (
    KNEE_JOINT_NAMES,
    MIRROR,
    PATELLA_JOINT_NAMES,
    Array,
    cross_matrix,
    knee_coordinates,
    mirrored_pose,
)
from tkamb.knee.anatomy import Anatomy, FixedFrame, knee_size
from tkamb.knee.chain import Chain, ChainMotion, ChainState
from tkamb.knee.load import LinkPoint, PointForces, wrenches

if TYPE_CHECKING:
    from tkamb.knee.wrap_object import WrapObject

# m and rad: pose error below which the iteration has converged. It is near the
# rounding error of double precision.
POSE_TOLERANCE = 1e-12
# m and rad: largest pose error that is accepted after the last Newton step. Not studied.
ACCEPTED_POSE_ERROR = 1e-8
# Maximum number of Newton steps. Not studied.
MAX_POSE_STEPS = 30


_TWIST_MIRROR = np.array([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
"""Signs of a twist or wrench (linear or force first) in the mirror image (z to -z)."""


def mirrored_spatial(vector: Array) -> Array:
    """Return twists or wrenches (..., 6) of the mirror image in the sagittal plane."""
    return np.asarray(vector * _TWIST_MIRROR)


def force_cross(twists: Array, wrench: Array) -> Array:
    """Return xi x* w (6, n) of twists xi (6, n) and a wrench w (6,)."""
    force, moment = cross_matrix(wrench.reshape(2, 3))
    return -np.concatenate([force @ twists[3:], moment @ twists[3:] + force @ twists[:3]])


def se3(pose: Array) -> pin.SE3:
    """Return a pose (4, 4) as a Pinocchio placement."""
    return pin.SE3(pose[:3, :3], pose[:3, 3])


class CanonicalChain(Chain):
    """The canonical chain of one knee; see the module.

    `component` are axes of the femoral component, fixed to the femur's joint; `insert` is the
    insert frame, fixed to the tibia's joint.
    """

    def __init__(
        self,
        anatomy: Anatomy,
        is_left: bool,
        with_patella: bool,
        component: FixedFrame,
        insert: FixedFrame,
    ) -> None:
        self.joints = KNEE_JOINT_NAMES + (PATELLA_JOINT_NAMES if with_patella else ())
        self._left = is_left
        model, user = pin.Model(), anatomy.model
        model.gravity = pin.Motion(self._right(np.array(user.gravity.vector)))
        joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
        _add_body(model, "tibia", joint, self._placed(anatomy.tibia.placement))
        placement = self._placed(insert.placement)
        for name, kind in zip(KNEE_JOINT_NAMES, _KNEE_JOINTS, strict=True):
            joint = model.addJoint(joint, kind(), placement, name)
            placement = pin.SE3.Identity()
        _add_body(model, "femur", joint)
        femur = component.placement
        hip = femur.inverse() * anatomy.hip.placement
        _add_body(model, "hip", joint, self._placed(hip))
        model.inertias[joint] = self._inertia(user.inertias[component.joint], femur)
        if with_patella:
            placement = self._placed(femur.inverse() * anatomy.plane.placement)
            for name, kind in zip(PATELLA_JOINT_NAMES, _PATELLA_JOINTS, strict=True):
                joint = model.addJoint(joint, kind(), placement, name)
                placement = pin.SE3.Identity()
            _add_body(model, "patella", joint)
            if anatomy.patella is not None:
                inertia_of_patella = user.inertias[anatomy.patella.joint]
                model.inertias[joint] = self._inertia(inertia_of_patella, anatomy.patella.placement)
        self._columns = [model.joints[model.getJointId(name)].idx_v for name in self.joints]
        self._set_model(model)

    def _right(self, vector: Array) -> Array:
        return mirrored_spatial(vector) if self._left else vector

    def _placed(self, placement: pin.SE3) -> pin.SE3:
        pose = placement.homogeneous
        return se3(mirrored_pose(pose) if self._left else pose)

    def _inertia(self, inertia: pin.Inertia, placement: pin.SE3) -> pin.Inertia:
        inertia_in_frame = inertia.se3Action(placement.inverse())
        if not self._left:
            return inertia_in_frame
        return pin.Inertia(
            inertia_in_frame.mass,
            MIRROR @ inertia_in_frame.lever,
            MIRROR @ inertia_in_frame.inertia @ MIRROR,
        )


_KNEE_JOINTS = (
    pin.JointModelPX,
    pin.JointModelPY,
    pin.JointModelPZ,
    lambda: pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0])),
    lambda: pin.JointModelRevoluteUnaligned(np.array([-1.0, 0.0, 0.0])),
    pin.JointModelRZ,
)
_PATELLA_JOINTS = (pin.JointModelPX, pin.JointModelPY, pin.JointModelRZ)


def _add_body(model: pin.Model, name: str, joint: int, placement: pin.SE3 | None = None) -> None:
    pose_in_joint = pin.SE3.Identity() if placement is None else placement
    model.addFrame(pin.Frame(name, joint, 0, pose_in_joint, pin.FrameType.BODY))


@dataclass(frozen=True, eq=False)
class KneePose:
    """The pose of a right knee, or of the mirror image of a left one, at one instant.

    Args:
        pose: femoral component in the insert frame, (4, 4).
        patella: coordinates (3,), m, m, rad; None: the model has no patella.
    """

    pose: Array
    patella: Array | None

    @cached_property
    def coordinates(self) -> Array:
        """Knee coordinates (6,), m and rad."""
        return knee_coordinates(self.pose)


class Bridge:
    """Converts poses, motions and loads between the user's model and the chain.

    `data` is Pinocchio's of the user's model, with joint placements up to date.
    """

    def __init__(
        self,
        anatomy: Anatomy,
        is_left: bool,
        chain: Chain,
        component: FixedFrame,
        insert: FixedFrame,
    ) -> None:
        self.anatomy, self.left, self.chain = anatomy, is_left, chain
        self.component, self.insert = component, insert
        self._chain_data = chain.model.createData()
        self._last = chain.model.getJointId(KNEE_JOINT_NAMES[-1])
        self._shank: Sequence[int] = anatomy.shank
        if anatomy.fixed:
            self._shank = tuple(anatomy.model.subtrees[anatomy.knee_joints[0]])

    def link_point(self, point: LinkPoint) -> LinkPoint:
        """Return a point on the user's model as a point on the chain."""
        link, in_link = self._on_link(point.link)
        local = in_link.act(np.asarray(point.position, float))
        return LinkPoint(link, MIRROR @ local if self.left else np.array(local))

    def wrap_object(self, wrap: "WrapObject") -> "WrapObject":
        """Return a wrap object on the user's model as one on the chain."""
        link, in_link = self._on_link(wrap.body)
        moved = wrap.on(link, in_link.homogeneous)
        return moved.mirrored() if self.left else moved

    def _on_link(self, name: str) -> tuple[str, pin.SE3]:
        anatomy = self.anatomy
        links = [("tibia", anatomy.tibia), ("femur", self.component)]
        if anatomy.patella is not None:
            links.append(("patella", anatomy.patella))
        elif name == "patella" and "patella_ap" in self.chain.joints:
            return "patella", pin.SE3.Identity()
        frame = anatomy.frame(name)
        for link, base in links:
            if frame.joint == base.joint:
                return link, base.placement.inverse() * frame.placement
        raise InputError(
            f"frame '{name}' is fixed to neither tibia, femur nor patella",
            "Knee",
            "a line that leaves the knee is a muscle: Knee(..., muscles=[...])",
        )

    def knee_pose(self, data: Any) -> KneePose:
        """Return the pose of the knee."""
        insert = data.oMi[self.insert.joint] * self.insert.placement
        femur = data.oMi[self.component.joint] * self.component.placement
        pose = self._right(insert.actInv(femur))
        patella = None
        if self.anatomy.patella is not None and "patella_ap" in self.chain.joints:
            plane = data.oMi[self.anatomy.plane.joint] * self.anatomy.plane.placement
            patella_placement = (
                data.oMi[self.anatomy.patella.joint] * self.anatomy.patella.placement
            )
            relative = self._right(plane.actInv(patella_placement))
            rotation = np.arctan2(relative[1, 0], relative[0, 0])
            patella = np.array([relative[0, 3], relative[1, 3], rotation])
        return KneePose(pose, patella)

    def twist(self, data: Any) -> Array:
        """Return the femur's twist (6,) relative to the insert, at the insert's origin and axes.

        `data` has velocities up to date.
        """
        total, joint = np.zeros(6), self.component.joint
        if joint:
            insert = data.oMi[self.insert.joint] * self.insert.placement
            total += insert.actInv(data.oMi[joint]).act(data.v[joint]).vector
        if self.insert.joint:
            total -= self.insert.placement.actInv(data.v[self.insert.joint]).vector
        return mirrored_spatial(total) if self.left else total

    def motion(self, data: Any, patella: bool) -> ChainMotion:
        """Return the motion of the chain.

        `data` is that after `pin.forwardKinematics(..., q, v, a)`; a missing patella has zero
        coordinates and rates.
        """
        anatomy, knee = self.anatomy, self.knee_pose(data)
        tibia, zero = anatomy.tibia, pin.Motion.Zero()
        pose = self._right(data.oMi[tibia.joint] * tibia.placement)
        rates = [
            tibia.placement.actInv(zero if not tibia.joint else derivative[tibia.joint]).vector
            for derivative in (data.v, data.a)
        ]
        q = pin.neutral(self.chain.model)
        q[7:13] = knee.coordinates
        joints = np.zeros((3, 9 if patella else 6))
        knee_rows = slice(0, 6)
        joints[:, knee_rows] = self._rates(
            q, knee.coordinates, data, tibia, self.component, knee_rows
        )
        if patella and knee.patella is not None:
            assert anatomy.patella is not None
            q[13:16] = knee.patella
            patella_rows = slice(6, 9)
            joints[:, patella_rows] = self._rates(
                q, knee.patella, data, self.component, anatomy.patella, patella_rows
            )
        tibia_rates = [mirrored_spatial(rate) if self.left else rate for rate in rates]
        return ChainMotion(pose, tibia_rates[0], tibia_rates[1], joints)

    def _rates(
        self,
        q: Array,
        coordinates: Array,
        data: Any,
        base: FixedFrame,
        follower: FixedFrame,
        rows: slice,
    ) -> Array:
        """Return coordinates, rates and accelerations (3, n) between two bodies.

        q is that of the chain with its root at the neutral pose; `base` is on the parent body,
        `follower` on the child; `rows` are these coordinates in the chain's joint coordinates.
        """
        twist, rate = self._relative(data, base, follower)
        model, cache = self.chain.model, self._chain_data
        joint = self._last if rows.start == 0 else model.njoints - 1
        columns = slice(6 + rows.start, 6 + rows.stop)
        jacobian = pin.computeJointJacobian(model, cache, q, joint)[:, columns]
        v = np.zeros(model.nv)
        v[columns] = _solved(jacobian, twist)
        # With zero joint accelerations the acceleration of the child body is J' qd.
        pin.forwardKinematics(model, cache, q, v, np.zeros(model.nv))
        acceleration = _solved(jacobian, rate - cache.a[joint].vector)
        return np.stack([coordinates, v[columns], acceleration])

    def _relative(self, data: Any, base: FixedFrame, follower: FixedFrame) -> tuple[Array, Array]:
        """Return s and s' (6,) of the equations above, in the child body's axes."""
        placement, zero = data.oMi[follower.joint] * follower.placement, pin.Motion.Zero()
        child_twist, child_rate = (
            follower.placement.actInv(zero if not follower.joint else values[follower.joint])
            for values in (data.v, data.a)
        )
        to_child = placement.actInv(data.oMi[base.joint])
        base_twist, base_rate = (
            zero if not base.joint else to_child.act(values[base.joint])
            for values in (data.v, data.a)
        )
        twist = child_twist - base_twist
        rate = child_rate - base_rate - child_twist.cross(twist)
        vectors = twist.vector, rate.vector
        if not self.left:
            return vectors
        return mirrored_spatial(vectors[0]), mirrored_spatial(vectors[1])

    def relative_jacobian(self, data: Any, q: Array) -> Array:
        """Return J (6, nv) of `tkamb.Knee.relative_jacobian`, and update `data`."""
        model = self.anatomy.model
        pin.computeJointJacobians(model, data, q)
        insert = data.oMi[self.insert.joint] * self.insert.placement
        total = np.zeros((6, model.nv))
        for frame, sign in ((self.component, 1.0), (self.insert, -1.0)):
            if frame.joint:
                local = pin.getJointJacobian(model, data, frame.joint, pin.ReferenceFrame.LOCAL)
                to_insert = insert.actInv(data.oMi[frame.joint]).toActionMatrix()
                total += sign * to_insert @ local.reshape(6, -1)
        return total

    def configuration(self, q: Array, target: Array) -> Array:
        """Return q with the knee's joints changed, by Newton's method, to the femur's pose
        `target`.

        It is pose_femoral_in_insert of a right knee.
        """
        model = self.anatomy.model
        data, placement = model.createData(), self._placed(target)
        columns = [
            model.joints[joint].idx_v + k
            for joint in self.anatomy.knee_joints
            for k in range(model.joints[joint].nv)
        ]
        q = np.array(q, float)
        for _ in range(MAX_POSE_STEPS):
            pin.forwardKinematics(model, data, q)
            insert = data.oMi[self.insert.joint] * self.insert.placement
            femur = data.oMi[self.component.joint] * self.component.placement
            # Pose error as a twist in the insert frame. The joints must produce this twist.
            error = pin.log6(placement * insert.actInv(femur).inverse()).vector
            if np.abs(error).max() < POSE_TOLERANCE:
                return q
            jacobian = self.relative_jacobian(data, q)[:, columns]
            step = np.zeros(model.nv)
            step[columns] = np.linalg.lstsq(jacobian, error, rcond=None)[0]
            q = pin.integrate(model, q, step)
        if np.abs(error).max() < ACCEPTED_POSE_ERROR:
            return q
        raise InputError(
            f"the {knee_size(self.anatomy)} degrees of freedom between tibia and femur do not "
            "reach the pose of equilibrium",
            "Knee",
            "give the knee of the model six degrees of freedom, such as a pin.JointModelFreeFlyer",
        )

    def shank_needs(self, data: Any) -> Array:
        """Return the wrench (6,) that inertia and weight of the shank require, insert frame.

        If the tibia is fixed to the universe, it is the negative of the sum over all bodies above
        the knee. `data` is that after `pin.forwardKinematics(model, data, q, v, a)`.
        """
        needs = []
        for joint in self._shank:
            inertia, velocity = self.anatomy.model.inertias[joint], data.v[joint]
            falling = data.a[joint] - data.oMi[joint].actInv(self.anatomy.model.gravity)
            needs.append(inertia * falling + velocity.cross(inertia * velocity))
        return self._sum(data, self._shank, needs)

    def on_shank(self, data: Any, external: Any) -> PointForces:
        """Return the sum of the external forces on the shank, at the insert's origin.

        If the tibia is fixed to the universe, it is the negative of the sum above the knee.
        `external` are forces on the joints, each in its joint's frame.
        """
        wrench = self._sum(data, self._shank, [external[joint] for joint in self._shank])
        return PointForces("tibia", np.zeros((1, 3)), wrench[None, :3], wrench[3:])

    def _sum(self, data: Any, joints: Sequence[int], forces: Sequence[pin.Force]) -> Array:
        """Return the sum (6,) about the insert's origin, insert frame."""
        insert = data.oMi[self.insert.joint] * self.insert.placement
        total = np.zeros(6)
        for joint, force in zip(joints, forces, strict=True):
            total += insert.actInv(data.oMi[joint]).act(force).vector
        total *= -1.0 if self.anatomy.fixed else 1.0
        return mirrored_spatial(total) if self.left else total

    def external_on(self, frame: FixedFrame | None, data: Any, external: Any) -> Array:
        """Return the external wrench (6,) on a frame's body, insert frame."""
        joint = 0 if frame is None else frame.joint
        if external is None or not joint:
            return np.zeros(6)
        insert = data.oMi[self.insert.joint] * self.insert.placement
        wrench = insert.actInv(data.oMi[joint]).act(external[joint]).vector
        return mirrored_spatial(wrench) if self.left else wrench

    def joint_forces(self, data: Any, loads: "dict[str, Array] | list[PointForces]") -> Any:
        """Return loads on the chain's links as forces on the user's joints.

        Args:
            loads: link -> wrench (6,) about the insert's origin, insert frame; or point forces.

        Returns:
            `pin.StdVec_Force`, one per joint, each in its joint's frame.
        """
        forces = [pin.Force.Zero()] * self.anatomy.model.njoints
        insert = data.oMi[self.insert.joint] * self.insert.placement
        for link, wrench in summed(loads).items():
            joint = self.joint_of(link)
            user_wrench = mirrored_spatial(wrench) if self.left else wrench
            force = data.oMi[joint].actInv(insert).act(pin.Force(user_wrench))
            forces[joint] = forces[joint] + force
        return pin.StdVec_Force(forces)

    def joint_of(self, link: str) -> int:
        """Return the user's joint that carries a link; a missing patella is part of the femur."""
        patella = self.anatomy.patella
        if link == "patella" and patella is not None:
            return patella.joint
        return self.insert.joint if link == "tibia" else self.component.joint

    def to_joint(self, data: Any, link: str) -> Array:
        """Return the matrix (6, 6) that maps a force from the insert frame to a link's joint."""
        insert = data.oMi[self.insert.joint] * self.insert.placement
        return np.asarray(data.oMi[self.joint_of(link)].actInv(insert).toDualActionMatrix())

    def _placed(self, pose: Array) -> pin.SE3:
        return se3(mirrored_pose(pose) if self.left else pose)

    def of_right_knee(self, placement: pin.SE3) -> Array:
        """Return a placement as a pose (4, 4); that of a left knee is mirrored."""
        return self._right(placement)

    def _right(self, placement: pin.SE3) -> Array:
        pose = placement.homogeneous
        return mirrored_pose(pose) if self.left else pose


def summed(loads: "dict[str, Array] | list[PointForces]") -> dict[str, Array]:
    """Return link -> sum (6,) about the insert's origin, insert frame."""
    if isinstance(loads, dict):
        return loads
    total: dict[str, Array] = {}
    if loads:
        for load, wrench in zip(loads, wrenches(loads), strict=True):
            total[load.link] = total.get(load.link, np.zeros(6)) + wrench
    return total


def _solved(jacobian: Array, twist: Array) -> Array:
    """Return joint rates for a twist (6,), by least squares if fewer than six."""
    if not (np.isfinite(jacobian).all() and np.isfinite(twist).all()):
        return np.full(jacobian.shape[1], np.nan)
    if jacobian.shape[1] == 6:
        return np.asarray(np.linalg.solve(jacobian, twist))
    return np.asarray(np.linalg.lstsq(jacobian, twist, rcond=None)[0])


def canonical_state(
    chain: Chain, motion: ChainMotion, shank: Array, thigh: Array, patella: Array
) -> ChainState:
    """Return the chain at one instant, with the shank's inertia from the user's model.

    The wrenches (6,) that inertia and weight of the shank require, and the external ones on thigh
    and patella, are in the insert frame.
    """
    state = chain.at(motion)
    needs = [("tibia", shank), ("femur", -thigh)]
    if "patella_ap" in chain.joints:
        needs.append(("patella", -patella))
    for link, wrench in needs:
        if wrench.any():
            state.add_need(link, wrench)
    return state
