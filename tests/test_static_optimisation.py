"""Static optimisation: comparison with closed forms, optimality conditions and SLSQP."""

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
    """Return the problem of muscles that balance the moment of one joint, N·m."""
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


def test_one_muscle_balances_the_moment():
    solution = share_load(joint([0.04], [1000.0], 20.0))
    assert solution.activation == pytest.approx([0.5])
    assert solution.others == pytest.approx([0.0], abs=1e-9)


@pytest.mark.parametrize("exponent", [2.0, 3.0, 5.0])
def test_two_muscles_share_by_lagrange_s_condition(exponent):
    arms, strength, moment = np.array([0.04, 0.02]), np.array([900.0, 1500.0]), 30.0
    solution = share_load(joint(arms, strength, moment, exponent=exponent)).activation
    # p a_i^(p-1) = lambda r_i F_i, and the sum of r_i F_i a_i is the moment
    shape = (arms * strength) ** (1 / (exponent - 1))
    expected = shape * moment / (arms * strength @ shape)
    np.testing.assert_allclose(solution, expected, rtol=1e-7)


def test_a_muscle_at_full_activation_leaves_the_remaining_moment_to_the_other():
    arms, strength = [0.04, 0.02], [500.0, 1500.0]
    solution = share_load(joint(arms, strength, 48.0)).activation  # unbounded: 0.74 and 1.11
    np.testing.assert_allclose(solution, [(48.0 - 30.0) / 20.0, 1.0], rtol=1e-9)


def test_the_moment_of_a_reserve_follows_its_cost():
    r, strength, moment, reserve = 0.04, 1000.0, 20.0, 5.0
    free = {"lower": np.array([-FREE]), "upper": np.array([FREE])}
    problem = joint([r], [strength], moment, reserve=np.array([reserve]), **free)
    a = share_load(problem).activation[0]
    # d/da: 2 a + 2 (M - r F a)(-r F) / reserve^2 = 0
    arm = r * strength / reserve
    assert a == pytest.approx(arm * (moment / reserve) / (1 + arm**2))


def test_the_residual_of_an_interior_optimum_is_relative_to_the_terms_of_the_gradient():
    free = {"lower": np.array([-FREE]), "upper": np.array([FREE]), "reserve": np.array([3.0])}
    problem = joint([0.0266], [50.0], 7.2, **free)
    solution = share_load(problem)
    assert abs(problem.gradient(solution.activation)[0]) < 1e-14
    assert solution.kkt_residual < 1e-14
    moved = replace(solution, activation=solution.activation + 1e-6)
    assert kkt_residual(problem, moved) > 1e-7


def test_the_effect_of_emg_follows_its_standard_deviation():
    e, s = 0.8, 0.25
    emg = {"expected": np.array([e, 0.0]), "spread": np.array([s, FREE])}
    activation = share_load(joint([0.04, 0.04], [1000.0, 1000.0], 40.0, **emg)).activation
    # a1 + a2 = 1: a1 (1 + 1/s^2) + (a1 - 1) = e / s^2
    assert activation[0] == pytest.approx((1 + e / s**2) / (2 + 1 / s**2))


def test_a_moment_beyond_all_muscles_is_refused():
    with pytest.raises(ComputationError, match="within their limits"):
        share_load(joint([0.04], [1000.0], 60.0))
    with pytest.raises(ComputationError, match="within their limits"):
        share_load(joint([0.04], [1000.0], -5.0))


def random_problem(seed, exponent=2.0):
    """Return a feasible problem of the size of a leg with some active bounds of y."""
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
def test_the_optimality_conditions_are_satisfied(seed, exponent):
    problem = random_problem(seed, exponent)
    solution = share_load(problem)
    assert solution.kkt_residual < 1e-8
    np.testing.assert_allclose(solution.others, problem.others(solution.activation))
    # the cost does not decrease towards any other feasible point
    rng = np.random.default_rng(seed)
    feasible = np.clip(solution.activation + 0.01 * rng.normal(size=20), 0, 1)
    slope = problem.gradient(solution.activation) @ (feasible - solution.activation)
    change = problem.gain @ (feasible - solution.activation)
    assert slope + solution.other_multiplier @ change >= -1e-9 * np.abs(slope).max(initial=1.0)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("exponent", [2.0, 3.0])
def test_slsqp_has_the_same_optimum(seed, exponent):
    problem = random_problem(seed, exponent)
    equal = problem.lower == problem.upper
    bounded = np.isfinite(problem.lower) & ~equal
    size = np.abs(problem.gain).max(axis=1)
    constraints = [
        {"type": "eq", "fun": lambda a: (problem.others(a) / size)[equal]},
        {"type": "ineq", "fun": lambda a: ((problem.others(a) - problem.lower) / size)[bounded]},
    ]
    solution = share_load(problem)
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
    np.testing.assert_allclose(solution.activation, other.x, atol=2e-5)
    a, reserves = solution.activation, problem.others(solution.activation) / problem.reserve
    assert problem.cost(a) <= other.fun * (1 + 1e-9)
    assert problem.cost(a) == pytest.approx(problem.weight @ a**exponent + reserves @ reserves)
