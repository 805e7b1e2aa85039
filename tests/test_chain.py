"""The chain's inverse dynamics against MuJoCo, balance of momentum, and virtual work."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from knees import leg, random_motion
from tkamb.geometry.frames import inverse, rotate, transform
from tkamb.knee import unknowns
from tkamb.knee.load import PointForces, total_wrench
from tkamb.knee.unknowns import Unknown, solve


def mujoco_twin(chain):
    """Return the chain as a MuJoCo model: one body per link, with the joints of this link."""
    model = chain.model
    bodies = {"tibia": ("root_joint",), "femur": chain.joints[:6], "patella": chain.joints[6:]}
    text, closing = "", ""
    for name, joints in bodies.items():
        last = model.getJointId(joints[-1])
        first = model.getJointId(joints[0])
        placement = model.jointPlacements[first]
        quaternion = pin.Quaternion(placement.rotation)
        quaternion_text = f"{quaternion.w!r} {quaternion.x!r} {quaternion.y!r} {quaternion.z!r}"
        inertia = model.inertias[last]
        i = inertia.inertia
        text += f'<body name="{name}" pos="{_t(placement.translation)}" quat="{quaternion_text}">'
        text += (
            f'<inertial pos="{_t(inertia.lever)}" mass="{inertia.mass!r}" '
            f'fullinertia="{_t([i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]])}"/>'
        )
        if name == "tibia":
            text += "<freejoint/>"
        else:
            for joint in joints:
                kind = "slide" if joint.endswith(("_ap", "_si", "_ml")) else "hinge"
                axis = {"knee_axial_rotation": "0 -1 0", "knee_adduction": "-1 0 0"}.get(joint)
                axis = axis or {"_ap": "1 0 0", "_si": "0 1 0", "_ml": "0 0 1"}.get(joint[-3:])
                text += f'<joint name="{joint}" type="{kind}" axis="{axis or "0 0 1"}"/>'
        closing += "</body>"
    return mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian" boundmass="0"/><option gravity="0 -9.80665 0"/>'
        f"<worldbody>{text}{closing}</worldbody></mujoco>"
    )


def _t(values):
    return " ".join(repr(float(v)) for v in values)


def mujoco_state(state, data):
    """Set a state of the chain in MuJoCo's data; return a function that converts forces (n,)."""
    root = Rotation.from_quat(state.q[3:7]).as_matrix()
    data.qpos[:] = np.r_[state.q[:3], state.q[6], state.q[3:6], state.q[7:]]
    data.qvel[:] = np.r_[root @ state.v[:3], state.v[3:]]
    # MuJoCo's linear acceleration is the world-frame derivative of the origin's velocity.
    classical = state.a[:3] + np.cross(state.v[3:6], state.v[:3])
    data.qacc[:] = np.r_[root @ classical, state.a[3:]]
    return lambda force: np.r_[root.T @ force[:3], force[3:]]


def test_rnea_agrees_with_mujoco_over_200_random_states():
    chain = leg()
    twin = mujoco_twin(chain)
    data = mujoco.MjData(twin)
    rng = np.random.default_rng(7)
    worst = 0.0
    for _ in range(200):
        state = chain.at(random_motion(chain, rng))
        to_chain = mujoco_state(state, data)
        mujoco.mj_inverse(twin, data)
        worst = max(worst, np.abs(to_chain(data.qfrc_inverse) - state.inertial).max())
    assert worst < 1e-9


def test_a_locked_patella_moves_with_the_femur():
    """A patella at rest on the femur gives the forces of a chain without patella."""
    free, locked = leg(True), leg(False)
    rng = np.random.default_rng(3)
    motion = random_motion(locked, rng)
    joints = np.hstack([motion.joints, np.zeros((3, 3))])
    with_patella = type(motion)(
        motion.tibia, motion.tibia_velocity, motion.tibia_acceleration, joints
    )
    np.testing.assert_allclose(
        locked.at(motion).inertial, free.at(with_patella).inertial[:12], rtol=0, atol=1e-9
    )


def all_unknowns(state, rng):
    """Return a full set of 15 unknowns with arbitrary but separated lines of action."""
    point = state.point("femur", np.zeros(3))

    def condyle_point(z):
        normal = np.array([0.1, 1.0, 0.05 * np.sign(z)]) + 0.05 * rng.normal(size=3)
        return unknowns.CondylePoint(
            np.array([-0.005, 0.009, z]), normal / np.linalg.norm(normal), rng.normal(size=3), 0.0
        )

    femur = state.pose("femur")
    quadriceps = _line(state, ("femur", [0.03, 0.2, 0.01]), ("patella", [0.0, 0.02, 0.0]))
    ligament = _line(state, ("patella", [0.0, -0.02, 0.0]), ("tibia", [0.05, 0.34, 0.0]))
    contact = state.point("patella", np.array([-0.012, -0.003, 0.0]))
    normal = rotate(femur, np.array([0.99, 0.14, 0.0]) / np.hypot(0.99, 0.14))
    unknown_loads = unknowns.hip(state.point("hip", np.zeros(3)))
    unknown_loads += [Unknown("quadriceps", quadriceps), Unknown("patellar_ligament", ligament)]
    unknown_loads += unknowns.patellofemoral(contact, normal, femur[:3, 2])
    unknown_loads += [unknowns.condyle("medial", condyle_point(-0.023), 0.05)]
    unknown_loads += [unknowns.condyle("lateral", condyle_point(0.022), 0.05)]
    unknown_loads += unknowns.residuals(point, lifted=False, extensor=True)
    return unknown_loads


def _line(state, start, end):
    a = state.point(start[0], np.array(start[1]))
    b = state.point(end[0], np.array(end[1]))
    direction = (b - a) / np.linalg.norm(b - a)
    return (
        PointForces(start[0], a[None], direction[None]),
        PointForces(end[0], b[None], -direction[None]),
    )


def test_all_loads_together_give_the_rate_of_momentum_of_the_leg():
    """Internal loads cancel: hip and ground, with gravity, change the momentum."""
    chain = leg()
    rng = np.random.default_rng(11)
    regular_states = 0
    for _ in range(20):
        motion = random_motion(chain, rng)
        state = chain.at(motion)
        force, point, moment = (rng.normal(size=3) * size for size in (400.0, 1.0, 5.0))
        in_insert = state.laboratory_in_insert
        ground = PointForces(
            "tibia",
            transform(in_insert, point)[None],
            rotate(in_insert, force)[None],
            rotate(in_insert, moment),
        )
        unknown_loads = all_unknowns(state, rng)
        columns = state.generalised([unknown.loads for unknown in unknown_loads])
        right = state.inertial - state.generalised([[ground]])[:, 0]
        solution = solve([unknown.name for unknown in unknown_loads], columns, right)
        if not solution.regular:  # a random line may pass through the joint's axis
            continue
        regular_states += 1
        loads = [ground]
        for unknown in unknown_loads:
            x = solution.values[unknown.name]
            loads += [
                PointForces(part.link, part.points, part.forces * x, part.moment * x)
                for part in unknown.loads
            ]
        origin = np.zeros(3)
        applied = total_wrench(loads, origin)
        expected = _momentum_rate(chain, state, origin)
        assert np.linalg.norm(applied - expected) < 1e-8 * np.linalg.norm(expected)
    assert regular_states >= 15


def _momentum_rate(chain, state, origin_in_insert):
    """Return d(momentum)/dt minus gravity about a fixed point, insert axes, by Pinocchio."""
    data = chain.model.createData()
    pin.computeCentroidalMomentumTimeVariation(chain.model, data, state.q, state.v, state.a)
    mass = pin.computeTotalMass(chain.model)
    force = data.dhg.linear - mass * chain.model.gravity.linear
    centre = transform(inverse(state.insert_in_laboratory), data.com[0]) - origin_in_insert
    turn = state.insert_in_laboratory[:3, :3]
    return np.r_[force @ turn, data.dhg.angular @ turn + np.cross(centre, force @ turn)]


def test_every_column_is_the_virtual_work_of_its_load():
    chain = leg()
    rng = np.random.default_rng(5)
    motion = random_motion(chain, rng)
    state = chain.at(motion)
    for unknown in all_unknowns(state, rng):
        analytic = state.generalised([unknown.loads])[:, 0]
        numeric = np.zeros(chain.model.nv)
        for index in range(chain.model.nv):
            numeric[index] = sum(_virtual_work(chain, state, load, index) for load in unknown.loads)
        np.testing.assert_allclose(analytic, numeric, rtol=0, atol=2e-8, err_msg=unknown.name)


def test_internal_loads_do_not_act_on_the_free_root():
    """Only the hip's loads have a component along the free root, by action and reaction."""
    chain = leg()
    rng = np.random.default_rng(6)
    state = chain.at(random_motion(chain, rng))
    for unknown in all_unknowns(state, rng):
        root_force = state.generalised([unknown.loads])[:6, 0]
        if unknown.name.startswith("hip"):
            assert np.abs(root_force).max() > 0.1
        else:
            np.testing.assert_allclose(root_force, 0.0, atol=1e-12, err_msg=unknown.name)


def _virtual_work(chain, state, load, index, step=1e-6):
    """Return dW/dq of a load with constant forces in the laboratory at points fixed to the link."""
    model = chain.model
    frame = chain.frame_id(load.link)
    to_laboratory = state.insert_in_laboratory
    forces = load.forces @ to_laboratory[:3, :3].T
    moment = to_laboratory[:3, :3] @ load.moment
    points = transform(to_laboratory, load.points)
    placements = []
    for sign in (1, -1):
        direction = np.zeros(model.nv)
        direction[index] = sign * step
        data = model.createData()
        pin.framesForwardKinematics(model, data, pin.integrate(model, state.q, direction))
        placements.append(data.oMf[frame].homogeneous.copy())
    local = transform(inverse(state.data.oMf[frame].homogeneous), points)
    shift = (transform(placements[0], local) - transform(placements[1], local)) / (2 * step)
    spin = Rotation.from_matrix(placements[0][:3, :3] @ placements[1][:3, :3].T).as_rotvec()
    return float((shift * forces).sum() + moment @ spin / (2 * step))


def test_a_missing_link_is_named():
    with pytest.raises(Exception, match=r"no link .fibula.*tibia"):
        leg().frame_id("fibula")


def test_the_insert_frame_is_the_origin_of_knee_ap():
    chain = leg()
    expected = Rotation.from_euler("xyz", [0, 0.02, 0.05]).as_matrix()
    np.testing.assert_allclose(chain.insert_in_tibia[:3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(chain.insert_in_tibia[:3, 3], [-0.005, 0.39, 0.002], atol=1e-12)


def test_the_patella_joint_is_the_pose_at_zero_coordinates():
    chain = leg()
    motion = random_motion(chain, np.random.default_rng(3))
    motion.joints[0, 6:] = 0.0
    state = chain.at(motion)
    patella_in_femur = inverse(state.pose("femur")) @ state.pose("patella")
    np.testing.assert_allclose(chain.patella_joint_in_femur, patella_in_femur, atol=1e-12)
    assert patella_in_femur[2, 3] == pytest.approx(1e-3)
