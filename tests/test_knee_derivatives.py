"""Derivatives of the knee's forces, of dynamics with them, of presses and of equilibria."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from knee_bodies import whole_body
from test_knee import FOUNDATION, SCENE, at, pressed
from test_knee_plain_model import state_of, without_patella
from tkamb.contact import foundation, pressing
from tkamb.errors import InputError
from tkamb.knee import balance, patella_search, released

STATES = 50
"""Number of random states."""


@pytest.fixture(scope="module")
def read():
    return tkamb.read_scene(tkamb.load_scene(SCENE, FOUNDATION))


@pytest.fixture(autouse=True)
def _sharp_patella(monkeypatch):
    """Central differences of a solved patella need a search that ends at rounding errors."""
    sharp = replace(
        patella_search.PATELLA_SEARCH,
        length_tolerance=1e-13,
        rotation_tolerance=1e-11,
        max_evaluations=30,
    )
    monkeypatch.setattr(patella_search, "PATELLA_SEARCH", sharp)


def vectors(forces):
    return np.array([force.vector for force in forces])


def slopes(values, knee, q, v, step, rate=1e-5):
    """Return central differences of values (n,) by q and v; the step of an angle is 40 times."""
    model, found = knee.model, []
    sizes = np.full(model.nv, step)
    for joint in model.joints:
        if joint.nv == 0:
            continue
        lengths = {"JointModelFreeFlyer": 3, "JointModelTranslation": 3}.get(joint.shortname(), 0)
        if joint.shortname().startswith("JointModelP"):
            lengths = 1
        sizes[joint.idx_v + lengths : joint.idx_v + joint.nv] *= 40.0
    for by_v in (False, True):
        columns = []
        for k in range(model.nv):
            size = rate if by_v else sizes[k]
            move = size * np.eye(model.nv)[k]
            ends = [
                values(q, v + s * move) if by_v else values(pin.integrate(model, q, s * move), v)
                for s in (1.0, -1.0)
            ]
            columns.append((ends[0] - ends[1]) / (2.0 * size))
        found.append(np.moveaxis(np.array(columns), 0, -1))
    return found


def errors(computed, expected):
    """Return the error of each column, relative to it or to 1e-3 of the largest column."""
    axes = tuple(range(expected.ndim - 1))
    size = np.abs(expected).max(axis=axes)
    if not size.any():
        return np.abs(computed).max(axis=axes)
    size = np.maximum(size, 1e-3 * size.max())
    return np.abs(computed - expected).max(axis=axes) / size


def largest_error(values, computed, knee, q, v, steps=(1e-9, 1e-8)):
    """Return the largest error of derivatives by q and by v.

    Facets and columns give the forces kinks. Of each column the better of two steps counts: the
    longer one has less rounding, the shorter one meets fewer kinks.
    """
    found = [
        [errors(*pair) for pair in zip(computed, slopes(values, knee, q, v, step), strict=True)]
        for step in steps
    ]
    return float(np.max(np.min(found, axis=0)))


def force_error(knee, q, v, tensions=None, steps=(1e-9, 1e-8), data=None):
    computed = knee.external_forces_derivatives(q, v, tensions, data)
    return largest_error(
        lambda q, v: vectors(knee.external_forces(q, v, tensions, data)),
        computed,
        knee,
        q,
        v,
        steps,
    )


def random_states(read, knee, count, load=1000.0, seed=0):
    """Yield random states near recorded frames; the condyles carry about the load."""
    rng, motion = np.random.default_rng(seed), read[1]
    model = knee.model
    columns = list(range(6, 12))
    while count:
        k = int(rng.integers(20, 95))
        move = np.zeros(model.nv)
        move[columns] = rng.uniform(-1, 1, 6) * [2e-3, 0, 1e-3, 0.03, 0.005, 0.05]
        q = pin.integrate(model, motion.q[k], move)
        v = motion.v[k] + 0.1 * rng.standard_normal(model.nv)
        yield pressed(knee, q, load * rng.uniform(0.5, 1.5)) if load else q, v
        count -= 1


def knee_of(plain, name="foundation", **changes):
    parts = {
        "implant": plain.implant,
        "ligaments": plain.ligaments,
        "contact": tkamb.contact_model(name, resolution=3e-3) if name else None,
        "friction": 0.05 if name else 0.0,
    }
    return tkamb.Knee(plain.model, **(parts | changes))


@pytest.mark.parametrize("name", ["foundation", "foundation-linear"])
def test_forces_of_contact_friction_and_ligaments(read, name):
    knee = knee_of(read[0], name)
    for q, v in random_states(read, knee, 6):
        assert force_error(knee, q, v) < 1e-5


def test_forces_of_muscle_lines_extensor_and_a_moving_patella(read):
    plain = read[0]
    points = (
        ("femur", (-0.02, 0.2, 0.0)),
        ("femur", (-0.02, 0.05, 0.0)),
        ("tibia", (-0.03, 0.3, 0.01)),
    )
    knee = knee_of(
        plain, None, extensor=plain.extensor, muscles=[tkamb.Muscle("hamstrings", points)]
    )
    tensions = {"hamstrings": 150.0, plain.extensor.quadriceps.name: 500.0}
    for q, v in random_states(read, knee, 3, load=0.0):
        assert force_error(knee, q, v, tensions, steps=(1e-7, 1e-6)) < 1e-5


def test_a_solved_patella_moves_with_the_femur(read):
    """The patella of a model without one follows by the implicit function theorem."""
    knee = without_patella(read[0])
    bare = tkamb.Knee(knee.model, implant=knee.implant, extensor=knee.extensor)
    for k in (40, 75):
        q, v, _, _ = state_of(read, k)
        assert force_error(bare, q, v, 600.0, steps=(1e-7, 1e-6)) < 1e-5, k


@pytest.mark.parametrize("left", [False, True])
def test_a_whole_body_with_a_free_joint_in_the_knee(read, left):
    plain = read[0]
    body = whole_body(plain, left=left)
    q, v, _, _ = body.state(*at(read, 70))
    assert force_error(body.knee, q, v, steps=(1e-8, 4e-8)) < 1e-5


def test_dynamics(read):
    knee = knee_of(read[0])
    rng = np.random.default_rng(3)
    for q, v in random_states(read, knee, 2):
        tau, a = 20.0 * rng.standard_normal((2, knee.model.nv))
        plain = pin.aba(knee.model, knee.model.createData(), q, v, tau, knee.external_forces(q, v))
        assert knee.forward_dynamics(q, v, tau) == pytest.approx(plain, rel=1e-12)
        found = knee.forward_dynamics_derivatives(q, v, tau)
        forward = lambda q, v, tau=tau: knee.forward_dynamics(q, v, tau)  # noqa: E731
        assert largest_error(forward, found[:2], knee, q, v) < 1e-5
        columns = [forward(q, v, tau + step) - forward(q, v, tau) for step in np.eye(len(tau))]
        assert found[2] == pytest.approx(np.array(columns).T, rel=1e-6, abs=1e-6)
        found = knee.inverse_dynamics_derivatives(q, v, a)

        def inverse(q, v, a=a):
            forces = knee.external_forces(q, v)
            return pin.rnea(knee.model, knee.model.createData(), q, v, a, forces)

        assert largest_error(inverse, found[:2], knee, q, v) < 1e-5
        assert found[2] == pytest.approx(pin.crba(knee.model, knee.model.createData(), q), rel=1e-9)


def test_a_press(read, monkeypatch):
    """Derivatives by load and pose agree with presses beside; no contact is solved again."""
    sharp = replace(pressing.PRESS, load_tolerance=1e-13)
    monkeypatch.setattr(pressing, "PRESS", sharp)
    monkeypatch.setattr(foundation, "PRESS", sharp)
    knee, motion = knee_of(read[0]), read[1]
    q = pressed(knee, motion.q[60], 1200.0)  # by_pose belongs to the pressed pose
    result, found = knee.press(q, 1200.0, derivatives=True)

    def values(q, load):
        pressed = knee.contact.model.press(
            knee.contact.state, load, knee.pose(q).homogeneous, result.of_right_knee
        )
        sides = pressed.medial.force, pressed.lateral.force
        return np.array([*sides, pressed.approach, pressed.pose[1, 3]])

    slope = (values(q, 1200.001) - values(q, 1199.999)) / 2e-3
    assert found.by_load == pytest.approx(slope, rel=1e-4)
    assert found.by_load[:2].sum() == pytest.approx(1.0, abs=0.02)
    by_joint = found.by_pose @ knee.relative_jacobian(q)
    # The condyles are round about the axis of flexion (11), so that its derivatives vanish.
    least = 1e-3 * np.abs(by_joint).max(axis=1)
    assert (np.abs(by_joint[:, 11]) < least).all()
    for k in (6, 8, 9, 10, 11):
        errors_of_steps = []
        for size in (1e-8, 2e-7):  # as in `largest_error`
            step = size * np.eye(knee.model.nv)[k]
            ends = [values(pin.integrate(knee.model, q, s * step), 1200.0) for s in (1.0, -1.0)]
            slope = (ends[0] - ends[1]) / (2.0 * size)
            errors_of_steps.append(
                np.abs(by_joint[:, k] - slope) / np.maximum(np.abs(slope), least)
            )
        assert np.max(np.min(errors_of_steps, axis=0)) < 1e-4, k


def test_many_presses_and_forces_are_stacked(read):
    knee, motion = knee_of(read[0]), read[1]
    q = motion.q[58:61]
    batch = knee.press(q, np.array([800.0, 1000.0, 1200.0]))
    assert batch.force.shape == (3, 2)
    assert batch.pressure.shape == (3, len(knee.contact.state.points))
    one = knee.press(q[2], 1200.0)
    assert batch.force[2, 0] == pytest.approx(one.medial.force, rel=1e-6)
    forces = knee.external_forces(q, motion.v[58:61])
    assert forces.shape == (3, knee.model.njoints, 6)
    assert forces[1] == pytest.approx(vectors(knee.external_forces(q[1], motion.v[59])), abs=1e-9)
    with pytest.raises(InputError, match="shape"):
        knee.press(q, np.ones(2))


def test_an_equilibrium(read, monkeypatch):
    """Derivatives by slack length, stiffness and flexion agree with equilibria beside."""
    sharp = replace(balance.BALANCE, force_tolerance=1e-7, step_tolerance=1e-12)
    monkeypatch.setattr(balance, "BALANCE", sharp)
    passes = replace(
        released.RELEASED_KNEE,
        knee_tolerance=1e-10,
        contact_force_tolerance=1e-6,
        contact_force_share=0.0,
    )
    monkeypatch.setattr(released, "RELEASED_KNEE", passes)
    plain, state = read[0], at(read, 60)
    knee = knee_of(plain, extensor=plain.extensor)
    free = ("ap", "ml", "axial_rotation", "adduction")
    found = knee.equilibrium(*state, released=free, derivatives=True)
    assert not found.failed

    def rows(changed, q=state[0]):
        other = changed.equilibrium(q, *state[1:], released=free)
        sides = other.search.contact.condyles
        forces = [sides[side].force if side in sides else 0.0 for side in ("medial", "lateral")]
        return np.array([*other.coordinates, *forces])

    for k in (0, 2):
        for name, columns in (
            ("slack_length", found.derivatives.by_slack_length),
            ("stiffness", found.derivatives.by_stiffness),
        ):
            ends = []
            for sign in (1.0, -1.0):
                bundles = list(plain.ligaments)
                factor = 1.0 + sign * 1e-5
                if name == "slack_length":
                    value = bundles[k].slack_length
                    bundles[k] = replace(bundles[k], slack_length=value * factor)
                else:
                    value = bundles[k].law.stiffness
                    bundles[k] = replace(bundles[k], law=bundles[k].law.stiffened(factor))
                ends.append(rows(knee.with_ligaments(bundles)))
            slope = (ends[0] - ends[1]) / (2e-5 * value)
            scale = np.abs(slope)
            assert columns[:, k] == pytest.approx(slope, rel=1e-4, abs=1e-4 * scale[:6].max())
