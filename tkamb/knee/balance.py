"""Equilibrium of a few coordinates under forces that depend on them: Newton in a trust region.

Let r(q) be the force that drives each coordinate, and K = -dr/dq the stiffness. A step d solves (K
+ lambda I) d = r. lambda is the smallest value with which the step descends and stays inside the
region. The ratio of W, the work of the forces along the step (trapezoidal rule), and W_K, the work
that K predicts, decides whether the step is accepted:

    W = (r(q) + r(q + d)) . d / 2          W_K = r(q) . d - d . K d / 2

If the forces have a potential, W is the energy that a step releases. A trial that overshoots into a
stiff contact has W < 0 and is rejected. Follower loads make K unsymmetric, and an equilibrium may
be stable although K is not positive definite. Near it, work does not show whether a step comes
closer: there the search takes Newton steps, and |r| decides on acceptance. A search that does not
converge is repeated once: |r| then decides for full Newton steps, and work for shorter steps.

All coordinates are in metres and all forces in newtons: rotations are scaled by a lever arm.

References: Nocedal & Wright, Numerical Optimization, 2nd ed., ch. 4 (2006),
doi:10.1007/978-0-387-40065-5.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import lru_cache

import numpy as np

from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class BalanceSettings:
    """Tolerances and limits of the search for the released coordinates."""

    force_tolerance: float = 0.05
    """N (moments are divided by the lever arm): residual below which a coordinate has converged.
    Larger noise of the forces replaces it. It is far below the resolution of the reports.
    """
    step_tolerance: float = 2e-6
    """m: Newton step below which a coordinate has converged. Not studied."""
    least_stiffness: float = 100.0
    """N/m: a state with a smaller stiffness is indeterminate. Such a state moves by
    more than 10 mm per newton."""
    narrow_radius: float = 1e-6
    """m: trust radius below which finite differences replace an approximate stiffness.
    An approximation that needs shorter steps does not reduce the residual."""
    jump_step: float = 1e-7
    """m: step below which a change of force that the stiffness does not explain is a jump. A
    contact of 1e7 N/m changes by 1 N at most.
    """
    largest_jump: float = 1.0
    """N: largest jump on which an equilibrium may lie. 0.1 % of a usual load. Measured: at 2 mm 3
    of 72 frames of subject JW had no equilibrium without it. The foundation's force jumped by 0.2
    to 0.6 N, where a column crosses an edge of two femoral facets.
    """
    max_travel: float = 20e-3
    """m: largest distance of a coordinate from its initial guess; beyond it the search ends.
    A coordinate that moves as far has no stable equilibrium."""
    difference_step: float = 2e-6
    """m: step of the finite differences of the force. Equal to `step_tolerance`."""
    max_prediction_error: float = 0.5
    """1: relative error of the predicted change of force. A larger error discards all corrections
    of an approximate stiffness. With a larger error a step does not reduce the
    residual reliably."""
    max_steps: int = 200
    """Maximum number of steps. A lightly loaded knee that slides 16 mm over lattice
    cells of 2 mm needs 80."""


BALANCE = BalanceSettings()

FIRST_RADIUS, WIDEST_RADIUS, NARROWEST_RADIUS = 0.5e-3, 3e-3, 1e-9
"""m: first radius of the trust region, and its limits."""


class BalanceStatus(Enum):
    """How a search for equilibrium ended."""

    OK = "ok"
    NOT_CONVERGED = "not converged"
    INDETERMINATE = "indeterminate: nothing holds the released coordinates where they are"
    UNSTABLE = "unstable equilibrium"
    RUNS_AWAY = "the released coordinates run away: nothing stops them"
    OUT_OF_RANGE = "out of the contact model's range"


@dataclass(frozen=True, eq=False)
class Trial:
    """The forces at trial coordinates.

    Args:
        force: driving forces, (n,), N, positive along the positive coordinates; NaN: unknown.
        stiffness: -d force / d coordinates, (n, n), N/m; None: by finite differences.
        exact: whether `stiffness` is the exact tangent. The search corrects an approximation from
            step to step.
        force_noise: error of the force, N; a force below it counts as zero.
    """

    force: Array
    stiffness: Array | None = None
    exact: bool = True
    force_noise: float = 0.0


@dataclass(frozen=True, eq=False)
class Balance:
    """The result of a search.

    Args:
        coordinates: last coordinates, (n,), m.
        force: residual, (n,), N.
        stiffness: stiffness at these coordinates, (n, n), N/m.
        steps: number of accepted and rejected steps.
        smallest_stiffness: smallest real part of the stiffness' eigenvalues, N/m.
        work: work of the forces along each accepted step, N·m.
        converged: True: converged to the tolerances. False: ended early by `residual_share` or
            `stop_distance`.
    """

    coordinates: Array
    force: Array
    stiffness: Array
    status: BalanceStatus
    steps: int
    trials: int
    smallest_stiffness: float
    work: tuple[float, ...]
    converged: bool = True


Forces = Callable[[Array], Trial]


def find_balance(
    forces: Forces,
    start: Array,
    stiffness: Array | None = None,
    residual_share: float = 0.0,
    stop_distance: float = np.inf,
) -> Balance:
    """Find the coordinates at which all forces are in equilibrium.

    Args:
        forces: coordinates (n,), m -> `Trial`.
        start: initial guess, (n,), m.
        stiffness: stiffness of an earlier, similar search, (n, n), N/m. It saves trials if `forces`
            gives no stiffness.
        residual_share: remaining Newton step, relative to the distance from the initial guess, at
            which the search ends early; 0: the tolerances alone decide. Use it for a search that is
            repeated under other forces.
        stop_distance: distance of a coordinate from its initial guess at which the search ends
            early, m.
    """
    result = _Search(forces, np.array(start, float), stiffness, residual_share, stop_distance).run()
    if result.status not in (BalanceStatus.RUNS_AWAY, BalanceStatus.NOT_CONVERGED):
        return result
    # Across the facets of a contact Newton's direction may lead away from the equilibrium. The
    # direction of decreasing energy does not.
    second = _Search(
        forces, np.array(start, float), stiffness, residual_share, stop_distance, downhill=True
    ).run()
    if second.status is not BalanceStatus.OK:
        return result
    return replace(second, trials=result.trials + second.trials, steps=result.steps + second.steps)


class _Search:
    def __init__(
        self,
        forces: Forces,
        start: Array,
        stiffness: Array | None,
        residual_share: float,
        stop_distance: float,
        downhill: bool = False,
    ) -> None:
        self._forces, self._start, self._downhill = forces, start, downhill
        self._residual_share, self._stop_distance = residual_share, stop_distance
        self._trials, self._steps = 0, 0
        self._from_differences, self._steps_since_differences, self._force_unknown = False, 0, False
        self._radius, self._newton_rejected = FIRST_RADIUS, False
        self._work: list[float] = []
        self._jump = 0.0
        self.x = start
        first = self._at(start)
        self.force, self._force_noise = first.force, first.force_noise
        self.known = bool(np.isfinite(first.force).all())
        if self.known:
            self._exact_tangent, self._model_stiffness = (
                first.stiffness is not None and first.exact,
                first.stiffness,
            )
            self._correction = np.zeros((len(start), len(start)))
            known = stiffness if first.stiffness is None else first.stiffness
            self.stiffness = self._differences() if known is None else known
        else:
            self.stiffness = np.full((len(start), len(start)), np.nan)

    def run(self) -> Balance:
        if not self.known:
            return self._end(BalanceStatus.OUT_OF_RANGE)
        while self._steps < BALANCE.max_steps:
            # A finite difference was out of range.
            if not np.isfinite(self.stiffness).all():
                return self._end(BalanceStatus.OUT_OF_RANGE)
            if self._converged():
                return self._end(self._stability())
            if self._close_enough() or self._travel() > self._stop_distance:
                return replace(self._end(BalanceStatus.OK), converged=False)
            if self._travel() > BALANCE.max_travel:
                return self._end(BalanceStatus.RUNS_AWAY)
            if self._radius < NARROWEST_RADIUS and (self._exact_tangent or self._from_differences):
                break
            if self._model_stiffness is None and self._steps_since_differences > len(self.x):
                self._refresh()
            else:
                self._step()
        out_of_range = self._radius < NARROWEST_RADIUS and self._force_unknown
        return self._end(
            BalanceStatus.OUT_OF_RANGE if out_of_range else BalanceStatus.NOT_CONVERGED
        )

    def _step(self) -> None:
        step, share = self._next()
        trial = self._at(self.x + step)
        self._steps, self._steps_since_differences = (
            self._steps + 1,
            self._steps_since_differences + 1,
        )
        length = float(np.linalg.norm(step))
        # Work that the linear model predicts along the step. The forces need not have a potential.
        # The trust region therefore compares work and not energy.
        predicted = float(self.force @ step - 0.5 * step @ self.stiffness @ step)
        # Work along the step from the forces at its two ends (trapezoidal rule).
        work = float(0.5 * (self.force + trial.force) @ step)
        self._force_unknown = not np.isfinite(work)
        if self._force_unknown:
            # Out of the contact model's range: reject the step and try a shorter step.
            self._radius = 0.25 * length
            return
        if length < BALANCE.jump_step:
            unexplained = self.force - trial.force - self.stiffness @ step
            jump = float(np.abs(unexplained).max())
            self._jump = max(self._jump, jump) if jump <= BALANCE.largest_jump else 0.0
        else:
            self._jump = 0.0
        # Relative reduction of the residual by the step.
        reduction = 1.0 - float(np.linalg.norm(trial.force) / np.linalg.norm(self.force))
        # A given share of Newton's step should reduce the residual by the same share. Half of this
        # reduction is enough to accept the step, whatever its work.
        reduces = share > 0 and reduction > 0.5 * share
        ratio = 1.0 if reduces else work / predicted if predicted > 0 else -1.0
        accepted = ratio > 0.05
        # |r| may rise across a kink of the contact: the next step is then a bounded step.
        self._newton_rejected = share > 0 and not accepted
        if not self._exact_tangent:
            self._learn(step, trial)
        if ratio < 0.25:
            self._radius = 0.25 * length
            approximation_fails = (
                self._model_stiffness is None or self._radius < BALANCE.narrow_radius
            )
            if (
                not (self._exact_tangent or self._from_differences)
                and approximation_fails
                and ratio < 0.05
            ):
                self._refresh()
        elif ratio > 0.7 and length > 0.8 * self._radius:
            self._radius = min(2.0 * self._radius, WIDEST_RADIUS)
        if accepted:
            self._work.append(work)
            self.x, self.force, self._force_noise = self.x + step, trial.force, trial.force_noise
            self._from_differences = False
            if trial.stiffness is not None:
                self._model_stiffness, self.stiffness = (
                    trial.stiffness,
                    trial.stiffness + self._correction,
                )

    def _next(self) -> tuple[Array, float]:
        """Return the next step, and its share of Newton's step; 0: it is no Newton step."""
        symmetric, smallest_stiffness = smallest_eigenvalues(self.stiffness)
        if symmetric > 0 or smallest_stiffness <= 0 or self._newton_rejected:
            return bounded_step(self.stiffness, self.force, self._radius), 0.0
        # The stiffness is K = -dr/dx, so that K dx = r is Newton's step.
        newton = newton_step(self.stiffness, self.force)
        if newton is None:
            return bounded_step(self.stiffness, self.force, self._radius), 0.0
        share = min(1.0, self._radius / float(np.linalg.norm(newton)))
        if self._downhill and share < 1.0:
            return bounded_step(self.stiffness, self.force, self._radius), 0.0
        return np.asarray(share * newton), share

    def _at(self, x: Array) -> Trial:
        self._trials += 1
        return self._forces(x)

    def _differences(self) -> Array:
        self._from_differences, self._steps_since_differences = True, 0
        columns = [
            self._at(self.x + d).force for d in BALANCE.difference_step * np.eye(len(self.x))
        ]
        return (self.force[:, None] - np.array(columns).T) / BALANCE.difference_step

    def _refresh(self) -> None:
        self.stiffness = self._differences()
        self._correction = self.stiffness - (
            0.0 if self._model_stiffness is None else self._model_stiffness
        )
        self._radius = max(self._radius, 1e-2 * FIRST_RADIUS)

    def _learn(self, step: Array, trial: Trial) -> None:
        """Correct the stiffness along a step (Broyden 1965, doi:10.2307/2003941).

        If both ends have an approximate stiffness, the update corrects their mean. If the change of
        force differs too much from its prediction (contact was made or lost), all updates are
        discarded, unless the stiffness comes from new finite differences.
        """
        expected = self.stiffness @ step
        if self._model_stiffness is not None and trial.stiffness is not None:
            # The mean stiffness of the two ends predicts the change of force to second order.
            expected = expected + 0.5 * (trial.stiffness - self._model_stiffness) @ step
        unexplained = (self.force - trial.force) - expected
        # Broyden's rank-one update: the smallest change of the stiffness that explains this step.
        update = np.outer(unexplained, step) / (step @ step)
        poorly_predicted = np.linalg.norm(
            unexplained
        ) > BALANCE.max_prediction_error * np.linalg.norm(expected)
        if self._model_stiffness is not None and poorly_predicted and not self._from_differences:
            update = -self._correction
        self._correction, self.stiffness = self._correction + update, self.stiffness + update

    def _converged(self) -> bool:
        # Equilibrium lies on a jump of the forces: the residual changes its sign across it.
        if np.abs(self.force).max() <= self._jump:
            return True
        if np.abs(self.force).max() > max(BALANCE.force_tolerance, self._force_noise):
            return False
        # A direction without stiffness has no Newton step; `_stability` reports it.
        left_vectors, values, right_vectors = np.linalg.svd(self.stiffness)
        stiff = values > BALANCE.least_stiffness
        step = right_vectors[stiff].T @ ((left_vectors.T @ self.force)[stiff] / values[stiff])
        return bool((np.abs(step) < BALANCE.step_tolerance).all())

    def _travel(self) -> float:
        return float(np.abs(self.x - self._start).max())

    def _close_enough(self) -> bool:
        # Newton's step estimates the remaining distance.
        distance = self._residual_share * float(np.linalg.norm(self.x - self._start))
        if distance == 0.0 or self._smallest_stiffness() <= BALANCE.least_stiffness:
            return False
        step = float(np.linalg.norm(np.linalg.solve(self.stiffness, self.force)))
        return step < min(distance, self._radius)

    def _stability(self) -> BalanceStatus:
        if (
            not (self._exact_tangent or self._from_differences)
            and self._smallest_stiffness() <= BALANCE.least_stiffness
        ):
            self._refresh()
        smallest_stiffness = self._smallest_stiffness()
        if np.isnan(smallest_stiffness):
            return BalanceStatus.OUT_OF_RANGE
        if smallest_stiffness < -BALANCE.least_stiffness:
            return BalanceStatus.UNSTABLE
        return (
            BalanceStatus.OK
            if smallest_stiffness > BALANCE.least_stiffness
            else BalanceStatus.INDETERMINATE
        )

    def _smallest_stiffness(self) -> float:
        finite = np.isfinite(self.stiffness).all()
        return smallest_eigenvalues(self.stiffness)[1] if finite else np.nan

    def _end(self, status: BalanceStatus) -> Balance:
        return Balance(
            self.x,
            self.force,
            self.stiffness,
            status,
            self._steps,
            self._trials,
            self._smallest_stiffness(),
            tuple(self._work),
        )


# 1: residual over a load at which the steps after a search end.
SMALL_RESIDUAL = 1e-10
# 1: steps of Newton's method after a search. Not studied.
MAX_STEPS = 12
# 1: halvings of such a step until the residual falls. Not studied.
MAX_HALVINGS = 6


def polished(forces: Forces, start: Array, size: float) -> tuple[Array, Trial]:
    """Return the coordinates of smallest residual by Newton's method, and their trial.

    Args:
        start: coordinates (n,) near the equilibrium, m.
        size: load to which the residual is compared, N.
    """
    x, last = start, forces(start)
    for _ in range(MAX_STEPS):
        small = np.abs(last.force).max() <= SMALL_RESIDUAL * size
        if small or last.stiffness is None:
            break
        step = np.linalg.solve(last.stiffness, last.force)
        for _ in range(MAX_HALVINGS):
            closer = forces(x + step)
            if np.linalg.norm(closer.force) < np.linalg.norm(last.force):
                break
            step = 0.5 * step
        else:
            break
        x, last = x + step, closer
    return x, last


def newton_step(stiffness: Array, force: Array) -> Array | None:
    """Return Newton's step (n,), m; None if the stiffness is singular."""
    try:
        return np.asarray(np.linalg.solve(stiffness, force))
    except np.linalg.LinAlgError:
        return None


def bounded_step(stiffness: Array, force: Array, radius: float) -> Array:
    """Return the Newton step (n,), m, or a shorter, descending step within the radius.

    Args:
        stiffness: stiffness, not necessarily symmetric, (n, n), N/m.
        force: driving forces, (n,), N.
        radius: trust radius, m.
    """
    symmetric, smallest_stiffness = smallest_eigenvalues(stiffness)
    identity = np.eye(len(force))
    if smallest_stiffness > 0:
        newton = newton_step(stiffness, force)
        if newton is not None and np.linalg.norm(newton) <= radius:
            return newton
    # Levenberg's shift makes the matrix positive definite. Bisection finds the shift with which the
    # step ends at the edge of the trust region.
    low = 1.0 + 1.001 * max(0.0, -symmetric)
    high = low + float(np.linalg.norm(force)) / radius + 1.0
    for _ in range(50):
        shift = 0.5 * (low + high)
        step = np.linalg.solve(stiffness + shift * identity, force)
        length = float(np.linalg.norm(step))
        if 0.9 * radius <= length <= radius:
            return np.asarray(step)
        low, high = (shift, high) if length > radius else (low, shift)
    return np.asarray(np.linalg.solve(stiffness + high * identity, force))


def smallest_eigenvalues(stiffness: Array) -> tuple[float, float]:
    """Return the smallest eigenvalue of the symmetric part, and the smallest real part.

    Follower loads make a stiffness unsymmetric. A state is then stable against divergence if the
    second value is positive.
    """
    return _smallest_eigenvalues(stiffness.tobytes(), len(stiffness))


@lru_cache(maxsize=4)
def _smallest_eigenvalues(entries: bytes, count: int) -> tuple[float, float]:
    """Return `smallest_eigenvalues`; each step of a search asks repeatedly."""
    stiffness = np.frombuffer(entries).reshape(count, count)
    # The symmetric part decides whether a step descends. The eigenvalues decide on stability.
    symmetric = float(np.linalg.eigvalsh(0.5 * (stiffness + stiffness.T))[0])
    return symmetric, float(np.linalg.eigvals(stiffness).real.min())
