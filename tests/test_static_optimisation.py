"""Static optimisation against closed forms, the optimality conditions and another solver."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from tkamb.errors import ComputationError
from tkamb.run.muscles.sharing import LoadSharing, kkt_residual, share_load

FREE = np.inf


def joint(arms, strength, moment, **changes):
    """Return muscles about one joint whose moment (N·m) they must carry exactly."""
    count = len(arms)
    problem = {
        "weight": np.ones(count),
        "lowest": np.zeros(count),
        "highest": np.ones(count),
        "offset": np.array([moment]),
        "gain": -np.atleast_2d(np.multiply(arms, strength)),
        "lower": np.zeros(1),
        "upper": np.zeros(1),
        "reserve": np.full(1, FREE),
    }
    return LoadSharing(**(problem | changes))


def test_one_muscle_carries_the_moment():
    found = share_load(joint([0.04], [1000.0], 20.0))
    assert found.activation == pytest.approx([0.5])
    assert found.others == pytest.approx([0.0], abs=1e-9)


@pytest.mark.parametrize("exponent", [2.0, 3.0, 5.0])
def test_two_muscles_share_as_lagrange_says(exponent):
    arms, strength, moment = np.array([0.04, 0.02]), np.array([900.0, 1500.0]), 30.0
    found = share_load(joint(arms, strength, moment, exponent=exponent)).activation
    # p a_i^(p-1) = lambda r_i F_i, and the moment
    shape = (arms * strength) ** (1 / (exponent - 1))
    expected = shape * moment / (arms * strength @ shape)
    np.testing.assert_allclose(found, expected, rtol=1e-7)


def test_a_muscle_at_its_limit_leaves_the_rest_to_the_others():
    arms, strength = [0.04, 0.02], [500.0, 1500.0]
    found = share_load(joint(arms, strength, 48.0)).activation  # unbounded: 0.74 and 1.11
    np.testing.assert_allclose(found, [(48.0 - 30.0) / 20.0, 1.0], rtol=1e-9)


def test_a_reserve_takes_what_its_price_says():
    r, strength, moment, reserve = 0.04, 1000.0, 20.0, 5.0
    free = {"lower": np.array([-FREE]), "upper": np.array([FREE])}
    problem = joint([r], [strength], moment, reserve=np.array([reserve]), **free)
    a = share_load(problem).activation[0]
    # d/da: 2 a + 2 (M - r F a)(-r F) / reserve^2 = 0
    arm = r * strength / reserve
    assert a == pytest.approx(arm * (moment / reserve) / (1 + arm**2))


def test_an_optimum_inside_all_bounds_is_judged_by_the_terms_that_cancel():
    free = {"lower": np.array([-FREE]), "upper": np.array([FREE]), "reserve": np.array([3.0])}
    problem = joint([0.0266], [50.0], 7.2, **free)
    found = share_load(problem)
    assert abs(problem.gradient(found.activation)[0]) < 1e-14
    assert found.kkt_residual < 1e-14
    moved = replace(found, activation=found.activation + 1e-6)
    assert kkt_residual(problem, moved) > 1e-7


def test_emg_pulls_by_its_spread():
    e, s = 0.8, 0.25
    emg = {"expected": np.array([e, 0.0]), "spread": np.array([s, FREE])}
    known = share_load(joint([0.04, 0.04], [1000.0, 1000.0], 40.0, **emg)).activation
    # a1 + a2 = 1: a1 (1 + 1/s^2) + (a1 - 1) = e / s^2
    assert known[0] == pytest.approx((1 + e / s**2) / (2 + 1 / s**2))


def test_what_no_muscle_can_carry_is_said():
    with pytest.raises(ComputationError, match="within their limits"):
        share_load(joint([0.04], [1000.0], 60.0))
    with pytest.raises(ComputationError, match="within their limits"):
        share_load(joint([0.04], [1000.0], -5.0))


def random_problem(seed, exponent=2.0):
    """Return a leg-sized problem that is feasible, some bounds of y active."""
    rng = np.random.default_rng(seed)
    n, m = 20, 9
    a = rng.uniform(0, 1, n)
    gain = rng.normal(size=(m, n)) * np.array([50.0] * 5 + [1500.0] * 4)[:, None]
    offset = -gain @ a
    lower = np.array([0.0] * 3 + [-FREE] * 2 + [-300.0] * 4)
    upper = np.array([0.0] * 3 + [FREE] * 2 + [FREE] * 4)
    reserve = np.array([FREE] * 3 + [10.0] * 2 + [FREE] * 4)
    weight = rng.uniform(0.3, 3.0, n)
    return LoadSharing(
        weight, np.zeros(n), np.ones(n), offset, gain, lower, upper, reserve, exponent=exponent
    )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([2.0, 3.0]))
def test_conditions_of_the_optimum_hold(seed, exponent):
    problem = random_problem(seed, exponent)
    found = share_load(problem)
    assert found.kkt_residual < 1e-8
    np.testing.assert_allclose(found.others, problem.others(found.activation))
    # an optimum: no feasible neighbour on the way to any other feasible point is cheaper
    rng = np.random.default_rng(seed)
    feasible = np.clip(found.activation + 0.01 * rng.normal(size=20), 0, 1)
    slope = problem.gradient(found.activation) @ (feasible - found.activation)
    carried = problem.gain @ (feasible - found.activation)
    assert slope + found.other_multiplier @ carried >= -1e-9 * np.abs(slope).max(initial=1.0)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("exponent", [2.0, 3.0])
def test_slsqp_finds_the_same(seed, exponent):
    problem = random_problem(seed, exponent)
    equal = problem.lower == problem.upper
    bounded = np.isfinite(problem.lower) & ~equal
    size = np.abs(problem.gain).max(axis=1)
    constraints = [
        {"type": "eq", "fun": lambda a: (problem.others(a) / size)[equal]},
        {"type": "ineq", "fun": lambda a: ((problem.others(a) - problem.lower) / size)[bounded]},
    ]
    own = share_load(problem)
    other = minimize(
        problem.cost,
        np.full(20, 0.5),
        jac=problem.gradient,
        bounds=[(0, 1)] * 20,
        constraints=constraints,
        method="SLSQP",
        options={"maxiter": 1000, "ftol": 1e-14},
    )
    assert other.success
    np.testing.assert_allclose(own.activation, other.x, atol=2e-5)
    assert problem.cost(own.activation) <= other.fun * (1 + 1e-9)
