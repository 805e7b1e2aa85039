"""Passes between muscles and knee: mean stiffness, tolerance of a pass, end of the passes."""

from types import SimpleNamespace

import numpy as np
import pytest

from joints import BALL, HEIGHT, LINEAR, flat_joint
from tkamb.contact.foundation import LinearFoundation
from tkamb.geometry.frames import knee_pose
from tkamb.knee import released
from tkamb.knee.balance import BalanceStatus, Trial, find_balance
from tkamb.knee.released import RELEASED_KNEE, ReleasedKnee, remaining_distance
from tkamb.knee.released_forces import SCALE
from tkamb.knee.starts import INITIAL_POSE, extrapolated

CELL = 1e-3


def test_the_mean_stiffness_is_the_closed_form_and_does_not_jump():
    """Two spheres on a layer have dF/dd = 2 pi (M/h) a², a² = 2 R d - d², wherever columns lie.

    With cells of the size s, the mean counts a column at the distance r from the centre with a
    share that falls from 1 to 0 linearly in the gap (r² - a²)/2R, over its change r s/R across the
    cell. With w uniform in ±1/2 and r² - a² = 2 r s w, the mean of r², the area by pi, is
    a² + s²/6.
    """
    model = LinearFoundation(CELL)
    probe = model.probe(model.prepare(flat_joint()))
    for depth in (0.05e-3, 0.15e-3):
        stiffnesses = []
        for x in np.linspace(0, CELL, 11):
            pose = knee_pose(np.array([x, HEIGHT + BALL - depth, 0.0003, 0, 0, 0.3]))
            contact = probe.at(pose)
            smooth = probe.smoothed(pose, contact)
            assert np.array_equal(smooth.wrench, contact.wrench)
            stiffnesses.append([sum(c.stiffness[1, 1] for c in s.loads) for s in (contact, smooth)])
        tangent, mean = np.abs(np.array(stiffnesses).T)
        area = np.pi * (2 * BALL * depth - depth**2 + CELL**2 / 6)
        exact = 2 * LINEAR.confined_modulus / HEIGHT * area
        assert mean == pytest.approx(np.full(11, exact), rel=0.01)
        assert np.abs(np.diff(mean)).max() < 0.2 * np.abs(np.diff(tangent)).max()


def springs(x):
    """Return the forces of hardening springs, f = load - K x - c x³."""
    stiffness = np.array([[3e5, 1e4], [1e4, 5e4]])
    force = np.array([200.0, -150.0]) - stiffness @ x - 1e10 * x**3
    return Trial(force, stiffness + np.diag(3e10 * x**2))


def test_a_search_that_ends_early_reports_that_it_has_not_converged():
    start = np.array([4e-3, 5e-3])
    solution = find_balance(springs, start)
    rough = find_balance(springs, start, residual_share=0.1)
    assert solution.status is rough.status is BalanceStatus.OK
    assert solution.converged
    assert not rough.converged
    assert rough.trials < solution.trials
    error = np.linalg.norm(rough.coordinates - solution.coordinates)
    assert 0 < error < 0.15 * np.linalg.norm(rough.coordinates - start)
    assert find_balance(springs, solution.coordinates, residual_share=0.1).converged


def test_a_search_does_not_end_early_at_an_unstable_state():
    """At a maximum of the energy a short Newton step increases the energy."""
    hilltop = find_balance(
        lambda x: Trial(1e5 * x, -1e5 * np.eye(1)), np.array([1e-4]), residual_share=0.5
    )
    assert hilltop.status is not BalanceStatus.OK


@pytest.mark.parametrize("ratio", [0.02, 0.3, 0.45])
def test_the_remaining_distance_of_converging_passes_is_a_series(ratio):
    distances = 1e-3 * ratio ** np.arange(60)
    for k in range(2, 8):
        assert remaining_distance(distances[k - 2 : k + 1]) * distances[k] == pytest.approx(
            distances[k + 1 :].sum(), rel=1e-6
        )


def test_passes_that_do_not_converge_have_no_extrapolation():
    """One short pass after a long one does not show convergence."""
    short = 1.5 * RELEASED_KNEE.knee_tolerance
    for distances in ([np.inf, np.inf, short], [np.inf, 1e-3, short], [1e-3, 0.9e-3, short]):
        assert remaining_distance(distances) == 1.0
    assert remaining_distance([1e-3, 4e-4, 3e-4]) == 1.0
    # with alternating ratios 0.4 and 0.02 the larger ratio bounds the remaining distance
    distances = 1e-3 * np.cumprod([1.0, *([0.4, 0.02] * 5)])
    for k in range(2, len(distances) - 1):
        assert (
            remaining_distance(distances[k - 2 : k + 1]) * distances[k] >= distances[k + 1 :].sum()
        )


def test_the_initial_guess_extrapolates_steady_frames_up_to_a_limit():
    step = np.array([3e-4, -1e-4, 2e-4, 4e-3, 1e-3, 0.0])
    steady = [np.zeros(6), step, 2 * step]
    assert extrapolated(steady) == pytest.approx(3 * step, abs=1e-15)
    assert np.array_equal(extrapolated(steady[:1]), steady[0])
    assert np.array_equal(extrapolated([np.zeros(6), step, np.zeros(6)]), np.zeros(6))
    extrapolation = extrapolated([np.zeros(6), 50 * step, 100 * step]) - 100 * step
    assert np.linalg.norm(extrapolation * SCALE) == pytest.approx(
        INITIAL_POSE.max_extrapolation, rel=1e-9
    )


def test_the_external_wrench_of_a_lost_patella_is_computed_again(monkeypatch):
    """The external wrench of a frame is stored unless it is NaN because of a lost patella."""
    wrenches = iter([np.full(6, np.nan), np.ones(6)])
    monkeypatch.setattr(released, "external_wrench", lambda *arguments: next(wrenches))
    monkeypatch.setattr(released, "joint_equilibrium", lambda *arguments: arguments[-1])
    knee, instant = ReleasedKnee(None, ()), SimpleNamespace(ligaments=())
    geometry = SimpleNamespace(coordinates=np.zeros(6))
    lost, found, again = (knee._joint(instant, geometry, np.zeros(3), False) for _ in range(3))
    assert np.isnan(lost).all()
    assert np.array_equal(found, np.ones(6)) and found is again
