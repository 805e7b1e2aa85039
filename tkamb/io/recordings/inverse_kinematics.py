"""Inverse kinematics: the pose of a chain of segments that fits the measured markers best.

Per frame, with measured markers p_m, weights w_m (zero for a marker that is missing) and the
chain's markers x_m(q),

    min_q  sum_m w_m |x_m(q) - p_m|²

by Gauss-Newton with Levenberg's damping and analytic Jacobians, and by Newton's method near
the solution where the chain brings the residuals' curvature. Frames are independent of each
other and solved all at once: every array has the frames as its first axis. Bounds are not
imposed, so that a coordinate outside its range shows.

Reference: Lu & O'Connor, J Biomech 32:129 (1999), doi:10.1016/S0021-9290(98)00158-4.
"""

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class InverseKinematicsSettings:
    """The fit of the poses of a leg to its markers, frame by frame."""

    step_tolerance: float = 1e-6
    """m and rad; a frame has converged when its step is smaller. Chosen: far below the noise of
    markers."""
    newton_below: float = 0.1
    """m and rad: after a smaller step the curvature of the residuals is included (Newton's method),
    before that it is not (Gauss-Newton). Chosen: nearer to the solution Newton's method
    converges."""
    max_iterations: int = 60
    """Iterations after which a frame without convergence fails. Chosen: frames that converge need
    fewer."""


INVERSE_KINEMATICS = InverseKinematicsSettings()


State = TypeVar("State")
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The least squares of f frames, linearised at their states.

    Args:
        cost: (f,) m², sum of weighted squared distances.
        matrix: (f, n, n) Jᵀ W J.
        right: (f, n) Jᵀ W (p - x).
        curvature: (f, n, n) part of the Hessian due to the residuals; None: not known.
    """

    cost: Array
    matrix: Array
    right: Array
    curvature: Array | None = None

    def of(self, frames: Index) -> "NormalEquations":
        """Return the equations of some frames."""
        bent = None if self.curvature is None else self.curvature[frames]
        return NormalEquations(self.cost[frames], self.matrix[frames], self.right[frames], bent)

    def replaced(self, frames: Index, part: "NormalEquations") -> "NormalEquations":
        """Return the equations with some frames as in `part`."""
        return NormalEquations(
            put(self.cost, frames, part.cost),
            put(self.matrix, frames, part.matrix),
            put(self.right, frames, part.right),
            None
            if self.curvature is None or part.curvature is None
            else put(self.curvature, frames, part.curvature),
        )


class MarkerChain(Protocol[State]):
    """Interface of a chain with n degrees of freedom and m markers for the least squares."""

    def places(self, state: State) -> Array:
        """Return the markers (f, m, 3) m."""

    def normal(self, state: State, target: Array, weights: Array) -> NormalEquations:
        """Return the least squares to markers (f, m, 3) m with weights (f, m)."""

    def moved(self, state: State, step: Array) -> State:
        """Return the state after a step (f, n)."""

    def chosen(self, state: State, frames: Index) -> State:
        """Return the state of some frames."""

    def replaced(self, state: State, frames: Index, part: State) -> State:
        """Return the state with some frames as in `part`."""


@dataclass(frozen=True, eq=False)
class ChainFit(Generic[State]):
    """A chain fitted to markers.

    Args:
        state: where it stands.
        rms: (f,) m, over the markers that were seen; NaN where none was.
        distance: (f, m) m, of each marker; NaN where missing.
        solved: (f,) whether the last step was below `INVERSE_KINEMATICS.step_tolerance`.
        steps: of the iteration.
    """

    state: State
    rms: Array
    distance: Array
    solved: np.ndarray
    steps: int


def fit_chain(
    chain: MarkerChain[State], measured: Array, weights: Array, start: State
) -> ChainFit[State]:
    """Return the weighted least-squares fit of a chain, all frames at once.

    Args:
        chain: the chain.
        measured: (f, m, 3) m, gaps NaN.
        weights: (m,) of the squared distances.
        start: where the iteration begins.
    """
    visible = np.isfinite(measured).all(axis=2)
    target, each = np.nan_to_num(measured), np.where(visible, weights, 0.0)
    damping, last = np.full(len(measured), 1e-6), np.full(len(measured), np.inf)
    active, steps = np.arange(len(measured)), 0
    state, residual = start, chain.normal(start, target, each)
    while steps < INVERSE_KINEMATICS.max_iterations:
        step = _step(
            residual.of(active), damping[active], last[active] < INVERSE_KINEMATICS.newton_below
        )
        trial = chain.moved(chain.chosen(state, active), step)
        size = np.abs(step).max(axis=1)
        converged = size < INVERSE_KINEMATICS.step_tolerance
        state = chain.replaced(
            state, active[converged], chain.chosen(trial, np.flatnonzero(converged))
        )
        active, size, steps = active[~converged], size[~converged], steps + 1
        if not len(active):
            break
        trial = chain.chosen(trial, np.flatnonzero(~converged))
        trial_residual = chain.normal(trial, target[active], each[active])
        # A frame whose cost would rise keeps its state.
        better = trial_residual.cost <= residual.cost[active] * (1.0 + 1e-12) + 1e-24
        accepted, rows = active[better], np.flatnonzero(better)
        state = chain.replaced(state, accepted, chain.chosen(trial, rows))
        residual = residual.replaced(accepted, trial_residual.of(rows))
        damping[active] = np.clip(damping[active] * np.where(better, 0.1, 10.0), 1e-12, 1e6)
        last[active] = np.where(better, size, np.inf)
    distance = np.where(visible, np.linalg.norm(chain.places(state) - target, axis=2), np.nan)
    count = visible.sum(axis=1)
    rms = np.sqrt(np.nansum(distance**2, axis=1) / np.maximum(count, 1))
    solved = np.ones(len(measured), np.bool_)
    solved[active] = False
    return ChainFit(state, np.where(count > 0, rms, np.nan), distance, solved, steps)


def _step(equations: NormalEquations, damping: Array, near: NDArray[np.bool_]) -> Array:
    """Return the damped steps (f, n) of some frames: Newton's where `near`, else Gauss-Newton's.

    A Newton step that would not descend is replaced.
    """
    matrix, right = equations.matrix, equations.right
    diagonal = np.einsum("fii->fi", matrix)
    # The floor keeps degrees of freedom that no marker determines at their value.
    floor = 1e-9 * diagonal.max(axis=1, keepdims=True, initial=1e-12)
    added = (damping[:, None] * diagonal + floor)[:, :, None] * np.eye(matrix.shape[1])
    step = np.zeros_like(right)
    if equations.curvature is not None and near.any():
        whole = (matrix + equations.curvature + added)[near]
        step[near] = np.linalg.solve(whole, right[near][:, :, None])[:, :, 0]
    uphill = np.einsum("fi,fi->f", step, right) <= 0.0
    step[uphill] = np.linalg.solve((matrix + added)[uphill], right[uphill][:, :, None])[:, :, 0]
    return step


def put(values: Array, frames: Index, part: Array) -> Array:
    """Return values with some frames as in `part`."""
    result = values.copy()
    result[frames] = part
    return result


def skew(vectors: Array) -> Array:
    """Return the matrices (..., 3, 3) of a ↦ v × a for vectors v (..., 3)."""
    result = np.zeros((*vectors.shape, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    result[..., 0, 1], result[..., 0, 2] = -z, y
    result[..., 1, 0], result[..., 1, 2] = z, -x
    result[..., 2, 0], result[..., 2, 1] = -y, x
    return result
