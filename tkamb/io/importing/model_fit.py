"""Least-squares fit of an OpenSim model to markers, as in OpenSim's InverseKinematicsTool.

All coordinates are free, except locked ones and the dependent ones of couplers; ranges are not
imposed. This module gives residuals and derivatives to `tkamb.io.recordings.inverse_kinematics`.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.importing.markers import recorded_labels
from tkamb.io.opensim.kinematics import Kinematics, cross
from tkamb.io.opensim.model import Joint, OpenSimModel
from tkamb.io.recordings.inverse_kinematics import ChainFit, Index, NormalEquations, fit_chain, put
from tkamb.io.recordings.laboratory import laboratory_rotation
from tkamb.io.recordings.markers import marker_trajectories, matched_labels
from tkamb.io.recordings.tables import Table

# Number of frames that are fitted in one call. It does not change the result. The
# arrays then fit into the processor's cache.
BLOCK_FRAMES = 128
# frames: every `COARSE_STRIDE`-th frame is fitted first. Interpolation between these poses gives
# the initial guesses of the other frames. Chosen freely: it changes only these guesses.
COARSE_STRIDE = 8


class ModelChain:
    """The free coordinates of a model and some of its markers."""

    def __init__(self, model: OpenSimModel, markers: Sequence[str]) -> None:
        self.kinematics = Kinematics(model)
        self._at = [self.kinematics.bodies[model.markers[name].body] for name in markers]
        self._points = np.array([model.markers[name].location for name in markers])
        index = self.kinematics.coordinates
        followers = {coupler.dependent for coupler in model.couplers}
        self.free = [
            index[name]
            for name, coordinate in model.coordinates.items()
            if not (coordinate.locked or name in followers)
        ]
        self._couplers = [
            (index[c.dependent], index[c.independent], c.function) for c in model.couplers
        ]
        # Free coordinates come first, then those that depend on them through one or more couplers.
        follow: list[int] = []
        for dependent, independent, _ in self._couplers:
            if independent in self.free or independent in follow:
                follow.append(dependent)
        self._moving = [*self.free, *follow]
        self._after = [
            (self._moving.index(d), self._moving.index(i), i, f)
            for d, i, f in self._couplers
            if d in follow
        ]
        carries, above = _tree(self.kinematics, self._at)
        self._carries, self._above = (
            carries[self._moving],
            above[np.ix_(self._moving, self._moving)],
        )

    def default(self, frames: int) -> Array:
        """Return the default coordinates (f, n) for f frames."""
        return np.tile(self.kinematics.coupled({}), (frames, 1))

    def places(self, state: Array) -> Array:
        """Return the marker positions (f, m, 3), m, in ground."""
        return self._markers_at(self.kinematics.poses(state))

    def _markers_at(self, poses: Array) -> Array:
        bodies = poses[:, self._at]
        return np.asarray(
            np.einsum("fmij,mj->fmi", bodies[..., :3, :3], self._points) + bodies[..., :3, 3]
        )

    def normal(self, state: Array, target: Array, weights: Array) -> NormalEquations:
        """Return the normal equations of a fit to measured markers.

        Let s = (a, b) be a coordinate's twist in ground: rotation a, and velocity b at ground's
        origin. A marker at x on the joint's outboard side has the velocity u = b + a × x. For a
        coordinate i that precedes j in the chain, with sums over the markers that j moves,

            (Jᵀ W J)_ij = s_i · Σ w (x × u_j, u_j)
            residuals' curvature_ij = -Σ w r · (a_i × u_j) = -a_i · Σ w u_j × r,   r = p - x

        Each coordinate therefore needs only the sums Σ w, Σ w x, Σ w x xᵀ, Σ w r and Σ w x rᵀ over
        the markers that it moves, not the markers' Jacobians. The curvature of the joints' splines
        is neglected.

        Args:
            state: coordinates, rad and m, (f, n).
            target: measured positions p of the markers, m, (f, m, 3).
            weights: weights w of the squared distances, (f, m).
        """
        poses, twists = self.kinematics.joint_twists(state)
        twists = twists[:, self._moving]
        x = self._markers_at(poses)
        residual = target - x
        pull = weights[:, :, None] * residual
        moments = np.concatenate(
            [
                weights[:, :, None],
                weights[:, :, None] * x,
                pull,
                (x[..., :, None] * (weights[:, :, None] * x)[..., None, :]).reshape(
                    *x.shape[:2], 9
                ),
                (x[..., :, None] * pull[..., None, :]).reshape(*x.shape[:2], 9),
            ],
            axis=2,
        )
        return self._assembled(
            state, twists, self._carries @ moments, np.einsum("fmi,fmi->f", pull, residual)
        )

    def _assembled(self, state: Array, twists: Array, sums: Array, cost: Array) -> NormalEquations:
        """Return the equations of the free coordinates, at a state (f, n).

        Args:
            twists: twists of the moving coordinates, (f, k, 6).
            sums: sums over the markers that each coordinate moves, (f, k, 25).
            cost: weighted sum of squared distances, m², (f,).
        """
        a, b = twists[..., :3], twists[..., 3:]
        weight, first, pull = sums[..., :1], sums[..., 1:4], sums[..., 4:7]
        second = sums[..., 7:16].reshape(*weight.shape[:2], 3, 3)
        turning = sums[..., 16:25].reshape(*weight.shape[:2], 3, 3)
        force = weight * b + cross(a, first)
        moment = cross(first, b) + _trace(second) * a - _product(second, a)
        matrix = twists @ np.concatenate([moment, force], axis=-1).swapaxes(1, 2)
        # Σ w u_j × r, with (a × x) × r = x (a·r) - a (x·r)
        lever = cross(b, pull) + _product(turning, a) - _trace(turning) * a
        curvature = -a @ lever.swapaxes(1, 2)
        torque = np.stack(
            [turning[..., i, j] - turning[..., j, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=-1
        )
        right = np.einsum("fni,fni->fn", a, torque) + np.einsum("fni,fni->fn", b, pull)
        matrix, curvature = (
            self._free_part(self._symmetric(part), state) for part in (matrix, curvature)
        )
        return NormalEquations(
            cost, matrix, self._free_part(right[..., None], state)[..., 0], curvature
        )

    def _symmetric(self, matrix: Array) -> Array:
        """Return the symmetric matrix (f, n, n). Only entries with i before j are read."""
        upper = matrix * self._above
        return np.asarray(upper + upper.swapaxes(1, 2))

    def _free_part(self, values: Array, state: Array) -> Array:
        """Return the rows, and for a square matrix also the columns, of the free coordinates.

        By the chain rule, the row (and column) of a dependent coordinate, times its coupler's
        slope, is added to that of the independent one. In a series of couplers the last one is
        added first.
        """
        square, free = values.shape[1] == values.shape[2], len(self.free)
        for dependent, independent, coordinate, function in reversed(self._after):
            slope = function.slope(state[:, coordinate])[:, None]
            values[:, independent] += slope * values[:, dependent]
            if square:
                values[:, :, independent] += slope * values[:, :, dependent]
        return values[:, :free, :free] if square else values[:, :free]

    def moved(self, state: Array, step: Array) -> Array:
        """Return the coordinates (f, n) after a step (f, k) of the k free coordinates."""
        shifted = state.copy()
        shifted[:, self.free] += step
        return self.kinematics.coupled(shifted) if self._couplers else shifted

    def chosen(self, state: Array, frames: Index) -> Array:
        """Return the coordinates of the chosen frames."""
        return np.asarray(state[frames])

    def replaced(self, state: Array, frames: Index, part: Array) -> Array:
        """Return the coordinates with `part` in the chosen frames."""
        return put(state, frames, part)


def _tree(kinematics: Kinematics, at: Sequence[int]) -> tuple[Array, Array]:
    """Return which markers (of bodies `at`) and axes each coordinate moves.

    Returns:
        Matrix (n, m): 1 where coordinate i moves marker j, else 0. Matrix (n, n): 1 where
        coordinate i moves the axis of coordinate j, 1/2 on the diagonal, else 0. Within a joint the
        translations precede the rotations, because they are along axes of the parent frame. The
        order is reversed in a joint that has its child nearer to ground.
    """
    model, bodies = kinematics.model, kinematics.bodies
    hanging: dict[Joint, set[int]] = {}  # bodies outboard of each joint
    for joint in reversed(model.joints):  # from the ends inwards
        outboard = {bodies[joint.outboard]}
        outboard.update(*(h for j, h in hanging.items() if j.inboard == joint.outboard))
        hanging[joint] = outboard
    count = len(kinematics.coordinates)
    carries, above = np.zeros((count, len(at))), 0.5 * np.eye(count)
    order = []  # (coordinate, its joint), from ground outwards
    for joint in model.joints:
        axes = (*joint.translations, *joint.rotations)[:: -1 if joint.backwards else 1]
        names = dict.fromkeys(axis.coordinate for axis in axes if axis.coordinate)
        order += [(kinematics.coordinates[name], joint) for name in names]
    for k, (i, joint) in enumerate(order):
        carries[i] = [body in hanging[joint] for body in at]
        for j, other in order[k + 1 :]:
            above[i, j] = bodies[other.outboard] in hanging[joint]
    return carries, above


def _trace(matrix: Array) -> Array:
    return np.trace(matrix, axis1=-2, axis2=-1)[..., None]


def _product(matrix: Array, vector: Array) -> Array:
    return np.einsum("...ij,...j->...i", matrix, vector)


def fit_model(
    model: OpenSimModel,
    recorded: Table,
    weights: Mapping[str, float] | None = None,
    laboratory_axes: str = "+x,+y,+z",
) -> tuple[ModelChain, ChainFit[Array]]:
    """Return a model's chain and its fit to all frames of a recording.

    Args:
        weights: marker -> weight of its squared distance; default 1.
        laboratory_axes: axes of the file that point along the model's ground x, y and z (forward,
            up and right), like "-x,+z,+y".

    Raises:
        InputError: model and recording share fewer than three markers.
    """
    match = matched_labels(model.markers, recorded_labels(recorded))
    if len(match) < 3:
        raise InputError(
            f"shares {len(match)} markers with the model '{model.name}'",
            recorded.path,
            f"the model has {', '.join(list(model.markers)[:8])}, …",
        )
    chain = ModelChain(model, list(match))
    scale = recorded.unit_scale(None, "length_unit")
    turn = laboratory_rotation(laboratory_axes, recorded.path)
    measured = marker_trajectories(recorded, list(match.values()), scale) @ turn.T
    values = np.array([(weights or {}).get(name, 1.0) for name in match])
    first = int(np.argmax(np.isfinite(measured).all(axis=2).sum(axis=1)))
    begin = fit_chain(chain, measured[first : first + 1], values, chain.default(1))
    # The frame with most visible markers is the initial guess of every `coarse_stride`-th frame.
    # Interpolation between those frames gives the initial guesses of the others.
    coarse = np.unique(np.append(np.arange(0, len(measured), COARSE_STRIDE), len(measured) - 1))
    start = np.tile(begin.state, (len(coarse), 1))
    knots = fit_in_blocks(chain, measured[coarse], values, start).state
    between = CubicSpline(coarse, knots)(np.arange(len(measured))) if len(coarse) > 2 else start
    return chain, fit_in_blocks(chain, measured, values, between)


def fit_in_blocks(
    chain: ModelChain, measured: Array, weights: Array, start: Array
) -> ChainFit[Array]:
    """Return the fit of many frames, computed in blocks of `block_frames`."""
    parts = [slice(k, k + BLOCK_FRAMES) for k in range(0, len(measured), BLOCK_FRAMES)]
    fits = [fit_chain(chain, measured[part], weights, start[part]) for part in parts]
    state, rms, distance, solved = (
        np.concatenate([getattr(fit, name) for fit in fits])
        for name in ("state", "rms", "distance", "solved")
    )
    return ChainFit(state, rms, distance, solved, max(fit.steps for fit in fits))
