"""A leg as a chain for skin markers: shank, knee, thigh, and neighbours on ball joints."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import Array, knee_pose, pose, transform
from tkamb.io.recordings.inverse_kinematics import Index, NormalEquations, put, skew

FLEXION = 5
"""Index of flexion among the knee coordinates."""


@dataclass(frozen=True, eq=False)
class Segment:
    """A body with markers.

    Args:
        name: "shank" and "thigh" are the knee's; others are joined to one of them by a ball joint.
        labels: (m) of its markers.
        points: (m, 3) m, the markers in its frame.
        weights: (m,) of their squared distances.
        joined_to: the segment that carries it; empty for shank and thigh.
        joint: (3,) m, the ball joint in that segment's frame.
        centre: (3,) m, the same in its own.
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
    """Poses of the segments of a leg.

    Args:
        shank: (f, 4, 4) pose_shank_in_world.
        knee: (f, 6) knee coordinates of the thigh, of which a hinge changes flexion alone.
        thigh: (f, 4, 4) pose_thigh_in_world.
        turns: segment -> (f, 3, 3), its rotation in the segment that carries it.
    """

    shank: Array
    knee: Array
    thigh: Array
    turns: dict[str, Array]


class LegChain:
    """Shank and thigh joined by the knee, and neighbours joined by ball joints.

    Freedoms, in order: shank (translation, rotation about its origin; world axes), knee
    (flexion of a hinge, or translation and rotation of a free thigh), three of each ball joint.

    Args:
        segments: "shank" and "thigh", and their neighbours.
        pose_insert_in_shank: (4, 4), the frame of the knee coordinates.
        free: whether the knee has six freedoms; else flexion alone.
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
        """Return a state to begin with, from the segments' own fits.

        Args:
            fitted: segment -> (f, 4, 4), NaN where it could not be fitted.
            neutral: (6,) knee coordinates that a hinge keeps.
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
            own = _fill_gaps(fitted[ball.name])[:, :3, :3]
            state.turns[ball.name] = np.swapaxes(parent[:, :3, :3], 1, 2) @ own
        return state

    def places(self, state: LegState) -> Array:
        """Return the markers (f, m, 3) m."""
        return self.markers(state)[0]

    def normal(self, state: LegState, target: Array, weights: Array) -> NormalEquations:
        """Return the least squares to markers (f, m, 3) m with weights (f, m)."""
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
        """Return the markers (f, m, 3) m and their Jacobian (f, m, 3, n)."""
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
        """Add the freedoms of shank and knee to the Jacobian of markers x of a chain's end."""
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
        shank = _carry(state.shank, step[:, :6])
        knee = state.knee.copy()
        if self.free:
            thigh = _carry(state.thigh, step[:, 6:12])
        else:
            knee[:, FLEXION] += step[:, 6]
            thigh = shank @ self.insert @ knee_pose(knee)
        parents, turns = {"shank": shank, "thigh": thigh}, {}
        for ball in self.balls:
            column = self._columns[ball.name]
            world = Rotation.from_rotvec(step[:, column : column + 3]).as_matrix()
            parent = parents[ball.joined_to][:, :3, :3]
            own = world @ parent @ state.turns[ball.name]
            turns[ball.name] = np.swapaxes(parent, 1, 2) @ own
        return LegState(shank, knee, thigh, turns)

    def chosen(self, state: LegState, frames: Index) -> LegState:
        """Return the state of some frames."""
        turns = {name: turn[frames] for name, turn in state.turns.items()}
        return LegState(state.shank[frames], state.knee[frames], state.thigh[frames], turns)

    def replaced(self, state: LegState, frames: Index, part: LegState) -> LegState:
        """Return the state with some frames as in `part`."""
        turns = {name: put(turn, frames, part.turns[name]) for name, turn in state.turns.items()}
        return LegState(
            put(state.shank, frames, part.shank),
            put(state.knee, frames, part.knee),
            put(state.thigh, frames, part.thigh),
            turns,
        )


def _carry(poses: Array, step: Array) -> Array:
    turn = Rotation.from_rotvec(step[:, 3:]).as_matrix()
    return pose(turn @ poses[:, :3, :3], poses[:, :3, 3] + step[:, :3])


def _fill_gaps(poses: Array) -> Array:
    """Return the poses with those that are missing taken from the frame before (or after)."""
    finite = np.flatnonzero(np.isfinite(poses[:, 0, 3]))
    if not len(finite):
        return np.tile(np.eye(4), (len(poses), 1, 1))
    nearest = finite[np.clip(np.searchsorted(finite, np.arange(len(poses)), "right") - 1, 0, None)]
    return np.asarray(poses[nearest])
