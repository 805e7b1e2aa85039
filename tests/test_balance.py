"""Equilibrium of released coordinates against closed forms."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import brentq

from joints import (
    BALL,
    DISH,
    HALF,
    HEIGHT,
    LINEAR,
    bundles,
    dished_joint,
    distance_between,
    find_equilibrium,
    flat_joint,
    joint_equations,
    push,
)
from tkamb.contact.foundation import LinearFoundation
from tkamb.contact.model import Probe
from tkamb.contact.registry import contact_model
from tkamb.geometry.frames import knee_axes, knee_pose, knee_twist
from tkamb.knee.balance import BalanceStatus, Trial, find_balance
from tkamb.knee.released_forces import SCALE, ReleasedForces

LOAD = 1000.0
TOUCH = HEIGHT + BALL - 0.05e-3
M = LINEAR.confined_modulus


@pytest.fixture(scope="module")
def flat():
    model = LinearFoundation(0.5e-3)
    return model, model.prepare(flat_joint())


@pytest.fixture(scope="module")
def dished():
    model = LinearFoundation(1e-3)
    return model, model.prepare(dished_joint())


def sphere_depth(force):
    """Return the penetration d (m) of a sphere: force = M/h pi d² (R - d/3)."""
    return brentq(lambda d: M / HEIGHT * np.pi * d**2 * (BALL - d / 3) - force, 0, HEIGHT / 2)


# The search for equilibrium


def test_linear_springs_reach_their_equilibrium():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(4, 4))
    stiffness = 1e5 * (root @ root.T + 0.1 * np.eye(4))
    load = rng.normal(size=4) * 20
    for with_stiffness in (True, False):
        end = find_balance(
            lambda x, with_stiffness=with_stiffness: Trial(
                load - stiffness @ x, stiffness if with_stiffness else None
            ),
            np.full(4, 1e-3),
        )
        assert end.status is BalanceStatus.OK
        assert np.allclose(end.coordinates, np.linalg.solve(stiffness, load), atol=2e-6)
        assert end.smallest_stiffness == pytest.approx(np.linalg.eigvalsh(stiffness)[0], rel=1e-3)


def test_the_first_step_teaches_the_stiffness_of_a_linear_spring():
    """The secant through two points of a line is the line: the second step ends the search."""
    for guess in (0.8e5, 1.5e5):
        end = find_balance(lambda x: Trial(50.0 - 1e5 * x), np.zeros(1), np.array([[guess]]))
        assert end.coordinates == pytest.approx(5e-4, abs=1e-12)
        assert end.steps == 2


def hardening(guide=None):
    """Return the trial function of hardening springs, f = load - K x - c x³, and its equilibrium.

    With `guide` a trial contains `guide(tangent)` as an inexact stiffness.
    """
    rng = np.random.default_rng(7)
    root = rng.normal(size=(4, 4))
    linear, cubic = 1e6 * (root @ root.T + np.eye(4)), 1e14
    equilibrium = np.array([3e-4, -2e-4, 1e-4, 2e-4])
    load = linear @ equilibrium + cubic * equilibrium**3

    def trial(x):
        tangent = linear + np.diag(3 * cubic * x**2)
        force = load - linear @ x - cubic * x**3
        return Trial(force) if guide is None else Trial(force, guide(tangent), exact=False)

    return trial, equilibrium


@pytest.mark.parametrize(
    ("guide", "max_trials"),
    [
        (lambda tangent: 1.3 * tangent, 14),
        (lambda tangent: tangent + 1e6, 14),
        (lambda tangent: 1e6 * np.eye(4), 100),
        (lambda tangent: -tangent, 100),
    ],
)
def test_an_inexact_stiffness_leads_to_the_same_equilibrium(guide, max_trials):
    """A tangent with an error of a third needs fewer trials than differences. With a wrong tangent
    the search converges, too.
    """
    exact_forces, equilibrium = hardening()
    by_differences = find_balance(exact_forces, np.zeros(4))
    trial, _ = hardening(guide)
    by_stiffness = find_balance(trial, np.zeros(4))
    for end in (by_differences, by_stiffness):
        assert end.status is BalanceStatus.OK
        assert len(end.work) <= end.steps < end.trials
        assert end.coordinates == pytest.approx(equilibrium, abs=5e-8)
    assert by_stiffness.trials <= max_trials
    assert max_trials > 20 or by_stiffness.trials < by_differences.trials


def test_forces_without_a_potential_converge():
    """The stiffness is stable, but its symmetric part is indefinite, so work does not measure
    progress.
    """
    stiffness = np.array([[1e4, 8e4, 0.0], [0.0, 2e4, 3e4], [0.0, 0.0, 1e4]])
    assert np.linalg.eigvalsh(0.5 * (stiffness + stiffness.T))[0] < -1e4
    end = find_balance(lambda x: Trial(-stiffness @ x, stiffness), np.array([5e-3, -3e-3, 2e-3]))
    assert end.status is BalanceStatus.OK
    assert end.steps < 20
    np.testing.assert_allclose(end.coordinates, 0.0, atol=2e-6)


@pytest.mark.parametrize("force_noise", [0.0, 0.4])
def test_force_noise_is_the_tolerance_of_the_residual(force_noise):
    """The force jumps at the equilibrium by its error."""

    def jumping(x):
        jump = np.where(x < 1e-4, 0.3, -0.3)
        return Trial(2e5 * (1e-4 - x) + jump, force_noise=force_noise)

    end = find_balance(jumping, np.array([-2e-4]))
    assert (end.status is BalanceStatus.OK) == (force_noise > 0.3)
    assert end.coordinates == pytest.approx([1e-4], abs=5e-6)


def test_an_inexact_stiffness_at_equilibrium_does_not_make_it_unstable():
    """The search computes differences before it calls an equilibrium unstable."""
    stiffness = np.diag([2e5, 1e5])
    end = find_balance(lambda x: Trial(-stiffness @ x, -stiffness, exact=False), np.zeros(2))
    assert end.status is BalanceStatus.OK
    assert end.smallest_stiffness == pytest.approx(1e5, rel=1e-6)


def test_constraint_forces_cancel_the_forces_on_prescribed_coordinates():
    external = push([30.0, LOAD, -40.0], [2e-3, 0, 5e-3])
    joint = joint_equations(external, ("adduction", "ap"))
    coordinates, contact = (
        np.array([1e-3, TOUCH, -0.5e-3, 0.03, 0.002, 0.4]),
        push([5.0, -800.0, 9.0]),
    )
    (residual,) = joint.forces_on_all_coordinates(coordinates[None], contact)
    assert np.abs(np.delete(residual, joint.released)).max() < 1e-10
    assert residual[list(joint.released)] == pytest.approx(
        joint.residual(coordinates, contact), abs=1e-9
    )


def test_contact_gain_is_the_derivative_of_the_residual():
    joint = joint_equations(push([30.0, LOAD, -40.0], [2e-3, 0, 5e-3]), ("adduction", "ap"))
    coordinates, contact = (
        np.array([1e-3, TOUCH, -0.5e-3, 0.03, 0.002, 0.4]),
        push([5.0, -800.0, 9.0]),
    )
    steps = np.stack([joint.residual(coordinates, contact + unit) for unit in np.eye(6)], axis=1)
    change = steps - joint.residual(coordinates, contact)[:, None]
    assert joint.contact_gain(coordinates) == pytest.approx(change, abs=1e-9)


def test_an_initial_guess_at_the_end_of_the_range_is_out_of_range():
    """The force is known at the initial guess but not beside it, so that differences fail."""
    start = np.array([1e-3, 0.0])
    end = find_balance(
        lambda x: Trial(np.array([5.0, -3.0]) if x[0] <= start[0] else np.full(2, np.nan)), start
    )
    assert end.status is BalanceStatus.OUT_OF_RANGE
    assert np.isnan(end.smallest_stiffness)


def test_energy_falls_in_every_step_through_a_stiffening_contact():
    """The potential is k x^2.5 less a load's work, with a soft spring in a curved valley."""

    def energy(x):
        depth = max(0.0, -(x[0] - x[1] ** 2 / 0.05))
        return 4e9 * depth**2.5 + LOAD * x[0] + 2e3 * x[1] ** 2

    def trial(x):
        depth = max(0.0, -(x[0] - x[1] ** 2 / 0.05))
        push = 1e10 * depth**1.5
        return Trial(np.array([push - LOAD, -push * 2 * x[1] / 0.05 - 4e3 * x[1]]))

    positions = [np.array([2e-3, 8e-3])]
    end = find_balance(lambda x: (positions.append(x.copy()), trial(x))[1], positions[0])
    assert end.status is BalanceStatus.OK
    assert np.allclose(end.coordinates, [-((LOAD / 1e10) ** (2 / 3)), 0], atol=3e-6)
    assert min(end.work) > 0
    assert energy(end.coordinates) < energy(positions[0])
    lost = energy(positions[0]) - energy(end.coordinates)
    assert sum(end.work) == pytest.approx(lost, rel=0.25)


def test_a_stiffness_that_is_singular_to_rounding_gets_a_status():
    """A stiffness of rank 1 has a smallest eigenvalue of +2e-12 by rounding."""
    matrix = np.array([[16000.0, 8000.0], [20000.0, 10000.0]])
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.solve(matrix, np.ones(2))
    end = find_balance(lambda x: Trial(np.array([10.0, 5.0]) - matrix @ x, matrix), np.zeros(2))
    assert end.status is not BalanceStatus.OK


def test_searches_without_equilibrium_have_a_status():
    def free(x):
        return Trial(np.array([-1e5 * x[0], 0.0]), np.diag([1e5, 0.0]))

    def pushed(x):
        return Trial(np.array([-1e5 * x[0], 1.0]), np.diag([1e5, 0.0]))

    def hilltop(x):
        return Trial(np.array([-1e5 * x[0], 1e4 * x[1]]), np.diag([1e5, -1e4]))

    def unknown(x):
        return Trial(np.full(2, np.nan))

    start = np.array([1e-3, 0.0])
    assert find_balance(free, start).status is BalanceStatus.INDETERMINATE
    assert find_balance(pushed, start).status is BalanceStatus.RUNS_AWAY
    assert find_balance(hilltop, start).status is BalanceStatus.UNSTABLE
    assert find_balance(unknown, start).status is BalanceStatus.OUT_OF_RANGE


# Parts of the search


def test_axes_are_the_twists_of_the_coordinates():
    rng = np.random.default_rng(2)
    place = rng.uniform(-1, 1, (5, 6)) * [0.03, 0.03, 0.03, 0.5, 0.3, 2.0]
    for coordinates, axes in zip(place, knee_axes(place), strict=True):
        for rates, axis in zip(np.eye(6), axes, strict=True):
            velocity, spin = knee_twist(coordinates, rates)
            at_origin = velocity - np.cross(spin, coordinates[:3])
            assert np.allclose(axis, np.concatenate([at_origin, spin]), atol=1e-12)


def test_the_foundation_probe_gives_the_wrench_of_evaluate_and_its_tangent(dished):
    model, state = dished
    place = np.array([1e-3, TOUCH - 0.05e-3, -0.5e-3, 0.03, 0.002, 0.4])
    probe, generic = model.probe(state), Probe(model, state)
    quick, slow = probe.at(knee_pose(place)), generic.at(knee_pose(place))
    assert quick.tangent
    assert not slow.tangent
    assert np.allclose(quick.wrench, slow.wrench, rtol=1e-12, atol=1e-12)
    for side, condyle in quick.condyles.items():
        assert condyle.centre == pytest.approx(slow.condyles[side].centre, abs=1e-12)
    axes = knee_axes(place)
    tangent = sum(c.stiffness for c in quick.condyles.values()) @ axes.T
    for i, size in enumerate(np.array([1, 1, 1, 40, 40, 40]) * 1e-6):
        step = size * np.eye(6)[i]
        change = probe.at(knee_pose(place + step)).wrench - probe.at(knee_pose(place - step)).wrench
        assert np.allclose(change / (2 * size), tangent[:, i], atol=0.03 * np.abs(tangent).max())


def test_the_stiffness_of_the_released_coordinates_is_the_slope_of_their_forces(dished):
    model, state = dished
    external = push([30.0, LOAD, -40.0], [2e-3, 0, 5e-3])
    strap = bundles([([0, 0, -35e-3], [0, -30e-3, -35e-3], 60e-3)])
    place = np.array([1e-3, TOUCH - 0.05e-3, -0.5e-3, 0.03, 0.002, 0.4])
    forces = ReleasedForces(joint_equations(external, ligaments=strap), model.probe(state), place)
    x = (place * SCALE)[:5]
    stiffness = forces.trial(x).stiffness
    for i in range(5):
        step = 1e-6 * np.eye(5)[i]
        slope = (forces.trial(x - step).force - forces.trial(x + step).force) / 2e-6
        assert np.allclose(slope, stiffness[:, i], atol=0.03 * np.abs(stiffness).max())


# A rigid two-sphere joint on an elastic foundation


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.9, -0.6])
def test_split_and_tilt_follow_the_adduction_moment(flat, share):
    """A load at the distance e from the middle: N_lateral - N_medial = F e/b, varus = (d_m -
    d_l)/(2b).
    """
    offset = share * HALF
    place, contact, balance = find_equilibrium(
        *flat, push([0, LOAD, 0], [0, 0, offset]), [0, TOUCH, 0, 0, 0, 0.3], ("adduction",)
    )
    assert balance.status is BalanceStatus.OK
    lateral, medial = LOAD * (1 + share) / 2, LOAD * (1 - share) / 2
    assert contact.condyles["medial"].force == pytest.approx(medial, abs=0.5)
    assert contact.condyles["lateral"].force == pytest.approx(lateral, abs=0.5)
    tilt = (sphere_depth(medial) - sphere_depth(lateral)) / (2 * HALF)
    assert place[4] == pytest.approx(tilt, abs=0.02 * sphere_depth(LOAD) / HALF)
    approach = HEIGHT + BALL - place[1]
    assert approach == pytest.approx((sphere_depth(lateral) + sphere_depth(medial)) / 2, rel=0.03)


def test_a_condyle_lifts_off_at_zero_force_and_lands_again(flat):
    """A medial ligament holds a tipping femur; loading and unloading have the same states.

    With a slack ligament N_medial = F (1 - e/b)/2 is zero at e = b. Beyond, the tension is T = F (e
    - b)/(a + b).
    """
    reach = 30e-3
    anchor = TOUCH + 30e-3
    ends = ([0, 0, -reach], [0, TOUCH - anchor, -reach], anchor)
    strap = bundles([ends], 2e5)
    model, state = flat
    up = np.concatenate([np.linspace(0.5, 1.5, 21), np.linspace(1.5, 0.5, 21)])
    place, states = np.array([0, TOUCH, 0, 0, 0, 0.3]), []
    for share in up:
        external = push([0, LOAD, 0], [0, 0, share * HALF])
        place, contact, balance = find_equilibrium(
            model, state, external, place, ("adduction",), strap
        )
        assert balance.status is BalanceStatus.OK
        assert min(balance.work, default=1.0) > 0
        tension = np.linalg.norm(strap.wrench(knee_pose(place))[:3])
        vertical_forces = {side: c.wrench[1] for side, c in contact.condyles.items()}
        assert max(vertical_forces.values()) < 0
        states.append((share, place, "medial" in contact.condyles, tension))
    for share, _, medial, tension in states:
        slackened = tension < 1e-9
        assert medial == (share < 0.999) or not slackened
        if not medial:
            expected = LOAD * (share * HALF - HALF) / (reach + HALF)
            assert tension == pytest.approx(expected, rel=0.02, abs=0.5)
    assert any(not medial for *_, medial, _ in states)
    for (_, loading, *_), (_, unloading, *_) in zip(states, states[::-1], strict=True):
        assert distance_between(loading, unloading) < 5e-6


def test_a_knee_without_constraints_is_indeterminate():
    model = contact_model("hertz", resolution=1e-3)
    flat = model, model.prepare(flat_joint())
    *_, balance = find_equilibrium(*flat, push([0, LOAD, 0]), [0, TOUCH, 0, 0, 0, 0.3])
    assert balance.status is BalanceStatus.INDETERMINATE
    assert balance.smallest_stiffness == pytest.approx(0.0, abs=1.0)


def test_columns_hold_a_ball_on_a_plate_less_the_closer_they_are():
    """Nothing holds the ball. The docstring of the foundation and docs/equilibrium.md say so."""
    found = {}
    for resolution in (1e-3, 2e-3):
        model = LinearFoundation(resolution)
        state, rng, held = model.prepare(flat_joint()), np.random.default_rng(0), []
        for _ in range(6):
            place = [rng.uniform(-2e-3, 2e-3), TOUCH, rng.uniform(-2e-3, 2e-3), 0, 0, 0.3]
            held.append(model.press(state, LOAD, knee_pose(place)).wrench_on_insert[[0, 2]])
        found[resolution] = np.sqrt(np.mean(np.square(held))) / LOAD
    assert found[1e-3] < 1e-3
    assert found[2e-3] < 3e-3
    assert found[1e-3] < found[2e-3] / 2


def test_a_knee_without_constraints_runs_away_or_does_not_settle(flat):
    start = [0, TOUCH, 0, 0, 0, 0.3]
    *_, balance = find_equilibrium(*flat, push([20.0, LOAD, 0]), start)
    assert balance.status is BalanceStatus.RUNS_AWAY
    *_, balance = find_equilibrium(
        *flat, push([0, LOAD, 0], [0, 0, 1.5 * HALF]), start, ("adduction",)
    )
    assert balance.status is not BalanceStatus.OK


# Two spheres in two dishes


@pytest.mark.parametrize("inclination", [(0.0, 0.0), (0.2, 0.0), (0.0, 0.15)])
def test_spheres_in_dishes_follow_the_direction_of_the_load(dished, inclination):
    """The centre of a sphere moves like a pendulum of length R_dish - R_ball + depth."""
    force = np.array([inclination[0] * LOAD, LOAD, inclination[1] * LOAD])
    level = np.array([0, HEIGHT + BALL, 0])
    place, contact, balance = find_equilibrium(
        *dished, push(force, level), [0, TOUCH, 0, 0, 0, 0.3], ("ap", "ml")
    )
    assert balance.status is BalanceStatus.OK
    assert min(balance.work, default=1.0) > 0
    depth = sphere_depth(LOAD / 2)
    expected = -(DISH - BALL + depth) * force / np.linalg.norm(force)
    assert np.allclose(place[[0, 2]], expected[[0, 2]], atol=2e-4)
    assert contact.wrench[0] == pytest.approx(-force[0], abs=0.1)


STARTS = [
    [5e-3, 3e-3, -5e-3, 0.0, 0.0],
    [-5e-3, 2e-3, 5e-3, np.radians(5), np.radians(5)],
    [3e-3, 4e-3, 5e-3, np.radians(-5), np.radians(-5)],
]


@pytest.mark.parametrize("offset", STARTS)
def test_initial_guesses_5_mm_and_5_deg_away_reach_the_same_equilibrium(dished, offset):
    external = push([40.0, LOAD, -30.0], [1e-3, 0, 4e-3])
    neutral = np.array([0, TOUCH, 0, 0, 0, 0.3])
    near, _, first = find_equilibrium(*dished, external, neutral)
    far, contact, balance = find_equilibrium(*dished, external, neutral + np.append(offset, 0.0))
    assert first.status is BalanceStatus.OK
    assert balance.status is BalanceStatus.OK
    assert distance_between(near, far) < 1e-5
    assert min(balance.work) > 0
    assert len(contact.condyles) == 2


def test_the_work_of_the_foundation_on_a_closed_path_is_small(dished):
    """The path is a loop of 0.5 mm sideways and 0.03 mm down."""
    model, state = dished
    probe = model.probe(state)
    corners = np.array([[0, 0], [0.5, 0], [0.5, -0.03], [0, -0.03], [0, 0]]) * 1e-3
    total, sides = 0.0, []
    for start, stop in pairwise(corners):
        path = start + np.linspace(0, 1, 41)[:, None] * (stop - start)
        forces = []
        for z, y in path:
            place = np.array([0, TOUCH - 0.04e-3 + y, z, 0, 0, 0.3])
            forces.append(-probe.at(knee_pose(place)).wrench[[2, 1]])
        work = np.trapezoid(np.array(forces) @ (stop - start), dx=1 / 40)
        total += work
        sides.append(abs(work))
    assert abs(total) < 0.02 * max(sides)


@pytest.mark.parametrize(
    ("name", "resolution_mm"),
    [
        ("foundation", 1.0),
        ("foundation-linear", 2.0),
        ("hertz", 2.0),
        pytest.param("lattice", 2.0, marks=pytest.mark.slow),
        pytest.param("lattice-linear", 2.0, marks=pytest.mark.slow),
        pytest.param("fe", 3.0, marks=pytest.mark.slow),
    ],
)
def test_every_contact_model_reaches_equilibrium(name, resolution_mm):
    model = contact_model(name, resolution=resolution_mm * 1e-3)
    state = model.prepare(dished_joint())
    external = push([20.0, LOAD, 0], [0, 0, 2e-3])
    start = [0.3e-3, TOUCH, -0.3e-3, 0.01, 0, 0.3]
    place, contact, balance = find_equilibrium(model, state, external, start)
    assert balance.status is BalanceStatus.OK
    assert np.allclose(contact.wrench[:3], [-20, -LOAD, 0], atol=0.2)
    assert contact.condyles["lateral"].force > contact.condyles["medial"].force
    assert abs(place[2]) < 0.5e-3


def test_a_diverged_search_with_rippled_forces_converges_in_a_second_search():
    """The spring is unsymmetric, as with friction; the ripples represent facets of a contact
    surface.
    """
    rng = np.random.default_rng(236)  # one of five in 400 that need the second search
    coupling = rng.uniform(5e4, 3e5), -rng.uniform(1e3, 1e4)
    stiffness = np.array([[3e4, coupling[0]], [coupling[1], rng.uniform(2e3, 2e4)]])
    amplitude, wave = rng.uniform(10, 80), 2 * np.pi / rng.uniform(2e-4, 2e-3)
    start, asked = rng.uniform(-8e-3, 8e-3, 2), []

    def forces(x):
        asked.append(x)
        slopes = stiffness + amplitude * wave * np.diag(np.cos(wave * x))
        return Trial(-stiffness @ x - amplitude * np.sin(wave * x), slopes)

    end = find_balance(forces, start)
    assert end.status is BalanceStatus.OK
    assert end.trials == len(asked)
    assert np.abs(forces(end.coordinates).force).max() < 0.05
    assert np.linalg.eigvals(forces(end.coordinates).stiffness).real.min() > 0
    assert np.abs(end.coordinates - start).max() < 20e-3
