"""Forward dynamics with tkamb.Knee: a dropped femur, a simulator that converges, friction."""

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from test_knee import FOUNDATION, SCENE, at, pressed
from tkamb.errors import ComputationError
from tkamb.knee.integrate import implicit_step

MASS, HEIGHT = 60.0, 1e-3
"""kg and m: mass of the femur with its load, and the height of the drop."""


@pytest.fixture(scope="module")
def plain():
    return tkamb.read_scene(tkamb.load_scene(SCENE, FOUNDATION))


def on_fixed_insert(plain, joints, coordinates, mass, **parts):
    """Return a knee with its insert fixed to the universe and its femur on a chain of joints."""
    model = pin.Model()
    model.gravity = pin.Motion(np.array([0.0, -9.81, 0.0]), np.zeros(3))
    model.addFrame(pin.Frame("tibia", 0, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    joint, placement = 0, pin.SE3(np.eye(3), np.array([coordinates[0], 0.0, coordinates[2]]))
    for name, kind in joints.items():
        joint = model.addJoint(joint, kind, placement, name)
        placement = pin.SE3.Identity()
    bent = pin.SE3(pin.utils.rotate("z", coordinates[5]), np.zeros(3))
    inertia = pin.Inertia(mass, np.array([0.0, 0.02, 0.0]), 2e-3 * mass * np.eye(3))
    model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    model.addFrame(pin.Frame("femur", joint, 0, bent, pin.FrameType.BODY))
    implant = tkamb.Implant(plain.femoral, plain.insert)
    model_of_contact = tkamb.contact_model("foundation", resolution=3e-3)
    return tkamb.Knee(model, implant=implant, contact=model_of_contact, **parts)


def drop(plain, step, seconds):
    """Return the change of energy (n,), J, of a femur that bounces on the insert."""
    joints = {"slide": pin.JointModelPY()}
    knee = on_fixed_insert(plain, joints, [-6.9e-3, 0, 0, 0, 0, 0.3], MASS)
    touch = knee.contact.pair.first_touch_height(knee.pose(np.zeros(1)).homogeneous)
    depth = np.linspace(0.0, 6e-4, 1201)
    force = [knee.evaluate(np.array([touch - d])).wrench_on_insert[1] for d in depth]
    strain_energy = -np.cumsum(np.concatenate([[0.0], (np.array(force)[1:] + force[:-1]) / 2.0]))
    strain_energy *= depth[1]
    q, v, data = np.array([touch + HEIGHT]), np.zeros(1), knee.create_data()
    energies = []
    for _ in range(round(seconds / step)):
        q, v = implicit_step(knee, q, v, step, data=data)
        height = q[0] - touch
        energies.append(
            MASS * (0.5 * v[0] ** 2 + 9.81 * height)
            + np.interp(-height, depth, strain_energy, left=0.0)
        )
    return np.array(energies) / (MASS * 9.81 * HEIGHT)


def test_a_dropped_femur_keeps_its_energy_to_the_order_of_the_scheme(plain):
    """With half of the step the error is about a quarter, and slightly larger at kinks."""
    coarse, fine = (np.abs(drop(plain[0], h, 0.1) - 1.0).max() for h in (1e-3, 5e-4))
    assert coarse < 0.15
    assert fine < coarse / 3.0


@pytest.mark.slow
def test_a_dropped_femur_keeps_its_energy_over_a_second(plain):
    energy = drop(plain[0], 2.5e-4, 1.0)
    assert abs(energy[-len(energy) // 4 :].mean() - 1.0) < 1e-3


def test_a_simulator_converges_to_the_equilibrium(plain):
    """The simulator has constant flexion, a load on a fixed line, and four free coordinates."""
    read, motion, _ = plain
    bundles = [b for b in read.ligaments if {b.proximal.link, b.distal.link} == {"femur", "tibia"}]
    shift = read.anatomy.tibia.placement.inverse() * read.bridge.insert.placement
    initial_coordinates = read.coordinates(motion.q[30])
    joints = {
        "ap": pin.JointModelPX(),
        "si": pin.JointModelPY(),
        "ml": pin.JointModelPZ(),
        "turn": pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0])),
        "tilt": pin.JointModelRevoluteUnaligned(np.array([-1.0, 0.0, 0.0])),
    }
    at_insert = [shifted(bundle, shift) for bundle in bundles]
    knee = on_fixed_insert(read, joints, initial_coordinates, 4.0, ligaments=at_insert)
    model = knee.model
    model.gravity = pin.Motion.Zero()
    load = pin.Force(np.array([0.0, -800.0, 0.0]), np.array([0.0, 0.0, 800.0 * 4e-3]))

    def external(q):
        data = model.createData()
        pin.forwardKinematics(model, data, q)
        forces = [pin.Force.Zero() for _ in range(model.njoints)]
        forces[-1] = data.oMi[model.njoints - 1].actInv(load)
        return pin.StdVec_Force(forces)

    q, v, data = np.zeros(5), np.zeros(5), knee.create_data()
    q[1] = knee.press(q, 800.0).pose.translation[1]
    drag = np.array([800.0, 3000.0, 800.0, 3.0, 3.0])
    for _ in range(150):
        q, v = implicit_step(
            knee, q, v, 0.02, fext=external(q), theta=1.0, friction_of_joints=drag, data=data
        )
    assert np.abs(v).max() < 1e-6
    equilibrium = knee.equilibrium(q + 1e-4, 0 * v, 0 * v, external(q + 1e-4))
    assert not equilibrium.failed
    coordinates = knee.coordinates(q)
    assert coordinates[:3] == pytest.approx(equilibrium.coordinates[:3], abs=2e-5)
    assert coordinates[3:] == pytest.approx(equilibrium.coordinates[3:], abs=2e-4)
    assert equilibrium.loads.contact_force[1] > 800.0
    # the simulator's forces balance all loads except the prescribed load
    forces = knee.external_forces(q, 0 * v)
    tau = pin.rnea(model, model.createData(), q, v, 0 * v, forces)
    assert np.abs(tau).max() == pytest.approx(800.0, rel=1e-3)


def shifted(bundle, shift):
    """Return a bundle with its distal end in the insert's frame, fixed to the universe."""
    from dataclasses import replace

    ends = [
        ("tibia", tuple(shift.actInv(end.position))) if end.link == "tibia" else
        ("femur", tuple(end.position))
        for end in (bundle.proximal, bundle.distal)
    ]  # fmt: skip
    return replace(bundle, proximal=ends[0], distal=ends[1])


def test_a_linear_step_agrees_with_a_full_step_to_second_order(plain):
    read = plain[0]
    parts = {"implant": read.implant, "contact": read.contact.model, "friction": 0.05}
    knee = tkamb.Knee(read.model, ligaments=read.ligaments, **parts)
    q, v, _, external = at(plain, 60)
    q, differences = pressed(read, q, 1000.0), []
    for step in (2e-4, 1e-4):
        ends = [
            implicit_step(knee, q, v, step, fext=external, theta=1.0, linear=linear)[1]
            for linear in (False, True)
        ]
        differences.append(float(np.abs(ends[0] - ends[1]).max()))
    assert differences[1] < 0.4 * differences[0]


def test_friction_only_dissipates(plain):
    read = plain[0]
    bare = tkamb.Knee(read.model, implant=read.implant, contact=read.contact.model)
    rough = tkamb.Knee(read.model, implant=read.implant, contact=read.contact.model, friction=0.1)
    rng, q = np.random.default_rng(3), pressed(read, at(plain, 60)[0], 1200.0)
    zero, powers = np.zeros(read.model.nv), []
    for _ in range(20):
        v = rng.standard_normal(read.model.nv) * rng.choice([1e-4, 1e-2, 1.0])
        taus = [
            -pin.rnea(read.model, read.model.createData(), q, zero, zero, k.external_forces(q, v))
            for k in (rough, bare)
        ]
        powers.append(float((taus[0] - taus[1]) @ v))
    assert max(powers) <= 1e-9
    assert min(powers) < -1.0


def test_damping_is_the_slope_of_the_friction(plain):
    read = plain[0]
    q, v = pressed(read, at(plain, 60)[0], 1200.0), at(plain, 60)[1]
    rough = tkamb.Knee(read.model, implant=read.implant, contact=read.contact.model, friction=0.1)
    jacobian, tibia = rough.relative_jacobian(q), rough.anatomy.tibia.joint
    step = np.zeros(read.model.nv)
    step[6:12] = 1e-6 * np.random.default_rng(2).standard_normal(6)
    ends = [rough.external_forces(q, v + sign * step)[tibia] for sign in (1.0, -1.0)]
    insert = rough.bridge.insert.placement
    slope = insert.actInv(ends[0] - ends[1]).vector / 2.0
    change = rough.damping(q, v) @ jacobian @ step
    assert change == pytest.approx(slope, rel=1e-4, abs=1e-7)
    assert np.linalg.norm(change) > 1e-6
    assert change @ jacobian @ step > 0.0  # friction on the insert follows the femur


def test_a_step_that_is_too_long_is_refused(plain):
    knee = on_fixed_insert(
        plain[0], {"slide": pin.JointModelPY()}, [-6.9e-3, 0, 0, 0, 0, 0.3], MASS
    )
    touch = knee.contact.pair.first_touch_height(knee.pose(np.zeros(1)).homogeneous)
    with pytest.raises(ComputationError):
        implicit_step(knee, np.array([touch]), np.array([-0.1]), 0.1)
