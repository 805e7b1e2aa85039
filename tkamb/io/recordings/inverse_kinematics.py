"""Inverse kinematics: the pose of a chain of segments that fits the measured markers best.

Per frame, with measured markers p_m, weights w_m (zero for a missing marker) and the chain's
markers x_m(q),

    min_q  sum_m w_m |x_m(q) - p_m|²

is solved by Gauss-Newton steps with Levenberg's damping and analytic Jacobians. Near the solution
Newton's method is used if the chain gives the curvature of the residuals. All frames are
independent and solved at once: every array has them as its first axis. No bounds are imposed, so
that a coordinate outside its range is visible.

Reference: Lu & O'Connor, J Biomech 32:129 (1999), doi:10.1016/S0021-9290(98)00158-4.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import Array, knee_pose, pose, transform

# m and rad: a frame has converged when its step is smaller. It is far below the
# noise of markers.
STEP_TOLERANCE = 1e-6
# m and rad: after a smaller step, the next step includes the curvature of the residuals (Newton);
# otherwise it does not (Gauss-Newton). Newton's method converges near the solution
# only.
NEWTON_BELOW = 0.1
# Largest number of iterations of a frame. Not studied.
MAX_ITERATIONS = 60


State = TypeVar("State")
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The least-squares problems of f frames, linearised at their states.

    Args:
        cost: (f,) m², sum of weighted squared distances.
        matrix: (f, n, n) Jᵀ W J.
        right: (f, n) Jᵀ W (p - x).
        curvature: (f, n, n) part of the Hessian due to the residuals; None: not computed.
    """

    cost: Array
    matrix: Array
    right: Array
    curvature: Array | None = None

    def of(self, frames: Index) -> "NormalEquations":
        """Return the equations of some frames."""
        curvature = None if self.curvature is None else self.curvature[frames]
        return NormalEquations(
            self.cost[frames], self.matrix[frames], self.right[frames], curvature
        )

    def replaced(self, frames: Index, part: "NormalEquations") -> "NormalEquations":
        """Return the equations with some frames replaced by `part`."""
        return NormalEquations(
            put(self.cost, frames, part.cost),
            put(self.matrix, frames, part.matrix),
            put(self.right, frames, part.right),
            None
            if self.curvature is None or part.curvature is None
            else put(self.curvature, frames, part.curvature),
        )


class MarkerChain(Protocol[State]):
    """A chain with n degrees of freedom and m markers."""

    def places(self, state: State) -> Array:
        """Return the chain's marker positions (f, m, 3), m."""

    def normal(self, state: State, target: Array, weights: Array) -> NormalEquations:
        """Return the normal equations for measured markers (f, m, 3) m with weights (f, m)."""

    def moved(self, state: State, step: Array) -> State:
        """Return the state after a step (f, n)."""

    def chosen(self, state: State, frames: Index) -> State:
        """Return the state of some frames."""

    def replaced(self, state: State, frames: Index, part: State) -> State:
        """Return the state with some frames replaced by `part`."""


@dataclass(frozen=True, eq=False)
class ChainFit(Generic[State]):
    """A chain fitted to markers.

    Args:
        rms: (f,) m, root mean square of `distance`; NaN without markers.
        distance: (f, m) m, from each measured marker to the chain's; NaN for a missing marker.
        solved: (f,) whether the last step was below `STEP_TOLERANCE`.
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
        measured: (f, m, 3) m, gaps NaN.
        weights: (m,) weights of the squared distances.
    """
    visible = np.isfinite(measured).all(axis=2)
    target, frame_weights = np.nan_to_num(measured), np.where(visible, weights, 0.0)
    damping, last_size = np.full(len(measured), 1e-6), np.full(len(measured), np.inf)
    active, steps = np.arange(len(measured)), 0
    state, residual = start, chain.normal(start, target, frame_weights)
    while steps < MAX_ITERATIONS:
        step = _step(
            residual.of(active),
            damping[active],
            last_size[active] < NEWTON_BELOW,
        )
        trial = chain.moved(chain.chosen(state, active), step)
        size = np.abs(step).max(axis=1)
        converged = size < STEP_TOLERANCE
        state = chain.replaced(
            state, active[converged], chain.chosen(trial, np.flatnonzero(converged))
        )
        active, size, steps = active[~converged], size[~converged], steps + 1
        if not len(active):
            break
        trial = chain.chosen(trial, np.flatnonzero(~converged))
        trial_residual = chain.normal(trial, target[active], frame_weights[active])
        # A step that raises the cost of a frame is rejected.
        better = trial_residual.cost <= residual.cost[active] * (1.0 + 1e-12) + 1e-24
        accepted, rows = active[better], np.flatnonzero(better)
        state = chain.replaced(state, accepted, chain.chosen(trial, rows))
        residual = residual.replaced(accepted, trial_residual.of(rows))
        damping[active] = np.clip(damping[active] * np.where(better, 0.1, 10.0), 1e-12, 1e6)
        last_size[active] = np.where(better, size, np.inf)
    distance = np.where(visible, np.linalg.norm(chain.places(state) - target, axis=2), np.nan)
    count = visible.sum(axis=1)
    rms = np.sqrt(np.nansum(distance**2, axis=1) / np.maximum(count, 1))
    solved = np.ones(len(measured), np.bool_)
    solved[active] = False
    return ChainFit(state, np.where(count > 0, rms, np.nan), distance, solved, steps)


def _step(equations: NormalEquations, damping: Array, near: NDArray[np.bool_]) -> Array:
    """Return the damped steps (f, n): Newton's where `near` (f,), else Gauss-Newton's.

    A Newton step that does not reduce the cost is replaced.
    """
    matrix, right = equations.matrix, equations.right
    diagonal = np.einsum("fii->fi", matrix)
    # The floor makes the matrix regular if no marker determines a degree of freedom.
    floor = 1e-9 * diagonal.max(axis=1, keepdims=True, initial=1e-12)
    added = (damping[:, None] * diagonal + floor)[:, :, None] * np.eye(matrix.shape[1])
    step = np.zeros_like(right)
    if equations.curvature is not None and near.any():
        hessian = (matrix + equations.curvature + added)[near]
        step[near] = np.linalg.solve(hessian, right[near][:, :, None])[:, :, 0]
    uphill = np.einsum("fi,fi->f", step, right) <= 0.0
    step[uphill] = np.linalg.solve((matrix + added)[uphill], right[uphill][:, :, None])[:, :, 0]
    return step


def put(values: Array, frames: Index, part: Array) -> Array:
    """Return a copy of `values` with those of some frames replaced by `part`."""
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


FLEXION = 5
"""Index of flexion among the knee coordinates."""


@dataclass(frozen=True, eq=False)
class Segment:
    """A body with markers.

    Args:
        name: "shank", "thigh", or the name of a neighbouring segment.
        points: (m, 3) m, its markers in its frame.
        weights: (m,) weights of the markers' squared distances.
        joined_to: of a neighbour: the segment, "shank" or "thigh", to which a ball joint connects
            it. Empty for shank and thigh.
        joint: (3,) m, the ball joint in the frame of `joined_to`.
        centre: (3,) m, the ball joint in the neighbour's frame.
    """

    name: str
    labels: tuple[str, ...]
    points: Array
    weights: Array
    joined_to: str = ""
    joint: Array | None = None
    centre: Array | None = None


@dataclass(frozen=True, eq=False)
class LegState:
    """Poses of a leg's segments.

    Args:
        shank: (f, 4, 4) pose_shank_in_world.
        knee: (f, 6) knee coordinates of the thigh; a hinge changes flexion only.
        thigh: (f, 4, 4) pose_thigh_in_world.
        turns: neighbour -> (f, 3, 3), its rotation in the frame of its `joined_to`.
    """

    shank: Array
    knee: Array
    thigh: Array
    turns: dict[str, Array]


class LegChain:
    """Shank and thigh joined by the knee, and neighbours joined by ball joints.

    Degrees of freedom, in order: shank (translation, rotation about its origin; world axes), knee
    (flexion of a hinge, or translation and rotation of a free thigh), three per ball joint.

    Args:
        segments: "shank" and "thigh", and their neighbours.
        pose_insert_in_shank: (4, 4), the frame of the knee coordinates.
        free: whether the knee has six degrees of freedom; otherwise it is a hinge.
    """

    def __init__(
        self, segments: Sequence[Segment], pose_insert_in_shank: Array, free: bool
    ) -> None:
        self.segments = {segment.name: segment for segment in segments}
        self.insert, self.free = pose_insert_in_shank, free
        self.balls = [segment for segment in segments if segment.joined_to]
        first = 12 if free else 7
        self._columns = {ball.name: first + 3 * k for k, ball in enumerate(self.balls)}
        self.freedoms = first + 3 * len(self.balls)

    def poses(self, state: LegState) -> dict[str, Array]:
        """Return segment -> (f, 4, 4) pose_segment_in_world."""
        poses = {"shank": state.shank, "thigh": state.thigh}
        for ball in self.balls:
            assert ball.joint is not None and ball.centre is not None
            turn = state.turns[ball.name]
            offset = ball.joint - np.einsum("fij,j->fi", turn, ball.centre)
            poses[ball.name] = poses[ball.joined_to] @ pose(turn, offset)
        return poses

    def start(self, fitted: dict[str, Array], neutral: Array) -> LegState:
        """Return an initial guess from the separate fits of the segments.

        Args:
            fitted: segment -> (f, 4, 4) pose in the world; NaN in frames without a fit.
            neutral: (6,) constant knee coordinates of a hinge.
        """
        shank = _fill_gaps(fitted["shank"])
        thigh = _fill_gaps(fitted["thigh"])
        knee = np.tile(neutral, (len(shank), 1))
        turn = np.swapaxes((shank @ self.insert)[:, :3, :3], 1, 2) @ thigh[:, :3, :3]
        angles = Rotation.from_matrix(turn).as_euler("YXZ")
        knee[:, FLEXION] = np.unwrap(angles[:, 2])
        if not self.free:
            thigh = shank @ self.insert @ knee_pose(knee)
        state = LegState(shank, knee, thigh, {})
        for ball in self.balls:
            parent = {"shank": shank, "thigh": thigh}.get(ball.joined_to)
            assert parent is not None
            rotation = _fill_gaps(fitted[ball.name])[:, :3, :3]
            state.turns[ball.name] = np.swapaxes(parent[:, :3, :3], 1, 2) @ rotation
        return state

    def places(self, state: LegState) -> Array:
        """Return the positions (f, m, 3) m of the chain's markers."""
        return self.markers(state)[0]

    def normal(self, state: LegState, target: Array, weights: Array) -> NormalEquations:
        """Return the normal equations for measured markers (f, m, 3) m with weights (f, m)."""
        places, jacobian = self.markers(state)
        frames = len(places)
        off, w = target - places, weights[:, :, None]
        j = jacobian.reshape(frames, -1, self.freedoms)
        weighted = (w[..., None] * jacobian).reshape(frames, -1, self.freedoms)
        return NormalEquations(
            np.sum(w * off**2, axis=(1, 2)),
            np.swapaxes(j, 1, 2) @ weighted,
            np.einsum("fki,fk->fi", weighted, off.reshape(frames, -1)),
        )

    def markers(self, state: LegState) -> tuple[Array, Array]:
        """Return the chain's marker positions (f, m, 3) m and their Jacobian (f, m, 3, n)."""
        poses, places, blocks = self.poses(state), [], []
        for segment in self.segments.values():
            x = transform(poses[segment.name], segment.points[None])
            block = np.zeros((*x.shape, self.freedoms))
            name = segment.name
            while name in self._columns:
                ball, column = self.segments[name], self._columns[name]
                assert ball.centre is not None
                centre = transform(poses[name], ball.centre)
                block[..., column : column + 3] = -skew(x - centre[:, None])
                name = ball.joined_to
            self._add_knee(block, x, name, state)
            places.append(x)
            blocks.append(block)
        return np.concatenate(places, axis=1), np.concatenate(blocks, axis=1)

    def _add_knee(self, block: Array, x: Array, name: str, state: LegState) -> None:
        """Add the columns of shank and knee to the Jacobian of x (f, m, 3)."""
        if name == "thigh" and self.free:
            block[..., 6:9] = np.eye(3)
            block[..., 9:12] = -skew(x - state.thigh[:, None, :3, 3])
            return
        block[..., :3] = np.eye(3)
        block[..., 3:6] = -skew(x - state.shank[:, None, :3, 3])
        if name == "thigh":
            axis = state.thigh[:, None, :3, 2]  # flexion turns about the femur's z
            block[..., 6] = np.cross(axis, x - state.thigh[:, None, :3, 3])

    def moved(self, state: LegState, step: Array) -> LegState:
        """Return the state after a step (f, n)."""
        shank = _displaced(state.shank, step[:, :6])
        knee = state.knee.copy()
        if self.free:
            thigh = _displaced(state.thigh, step[:, 6:12])
        else:
            knee[:, FLEXION] += step[:, 6]
            thigh = shank @ self.insert @ knee_pose(knee)
        parents, turns = {"shank": shank, "thigh": thigh}, {}
        for ball in self.balls:
            column = self._columns[ball.name]
            world = Rotation.from_rotvec(step[:, column : column + 3]).as_matrix()
            parent = parents[ball.joined_to][:, :3, :3]
            rotation = world @ parent @ state.turns[ball.name]
            turns[ball.name] = np.swapaxes(parent, 1, 2) @ rotation
        return LegState(shank, knee, thigh, turns)

    def chosen(self, state: LegState, frames: Index) -> LegState:
        """Return the state of some frames."""
        turns = {name: turn[frames] for name, turn in state.turns.items()}
        return LegState(state.shank[frames], state.knee[frames], state.thigh[frames], turns)

    def replaced(self, state: LegState, frames: Index, part: LegState) -> LegState:
        """Return the state with some frames replaced by `part`."""
        turns = {name: put(turn, frames, part.turns[name]) for name, turn in state.turns.items()}
        return LegState(
            put(state.shank, frames, part.shank),
            put(state.knee, frames, part.knee),
            put(state.thigh, frames, part.thigh),
            turns,
        )


def _displaced(poses: Array, step: Array) -> Array:
    turn = Rotation.from_rotvec(step[:, 3:]).as_matrix()
    return pose(turn @ poses[:, :3, :3], poses[:, :3, 3] + step[:, :3])


def _fill_gaps(poses: Array) -> Array:
    finite = np.flatnonzero(np.isfinite(poses[:, 0, 3]))
    if not len(finite):
        return np.tile(np.eye(4), (len(poses), 1, 1))
    nearest = finite[np.clip(np.searchsorted(finite, np.arange(len(poses)), "right") - 1, 0, None)]
    return np.asarray(poses[nearest])
