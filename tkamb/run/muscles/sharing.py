"""Static optimisation: the muscle activations of least cost for the joint moments of one frame.

For given activations a (n,), the equations of motion are a square system for the other unknowns y
(m,), here the reserves. So y is affine in a:

    A_d y + A_f F a = b     =>     y = offset + gain a,
    offset = A_d^-1 b,      gain = -A_d^-1 A_f F

with the muscle forces F at a = 1, N. The activations

    minimise   sum_i w_i a_i^p + sum_j (y_j / r_j)^2 + sum_i ((a_i - e_i) / s_i)^2
    subject to lowest_i <= a_i <= highest_i,   lower_j <= y_j <= upper_j.

The weights w are the muscles' relative volumes or 1. A reserve of size r costs as much as a fully
active muscle of weight 1 (inf: nothing). EMG gives activations e with standard deviations s (inf:
no EMG). For p = 2 this is one strictly convex quadratic programme, for p > 2 a sequence of them
(Newton's method).

References: Crowninshield & Brand, J Biomech 14:793 (1981), doi:10.1016/0021-9290(81)90035-X;
Arnstrom et al., IEEE Trans Autom Control 67:4362 (2022), doi:10.1109/TAC.2022.3176430 (DAQP).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import Literal

import numpy as np

from tkamb.errors import ComputationError, InputError, not_installed
from tkamb.geometry.frames import Array
from tkamb.io.opensim.model import OpenSimMuscle
from tkamb.run.muscles.leg import LONGEST_FIBRE_RATIO

# 1: change of the activations below which the sequence for p > 2 has converged. Not studied.
NEWTON_TOLERANCE = 1e-10
# 1: largest number of quadratic programmes for p > 2. Not studied.
MOST_STEPS = 60
# 1: primal and dual tolerance of DAQP. Chosen for rows that are scaled to about 1.
SOLVER_TOLERANCE = 1e-11


OPTIMAL = 1
"""DAQP's exit flag of a solution."""


@dataclass(frozen=True, eq=False)
class LoadSharing:
    """The optimisation problem of one frame, in the module's symbols.

    Args:
        weight: weights w > 0, (n,).
        lowest: least activations, (n,).
        highest: largest activations, (n,).
        offset: y without muscles, N or N·m, (m,).
        gain: change of y by full activation, N or N·m, (m, n).
        lower: least y, (m,); equal to `upper` for a prescribed y.
        reserve: r, N or N·m, (m,); inf: no cost.
        expected: activations e from EMG, (n,).
        spread: standard deviations s, (n,); inf: no EMG.
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
        effort = self.exponent * self.weight * np.abs(activation) ** (self.exponent - 1)
        return np.asarray(effort + hessian @ activation + gradient)

    def _quadratic(self) -> tuple[Array, Array, float]:
        """Return H, g and c of the cost of reserves and EMG, 1/2 a.H a + g.a + c."""
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
    """The solution of one frame.

    Args:
        activation: activations, (n,).
        others: y, N or N·m, (m,).
        own_multiplier: multipliers of the activations' bounds, positive at the upper bound, (n,).
        other_multiplier: multipliers of the bounds of y, 1/N or 1/(N·m), (m,).
    """

    activation: Array
    others: Array
    own_multiplier: Array
    other_multiplier: Array
    kkt_residual: float
    steps: int


def solver_missing() -> InputError:
    """Return the error for [muscles] without the solver DAQP."""
    return not_installed("the solver DAQP", "[muscles]", "muscles")


def solver_is_installed() -> bool:
    """Return whether DAQP is installed, by the extra `muscles`."""
    return find_spec("daqp") is not None


def share_load(problem: LoadSharing) -> Shared:
    """Return the activations of least cost.

    Raises:
        ComputationError: no activations satisfy all bounds, or the sequence of programmes does not
            converge.
        InputError: DAQP is not installed.
    """
    p, w = problem.exponent, problem.weight
    hessian, gradient, _ = problem._quadratic()
    a, own, other = _programme(problem, np.diag(2 * w) + hessian, gradient)
    steps = 1
    while p != 2.0:
        # Newton's method: a quadratic model of the cost about a. The lower limit of the activation
        # keeps the model strictly convex for idle muscles.
        curvature = p * (p - 1) * w * np.maximum(np.abs(a), 1e-3) ** (p - 2)
        slope = p * w * np.abs(a) ** (p - 1)
        target, own, other = _programme(
            problem, np.diag(curvature) + hessian, gradient + slope - curvature * a
        )
        step = _descending(problem, a, target - a)
        steps += 1
        change, a = float(np.abs(step).max()), a + step
        if change < NEWTON_TOLERANCE:
            break
        if steps == MOST_STEPS:
            raise ComputationError("static optimisation does not converge", "muscles")
    shared = Shared(a, problem.others(a), own, other, np.nan, steps)
    return replace(shared, kkt_residual=kkt_residual(problem, shared))


def kkt_residual(problem: LoadSharing, shared: Shared) -> float:
    """Return the largest relative violation of the optimality conditions.

    The conditions (Karush, Kuhn and Tucker) are stationarity, feasibility and complementarity.
    Stationarity means that gradient plus multipliers is zero. Its violation is relative to the
    largest term of the gradient. Complementarity means that multiplier times distance from the
    bound is zero.
    """
    a, y = shared.activation, shared.others
    slope = problem.gradient(a)
    hessian, pull, _ = problem._quadratic()
    effort = problem.exponent * problem.weight * np.abs(a) ** (problem.exponent - 1)
    stationarity = slope + shared.own_multiplier + problem.gain.T @ shared.other_multiplier
    terms = np.concatenate([effort, hessian @ a, pull])
    size = max(float(np.abs(terms).max(initial=0.0)), 1e-12)
    scale = _row_scale(problem)
    result = [float(np.abs(stationarity).max(initial=0.0)) / size]
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
    """Return activations and multipliers of the minimum of 1/2 a.H a + g.a within all bounds."""
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
        np.where(equal, 5, 0).astype(np.intc),  # DAQP marks an equality by 5
        primal_tol=SOLVER_TOLERANCE,
        dual_tol=SOLVER_TOLERANCE,
    )
    if flag != OPTIMAL:
        what = "no muscle forces within their limits balance the joint moments"
        raise ComputationError(what, "muscles")
    multiplier = np.asarray(text["lam"], float)
    other = np.zeros(len(problem.offset))
    count = len(problem.lowest)
    other[bounded] = multiplier[count:] / scale[bounded]
    return np.asarray(a, float), multiplier[:count], other


def _row_scale(problem: LoadSharing) -> Array:
    """Return the largest change (m,) of each y by one muscle, which scales its bounds."""
    size = np.maximum(np.abs(problem.gain).max(axis=1, initial=0.0), 1e-12)
    return np.asarray(size)


def _descending(problem: LoadSharing, a: Array, step: Array) -> Array:
    """Return the step, halved until the cost does not increase."""
    before = problem.cost(a)
    for _ in range(30):
        if problem.cost(a + step) <= before * (1 + 1e-12):
            return step
        step = 0.5 * step
    return step


@dataclass(frozen=True, eq=False)
class EmgGuide:
    """Guidance of the activations a by EMG envelopes e.

    - "target" adds Σ_i W (a_i - e_i)² to the cost, with the weight W.
    - "bounds" limits a_i to e_i ± width, within the bounds of all muscles.

    Args:
        envelope: normalised envelopes, (f, m); NaN for muscles without EMG.
        use: "target" or "bounds".
        size: weight W or width.
    """

    envelope: Array
    use: Literal["target", "bounds"]
    size: float

    def only(self, k: int) -> "EmgGuide":
        """Return the guidance of frame k alone."""
        return replace(self, envelope=self.envelope[k : k + 1])

    def applied(self, problem: LoadSharing, k: int) -> LoadSharing:
        """Return the problem of frame k, guided by its envelopes."""
        finite, expected = np.isfinite(self.envelope[k]), np.nan_to_num(self.envelope[k])
        if self.use == "target":
            spread = np.where(finite, self.size**-0.5, np.inf)
            return replace(problem, expected=expected, spread=spread)
        low, high = (
            np.clip(expected + sign * self.size, problem.lowest, problem.highest)
            for sign in (-1.0, 1.0)
        )
        return replace(
            problem,
            lowest=np.where(finite, low, problem.lowest),
            highest=np.where(finite, high, problem.highest),
        )


# 1: largest relative violation of the optimality conditions. Beyond it the frame fails.
# The solver's residuals are smaller.
KKT_TOLERANCE = 1e-8


@dataclass(frozen=True)
class Sharing:
    """Options of the static optimisation.

    Args:
        muscles: names; None: the result of `leg_muscles`.
        coordinates: names of the balanced coordinates; None: hip, knee flexion, ankle, subtalar.
        reserve: r, N·m (N for a translation), for all coordinates or by name; None: those of
            `tkamb.run.muscles.leg.default_reserves`. A reserve of this
            size costs as much as one fully active muscle of weight 1. inf: no cost, 0: no reserve.
        exponent: p, at least 2.
        weights: "volume" (optimal fibre length times strength, relative to the mean) or "equal".
        least_share: least share of each condyle in the load of the knee, see
            `tkamb.run.muscles.knee_trial`; 0: a condyle may lift off. Only for tkamb's own knee.
        law: "isometric" (F_i is the maximal isometric force, without passive force) or "hill", see
            `rigid_tendon_strength`.
    """

    muscles: tuple[str, ...] | None = None
    coordinates: tuple[str, ...] | None = None
    reserve: float | Mapping[str, float] | None = 10.0
    exponent: float = 2.0
    weights: Literal["volume", "equal"] = "volume"
    lowest: float = 0.0
    highest: float = 1.0
    least_share: float = 0.0
    law: Literal["isometric", "hill"] = "isometric"

    def reserves(self, coordinates: Sequence[str]) -> Array:
        """Return r (c,) of c coordinates."""
        if isinstance(self.reserve, Mapping):
            return np.array([float(self.reserve[name]) for name in coordinates])
        assert self.reserve is not None
        return np.full(len(coordinates), float(self.reserve))

    def check(self, coordinates: Sequence[str]) -> None:
        """Raise an InputError for an option out of range."""
        if isinstance(self.reserve, Mapping) and set(self.reserve) != set(coordinates):
            unmatched = sorted(set(self.reserve) ^ set(coordinates))
            raise InputError(f"reserve and coordinates differ in {', '.join(unmatched)}", "muscles")
        if not (self.reserves(coordinates) >= 0.0).all():
            raise InputError("a reserve is negative or no number", "muscles")
        if not (0.0 <= self.lowest < self.highest < np.inf and 2.0 <= self.exponent < np.inf):
            raise InputError(
                f"lowest {self.lowest:g}, highest {self.highest:g}, exponent {self.exponent:g}",
                "muscles",
                "0 <= lowest < highest and exponent >= 2",
            )


@dataclass(frozen=True, eq=False)
class FrameProblems:
    """The optimisation problems of f frames, m muscles and c coordinates.

    Args:
        coordinates: names of the c balanced coordinates.
        moment: joint moments τ, N·m, (f, c).
        arms: moment arms, m, (f, m, c).
        active: forces at full activation without the passive forces, N, (f, m).
        guide: guidance by EMG; None: without.
        least: offset (r,) N and gain (r, m) of r sums of muscle forces that must not be negative;
            None: without.
    """

    muscles: list[OpenSimMuscle]
    coordinates: tuple[str, ...]
    sharing: Sharing
    moment: Array
    arms: Array
    active: Array
    passive: Array
    guide: EmgGuide | None = None
    least: tuple[Array, Array] | None = None

    def solved(self, k: int) -> tuple[Array, Array, float, str]:
        """Return activations (m,), reserves (c,), KKT residual and status of frame k."""
        reason = self._unknown(k)
        if reason is None:
            try:
                shared = share_load(self.frame(k))
            except ComputationError as error:
                reason = error.what
            else:
                if shared.kkt_residual < KKT_TOLERANCE:
                    others = shared.others[: len(self.coordinates)]
                    return shared.activation, others, shared.kkt_residual, "ok"
                reason = f"the conditions of the optimum are violated by {shared.kkt_residual:.1g}"
        missing = np.full(len(self.muscles), np.nan), np.full(len(self.coordinates), np.nan)
        return *missing, np.nan, f"failed: {reason}"

    def _unknown(self, k: int) -> str | None:
        if not np.isfinite(self.moment[k]).all():
            return "an external load is unknown"
        for missing, why in (
            (~np.isfinite(self.arms[k]).all(axis=1), "no taut path of"),
            (
                ~np.isfinite(self.active[k]),
                f"fibres beyond {LONGEST_FIBRE_RATIO:g} optimal lengths in",
            ),
        ):
            if missing.any():
                names = [self.muscles[i].name for i in np.flatnonzero(missing)]
                return f"{why} {', '.join(names)}"
        return None

    def frame(self, k: int) -> LoadSharing:
        """Return the problem of frame k."""
        count, reserve = len(self.muscles), self.sharing.reserves(self.coordinates)
        none = reserve == 0.0
        transposed = self.arms[k].T
        problem = LoadSharing(
            weight=_weights(self.muscles, self.sharing),
            lowest=np.full(count, self.sharing.lowest),
            highest=np.full(count, self.sharing.highest),
            offset=self.moment[k] - transposed @ self.passive[k],
            gain=-transposed * self.active[k],
            lower=np.where(none, 0.0, -np.inf),
            upper=np.where(none, 0.0, np.inf),
            reserve=np.where(none, np.inf, reserve),
            exponent=self.sharing.exponent,
        )
        problem = problem if self.guide is None else self.guide.applied(problem, k)
        return problem if self.least is None else self._above_least(problem, k)

    def _above_least(self, problem: LoadSharing, k: int) -> LoadSharing:
        """Return the problem with `least`'s sums as further y, without cost."""
        assert self.least is not None
        offset, gain = self.least
        without = np.full(len(offset), np.inf)
        return replace(
            problem,
            offset=np.concatenate([problem.offset, offset + gain @ self.passive[k]]),
            gain=np.vstack([problem.gain, gain * self.active[k]]),
            lower=np.concatenate([problem.lower, np.zeros(len(offset))]),
            upper=np.concatenate([problem.upper, without]),
            reserve=np.concatenate([problem.reserve, without]),
        )


def _weights(muscles: Sequence[OpenSimMuscle], sharing: Sharing) -> Array:
    if sharing.weights == "equal":
        return np.ones(len(muscles))
    volume = np.array([m.optimal_fibre_length_m * m.max_isometric_force_N for m in muscles])
    return volume / volume.mean()
