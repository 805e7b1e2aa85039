"""tkamb.Knee from files, from objects and in a whole body; its forces and stiffness."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from knee_bodies import MIRROR, whole_body
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import cross, displaced, inverse

SCENE = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "scene.toml"
FOUNDATION = {"contact.model": "foundation", "contact.resolution_mm": 2.0}
FRAMES = slice(15, 101, 30)
MODELS = ("hertz", "foundation", "foundation-linear", "lattice", "lattice-linear", "fe")


@pytest.fixture(scope="module")
def scene():
    return tkamb.load_scene(SCENE, FOUNDATION)


@pytest.fixture(scope="module")
def read(scene):
    return tkamb.read_scene(scene)


def at(read, k):
    """Return q, v, a and the ground reaction of a frame."""
    _, motion, ground = read
    return motion.q[k], motion.v[k], motion.a[k], ground[k]


def plus(*forces):
    """Return the sum of forces on joints."""
    total = [pin.Force.Zero() for _ in forces[0]]
    for part in forces:
        total = [one + other for one, other in zip(total, part, strict=True)]
    return pin.StdVec_Force(total)


def columns(loads):
    """Return the columns of results.csv that loads contain."""
    ap, si, ml = -loads.contact_force
    row = {
        "force_ap_N": ap,
        "force_si_N": -si,
        "force_ml_N": ml,
        "quadriceps_N": loads.quadriceps,
        "patellar_ligament_N": loads.patellar_ligament,
        "patellofemoral_N": loads.patellofemoral,
        "patellofemoral_tangential_N": loads.patellofemoral_tangential,
        "residual_ap_N": loads.residuals["ap"],
        "residual_ml_N": loads.residuals["ml"],
        "residual_axial_Nm": loads.residuals["axial"],
        "condition_number": loads.condition,
        "external_flexion_moment_Nm": loads.external_flexion,
        "external_adduction_moment_Nm": loads.external_adduction,
        "medial_force_equilibrium_N": loads.normal_force["medial"],
        "lateral_force_equilibrium_N": loads.normal_force["lateral"],
    }
    for name, tension in loads.ligaments.items():
        row[f"ligament_{name}_N"] = tension
    for axis, force, moment in zip(
        ("ap", "si", "ml"), loads.hip_force, loads.hip_moment, strict=True
    ):
        row |= {f"hip_force_{axis}_N": force, f"hip_moment_{axis}_Nm": moment}
    return row


VARIANTS = {
    "foundation": FOUNDATION,
    "lattice": {"contact.model": "lattice", "contact.resolution_mm": 4.0},
    "filtered": FOUNDATION | {"motion.cutoff_Hz": 1.0, "patella.motion": "solved"},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_files_and_object_give_the_same_columns(variant):
    scene = tkamb.load_scene(SCENE, VARIANTS[variant])
    read = tkamb.read_scene(scene)
    knee, motion, _ = read
    results = tkamb.simulate(scene, frames=FRAMES)
    data = knee.create_data()
    for row, k in enumerate(range(*FRAMES.indices(len(motion)))):
        loads = knee.inverse_dynamics(*at(read, k))
        for name, value in columns(loads).items():
            assert value == pytest.approx(results[name][row], rel=1e-9, abs=1e-9), name
        pressed = knee.press(motion.q[k], loads.contact_force[1], data)
        tolerance = 1e-6 if variant == "lattice" else 1e-9
        for side in ("medial", "lateral"):
            condyle = getattr(pressed, side)
            force, peak = results[f"{side}_force_N"][row], results[f"{side}_peak_pressure_MPa"][row]
            assert condyle.force == pytest.approx(force, rel=tolerance)
            assert condyle.peak_pressure == pytest.approx(1e6 * peak, rel=tolerance)


@pytest.mark.parametrize("left", [False, True])
@pytest.mark.parametrize("leg_first", [False, True])
def test_a_whole_body_has_the_same_knee_forces(read, left, leg_first):
    plain = read[0]
    body = whole_body(plain, left, leg_first)
    assert body.model.njoints > 25
    flip = MIRROR if left else np.eye(3)
    for k in (40, 80):
        state = body.state(*at(read, k))
        in_body, alone = body.knee.inverse_dynamics(*state), plain.inverse_dynamics(*at(read, k))
        assert in_body.contact_force == pytest.approx(flip @ alone.contact_force, abs=1e-9)
        assert in_body.hip_force == pytest.approx(flip @ alone.hip_force, abs=1e-9)
        assert in_body.hip_moment == pytest.approx(-flip @ alone.hip_moment * (1 if left else -1))
        for name in ("quadriceps", "patellar_ligament", "patellofemoral", "external_adduction"):
            assert getattr(in_body, name) == pytest.approx(getattr(alone, name), abs=1e-9)
        signs = (
            {"ap": 1.0, "ml": -1.0, "axial": -1.0}
            if left
            else dict.fromkeys(("ap", "ml", "axial"), 1.0)
        )
        for name, value in alone.residuals.items():
            assert in_body.residuals[name] == pytest.approx(signs[name] * value, abs=1e-9)
        body_forces, plain_forces = (
            knee.external_forces(q, v, 800.0)
            for knee, (q, v) in ((body.knee, state[:2]), (plain, at(read, k)[:2]))
        )
        tibia = plain.anatomy.tibia
        expected = tibia.placement.actInv(plain_forces[tibia.joint]).vector
        expected = expected * (np.array([1, 1, -1, -1, -1, 1]) if left else 1.0)
        calf = body.knee.anatomy.tibia
        assert calf.placement.actInv(body_forces[calf.joint]).vector == pytest.approx(
            expected, abs=1e-8
        )


def test_rnea_with_the_solved_loads_leaves_the_residuals(read):
    knee = read[0]
    for k in (20, 60, 100):
        q, v, a, external = at(read, k)
        loads = knee.inverse_dynamics(q, v, a, external)
        data = knee.model.createData()
        # residuals act on the tibia, opposite loads on the femur
        jacobian, on_tibia = knee.relative_jacobian(q), residual_wrench(knee, loads)
        acting = plus(external, loads.external_forces, loads.hip_forces)
        tau = pin.rnea(knee.model, data, q, v, a, acting)
        assert np.abs(tau).max() > 1.0
        assert tau == pytest.approx(-jacobian.T @ on_tibia, abs=1e-8)
        with_residuals = plus(
            external, loads.external_forces, loads.residual_forces, loads.hip_forces
        )
        assert pin.rnea(knee.model, data, q, v, a, with_residuals) == pytest.approx(0.0, abs=1e-8)


def residual_wrench(knee, loads):
    """Return the wrench (6,) of the reported residuals on the tibia, about the insert's origin."""
    residuals = loads.residuals
    middle = np.mean([one.point for one in loads.geometry.condyles.values()], axis=0)
    force = np.array([residuals["ap"], 0.0, residuals["ml"]])
    moment = np.array(
        [residuals.get("coronal", 0.0), residuals["axial"], residuals.get("flexion", 0.0)]
    )
    return np.concatenate([force, moment + cross(middle, force)])


def test_forces_on_the_joints_are_internal(read):
    """The sum of contact, ligaments and extensor mechanism on the whole leg is zero."""
    knee, motion, _ = read
    q, v = motion.q[60], motion.v[60]
    forces = knee.external_forces(q, v, 1000.0)
    data = knee.model.createData()
    pin.forwardKinematics(knee.model, data, q)
    total = sum(
        (data.oMi[j].act(forces[j]).vector for j in range(1, knee.model.njoints)), np.zeros(6)
    )
    assert np.abs(forces[1].vector).max() > 100.0
    assert total == pytest.approx(0.0, abs=1e-9)


def test_the_pull_of_the_ligaments_is_the_slope_of_their_energy(read):
    """Without contact the generalised force is minus the slope of the bundles' energy."""
    plain, motion, _ = read
    toe = [replace(one, law=tkamb.QuadraticToe(stiffness=2e3)) for one in plain.ligaments]
    knee = tkamb.Knee(plain.model, ligaments=toe)
    q, v = motion.q[50].copy(), np.zeros(knee.model.nv)
    tau = -pin.rnea(knee.model, knee.model.createData(), q, v, v, knee.external_forces(q, v))
    tau += pin.rnea(knee.model, knee.model.createData(), q, v, v)

    def energy(moved):
        data = knee.model.createData()
        pin.framesForwardKinematics(knee.model, data, moved)
        total = 0.0
        for one in toe:
            ends = [
                data.oMf[knee.model.getFrameId(end.link)].act(end.position)
                for end in (one.proximal, one.distal)
            ]
            length = np.linalg.norm(ends[0] - ends[1])
            lengths = np.linspace(one.slack_length, max(length, one.slack_length), 2001)
            total += np.trapezoid(one.force(lengths), lengths)
        return total

    for column in knee.chain.knee_columns():
        step = np.zeros(knee.model.nv)
        step[column] = 1e-6
        slope = (
            energy(pin.integrate(knee.model, q, step)) - energy(pin.integrate(knee.model, q, -step))
        ) / 2e-6
        assert tau[column] == pytest.approx(-slope, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("name", MODELS)
def test_stiffness_is_the_slope_of_the_wrench(read, name):
    plain, motion, _ = read
    knee = tkamb.Knee(
        plain.model,
        implant=plain.implant,
        ligaments=plain.ligaments,
        contact=tkamb.contact_model(name, resolution=3e-3),
        friction=0.05,
    )
    q, v = pressed(knee, motion.q[60], 1200.0), motion.v[60]
    stiffness = knee.stiffness(q, v)
    contact = knee.contact
    probe = contact.precise_probe()
    femur_pose = knee.pose(q).homogeneous
    twist = knee.relative_jacobian(q) @ v
    contact.at(probe, femur_pose)
    rng = np.random.default_rng(1)
    # The curvatures of Hertz's ellipses jump from facet to facet. Nodes come into contact less than
    # 1e-6 m away, and the lattices and fe end at a residual that a much shorter step divides.
    size, share = (1e-9, 1e-5) if contact.model.probe(contact.state).exact else (1e-7, 2e-3)
    size, share = (3e-6, 0.05) if name == "hertz" else (size, share)
    for _ in range(3):
        step = size * rng.standard_normal(6) / np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03])
        ends = []
        for sign in (1.0, -1.0):
            moved = displaced(femur_pose, sign * step)
            wrench = contact.wrench(contact.at(probe, moved), twist)
            ends.append(wrench + knee._crossing.wrench(moved))
        slope, predicted = (ends[0] - ends[1]) / 2.0, stiffness @ step
        scale = share * np.linalg.norm(slope[:3])
        assert predicted[:3] == pytest.approx(slope[:3], abs=scale), name
        assert predicted[3:] == pytest.approx(slope[3:], abs=0.03 * scale), name


def pressed(knee, q, load):
    """Return q with the femur raised or lowered until the contact carries a load, N."""
    result = knee.press(q, load)
    q = q.copy()
    q[knee.model.joints[knee.model.getJointId("knee_si")].idx_q] += (
        result.pose.translation[1] - knee.coordinates(q)[1]
    )
    return q


def test_a_left_knee_is_as_stiff_as_its_mirror_image(read):
    plain = read[0]
    body = whole_body(plain, left=True)
    q, v, a, external = at(read, 70)
    state = body.state(q, v, a, external)
    flip = np.diag([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
    expected = flip @ plain.stiffness(q, v, exact=False) @ flip
    stiffness = body.knee.stiffness(*state[:2], exact=False)
    assert stiffness == pytest.approx(expected, rel=1e-6, abs=1e-3 * np.abs(expected).max())


def test_in_equilibrium_the_residual_is_small_and_the_contact_carries_the_loads(read):
    knee, motion, _ = read
    k = 75
    equilibrium = knee.equilibrium(*at(read, k))
    assert not equilibrium.failed
    assert equilibrium.residual < 0.06
    assert knee.coordinates(equilibrium.q) == pytest.approx(equilibrium.coordinates, abs=1e-11)
    by_deformation = -equilibrium.contact.wrench_on_insert[:3]
    frictionless = equilibrium.loads.contact_force[1]
    assert by_deformation[1] == pytest.approx(frictionless, rel=2e-3)
    # the deformation at that pose gives the contact forces of the equations
    forces = knee.external_forces(equilibrium.q, motion.v[k], equilibrium.loads.tensions)
    weight = 1.0  # N: weight of the patella, which these forces ignore
    for fixed_frame, tolerance in ((knee.anatomy.tibia, 0.1), (knee.anatomy.femur, 0.1 + weight)):
        expected = equilibrium.loads.external_forces[fixed_frame.joint].vector
        assert forces[fixed_frame.joint].vector == pytest.approx(expected, abs=tolerance)


def test_files_and_object_find_the_same_equilibrium():
    """Files and object give the same equilibrium in a first frame with released coordinates."""
    free = ["adduction", "axial_rotation", "ap", "ml"]
    scene = tkamb.load_scene(SCENE, FOUNDATION | {"contact.released": free})
    read = tkamb.read_scene(scene)
    results = tkamb.simulate(scene, frames=slice(60, 61))
    equilibrium = read[0].equilibrium(*at(read, 60), released=free)
    for name, value in columns(equilibrium.loads).items():
        assert value == pytest.approx(results[name][0], rel=1e-9, abs=1e-9), name
    for k, axis in enumerate(("ap", "si", "ml")):
        assert 1e3 * equilibrium.coordinates[k] == pytest.approx(results[f"{axis}_mm"][0], abs=1e-9)
    peak = 1e6 * results["medial_peak_pressure_MPa"][0]
    assert equilibrium.contact.medial.peak_pressure == pytest.approx(peak, rel=1e-9)


def test_equilibrium_in_a_whole_body_is_the_same(read):
    plain = read[0]
    body = whole_body(plain)
    in_body = body.knee.equilibrium(*body.state(*at(read, 60)), released=("ap", "adduction"))
    alone = plain.equilibrium(*at(read, 60), released=("ap", "adduction"))
    assert in_body.coordinates == pytest.approx(alone.coordinates, abs=1e-7)
    assert in_body.loads.contact_total == pytest.approx(alone.loads.contact_total, abs=0.1)


def test_warm_and_cold_calls_agree_and_leave_no_trace(read):
    knee, motion, _ = read
    q, v = motion.q[60], motion.v[60]
    cold = knee.external_forces(q, v)
    data = knee.create_data()
    for k in (58, 59, 61):
        knee.external_forces(motion.q[k], motion.v[k], data=data)
    warm, cold_again = knee.external_forces(q, v, data=data), knee.external_forces(q, v)
    for joint in range(1, knee.model.njoints):
        assert np.array_equal(cold_again[joint].vector, cold[joint].vector)
        assert warm[joint].vector == pytest.approx(cold[joint].vector, abs=1e-9)


def test_an_insert_anywhere_on_the_tibia_gives_the_same_forces(read):
    """`Knee` finds the flat bottom of an insert mesh in the tibia's axes."""
    plain, motion, _ = read
    in_tibia = inverse(plain.anatomy.tibia.placement.homogeneous) @ (
        plain.bridge.insert.placement.homogeneous
    )
    model = pin.Model(plain.model)
    frame = pin.Frame("shin", 1, 0, plain.anatomy.tibia.placement, pin.FrameType.BODY)
    model.addFrame(frame)
    knee = tkamb.Knee(
        model,
        implant=tkamb.Implant(plain.femoral, plain.insert.moved(in_tibia)),
        contact=plain.contact.model,
        frames={"insert": "shin"},
    )
    bare = tkamb.Knee(plain.model, implant=plain.implant, contact=plain.contact.model)
    q, v = motion.q[60], motion.v[60]
    expected = bare.external_forces(q, v)[1].vector
    assert knee.external_forces(q, v)[1].vector == pytest.approx(expected, abs=1e-5)


def test_muscles_of_given_tension_pull_between_frames(read):
    plain = read[0]
    points = (("femur", (-0.02, 0.2, 0.0)), ("tibia", (-0.03, 0.30, 0.01)))
    flexor = tkamb.Muscle("hamstrings", points)
    knee = tkamb.Knee(
        plain.model,
        implant=plain.implant,
        ligaments=plain.ligaments,
        extensor=plain.extensor,
        contact=plain.contact.model,
        friction=0.05,
        muscles=[flexor],
    )
    state = at(read, 60)
    without, with_it = (
        knee.inverse_dynamics(*state, tensions=tension) for tension in (None, {"hamstrings": 100.0})
    )
    assert with_it.quadriceps > without.quadriceps + 10.0
    assert with_it.external_flexion > without.external_flexion + 1.0
    forces = knee.external_forces(state[0], state[1], {"hamstrings": 100.0})
    bare = knee.external_forces(state[0], state[1])
    assert np.linalg.norm(forces[1].linear - bare[1].linear) == pytest.approx(100.0)


def test_without_parts_nothing_is_imported(read):
    import subprocess
    import sys

    code = (
        "import sys, pinocchio as pin, tkamb\n"
        "model = pin.Model()\n"
        "j = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), 'root')\n"
        "k = model.addJoint(j, pin.JointModelFreeFlyer(), pin.SE3.Identity(), 'k')\n"
        "for n, i in (('tibia', j), ('femur', k)):\n"
        "    model.addFrame(pin.Frame(n, i, 0, pin.SE3.Identity(), pin.FrameType.BODY))\n"
        "knee = tkamb.Knee(model)\n"
        "knee.external_forces(pin.neutral(model), [0.0] * model.nv)\n"
        "bad = [m for m in sys.modules if m.startswith(('tkamb.contact.lattice', 'tkamb.io.scene', "
        "'tkamb.io.recordings', 'tkamb.contact.foundation', 'fcl', 'meshcat', 'matplotlib', "
        "'h5py', 'pydantic', 'trimesh'))]\n"
        "assert not bad, bad\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def knee_of(read, **changes):
    plain = read[0]
    parts = {"implant": plain.implant, "contact": plain.contact.model}
    return tkamb.Knee(plain.model, **(parts | changes))


def test_inconsistent_arguments_are_refused_in_one_line(read):
    plain, motion, _ = read
    q, v = motion.q[60], motion.v[60]
    knee, bare = knee_of(read), tkamb.Knee(plain.model)
    mesh = plain.femoral.mesh.copy()
    mesh.apply_scale(1000.0)
    bundle = replace(plain.ligaments[0], slack_length=float("nan"))
    lost = replace(plain.ligaments[0], proximal=tkamb.LinkPoint("universe", np.zeros(3)))
    cases = [
        (lambda: knee_of(read, side="both"), "side"),
        (lambda: knee_of(read, frames={"femur": "thigh"}), "no frame 'thigh'"),
        (lambda: knee_of(read, frames={"shin": "tibia"}), "no part 'shin'"),
        (lambda: knee_of(read, frames={"femur": "tibia"}), "fixed to each other"),
        (lambda: knee_of(read, joints=["root_joint"]), "not part of the knee"),
        (lambda: knee_of(read, implant=tkamb.Implant(plain.femoral)), "no insert mesh"),
        (lambda: knee_of(read, implant=tkamb.Implant(mesh, plain.insert)), "metres"),
        (lambda: knee_of(read, implant=tkamb.Implant("femur.stl", plain.insert)), "not a mesh"),
        (lambda: knee_of(read, ligaments=[bundle]), "slack_length nan m"),
        (lambda: knee_of(read, ligaments=[lost]), "universe"),
        (lambda: knee_of(read, friction=-0.1), "friction"),
        (lambda: knee_of(read, contact=3), "3 is no contact model"),
        (lambda: knee.external_forces(q[:-1], v), "shape"),
        (lambda: knee.external_forces(q, v, {"biceps": 3.0}), "no muscle 'biceps'"),
        (lambda: knee.external_forces(q, v, 3.0), "no quadriceps"),
        (lambda: plain.external_forces(q, v, -3.0), "only pulls"),
        (lambda: knee.press(q, -1.0), "load"),
        (lambda: bare.press(q, 1.0), "no contact"),
        (lambda: bare.inverse_dynamics(q, v, 0 * v, contact=knee.press(q, 500.0)), "no contact"),
        (lambda: knee.equilibrium(q, v, v, None, ("flexion",)), "no coordinate"),
        (lambda: knee.equilibrium(q, v, v, None, "ap"), "is the text 'ap'"),
        (lambda: tkamb.contact_model("lattice", resolution=1.0), "resolution"),
    ]
    for call, words in cases:
        with pytest.raises(InputError, match=words) as refused:
            call()
        assert "\n" not in str(refused.value)


def test_a_pose_out_of_range_raises_an_error(read):
    knee = knee_of(read)
    q = read[1].q[60].copy()
    q[knee.model.joints[knee.model.getJointId("knee_si")].idx_q] -= 0.02
    with pytest.raises(ComputationError, match="contact"):
        knee.external_forces(q, np.zeros(knee.model.nv))
    q[0] = np.nan
    with pytest.raises((ComputationError, InputError)):
        knee.external_forces(q, np.zeros(knee.model.nv))


def test_resolution_in_metres_is_the_same_model():
    assert tkamb.contact_model("lattice", resolution=1e-3) == tkamb.contact_model(
        "lattice", resolution=1e-3
    )
