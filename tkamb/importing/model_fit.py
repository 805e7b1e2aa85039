"""An OpenSim model's own chain fitted to markers: what OpenSim's InverseKinematicsTool does.

All coordinates that are not locked are free, those that follow others by an enforced coupler
follow. Ranges are not imposed. The same least squares as for a leg
(`tkamb.inputs.inverse_kinematics`), with the model's joints.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.importing.markers import recorded_labels
from tkamb.inputs.inverse_kinematics import ChainFit, Index, NormalEquations, fit_chain, put, skew
from tkamb.inputs.laboratory import laboratory_rotation
from tkamb.inputs.markers import marker_trajectories, matched_labels
from tkamb.inputs.tables import Table
from tkamb.opensim.kinematics import Kinematics
from tkamb.opensim.model import OpenSimModel

COARSE = 8
"""Frames between those that are fitted first."""


class ModelChain:
    """The free coordinates of a model and some of its markers.

    Args:
        model: the model.
        markers: names of the markers.
        locked: coordinates that stay at their default beside those that the model locks.
    """

    def __init__(
        self, model: OpenSimModel, markers: Sequence[str], locked: Sequence[str] = ()
    ) -> None:
        self.kinematics = Kinematics(model)
        self._at = [self.kinematics.bodies[model.markers[name].body] for name in markers]
        self._groups = {b: np.flatnonzero(np.array(self._at) == b) for b in set(self._at)}
        self._points = np.array([model.markers[name].location for name in markers])
        index = self.kinematics.coordinates
        followers = {coupler.dependent for coupler in model.couplers}
        self.free = [
            index[name]
            for name, coordinate in model.coordinates.items()
            if not (coordinate.locked or name in followers or name in locked)
        ]
        self._couplers = [
            (index[c.dependent], index[c.independent], c.function) for c in model.couplers
        ]

    def default(self, frames: int) -> Array:
        """Return the coordinates (f, n) at their defaults."""
        return np.tile(self.kinematics.coupled({}), (frames, 1))

    def places(self, state: Array) -> Array:
        """Return the markers (f, m, 3) m."""
        poses = self.kinematics.poses(state)[:, self._at]
        return np.asarray(
            np.einsum("fmij,mj->fmi", poses[..., :3, :3], self._points) + poses[..., :3, 3]
        )

    def normal(self, state: Array, target: Array, weights: Array) -> NormalEquations:
        """Return the least squares to markers (f, m, 3) m with weights (f, m).

        A body moves by its twist (ω, v) at ground's origin and its marker at x by v + ω × x.
        With A = [-[x]×, I] that is A (ω, v), so that a body's markers enter by two sums, of
        Aᵀ w A (6, 6) and Aᵀ w (p - x) (6,): no marker needs its own Jacobian.
        """
        motion = self.kinematics.motion(state)
        poses = motion.poses[:, self._at]
        x = np.einsum("fmij,mj->fmi", poses[..., :3, :3], self._points) + poses[..., :3, 3]
        off = target - x
        pull = weights[:, :, None] * off
        cost = np.sum(pull * off, axis=(1, 2))
        freedoms = len(self.free)
        matrix = np.zeros((len(x), freedoms, freedoms))
        right = np.zeros((len(x), freedoms))
        for body, own in self._groups.items():
            twist = self._free_twists(motion.twists[:, body], state)
            sums = _wrench_matrix(x[:, own], weights[:, own])
            moment = np.cross(x[:, own], pull[:, own]).sum(axis=1)
            wrench = np.concatenate([moment, pull[:, own].sum(axis=1)], axis=1)
            turned = np.swapaxes(twist, 1, 2)
            matrix += turned @ (sums @ twist)
            right += np.einsum("fni,fi->fn", turned, wrench)
        return NormalEquations(cost, matrix, right)

    def _free_twists(self, twists: Array, state: Array) -> Array:
        """Return a body's twists (f, 6, free), with what follows a free coordinate in it."""
        if self._couplers:
            twists = twists.copy()
            for dependent, independent, function in self._couplers:
                slope = function.slope(state[:, independent])[:, None]
                twists[..., independent] += twists[..., dependent] * slope
        return twists[..., self.free]

    def moved(self, state: Array, step: Array) -> Array:
        """Return the coordinates (f, n) after a step (f, free) of the free ones."""
        moved = state.copy()
        moved[:, self.free] += step
        return self.kinematics.coupled(moved) if self._couplers else moved

    def chosen(self, state: Array, frames: Index) -> Array:
        """Return the coordinates of some frames."""
        return np.asarray(state[frames])

    def replaced(self, state: Array, frames: Index, part: Array) -> Array:
        """Return the coordinates with some frames as in `part`."""
        return put(state, frames, part)


def _wrench_matrix(x: Array, weights: Array) -> Array:
    """Return the sums (f, 6, 6) of Aᵀ w A over markers at x (f, m, 3), A = [-[x]×, I]."""
    total = weights.sum(axis=1)
    first = np.einsum("fm,fmi->fi", weights, x)
    second = np.einsum("fm,fmi,fmj->fij", weights, x, x)
    result = np.zeros((len(x), 6, 6))
    trace = np.trace(second, axis1=1, axis2=2)
    result[:, :3, :3] = trace[:, None, None] * np.eye(3) - second
    result[:, 3:, 3:] = total[:, None, None] * np.eye(3)
    cross = skew(first)
    result[:, :3, 3:], result[:, 3:, :3] = cross, -cross
    return result


def fit_model(
    model: OpenSimModel,
    recorded: Table,
    weights: Mapping[str, float] | None = None,
    locked: Sequence[str] = (),
    laboratory_axes: str = "+x,+y,+z",
) -> tuple[ModelChain, ChainFit[Array]]:
    """Return a model's chain fitted to a recording, all frames at once.

    Args:
        model: the model.
        recorded: table of markers.
        weights: marker -> weight of its squared distance, where not 1.
        locked: coordinates kept at their default.
        laboratory_axes: axes of the file that are the model's ground x, y and z (forward, up
            and right), as "-x,+z,+y".

    Raises:
        InputError: fewer than three markers in common.
    """
    match = matched_labels(model.markers, recorded_labels(recorded))
    if len(match) < 3:
        raise InputError(
            f"shares {len(match)} markers with the model '{model.name}'",
            recorded.path,
            f"the model has {', '.join(list(model.markers)[:8])}, …",
        )
    chain = ModelChain(model, list(match), locked)
    scale = recorded.unit_scale(None, "length_unit")
    turn = laboratory_rotation(laboratory_axes, recorded.path)
    measured = marker_trajectories(recorded, list(match.values()), scale) @ turn.T
    values = np.array([(weights or {}).get(name, 1.0) for name in match])
    first = int(np.argmax(np.isfinite(measured).all(axis=2).sum(axis=1)))
    begin = fit_chain(chain, measured[first : first + 1], values, chain.default(1))
    # some frames first, from the best seen; between them the others are nearly there
    coarse = np.unique(np.append(np.arange(0, len(measured), COARSE), len(measured) - 1))
    frames = np.arange(len(measured))
    start = np.tile(begin.state, (len(coarse), 1))
    knots = fit_chain(chain, measured[coarse], values, start).state
    between = np.stack([np.interp(frames, coarse, knots[:, k]) for k in range(knots.shape[1])], 1)
    return chain, fit_chain(chain, measured, values, between)
