"""Derivatives of the knee's forces, of dynamics with them, of presses and of equilibria."""

import itertools
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from derivative_cases import (
    CASES,
    TOLERANCE,
    agreement,
    case_directions,
    direction_error,
    knee_of,
    random_states,
    sharpen,
    vectors,
)
from knee_bodies import whole_body
from test_knee import FOUNDATION, SCENE, at, pressed
from tkamb.contact import foundation, pressing
from tkamb.errors import InputError
from tkamb.geometry.frames import displaced
from tkamb.knee import balance, released
from tkamb.knee.solution_derivatives import moved_contact

STATES, SLOW = 50, {"lattice", "fe"}
"""Number of random states; cases whose contact takes a second per pose."""


@pytest.fixture(scope="module")
def read():
    return tkamb.read_scene(tkamb.load_scene(SCENE, FOUNDATION))


@pytest.fixture(autouse=True)
def _sharp(monkeypatch):
    sharpen(monkeypatch)


@pytest.mark.parametrize("name", [name for name in CASES if name not in SLOW])
def test_forces_agree_with_central_differences(read, name):
    assert max(one.smooth for one in case_directions(CASES[name](read), 2)) < TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_forces_agree_with_central_differences_in_many_states(read, name):
    """A state on a kink agrees on its own side: a column or node comes into contact."""
    states = 3 if name in SLOW else STATES
    found = case_directions(CASES[name](read), states)
    assert np.mean([one.smooth < TOLERANCE for one in found]) >= 0.95
    assert np.mean([one.kinks == 0 for one in found]) >= 0.9


def test_a_contact_that_jumps_has_no_derivative(read):
    knee, motion = knee_of(read[0], "hertz"), read[1]
    q = pressed(knee, motion.q[60], 1000.0)
    with pytest.raises(InputError, match="hertz"):
        knee.external_forces_derivatives(q, motion.v[60])


@pytest.mark.parametrize("left", [False, True])
def test_smooth_peak_pressures(read, left):
    """They are below the peaks of the result."""
    body = whole_body(read[0], left=left)
    recorded = at(read, 60)
    q = body.state(pressed(read[0], recorded[0], 1000.0), *recorded[1:])[0]
    peaks, result = body.knee.condyle_pressures(q), body.knee.evaluate(q)
    for peak, condyle in zip(peaks, (result.medial, result.lateral), strict=True):
        assert 0.6 * condyle.peak_pressure < peak < condyle.peak_pressure


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("foundation", 5),
        ("foundation-linear", 5),
        ("whole body, left", 3),
        ("lattice-linear", 2),
        pytest.param("lattice", 2, marks=pytest.mark.slow),
    ],
)
def test_slopes_of_smooth_peak_pressures_agree_with_central_differences(read, name, count):
    case = CASES[name](read)
    for q, v in case.states(count):
        found = case.knee.condyle_pressure_slopes(q)
        values = lambda q, v, knee=case.knee: knee.condyle_pressures(q)  # noqa: E731
        compared = agreement(values, (found, 0.0 * found), case.knee, q, v, case.steps)
        assert compared.smooth < TOLERANCE
        assert compared.kinks <= 1


def test_smooth_peaks_of_a_model_without_slopes_of_pressures(read, monkeypatch):
    """A model of another package: central differences agree with the exact slopes."""
    knee = knee_of(read[0])
    q = pressed(knee, read[1].q[60], 1000.0)
    peaks, slopes = knee.condyle_pressures(q), knee.condyle_pressure_slopes(q)
    monkeypatch.delattr(foundation.FoundationProbe, "loaded_points")
    assert knee.condyle_pressures(q) == pytest.approx(peaks, rel=1e-9)
    found = knee.condyle_pressure_slopes(q)
    assert found == pytest.approx(slopes, rel=1e-4, abs=1e-4 * np.abs(slopes).max())


def test_dynamics(read):
    knee = knee_of(read[0])
    rng = np.random.default_rng(3)
    for q, v in random_states(read, knee, 2):
        tau, a = 20.0 * rng.standard_normal((2, knee.model.nv))
        plain = pin.aba(knee.model, knee.model.createData(), q, v, tau, knee.external_forces(q, v))
        assert knee.forward_dynamics(q, v, tau) == pytest.approx(plain, rel=1e-12)
        found = knee.forward_dynamics_derivatives(q, v, tau)
        forward = lambda q, v, tau=tau: knee.forward_dynamics(q, v, tau)  # noqa: E731
        assert direction_error(forward, found[:2], knee, q, v) < TOLERANCE
        columns = [forward(q, v, tau + step) - forward(q, v, tau) for step in np.eye(len(tau))]
        assert found[2] == pytest.approx(np.array(columns).T, rel=1e-6, abs=1e-6)
        found = knee.inverse_dynamics_derivatives(q, v, a)

        def inverse(q, v, a=a):
            forces = knee.external_forces(q, v)
            return pin.rnea(knee.model, knee.model.createData(), q, v, a, forces)

        assert direction_error(inverse, found[:2], knee, q, v) < TOLERANCE
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


@pytest.mark.parametrize("extension", [0.0, 100.0])
def test_an_equilibrium(read, monkeypatch, extension):
    """Derivatives by slack lengths, stiffnesses, load and flexion agree with equilibria beside.

    A moment that extends the knee (N·m) makes the quadriceps slack.
    """
    sharp = replace(balance.BALANCE, force_tolerance=1e-7, step_tolerance=1e-12)
    monkeypatch.setattr(balance, "BALANCE", sharp)
    passes = replace(
        released.RELEASED_KNEE,
        knee_tolerance=1e-12,  # at 1e-10 the reference is sometimes too coarse
        contact_force_tolerance=1e-6,
        contact_force_share=0.0,
    )
    monkeypatch.setattr(released, "RELEASED_KNEE", passes)
    plain, (*state, ground) = read[0], at(read, 60)
    knee, insert = knee_of(plain, extensor=plain.extensor), plain.bridge.insert
    external = pin.StdVec_Force(ground)
    moment = pin.Force(np.zeros(3), np.array([0.0, 0.0, extension]))
    external[insert.joint] += insert.placement.act(moment)
    free = ("ap", "ml", "axial_rotation", "adduction")
    found = knee.equilibrium(*state, external, released=free, derivatives=True)
    assert not found.failed
    assert (found.loads.quadriceps == 0.0) == (extension > 0.0)

    def changed(bundle, name, step):
        if name == "slack_length":
            return replace(bundle, slack_length=bundle.slack_length + step)
        return replace(bundle, law=bundle.law.stiffened(1.0 + step / bundle.law.stiffness))

    def rows(name, step):
        """Return coordinates and forces after a step of an input."""
        q, forces, bundles = state[0], pin.StdVec_Force(external), plain.ligaments
        if name == "flexion":
            q = pin.integrate(plain.model, q, step * np.eye(plain.model.nv)[11])
        elif name == "load":
            forces[insert.joint] += insert.placement.act(pin.Force(step))
        else:
            bundles = [changed(one, name, size) for one, size in zip(bundles, step, strict=True)]
        other = knee.with_ligaments(bundles).equilibrium(q, *state[1:], forces, released=free)
        sides = other.search.contact.condyles
        pressed = [sides[side].force if side in sides else 0.0 for side in ("medial", "lateral")]
        return np.array([*other.coordinates, *pressed])

    slopes, signs = found.derivatives, np.array([1.0, -1.0, -1.0, 1.0, 1.0, -1.0])
    lengths = np.array([bundle.slack_length for bundle in plain.ligaments])
    stiffness = np.array([bundle.law.stiffness for bundle in plain.ligaments])
    for name, columns, step in (
        ("slack_length", slopes.by_slack_length, 1e-5 * lengths),
        # Below it rounding errors count: the forces hardly depend on the stiffness.
        ("stiffness", slopes.by_stiffness, 3e-4 * stiffness),
        ("load", slopes.by_load, np.array([0.1, 0.1, 0.1, 2e-3, 2e-3, 2e-3])),
        ("flexion", slopes.by_coordinate[:, 5:], np.array([1e-6])),
    ):
        step = step * np.resize(signs, len(step))
        change = (rows(name, step) - rows(name, -step)) / 2.0
        scale = np.abs(change)
        assert columns @ step == pytest.approx(change, rel=1e-4, abs=1e-4 * scale[:6].max())


def test_a_contact_moved_by_its_tangent_agrees_with_contacts_beside(read):
    """Force, moment and centre of each condyle; an equilibrium is differentiated with it."""
    knee = knee_of(read[0])
    pose = knee.pose(pressed(knee, read[1].q[60], 1200.0)).homogeneous
    probe, move = knee.contact.probe(), 1e-7 * np.array([1, -1, 1, 40, -40, 40])
    here = knee.contact.at(probe, pose)
    moved, beside = (
        [contact(sign * move).condyles for sign in (1.0, -1.0)]
        for contact in (
            lambda move: moved_contact(here, move),
            lambda move: knee.contact.at(probe, displaced(pose, move)),
        )
    )
    for side, name in itertools.product(here.condyles, ("wrench", "centre")):
        found, expected = (
            getattr(ahead[side], name) - getattr(behind[side], name)
            for ahead, behind in (moved, beside)
        )
        assert found == pytest.approx(expected, rel=TOLERANCE, abs=TOLERANCE * abs(found).max())
