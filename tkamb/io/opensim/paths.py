"""Lengths and moment arms of muscles and ligaments, by the virtual work of a taut string.

A string of unit tension exerts a force on each path point, and on each wrap object at the points
where the string meets and leaves it. Let w_b be the wrench of these forces on body b, and J_b the
body's twist per unit of the coordinates q. The moment arms are

    -dL/dq = Σ_b w_b · J_b.

This is exact for a taut string, because sliding along a surface does not change its length to first
order. For a path point that moves in its body, the work of the tension on this motion is added.

Reference: Sherman, Seth & Delp, Proc ASME IDETC (2013), doi:10.1115/DETC2013-13633.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index
from tkamb.io.opensim.kinematics import Kinematics, Motion
from tkamb.io.opensim.model import (
    ConditionalPathPoint,
    MovingPathPoint,
    OpenSimLigament,
    OpenSimMuscle,
    Path,
)
from tkamb.knee.taut_strings import StraightParts, Tension, strings_over

# rad or m: margin of the range of a conditional path point, as in OpenSim.
CONDITION_TOLERANCE = 1e-5
# Number of frames that are evaluated in one call. It does not change the result. It
# limits the arrays to some tens of megabytes.
BLOCK_FRAMES = 256


@dataclass(frozen=True, eq=False)
class Lines:
    """Lengths and moment arms of taut paths, for coordinate sets of leading shape (...).

    Args:
        names: names of the m muscles or ligaments.
        lengths_m: lengths, (..., m); NaN if no taut string was found.
        moment_arms: -dL/dq, m per rad or m per m, (..., m, n), with the coordinates in the model's
            order.
    """

    names: tuple[str, ...]
    lengths_m: Array
    moment_arms: Array


@dataclass(frozen=True, eq=False)
class Pulls(Lines):
    """Taut paths, and the wrenches that unit tensions in them exert on g groups of bodies.

    Args:
        wrenches: moment (N·m per N) above force (N per N) on each group, in ground at ground's
            origin, (..., m, g, 6).
        crossings: straight parts between different groups. Their `bodies` are indices of groups;
            -1 means a body outside all groups.
    """

    wrenches: Array
    crossings: StraightParts


class LineSet:
    """Muscles and ligaments of an OpenSim model, prepared for many poses.

    Args:
        names: names of muscles and ligaments; None: all muscles.
    """

    def __init__(self, kinematics: Kinematics, names: Iterable[str] | None = None) -> None:
        self.kinematics, model = kinematics, kinematics.model
        self.names = tuple(model.muscles if names is None else names)
        owners: dict[str, OpenSimMuscle | OpenSimLigament] = {**model.ligaments, **model.muscles}
        for name in self.names:
            if name not in owners:
                raise InputError(f"has no muscle or ligament '{name}'", model.name)
        paths: list[Path] = [owners[name].path for name in self.names]
        self._paths = paths
        self._points = [point for path in paths for point in path.points]
        self._first = np.cumsum([0] + [len(path.points) for path in paths])[:-1]
        owner = np.repeat(np.arange(len(paths)), [len(path.points) for path in paths])
        self._body = np.array([kinematics.bodies[point.body] for point in self._points], int)
        self._last = np.append(np.flatnonzero(np.diff(owner)), len(owner) - 1)
        self._owner = owner
        self._locations = np.array(
            [np.zeros(3) if isinstance(p, MovingPathPoint) else p.location for p in self._points]
        )

    def at(self, q: Mapping[str, float] | ArrayLike) -> Lines:
        """Return lengths and moment arms at coordinates q (..., n)."""
        q = self.kinematics.vector(q)
        chunks = [self._measure(chunk)[:2] for _, chunk in self._chunks(q)]
        length, arm = self._joined(q, *zip(*chunks, strict=True))
        return Lines(self.names, length, arm)

    def pulls(self, q: Mapping[str, float] | ArrayLike, groups: Sequence[Collection[str]]) -> Pulls:
        """Return lengths, moment arms, wrenches on groups of bodies, and crossings between groups.

        Args:
            q: coordinates, rad and m, (..., n).
            groups: names of the bodies in each of the g groups.
        """
        q = self.kinematics.vector(q)
        group = np.full(len(self.kinematics.bodies), -1)
        for k, bodies in enumerate(groups):
            group[[self.kinematics.bodies[name] for name in bodies]] = k
        member = (group[:, None] == np.arange(len(groups))).astype(float)
        lengths, arms, wrenches, parts = [], [], [], []
        for first, chunk in self._chunks(q):
            length, arm, work = self._measure(chunk)
            lengths.append(length)
            arms.append(arm)
            wrenches.append(np.einsum("fmbi,bg->fmgi", work.wrenches, member))
            part = work.parts()
            ends = group[part.bodies]
            part = StraightParts(part.frame + first, part.line, ends, part.ends)
            parts.append(part.chosen(np.flatnonzero(ends[:, 0] != ends[:, 1])))
        length, arm, wrench = self._joined(q, lengths, arms, wrenches)
        return Pulls(self.names, length, arm, wrench, StraightParts.joined(parts))

    def _chunks(self, q: Array) -> Iterator[tuple[int, Array]]:
        """Yield, for each block of frames, the index of its first frame and coordinates (f, n)."""
        flat = q.reshape(-1, q.shape[-1])
        for first in range(0, len(flat), BLOCK_FRAMES):
            yield first, flat[first : first + BLOCK_FRAMES]

    def _joined(self, q: Array, *columns: Sequence[Array]) -> list[Array]:
        arrays = [np.concatenate(parts) for parts in columns]
        return [values.reshape(*q.shape[:-1], *values.shape[1:]) for values in arrays]

    def _measure(self, q: Array) -> tuple[Array, Array, Tension]:
        """Return lengths (f, m), moment arms (f, m, n) and forces at coordinates q (f, n)."""
        motion = self.kinematics.motion(q)
        locations, rates = self._own_motion(q)
        poses = motion.poses[:, self._body]
        points = np.einsum("fkij,fkj->fki", poses[..., :3, :3], locations) + poses[..., :3, 3]
        follower = self._followers(q)
        rows, point = np.nonzero(follower >= 0)
        next_point = follower[rows, point]
        wrapped = np.zeros(len(rows), bool)
        count = len(self.names), len(self.kinematics.bodies)
        work = Tension(points, self._owner, self._body, count)
        for path, first in zip(self._paths, self._first, strict=True):
            for k in range(first, first + len(path.points) - 1) if path.wraps else ():
                chosen = point == k
                wrapped |= chosen
                self._wrap(path, first, k, rows[chosen], next_point[chosen], motion, work)
        straight = ~wrapped
        work.pull(rows[straight], point[straight], next_point[straight])
        work.press_points()
        shape = len(q), len(self.names), -1
        twists = motion.twists.reshape(len(q), -1, q.shape[1])
        arms = work.wrenches.reshape(shape) @ twists
        for k, c, rate in rates:
            velocity = np.einsum("fij,fj->fi", poses[:, k, :3, :3], rate)
            arms[:, self._owner[k], c] += (work.pulls[:, k] * velocity).sum(axis=1)
        lengths = np.add.reduceat(work.lengths, self._first, axis=1)
        arms[np.isnan(lengths)] = np.nan
        return lengths, arms, work

    def _own_motion(self, q: Array) -> tuple[Array, list[tuple[int, int, Array]]]:
        """Return the points (f, k, 3) in their bodies, and derivatives of moving points: index of
        the point, of the coordinate, dp/dq (f, 3).
        """
        locations = np.broadcast_to(self._locations, (len(q), *self._locations.shape)).copy()
        rates = []
        for k, point in enumerate(self._points):
            if isinstance(point, MovingPathPoint):
                for axis, (name, function) in enumerate(
                    zip(point.coordinates, point.functions, strict=True)
                ):
                    c = -1 if name is None else self.kinematics.coordinates[name]
                    value = np.zeros(len(q)) if name is None else q[:, c]
                    locations[:, k, axis] = function(value)
                    if name is not None:
                        rates.append((k, c, np.outer(function.slope(value), np.eye(3)[axis])))
        return locations, rates

    def _followers(self, q: Array) -> Index:
        """Return the next active point (f, k) after each active one; -1: none."""
        follower = np.full((len(q), len(self._points)), -1)
        ends = set(self._last.tolist())
        upcoming = np.full(len(q), -1)
        for k in range(len(self._points) - 1, -1, -1):
            if k in ends:
                upcoming = np.full(len(q), -1)
            point = self._points[k]
            if isinstance(point, ConditionalPathPoint):
                value = q[:, self.kinematics.coordinates[point.coordinate]]
                low, high = point.range
                active = (value >= low - CONDITION_TOLERANCE) & (
                    value <= high + CONDITION_TOLERANCE
                )
                follower[:, k] = np.where(active, upcoming, -1)
                upcoming = np.where(active, k, upcoming)
            else:
                follower[:, k] = upcoming
                upcoming = np.full(len(q), k)
        return follower

    def _wrap(
        self,
        path: Path,
        first: int,
        k: int,
        rows: Index,
        next_point: Index,
        motion: Motion,
        work: Tension,
    ) -> None:
        """Add strings from point k to points `next_point` in frames `rows`, over the wraps."""
        objects = self.kinematics.model.wrap_objects
        usable = [w for w in path.wraps if first + w.first <= k and objects[w.wrap_object].active]
        wraps = [objects[w.wrap_object] for w in usable]
        if not wraps:
            work.pull(rows, np.full(len(rows), k), next_point)
            return
        bodies = [self.kinematics.bodies[wrap.body] for wrap in wraps]
        poses = motion.poses[rows[:, None], np.array(bodies)] @ np.stack(
            [wrap.pose for wrap in wraps]
        )
        allowed = next_point[:, None] <= first + np.array([w.last for w in usable])
        start, end = work.points[rows, k], work.points[rows, next_point]
        ends = np.stack([np.full(len(rows), self._body[k]), self._body[next_point]], axis=1)
        moves = ends[:, None, :] != np.array(bodies)[:, None]
        result = strings_over(wraps, poses, start, end, allowed, moves)
        work.pull_wrapped(rows, k, next_point, result, np.array(bodies))
