"""Poses of an OpenSim model's bodies, and derivatives of points with respect to its coordinates.

All functions accept many coordinate sets at once: q has shape (..., n), in the order of
`model.coordinates`. Let J be the twists of a body per unit of each coordinate, in ground and at
ground's origin (angular above linear velocity). Then a point p of the body has the derivative

    ∂p/∂q = J_linear + J_angular × p.

The twist of a joint's outboard body is that of the inboard body plus a term for each axis. For a
rotation by u(q) about the line through c along d it is (d, c × d) du/dq, for a translation (0, d)
du/dq. In a backwards joint, whose child is nearer to ground, the term has the opposite sign.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, pose
from tkamb.io.opensim.model import GROUND, JointAxis, Linear, OpenSimModel


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses and twists of bodies in ground, for coordinate sets of leading shape (...).

    Args:
        bodies: body -> its index; ground is first.
        poses: pose of each body in ground, (..., b, 4, 4).
        twists: twist of each body at ground's origin, per unit of each coordinate, (..., b, 6, n).
        axes: twist of the child frame relative to the parent frame, per unit of motion along each
            joint axis, (..., a, 6).
    """

    bodies: dict[str, int]
    poses: Array
    twists: Array
    axes: Array

    def points(self, bodies: Sequence[str], locations: ArrayLike) -> tuple[Array, Array]:
        """Return positions of points on m named bodies in ground, and their derivatives.

        Args:
            locations: points in the frames of their bodies, m, (m, 3) or (..., m, 3).

        Returns:
            Positions (..., m, 3), m, and their derivatives ∂p/∂q (..., m, 3, n).
        """
        index = [self.bodies[name] for name in bodies]
        poses, twists = self.poses[..., index, :, :], self.twists[..., index, :, :]
        rotated = np.einsum("...ij,...j->...i", poses[..., :3, :3], np.asarray(locations, float))
        positions = rotated + poses[..., :3, 3]
        return positions, velocities(twists, positions)


def velocities(twists: Array, positions: Array) -> Array:
    """Return ∂p/∂q (..., 3, n) of points p (..., 3), m, on bodies with twists (..., 6, n)."""
    return twists[..., 3:, :] + np.cross(twists[..., :3, :], positions[..., None], axis=-2)


class Kinematics:
    """The kinematic chain of an OpenSim model, prepared for many evaluations."""

    def __init__(self, model: OpenSimModel) -> None:
        self.model = model
        self.coordinates = {name: k for k, name in enumerate(model.coordinates)}
        self.bodies = {name: k for k, name in enumerate((GROUND, *model.bodies))}
        self._axes = [a for j in model.joints for a in (*j.rotations, *j.translations)]
        # One matrix product evaluates all linear functions. Other functions are evaluated singly.
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
        self._index_joints(model)

    def _index_joints(self, model: OpenSimModel) -> None:
        joints = model.joints
        self._ends = [(self.bodies[j.inboard], self.bodies[j.outboard]) for j in joints]
        self._backwards = np.array([j.backwards for j in joints], bool).reshape(-1, 1, 1)
        parent = np.array([j.pose_parent_frame for j in joints]).reshape(-1, 4, 4)
        child = np.array([j.pose_child_frame for j in joints]).reshape(-1, 4, 4)
        self._inboard_frames = np.where(self._backwards, child, parent)
        self._outboard_frames = inverse(np.where(self._backwards, parent, child))
        counts = [(len(j.rotations), len(j.translations)) for j in joints]
        self._owner = np.repeat(np.arange(len(joints)), [r + t for r, t in counts])
        rank = [k for r, t in counts for k in (*range(r), *[-1] * t)]  # of rotations
        self._turning = np.array(rank, int) >= 0
        self._ranks = [
            np.flatnonzero(np.array(rank) == k) for k in range(max(rank, default=-1) + 1)
        ]
        self._sums = (self._owner == np.arange(len(joints))[:, None]).astype(float)
        self._signs = np.where(self._backwards[self._owner, 0, 0], -1.0, 1.0)
        self._signed_gradients = self._signs[:, None] * self._gradients

    def vector(self, q: Mapping[str, float] | ArrayLike) -> Array:
        """Return coordinates (..., n). Those that are not in a mapping have default values."""
        if isinstance(q, Mapping):
            values = np.array([c.default for c in self.model.coordinates.values()])
            for name, value in q.items():
                if name not in self.coordinates:
                    raise InputError(f"has no coordinate '{name}'", self.model.name)
                values[self.coordinates[name]] = value
            return values
        values = np.asarray(q, float)
        if values.shape[-1:] != (len(self.coordinates),):
            count = values.shape[-1] if values.ndim else 1
            what = f"has {len(self.coordinates)} coordinates, {count} are given"
            raise InputError(what, self.model.name)
        return values

    def coupled(self, q: Mapping[str, float] | ArrayLike) -> Array:
        """Return the coordinates (..., n) with dependent ones set by their couplers."""
        values = self.vector(q).copy()
        for coupler in self.model.couplers:
            independent = values[..., self.coordinates[coupler.independent]]
            values[..., self.coordinates[coupler.dependent]] = coupler.function(independent)
        return values

    def coupling(self, q: ArrayLike) -> Array:
        """Return the derivatives (..., n, n) of all coordinates (rows) by the independent ones.

        The column of a dependent coordinate is zero.
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

    def joint_twists(self, q: Array) -> tuple[Array, Array]:
        """Return the poses of all bodies, and the twist that each coordinate gives to bodies.

        Args:
            q: coordinates, rad and m, (..., n).

        Returns:
            Poses in ground (..., b, 4, 4). Twists (..., n, 6) at ground's origin, per unit of each
            coordinate, of all bodies outboard of the coordinate's joint. Couplers are ignored.
        """
        poses, axes = self._chain(self.axis_values(q))
        twists = self._signed_gradients.T @ axes
        for k, c, axis in self._curved:
            sign = self._signs[k]
            twists[..., c, :] += sign * axis.function.slope(q[..., c])[..., None] * axes[..., k, :]
        return poses, twists

    def axis_values(self, q: Array) -> Array:
        """Return the angles and translations u (..., a) of all joint axes."""
        values = q @ self._gradients.T + self._offsets
        for k, c, axis in self._curved:
            values[..., k] = axis.function(q[..., c])
        return values

    def axis_slopes(self, q: Array) -> Array:
        """Return the derivatives du/dq (..., a, n) of the angles and translations of all axes."""
        slopes = np.broadcast_to(self._gradients, (*q.shape[:-1], *self._gradients.shape)).copy()
        for k, c, axis in self._curved:
            slopes[..., k, c] = axis.function.slope(q[..., c])
        return slopes

    def axis_rates(self, q: Array, rates: Array, accelerations: Array) -> tuple[Array, Array]:
        """Return du/dt and d²u/dt² (..., a) from coordinates and their derivatives (..., n)."""
        slopes = self.axis_slopes(q)
        speeds = (slopes @ rates[..., None])[..., 0]
        second = (slopes @ accelerations[..., None])[..., 0]
        for k, c, axis in self._curved:
            second[..., k] += axis.function.curvature(q[..., c]) * rates[..., c] ** 2
        return speeds, second

    def _chain(self, values: Array) -> tuple[Array, Array]:
        """Return body poses (..., b, 4, 4), and the twist in ground (..., a, 6) of each axis.

        The poses within joints are computed at once, those of bodies from ground outwards.
        """
        joint_poses, directions = self._joint_poses(values)
        steps = np.where(self._backwards, inverse(joint_poses), joint_poses)
        steps = self._inboard_frames @ steps @ self._outboard_frames
        poses = np.zeros((*values.shape[:-1], len(self.bodies), 4, 4))
        poses[..., 0, :, :] = np.eye(4)
        for k, (inboard, outboard) in enumerate(self._ends):
            poses[..., outboard, :, :] = poses[..., inboard, :, :] @ steps[..., k, :, :]
        inner = [inboard for inboard, _ in self._ends]
        to_frame = poses[..., inner, :, :] @ self._axis_frames(joint_poses)
        centre = (to_frame @ joint_poses)[..., :3, 3]
        spins = (to_frame[..., self._owner, :3, :3] @ directions[..., None])[..., 0]
        twists = np.zeros((*values.shape, 6))
        turning, centres = self._turning, centre[..., self._owner[self._turning], :]
        twists[..., turning, :3] = spins[..., turning, :]
        twists[..., turning, 3:] = cross(centres, spins[..., turning, :])
        twists[..., ~turning, 3:] = spins[..., ~turning, :]
        return poses, twists

    def _axis_frames(self, joint_poses: Array) -> Array:
        """Return the poses (..., j, 4, 4) of the joints' parent frames in the inboard bodies.

        In a backwards joint, the parent frame belongs to the outboard body.
        """
        return np.asarray(
            np.where(
                self._backwards, self._inboard_frames @ inverse(joint_poses), self._inboard_frames
            )
        )

    def _joint_poses(self, values: Array) -> tuple[Array, Array]:
        """Return the child frames' poses (..., j, 4, 4) and the axes (..., a, 3) in parent frames.

        A rotation by u is I + sin u K + (1 - cos u) K² (Rodrigues), with K the cross-product matrix
        of its axis.
        """
        sine = np.sin(values)[..., None, None]
        versine = 2.0 * np.sin(0.5 * values)[..., None, None] ** 2
        turns = np.eye(3) + sine * self._crosses + versine * self._squares
        shape = values.shape[:-1]
        rotation = np.broadcast_to(np.eye(3), (*shape, len(self._ends), 3, 3)).copy()
        directions = np.broadcast_to(self._directions, (*shape, *self._directions.shape)).copy()
        # First the first rotations of all joints, then the second, then the third.
        for axes in self._ranks:
            owners = self._owner[axes]
            previous = rotation[..., owners, :, :]
            directions[..., axes, :] = (previous @ self._directions[axes][..., None])[..., 0]
            rotation[..., owners, :, :] = previous @ turns[..., axes, :, :]
        shift = np.where(self._turning, 0.0, values)[..., None] * self._directions
        return pose(rotation, self._sums @ shift), directions


def cross(a: Array, b: Array) -> Array:
    """Return a × b (..., 3), for large arrays faster than `np.cross`."""
    x, y, z = np.moveaxis(a, -1, 0)
    u, v, w = np.moveaxis(b, -1, 0)
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)
