"""The patella in six degrees of freedom: equilibrium, symmetry, virtual work and energy."""

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from knee_bodies import whole_body
from patella_bodies import HEADS, body_knee, read_plane, symmetric
from tkamb.errors import InputError
from tkamb.geometry.frames import PATELLA_BODY_COORDINATES, inverse
from tkamb.knee.patella_body import (
    SCALE,
    Head,
    coordinates_of,
    patella_pose,
    sides_without_head,
)

SIZE = sum(HEADS.values())


@pytest.fixture(scope="module")
def plain():
    return read_plane()


@pytest.fixture(scope="module")
def knee(plain):
    return body_knee(plain[0])


def body_at(knee, q, tensions=HEADS):
    """Return the forces on the patella at a configuration."""
    from tkamb.knee.patella_equilibrium import patella_method

    poses = knee._link_poses(knee._kinematics(knee.create_data(), q), None)
    method = patella_method(knee, None, PATELLA_BODY_COORDINATES)
    return method.body_of_heads(poses, tensions)


def as_array(result):
    return np.array([result.coordinates[name] for name in PATELLA_BODY_COORDINATES])


def test_poses_and_coordinates_are_inverse():
    rng = np.random.default_rng(3)
    for _ in range(20):
        coordinates = rng.uniform(-1, 1, 6) * [0.05, 0.05, 0.01, 1.4, 0.6, 0.6]
        assert coordinates_of(patella_pose(coordinates)) == pytest.approx(coordinates, abs=1e-14)


@pytest.mark.parametrize("frame", [5, 25, 50, 75, 100])
def test_all_six_forces_vanish_in_equilibrium(plain, knee, frame):
    """The residual, and the wrench on the patella from all forces on the model's joints."""
    q = plain[1].q[frame]
    result = knee.patella_equilibrium(q, HEADS)
    assert not result.failed and result.residual <= 1e-6 * SIZE
    patella = knee.anatomy.patella.joint
    assert np.abs(result.forces[patella].linear).max() <= 1e-6 * SIZE
    assert np.abs(result.forces[patella].angular).max() <= 1e-6 * SIZE * 0.05
    # All forces are internal: together they have no resultant and no moment.
    data = knee.model.createData()
    pin.forwardKinematics(knee.model, data, q)
    total = sum((data.oMi[k].act(force) for k, force in enumerate(result.forces)), pin.Force.Zero())
    assert np.abs(total.vector).max() <= 1e-9 * SIZE
    assert np.linalg.eigvals(result.stiffness).real.min() > 0.0


def test_the_stiffness_is_the_derivative_of_the_forces(plain, knee):
    q = plain[1].q[60]
    found = as_array(knee.patella_equilibrium(q, HEADS))
    body = body_at(knee, q)

    def forces(x):
        return body.twists(x / SCALE).T @ body.wrench(x / SCALE) / SCALE

    x = found * SCALE + np.array([1e-5, -2e-5, 3e-5, 1e-5, -2e-5, 1e-5])
    balance = body.balance(x / SCALE, range(6), SIZE)
    steps = 1e-8 * np.eye(6)
    place = balance.coordinates * SCALE
    numeric = np.array([(forces(place - s) - forces(place + s)) / 2e-8 for s in steps]).T
    assert numeric == pytest.approx(balance.stiffness, abs=1e-5 * np.abs(balance.stiffness).max())


def test_a_head_that_wraps_has_exact_slopes():
    rng = np.random.default_rng(5)
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    outline = 0.02 * np.column_stack([np.cos(angle), np.sin(angle)])
    head = Head("head", np.array([0.018, 0.2, 0.004]), np.zeros(3), outline, 1.0)
    wrapped = 0
    for _ in range(20):
        end = np.array([0.02, -0.04, 0.0]) + rng.uniform(-1, 1, 3) * [0.02, 0.02, 0.02]
        gradient, second = head.slopes(end)
        steps = 1e-6 * np.eye(3)
        lengths = [(head.path(end + s).length - head.path(end - s).length) / 2e-6 for s in steps]
        assert gradient == pytest.approx(lengths, abs=1e-8)
        turns = [(head.slopes(end + s)[0] - head.slopes(end - s)[0]) / 2e-6 for s in steps]
        assert second == pytest.approx(np.array(turns).T, abs=1e-5 * np.abs(second).max())
        wrapped += head.path(end).wrapped
    assert wrapped > 5


def test_a_symmetric_knee_has_no_tilt_and_no_shift(plain):
    source, motion, _ = plain
    parts = symmetric(source.femoral), symmetric(source.button)
    even = body_knee(source, femoral=parts[0], button=parts[1], even=True)
    tensions = HEADS | {"vastus_lateralis": HEADS["vastus_medialis"]}
    for frame in (10, 50, 90):
        coordinates = motion.coordinates[frame] * [1.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        q = even.bridge.configuration(motion.q[frame], _pose(coordinates))
        result = even.patella_equilibrium(q, tensions)
        assert not result.failed, result.reason
        for name in ("shift", "tilt", "rotation"):
            assert abs(result.coordinates[name]) < 1e-9, name
        sides = result.contact.contact
        assert sides.medial.force == pytest.approx(sides.lateral.force, rel=1e-9)


def _pose(coordinates):
    from tkamb.geometry.frames import knee_pose

    return knee_pose(coordinates)


def test_a_left_patella_is_the_mirror_image_of_a_right_one(plain, knee):
    _, motion, ground = plain
    state = (motion.q[60], motion.v[60], motion.a[60], ground[60])
    results = []
    for left in (False, True):
        body = whole_body(knee, left)
        q = body.state(*state)[0]
        results.append(body.knee.patella_equilibrium(q, HEADS))
    right, left = results
    assert as_array(left) == pytest.approx(as_array(right), abs=1e-8)
    for name, tension in right.tensions.items():
        assert left.tensions[name] == pytest.approx(tension, abs=1e-3)
    mirrored = np.diag([1.0, 1.0, -1.0])
    assert left.pose.translation == pytest.approx(mirrored @ right.pose.translation, abs=1e-8)


def ligament_energy(bundle, length):
    """Return the integral of the tension from the slack length, N·m."""
    stretch = np.linspace(bundle.slack_length, max(length, bundle.slack_length), 20001)
    return np.trapezoid(bundle.force(stretch), stretch)


def energy(knee, q, result):
    """Return the energy of contact and ligaments, and the potential of the constant tensions."""
    contact = result.contact.contact.of_right_knee
    h = knee.button_contact.contact.state.surface.thickness
    modulus = contact.pair.material.confined_modulus
    depth = np.maximum(-contact.gap, 0.0)
    total = float(np.sum(contact.area * modulus * depth**2 / (2.0 * h)))
    poses = knee._link_poses(knee._kinematics(knee.create_data(), q), None)
    joint = knee.chain.patella_joint_in_femur
    poses["patella"] = poses["femur"] @ joint @ patella_pose(as_array(result))
    for bundle in knee._others:
        total += ligament_energy(bundle, float(bundle.length(poses)))
    body = body_at(knee, q)
    for head, _ in body._heads:
        place = inverse(poses["femur"]) @ poses["patella"]
        end = place[:3, :3] @ head.insertion + place[:3, 3]
        total += head.tension * head.path(end).length
    return total


@pytest.mark.parametrize("frame", [30, 60, 90])
def test_virtual_work_of_the_whole_extensor(plain, frame):
    """The moment on flexion is the negative derivative of the energy in equilibrium, to 0.5 %."""
    source, motion, _ = plain
    knee = body_knee(source, "foundation-linear")
    model, joint = knee.model, knee.model.joints[knee.model.getJointId("knee_flexion")]
    step, energies = np.radians(0.25), []
    for sign in (-1.0, 1.0):
        q = motion.q[frame].copy()
        q[joint.idx_q] += sign * step
        result = knee.patella_equilibrium(q, HEADS)
        assert not result.failed
        energies.append(energy(knee, q, result))
    slope = (energies[1] - energies[0]) / (2.0 * step)
    q, rest = motion.q[frame], np.zeros(model.nv)
    forces, data = knee.patella_equilibrium(q, HEADS).forces, model.createData()
    without = pin.rnea(model, data, q, rest, rest).copy()
    moment = (without - pin.rnea(model, data, q, rest, rest, forces))[joint.idx_v]
    assert moment == pytest.approx(-slope, rel=0.005)
    assert abs(moment) > 10.0


def test_the_work_along_a_closed_loop_vanishes(plain, knee):
    """A loop of 0.1 mm and 0.4 deg in all six coordinates around the equilibrium."""
    q = plain[1].q[60]
    centre, body = as_array(knee.patella_equilibrium(q, HEADS)), body_at(knee, q)
    rng = np.random.default_rng(1)
    first, second = rng.uniform(-1, 1, (2, 6)) * 1e-4 / SCALE
    angle = np.linspace(0.0, 2.0 * np.pi, 241)
    places = centre + np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second)
    forces = np.array([body.twists(c).T @ body.wrench(c) for c in places])
    steps = np.diff(places, axis=0)
    work = np.einsum("ij,ij->i", 0.5 * (forces[1:] + forces[:-1]), steps)
    assert abs(work.sum()) < 1e-3 * np.abs(work).sum()


def test_a_small_change_of_a_tension_moves_the_patella_by_its_compliance(plain, knee):
    """0.1 N more of the lateral head: dc = K^-1 dg, with its generalised force dg per newton."""
    q, name = plain[1].q[60], "vastus_lateralis"
    before, after = (
        knee.patella_equilibrium(q, HEADS | {name: HEADS[name] + more}) for more in (-0.05, 0.05)
    )
    body, centre = body_at(knee, q), as_array(before)
    head, insertion = next(pair for pair in body._heads if pair[0].name == name)
    wrench = head.loads(body.femur_in_button(centre), insertion)[0] / head.tension
    force = body.twists(centre).T @ wrench / SCALE
    expected = np.linalg.solve(before.stiffness, force)
    moved = (as_array(after) - centre) * SCALE / 0.1
    assert moved == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())


def test_held_coordinates_keep_their_values(plain, knee):
    q = plain[1].q[40]
    plane = knee.patella_equilibrium(q, HEADS, released=("ap", "si", "flexion"))
    assert not plane.failed and plane.residual <= 1e-6 * SIZE
    assert [plane.coordinates[name] for name in ("shift", "tilt", "rotation")] == [0.0] * 3
    free = knee.patella_equilibrium(q, HEADS)
    assert abs(free.coordinates["tilt"]) > 1e-3


def test_a_warm_start_changes_nothing(plain, knee):
    data, cold = knee.create_data(), []
    for frame in (40, 42, 44):
        q = plain[1].q[frame]
        warm = knee.patella_equilibrium(q, HEADS, data=data)
        cold = knee.patella_equilibrium(q, HEADS)
        assert as_array(warm) == pytest.approx(as_array(cold), abs=1e-9)


def test_what_is_wrong_with_the_patella_is_in_words(plain, knee):
    q = plain[1].q[40]
    one_sided = knee.patella_equilibrium(q, {"vastus_lateralis": 100.0, "quadriceps": 700.0})
    assert any("medial side" in words for words in one_sided.flags)
    assert sides_without_head({"a": np.array([0, 0, 0.01])}, {"a": 0.0}) == []
    with pytest.raises(InputError, match="no coordinate of the patella 'tild'"):
        knee.patella_equilibrium(q, HEADS, released=("tild",))
    with pytest.raises(InputError, match="is the text 'tilt'"):
        knee.patella_equilibrium(q, HEADS, released="tilt")
    with pytest.raises(InputError, match="no head of the quadriceps pulls"):
        knee.patella_equilibrium(q, 0.0)
    with pytest.raises(InputError, match="no strand"):
        knee.with_ligaments(()).patella_equilibrium(q, HEADS)
    loose = [one for one in knee.ligaments if one.name.startswith("retinaculum")]
    strand = tkamb.Ligament(
        "slack",
        tkamb.LinkPoint("patella", np.zeros(3)),
        tkamb.LinkPoint("tibia", np.zeros(3)),
        tkamb.TwoLine(stiffness=1e5),
        slack_length=0.49,
    )
    lost = knee.with_ligaments([*loose, strand]).patella_equilibrium(q, HEADS)
    assert lost.failed and lost.reason.startswith("patella: ") and lost.contact is None
