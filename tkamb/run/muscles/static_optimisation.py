"""Static optimisation: muscles share the joint moments of one frame at the least cost.

The equations of motion leave, for given muscle activations a (n,), a square system for all other
unknowns y (m,) (hip, contact, patella, residuals, reserves), so that y is affine in a:

    A_d y + A_f F a = b     =>     y = offset + gain a,
    offset = A_d^-1 b,      gain = -A_d^-1 A_f F

with F the muscles' strengths (N at a = 1). Of all a that keep y within its bounds

    minimise   sum_i w_i a_i^p + sum_j (y_j / r_j)^2 + sum_i ((a_i - e_i) / s_i)^2
    subject to lowest_i <= a_i <= highest_i,   lower_j <= y_j <= upper_j

is sought: w the muscles' volumes or 1, r the size of a reserve or residual that costs as much as
a fully active muscle of weight 1 (inf: free of cost), e and s activations known from EMG and
their standard deviations (inf: not known). For p = 2 this is one quadratic programme, strictly
convex and small; for p > 2 a sequence of them by Newton's method.

References: Crowninshield & Brand, J Biomech 14:793 (1981), doi:10.1016/0021-9290(81)90035-X;
Arnstrom et al., IEEE Trans Autom Control 67:4362 (2022), doi:10.1109/TAC.2022.3176430 (DAQP).
"""

from dataclasses import dataclass, field, replace
from importlib.util import find_spec

import numpy as np

from tkamb.errors import ComputationError, InputError, not_installed
from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class StaticOptimisationSettings:
    """How one frame's quadratic programme ends."""

    newton_tolerance: float = 1e-10
    """Change of the activations at which the sequence for p > 2 has converged. Chosen: far below
    what changes a force."""
    most_steps: int = 60
    """Quadratic programmes of the sequence for p > 2. Chosen: sequences that converge need
    fewer."""
    solver_tolerance: float = 1e-11
    """Primal and dual tolerance handed to DAQP. Chosen: rows are scaled to about 1."""


STATIC_OPTIMISATION = StaticOptimisationSettings()

OPTIMAL = 1
"""DAQP's exit flag of a solution."""


@dataclass(frozen=True, eq=False)
class LoadSharing:
    """One frame's problem.

    Args:
        weight: (n,) cost of full activation, > 0.
        lowest: (n,) least activation.
        highest: (n,) largest activation.
        offset: (m,) the other unknowns without muscles, N or N·m.
        gain: (m, n) what full activation adds to them.
        lower: (m,) their least values; equal to `upper` where a value is asked for.
        upper: (m,) their largest values.
        reserve: (m,) N or N·m, see r above; inf where a value costs nothing.
        expected: (n,) activations known from EMG; not looked at where `spread` is inf.
        spread: (n,) their standard deviations.
        exponent: p, at least 2.
    """

    weight: Array
    lowest: Array
    highest: Array
    offset: Array
    gain: Array
    lower: Array
    upper: Array
    reserve: Array
    expected: Array = field(default_factory=lambda: np.zeros(0))
    spread: Array = field(default_factory=lambda: np.zeros(0))
    exponent: float = 2.0

    def others(self, activation: Array) -> Array:
        """Return y (m,) at activations (n,)."""
        return self.offset + self.gain @ activation

    def cost(self, activation: Array) -> float:
        """Return the cost of activations (n,)."""
        effort = float(self.weight @ np.abs(activation) ** self.exponent)
        hessian, gradient, constant = self._quadratic()
        return (
            effort
            + float(0.5 * activation @ hessian @ activation + gradient @ activation)
            + (constant)
        )

    def gradient(self, activation: Array) -> Array:
        """Return d cost / d activation (n,)."""
        hessian, gradient, _ = self._quadratic()
        own = self.exponent * self.weight * np.abs(activation) ** (self.exponent - 1)
        return np.asarray(own + hessian @ activation + gradient)

    def _quadratic(self) -> tuple[Array, Array, float]:
        """Return reserves and EMG as 1/2 a.H a + g.a + constant."""
        scaled = self.gain / self.reserve[:, None]
        target = self.offset / self.reserve
        hessian, gradient = 2 * scaled.T @ scaled, 2 * scaled.T @ target
        constant = float(target @ target)
        if len(self.spread):
            stiff = 1.0 / self.spread**2
            hessian = hessian + 2 * np.diag(stiff)
            gradient = gradient - 2 * stiff * self.expected
            constant += float(stiff @ self.expected**2)
        return hessian, gradient, constant


@dataclass(frozen=True, eq=False)
class Shared:
    """The least costly way to carry a frame.

    Args:
        activation: (n,).
        others: (m,) y, N or N·m.
        own_multiplier: (n,) of the activations' bounds, positive at the upper one.
        other_multiplier: (m,) likewise of the bounds of y, per N or N·m.
        kkt_residual: largest violation of the optimality conditions, see `kkt_residual`.
        steps: quadratic programmes solved.
    """

    activation: Array
    others: Array
    own_multiplier: Array
    other_multiplier: Array
    kkt_residual: float
    steps: int


def solver_missing() -> InputError:
    """Return the refusal of a run whose muscles need the solver DAQP, which is not installed."""
    return not_installed("the solver DAQP", "[muscles]", "muscles")


def solver_is_installed() -> bool:
    """Say whether the solver DAQP, which the extra `muscles` brings, is installed."""
    return find_spec("daqp") is not None


def share_load(problem: LoadSharing) -> Shared:
    """Return the activations of least cost.

    Raises:
        ComputationError: no activations within their bounds keep y within its own, or the
            sequence of programmes does not converge.
        InputError: DAQP is not installed.
    """
    p, w = problem.exponent, problem.weight
    rest, pull, _ = problem._quadratic()
    a, own, other = _programme(problem, np.diag(2 * w) + rest, pull)
    steps = 1
    while p != 2.0:
        # Newton: the cost's second-order model about a; a floor keeps idle muscles convex.
        curved = p * (p - 1) * w * np.maximum(np.abs(a), 1e-3) ** (p - 2)
        slope = p * w * np.abs(a) ** (p - 1)
        aim, own, other = _programme(problem, np.diag(curved) + rest, pull + slope - curved * a)
        step = _descending(problem, a, aim - a)
        steps += 1
        change, a = float(np.abs(step).max()), a + step
        if change < STATIC_OPTIMISATION.newton_tolerance:
            break
        if steps == STATIC_OPTIMISATION.most_steps:
            raise ComputationError("static optimisation does not converge", "muscles")
    shared = Shared(a, problem.others(a), own, other, np.nan, steps)
    return replace(shared, kkt_residual=kkt_residual(problem, shared))


def kkt_residual(problem: LoadSharing, shared: Shared) -> float:
    """Return the largest violation of the conditions of an optimum, relative.

    Stationarity (gradient + multipliers = 0, over the largest term of the gradient: their sum
    vanishes where no bound is active), feasibility and complementarity (multiplier times distance
    from its bound), each over its own scale.
    """
    a, y = shared.activation, shared.others
    slope = problem.gradient(a)
    hessian, pull, _ = problem._quadratic()
    own = problem.exponent * problem.weight * np.abs(a) ** (problem.exponent - 1)
    still = slope + shared.own_multiplier + problem.gain.T @ shared.other_multiplier
    terms = np.concatenate([own, hessian @ a, pull])
    size = max(float(np.abs(terms).max(initial=0.0)), 1e-12)
    scale = _row_scale(problem)
    result = [float(np.abs(still).max(initial=0.0)) / size]
    for value, low, high, multiplier, unit in (
        (a, problem.lowest, problem.highest, shared.own_multiplier, np.ones_like(a)),
        (y, problem.lower, problem.upper, shared.other_multiplier, scale),
    ):
        beyond = np.maximum(np.maximum(low - value, value - high), 0.0) / unit
        bound = np.where(multiplier > 0, high, low)
        active = multiplier != 0
        slack = np.abs(value - bound)[active] * np.abs(multiplier)[active] / size
        result += [float(beyond.max(initial=0.0)), float(slack.max(initial=0.0))]
    return max(result)


def _programme(problem: LoadSharing, hessian: Array, gradient: Array) -> tuple[Array, Array, Array]:
    """Return activations and multipliers of min 1/2 a.H a + g.a within all bounds."""
    try:
        import daqp
    except ImportError:
        raise solver_missing() from None
    scale = _row_scale(problem)
    bounded = np.isfinite(problem.lower) | np.isfinite(problem.upper)
    rows = problem.gain[bounded] / scale[bounded, None]
    upper = (problem.upper - problem.offset)[bounded] / scale[bounded]
    lower = (problem.lower - problem.offset)[bounded] / scale[bounded]
    equal = np.concatenate([problem.lowest == problem.highest, lower == upper])
    a, _, flag, text = daqp.solve(
        np.ascontiguousarray(hessian),
        np.ascontiguousarray(gradient),
        np.ascontiguousarray(rows),
        np.concatenate([problem.highest, upper]),
        np.concatenate([problem.lowest, lower]),
        np.where(equal, 5, 0).astype(np.intc),  # 5: an equality
        primal_tol=STATIC_OPTIMISATION.solver_tolerance,
        dual_tol=STATIC_OPTIMISATION.solver_tolerance,
    )
    if flag != OPTIMAL:
        raise ComputationError("no muscle forces within their limits carry this frame", "muscles")
    multiplier = np.asarray(text["lam"], float)
    other = np.zeros(len(problem.offset))
    count = len(problem.lowest)
    other[bounded] = multiplier[count:] / scale[bounded]
    return np.asarray(a, float), multiplier[:count], other


def _row_scale(problem: LoadSharing) -> Array:
    """Return the size (m,) of each y that muscles can bring about, to compare its bounds with."""
    size = np.maximum(np.abs(problem.gain).max(axis=1, initial=0.0), 1e-12)
    return np.asarray(size)


def _descending(problem: LoadSharing, a: Array, step: Array) -> Array:
    """Return the step, halved until the cost does not rise."""
    before = problem.cost(a)
    for _ in range(30):
        if problem.cost(a + step) <= before * (1 + 1e-12):
            return step
        step = 0.5 * step
    return step
