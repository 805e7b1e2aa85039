"""The shipped knee inside a whole body: Pinocchio's sample humanoid with a leg of other names.

The leg hangs from the pelvis. Its knee is one free joint, and its foot is a separate body. The
world's z axis points up. A left leg is the mirror image. Poses and motion of the bodies are those
of the plain chain, which has its root at the tibia and y up.
"""

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

import tkamb
from tkamb.knee.canonical import mirrored_spatial
from tkamb.knee.load import link_point
from tkamb.units import STANDARD_GRAVITY

MIRROR = np.diag([1.0, 1.0, -1.0])
UPRIGHT = pin.SE3(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), np.array([0.3, -0.2, 0.1]))
"""Turns y up into z up, and moves the laboratory."""
NAMES = {"femur": "thigh_x", "tibia": "calf", "patella": "kneecap", "insert": "tray", "hip": "cup"}
FOOT = pin.Inertia(0.9, np.array([0.05, -0.03, 0.01]), np.diag([1e-3, 2e-3, 3e-3]))


def mirrored_se3(placement):
    rotation = MIRROR @ placement.rotation @ MIRROR
    return pin.SE3(rotation, MIRROR @ placement.translation)


def mirrored_inertia(inertia):
    return pin.Inertia(inertia.mass, MIRROR @ inertia.lever, MIRROR @ inertia.inertia @ MIRROR)


def unchanged(value):
    return value


@dataclass
class Body:
    """A whole body with the leg. `state` converts states of the plain chain."""

    model: pin.Model
    knee: tkamb.Knee
    left: bool
    plain: tkamb.Knee

    def state(self, q, v, a, external):
        """Return q, v, a and external forces of the body for those of the plain chain."""
        turn = mirrored_se3 if self.left else unchanged
        flip = mirrored_spatial if self.left else unchanged
        plain, data = self.plain, self.plain.model.createData()
        pin.forwardKinematics(plain.model, data, q, v, a)
        anatomy = plain.anatomy
        pose, twist, rate = {}, {}, {}
        for name in ("tibia", "femur", "patella"):
            fixed_frame = getattr(anatomy, name)
            pose[name] = UPRIGHT * turn(data.oMi[fixed_frame.joint] * fixed_frame.placement)
            twist[name], rate[name] = (
                pin.Motion(flip(fixed_frame.placement.actInv(derivative[fixed_frame.joint]).vector))
                for derivative in (data.v, data.a)
            )
        model = self.model
        q2, v2, a2 = (
            pin.randomConfiguration(model, -np.ones(model.nq), np.ones(model.nq)),
            np.zeros(model.nv),
            np.zeros(model.nv),
        )
        rng = np.random.default_rng(4)
        v2[:], a2[:] = 0.3 * rng.standard_normal(model.nv), rng.standard_normal(model.nv)
        joints = {n: model.joints[model.getJointId(n)] for n in model.names if n != "universe"}
        root, hip, knee = joints["root_joint"], joints["hip_ball"], joints["knee_free"]
        ankle = joints["ankle_hinge"]
        q2[ankle.idx_q] = v2[ankle.idx_v] = a2[ankle.idx_v] = 0.0
        # pose of the pelvis from the pose of the thigh
        turn_hip = pin.SE3(pin.Quaternion(q2[hip.idx_q : hip.idx_q + 4]).matrix(), np.zeros(3))
        hip_id, thigh = model.getJointId("hip_ball"), model.frames[model.getFrameId("thigh_x")]
        to_thigh = model.jointPlacements[hip_id] * turn_hip * thigh.placement
        q2[root.idx_q : root.idx_q + 7] = pin.SE3ToXYZQUAT(pose["femur"] * to_thigh.inverse())
        spin, spin_rate = np.zeros(6), np.zeros(6)
        spin[3:], spin_rate[3:] = v2[hip.idx_v :][:3], a2[hip.idx_v :][:3]
        relative_twist, relative_rate = (
            thigh.placement.actInv(pin.Motion(x)) for x in (spin, spin_rate)
        )
        v_root = to_thigh.act(twist["femur"] - relative_twist)
        a_root = to_thigh.act(rate["femur"] - relative_rate - twist["femur"].cross(relative_twist))
        v2[root.idx_v :][:6], a2[root.idx_v :][:6] = v_root.vector, a_root.vector
        for joint, name in ((knee, "tibia"), (joints["cap_free"], "patella")):
            relative = pose["femur"].actInv(pose[name])
            relative_twist = twist[name] - relative.actInv(twist["femur"])
            relative_rate = (
                rate[name] - relative.actInv(rate["femur"]) - twist[name].cross(relative_twist)
            )
            q2[joint.idx_q :][:7] = pin.SE3ToXYZQUAT(relative)
            v2[joint.idx_v :][:6], a2[joint.idx_v :][:6] = (
                relative_twist.vector,
                relative_rate.vector,
            )
        forces = [pin.Force.Zero() for _ in range(model.njoints)]
        fixed_frame = anatomy.tibia
        ground = fixed_frame.placement.actInv(external[fixed_frame.joint])
        ankle_id = model.getJointId("ankle_hinge")
        forces[ankle_id] = model.jointPlacements[ankle_id].actInv(pin.Force(flip(ground.vector)))
        return q2, v2, a2, pin.StdVec_Force(forces)


def whole_body(plain, left=False, leg_first=False):
    """Return the sample humanoid with the leg of a plain chain's knee."""
    turn, weigh = (mirrored_se3, mirrored_inertia) if left else (unchanged, unchanged)
    anatomy, user = plain.anatomy, plain.model
    model = pin.Model() if leg_first else pin.buildSampleModelHumanoid()
    if leg_first:
        root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    else:
        root = model.getJointId("root_joint")
    hip = turn(pin.SE3(np.eye(3), (anatomy.hip.placement).translation))
    on_thigh = pin.SE3(pin.utils.rpyToMatrix(0.3, -0.2, 0.5), np.array([0.01, 0.02, -0.03]))
    # the joint's frame is at the hip; the thigh's frame is shifted
    thigh = hip.inverse()
    ball = model.addJoint(
        root, pin.JointModelSpherical(), pin.SE3(np.eye(3), np.array([0, 0.1, -0.1])), "hip_ball"
    )
    femur = anatomy.femur
    inertia = user.inertias[femur.joint].se3Action(femur.placement.inverse())
    model.appendBodyToJoint(ball, weigh(inertia), thigh)
    frame(model, "thigh_x", ball, thigh)
    frame(model, "cup", ball, pin.SE3.Identity())
    cap = model.addJoint(ball, pin.JointModelFreeFlyer(), thigh, "cap_free")
    inertia = user.inertias[anatomy.patella.joint].se3Action(anatomy.patella.placement.inverse())
    model.appendBodyToJoint(cap, weigh(inertia), pin.SE3.Identity())
    frame(model, "kneecap", cap, pin.SE3.Identity())
    shank = model.addJoint(ball, pin.JointModelFreeFlyer(), thigh, "knee_free")
    ankle = model.addJoint(shank, pin.JointModelRX(), on_thigh, "ankle_hinge")
    shank_inertia = weigh(
        user.inertias[anatomy.tibia.joint].se3Action(anatomy.tibia.placement.inverse())
    )
    shank_parameters = (
        shank_inertia.toDynamicParameters() - FOOT.se3Action(on_thigh).toDynamicParameters()
    )
    model.appendBodyToJoint(
        shank, pin.Inertia.FromDynamicParameters(shank_parameters), pin.SE3.Identity()
    )
    model.appendBodyToJoint(ankle, FOOT, pin.SE3.Identity())
    frame(model, "calf", shank, pin.SE3.Identity())
    tray = turn(anatomy.tibia.placement.inverse() * plain.bridge.insert.placement)
    frame(model, "tray", shank, tray)
    if leg_first:
        for k in range(20):
            base = root if k % 5 == 0 else model.njoints - 1
            arm = model.addJoint(base, pin.JointModelRY(), pin.SE3.Random(), f"arm_{k}")
            model.appendBodyToJoint(arm, pin.Inertia.Random(), pin.SE3.Identity())
    model.gravity = pin.Motion(np.array([0, 0, -STANDARD_GRAVITY]), np.zeros(3))
    plane = turn(anatomy.femur.placement.inverse() * anatomy.plane.placement)
    return Body(model, other_knee(plain, model, left, plane), left, plain)


def frame(model, name, joint, placement):
    model.addFrame(pin.Frame(name, joint, 0, placement, pin.FrameType.BODY))


def moved(point, left):
    link = NAMES[point.link]
    return (link, tuple(MIRROR @ point.position if left else point.position))


def other_knee(plain, model, left, plane):
    """Return the same knee on another model, with meshes as trimesh objects or arrays."""
    surfaces = [plain.femoral, plain.insert, plain.button]
    if left:
        surfaces = [item.mirrored() for item in surfaces]
    femoral, insert, button = ((item.vertices, item.faces) for item in surfaces)
    bundles = [
        replace(item, proximal=moved(item.proximal, left), distal=moved(item.distal, left))
        for item in plain.ligaments
    ]
    button_contact, method = plain.button_contact, plain.patella
    muscle, line = plain.extensor.quadriceps, plain.extensor.patellar_ligament
    extensor = tkamb.Extensor(
        replace(muscle, points=tuple(moved(point, left) for point in muscle.points)),
        replace(line, proximal=moved(line.proximal, left), distal=moved(line.distal, left)),
        plane=plane,
        solved=plain.extensor.solved,
    )
    return tkamb.Knee(
        model,
        side="left" if left else "right",
        implant=tkamb.Implant(surfaces[0].mesh if not left else femoral, insert, button),
        ligaments=bundles,
        extensor=extensor,
        contact=None if plain.contact is None else plain.contact.model,
        muscles=[
            replace(muscle, points=tuple(moved(link_point(point), left) for point in muscle.points))
            for muscle in plain.muscles
        ],
        friction=plain.friction,
        frames=NAMES,
        joints=["knee_free"],
        patellofemoral_contact=None if button_contact is None else button_contact.contact.model,
        released_patella=() if method is None else method.released,
        head_shares=None if method is None else {one.name: one.share for one in method.heads},
    )
