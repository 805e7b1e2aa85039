"""Where an OpenSim model's bodies are, and how points move with its coordinates.

Everything is computed for many coordinate sets at once: q has shape (..., n), in the order of
`model.coordinates`. With J the twist of a body per unit of each coordinate, in ground and at
ground's origin (angular above linear velocity), a point p of it moves with

    ∂p/∂q = J_linear + J_angular × p.

A joint adds to its outboard body's twist one column per axis: for a rotation by u(q) about
the line through c along d, (d, c × d) du/dq; for a translation (0, d) du/dq; with the sign
turned where the joint is passed backwards.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, pose
from tkamb.opensim.functions import Linear
from tkamb.opensim.model import GROUND, Joint, JointAxis, OpenSimModel


@dataclass(frozen=True, eq=False)
class Motion:
    """Bodies in ground at coordinate sets of leading shape (...).

    Args:
        bodies: names, ground first.
        poses: (..., b, 4, 4) of each body in ground.
        twists: (..., b, 6, n) twist at ground's origin per unit of each coordinate.
        axes: (..., a, 6) twist of child against parent frame per unit of each joint axis.
    """

    bodies: dict[str, int]
    poses: Array
    twists: Array
    axes: Array

    def points(self, bodies: Sequence[str], locations: ArrayLike) -> tuple[Array, Array]:
        """Return points of bodies in ground and their Jacobian.

        Args:
            bodies: m names.
            locations: (m, 3) or (..., m, 3) m, in the bodies.

        Returns:
            Positions (..., m, 3) m, and their derivatives (..., m, 3, n) by the coordinates.
        """
        index = [self.bodies[name] for name in bodies]
        poses, twists = self.poses[..., index, :, :], self.twists[..., index, :, :]
        rotated = np.einsum("...ij,...j->...i", poses[..., :3, :3], np.asarray(locations, float))
        positions = rotated + poses[..., :3, 3]
        return positions, velocities(twists, positions)


def velocities(twists: Array, positions: Array) -> Array:
    """Return ∂p/∂q (..., 3, n) of points (..., 3) that move with twists (..., 6, n)."""
    return twists[..., 3:, :] + np.cross(twists[..., :3, :], positions[..., None], axis=-2)


class Kinematics:
    """The chain of an OpenSim model, prepared for many evaluations.

    Args:
        model: the model.
    """

    def __init__(self, model: OpenSimModel) -> None:
        self.model = model
        self.coordinates = {name: k for k, name in enumerate(model.coordinates)}
        self.bodies = {name: k for k, name in enumerate((GROUND, *model.bodies))}
        self._axes = [a for j in model.joints for a in (*j.rotations, *j.translations)]
        # What a linear function needs is one product for all axes; the rest is added after.
        self._gradients = np.zeros((len(self._axes), len(self.coordinates)))
        self._offsets = np.zeros(len(self._axes))
        self._curved: list[tuple[int, int, JointAxis]] = []
        for k, axis in enumerate(self._axes):
            if axis.coordinate is None:
                self._offsets[k] = axis.function(np.zeros(1))[0]
            elif isinstance(axis.function, Linear):
                self._gradients[k, self.coordinates[axis.coordinate]] = axis.function.gradient
                self._offsets[k] = axis.function.offset
            else:
                self._curved.append((k, self.coordinates[axis.coordinate], axis))
        directions = np.array([axis.direction for axis in self._axes]).reshape(-1, 3)
        self._directions = directions
        self._crosses = np.cross(directions[:, None, :], -np.eye(3)[None])
        self._squares = self._crosses @ self._crosses
        self._parent_frames = [joint.pose_parent_frame for joint in model.joints]
        self._from_child_frames = [inverse(joint.pose_child_frame) for joint in model.joints]

    def vector(self, q: Mapping[str, float] | ArrayLike) -> Array:
        """Return coordinates (..., n); a mapping fills in what it names over the defaults.

        Raises:
            InputError: an unknown coordinate or a wrong number of them.
        """
        if isinstance(q, Mapping):
            values = np.array([c.default for c in self.model.coordinates.values()])
            for name, value in q.items():
                if name not in self.coordinates:
                    raise InputError(f"has no coordinate '{name}'", self.model.name)
                values[self.coordinates[name]] = value
            return values
        values = np.asarray(q, float)
        if values.shape[-1:] != (len(self.coordinates),):
            given = values.shape[-1] if values.ndim else 1
            wanted = f"{len(self.coordinates)} coordinates, {given} are given"
            raise InputError(f"has {wanted}", self.model.name)
        return values

    def coupled(self, q: Mapping[str, float] | ArrayLike) -> Array:
        """Return the coordinates (..., n) with those that follow others set from them."""
        values = self.vector(q).copy()
        for coupler in self.model.couplers:
            independent = values[..., self.coordinates[coupler.independent]]
            values[..., self.coordinates[coupler.dependent]] = coupler.function(independent)
        return values

    def coupling(self, q: ArrayLike) -> Array:
        """Return ∂q/∂q (..., n, n): one coordinate's own change, and that of what follows it.

        The column of a coordinate that follows another is zero: it is none of its own.
        """
        values = self.vector(q)
        result = np.broadcast_to(np.eye(values.shape[-1]), (*values.shape, values.shape[-1])).copy()
        for coupler in self.model.couplers:
            dependent = self.coordinates[coupler.dependent]
            independent = self.coordinates[coupler.independent]
            slope = coupler.function.slope(values[..., independent])
            result[..., dependent, :] = slope[..., None] * result[..., independent, :]
        return result

    def poses(self, q: Mapping[str, float] | ArrayLike) -> Array:
        """Return the poses (..., b, 4, 4) of ground and all bodies in ground."""
        return self._chain(self.axis_values(self.vector(q)))[0]

    def motion(self, q: Mapping[str, float] | ArrayLike) -> Motion:
        """Return poses and twists of ground and all bodies."""
        q = self.vector(q)
        poses, axis_twists = self._chain(self.axis_values(q))
        slopes = self.axis_slopes(q)
        twists = np.zeros((*q.shape[:-1], len(self.bodies), 6, q.shape[-1]))
        first = 0
        for joint in self.model.joints:
            last = first + len(joint.rotations) + len(joint.translations)
            added = axis_twists[..., first:last, :].swapaxes(-1, -2) @ slopes[..., first:last, :]
            inboard, outboard = self.bodies[joint.inboard], self.bodies[joint.outboard]
            sign = -1.0 if joint.backwards else 1.0
            twists[..., outboard, :, :] = twists[..., inboard, :, :] + sign * added
            first = last
        return Motion(self.bodies, poses, twists, axis_twists)

    def axis_values(self, q: Array) -> Array:
        """Return the angles and translations u (..., a) of all joint axes."""
        values = q @ self._gradients.T + self._offsets
        for k, c, axis in self._curved:
            values[..., k] = axis.function(q[..., c])
        return values

    def axis_slopes(self, q: Array) -> Array:
        """Return du/dq (..., a, n)."""
        slopes = np.broadcast_to(self._gradients, (*q.shape[:-1], *self._gradients.shape)).copy()
        for k, c, axis in self._curved:
            slopes[..., k, c] = axis.function.slope(q[..., c])
        return slopes

    def axis_rates(self, q: Array, rates: Array, accelerations: Array) -> tuple[Array, Array]:
        """Return du/dt and d²u/dt² (..., a) from the coordinates' own (..., n)."""
        slopes = self.axis_slopes(q)
        speeds = (slopes @ rates[..., None])[..., 0]
        second = (slopes @ accelerations[..., None])[..., 0]
        for k, c, axis in self._curved:
            second[..., k] += axis.function.curvature(q[..., c]) * rates[..., c] ** 2
        return speeds, second

    def _chain(self, values: Array) -> tuple[Array, Array]:
        """Return body poses (..., b, 4, 4) and each axis's twist in ground (..., a, 6)."""
        shape = values.shape[:-1]
        turns = self._turns(values)
        poses = np.zeros((*shape, len(self.bodies), 4, 4))
        poses[..., 0, :, :] = np.eye(4)
        twists = np.zeros((*shape, len(self._axes), 6))
        first = 0
        for joint, parent_frame, from_child in zip(
            self.model.joints, self._parent_frames, self._from_child_frames, strict=True
        ):
            last = first + len(joint.rotations) + len(joint.translations)
            count = len(joint.rotations)
            moved, before = self._joint_pose(joint, values[..., first:last], turns, first, shape)
            inboard = poses[..., self.bodies[joint.inboard], :, :]
            if joint.backwards:
                to_frame = inboard @ joint.pose_child_frame @ inverse(moved)
                outboard = to_frame @ inverse(parent_frame)
            else:
                to_frame = inboard @ parent_frame
                outboard = to_frame @ moved @ from_child
            poses[..., self.bodies[joint.outboard], :, :] = outboard
            frame = to_frame[..., None, :3, :3]
            centre = (to_frame @ moved)[..., None, :3, 3]
            spins = np.einsum("...ij,...j->...i", frame, before)
            twists[..., first : first + count, :3] = spins[..., :count, :]
            twists[..., first : first + count, 3:] = np.cross(centre, spins[..., :count, :])
            twists[..., first + count : last, 3:] = spins[..., count:, :]
            first = last
        return poses, twists

    def _turns(self, values: Array) -> Array:
        """Return each axis's rotation (..., a, 3, 3): I + sin u K + (1 - cos u) K²."""
        sine = np.sin(values)[..., None, None]
        versine = 2.0 * np.sin(0.5 * values)[..., None, None] ** 2
        return np.eye(3) + sine * self._crosses + versine * self._squares

    def _joint_pose(
        self, joint: Joint, values: Array, turns: Array, first: int, shape: tuple[int, ...]
    ) -> tuple[Array, Array]:
        """Return the child frame in the parent frame, and each axis in the parent frame."""
        count = len(joint.rotations)
        directions = self._directions[first : first + values.shape[-1]]
        before = np.broadcast_to(directions, (*shape, *directions.shape)).copy()
        rotation = np.broadcast_to(np.eye(3), (*shape, 3, 3))
        for k in range(count):
            before[..., k, :] = rotation @ directions[k]
            rotation = rotation @ turns[..., first + k, :, :]
        return pose(rotation, values[..., count:] @ directions[count:]), before


def frame_poses(model: OpenSimModel, q: Mapping[str, float] | ArrayLike) -> dict[str, Array]:
    """Return each body's pose (..., 4, 4) in ground, ground among them.

    Args:
        model: the model.
        q: coordinates (..., n) in the order of `model.coordinates`, or some of them by name;
            the others stand at their defaults.
    """
    kinematics = Kinematics(model)
    poses = kinematics.poses(q)
    return {name: poses[..., k, :, :] for name, k in kinematics.bodies.items()}
