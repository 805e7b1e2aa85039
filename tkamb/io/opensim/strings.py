"""Taut strings between two points over several wrap objects at once.

Each object is passed in turn, with its neighbours' touching points held, until nothing moves:
then every straight part is tangent to the objects at both its ends, and the string is taut.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, inverse
from tkamb.io.opensim.lines import WrapObject
from tkamb.io.opensim.wrapping import Index, Mask, Touch, touch


@dataclass(frozen=True)
class StringSettings:
    """The shortest string over several wrap objects, object by object."""

    max_sweeps: int = 100
    """Sweeps over all objects, after which a string without convergence is reported as failed.
    Chosen: strings that converge need fewer."""
    max_extrapolation: float = 10.0
    """Largest extrapolation, as a multiple of the last step. Chosen: two sweeps do not predict
    farther."""
    tolerance: float = 1e-10
    """m; a string has converged when the last sweep moves no touching point by more. Chosen: far
    below what changes a muscle's length."""


STRING = StringSettings()


@dataclass(frozen=True, eq=False)
class WrappedStrings:
    """Strings (f) over w objects.

    Args:
        order: (f, w) the objects each touches, from its start to its end; -1 where no more.
        entry: (f, w, 3) m, where it meets object w.
        exit: (f, w, 3) m, where it leaves object w.
        arc_m: (f, w) its length on object w; NaN where no taut string was found.
        push: (f, w, 2, 3) force of a shrinking object w on the two ends, per unit tension.
    """

    order: Index
    entry: Array
    exit: Array
    arc_m: Array
    push: Array


def strings_over(
    wraps: Sequence[WrapObject],
    poses: Array,
    start: Array,
    end: Array,
    allowed: Mask,
    moves: Mask,
) -> WrappedStrings:
    """Return the taut strings from start to end (f, 3) over the objects that lie in the way.

    Args:
        wraps: w objects, in the order in which they are tried.
        poses: (f, w, 4, 4) of the objects, in the frame of the points.
        start: (f, 3) m.
        end: (f, 3) m.
        allowed: (f, w) whether a string may touch an object.
        moves: (f, w, 2) whether the start and the end belong to another body than object w.
    """
    strings = _Strings(wraps, poses, start, end, moves)
    if len(wraps) == 1:
        strings.insert(0, np.flatnonzero(allowed[:, 0]))
        return strings.found()
    live = np.arange(len(start))
    point, order = strings.places(), strings.order.copy()
    value = residual = np.full_like(point, np.nan)
    for _ in range(STRING.max_sweeps):
        strings.sweep(live, allowed)
        same = (strings.order == order).all(axis=1)
        order, (last_value, last_residual) = strings.order.copy(), (value, residual)
        value = strings.places()
        residual = np.where(same[:, None], value - point, np.nan)
        live = live[~(np.abs(residual[live]).max(axis=1) < STRING.tolerance)]
        if not len(live):
            break
        point = value.copy()
        point[live] += _leap(value, last_value, residual, last_residual)[live]
        strings.place(point)
    strings.arc[live] = np.nan
    return strings.found()


def _leap(value: Array, last_value: Array, residual: Array, last_residual: Array) -> Array:
    """Return the extrapolated step (f, 6w) from the last two sweeps (Aitken, Anderson).

    Zero before there are two sweeps over the same objects, or if it is too large.
    """
    change = residual - last_residual
    squared = np.maximum((change**2).sum(axis=1), 1e-300)
    share = (residual * change).sum(axis=1) / squared
    sound = np.abs(share) < STRING.max_extrapolation
    leap = -np.where(sound, share, 0.0)[:, None] * (value - last_value)
    return np.where(sound[:, None], leap, 0.0)


class _Strings:
    """Current state of the strings, object by object; see `strings_over` for the arguments."""

    def __init__(
        self, wraps: Sequence[WrapObject], poses: Array, start: Array, end: Array, moves: Mask
    ) -> None:
        self.wraps, self.poses, self.back = wraps, poses, inverse(poses)
        self.start, self.end, self.moves = start, end, moves
        shape = poses.shape[:2]
        self.order = np.full(shape, -1)
        self.entry, self.exit = np.zeros((*shape, 3)), np.zeros((*shape, 3))
        self.arc, self.push = np.zeros(shape), np.zeros((*shape, 2, 3))

    def found(self) -> WrappedStrings:
        """Return the strings as a result."""
        return WrappedStrings(self.order, self.entry, self.exit, self.arc, self.push)

    def places(self) -> Array:
        """Return the touching points in one row (f, 6w) a string."""
        return np.concatenate([self.entry, self.exit], axis=2).reshape(len(self.start), -1)

    def place(self, places: Array) -> None:
        """Set the touching points from one row (f, 6w) a string."""
        both = places.reshape(*self.order.shape, 6)
        self.entry, self.exit = both[..., :3].copy(), both[..., 3:].copy()

    def sweep(self, rows: Index, allowed: Mask) -> None:
        """Lay some strings again over each allowed object (f, w), one after the other."""
        for w in range(len(self.wraps)):
            self.remove(w, rows)
            self.insert(w, rows[allowed[rows, w]])

    def remove(self, w: int, rows: Index) -> None:
        """Remove object w from the path of some strings."""
        kept = np.where(self.order[rows] == w, -1, self.order[rows])
        closed = np.argsort(kept < 0, axis=1, kind="stable")
        self.order[rows] = np.take_along_axis(kept, closed, axis=1)

    def insert(self, w: int, free: Index) -> None:
        """Lay some strings over object w in the first of their straight parts that meets it."""
        for gap in range(len(self.wraps)):
            free = free[(self.order[free] >= 0).sum(axis=1) >= gap]
            if not len(free):
                break
            follower = self.order[free, gap]
            last = follower < 0
            before = self.start[free]
            if gap > 0:
                before = self.exit[free, self.order[free, gap - 1]]
            after = np.where(last[:, None], self.end[free], self.entry[free, follower])
            is_end = np.stack([np.full(len(free), gap == 0), last], axis=1)
            back = self.back[free, w]
            moves = self.moves[free, w] & is_end
            result = touch(self.wraps[w], _moved(back, before), _moved(back, after), moves)
            self._touch(w, gap, free[result.touches], result)
            free = free[~result.touches]

    def _touch(self, w: int, gap: int, rows: Index, found: Touch) -> None:
        on, poses = found.touches, self.poses[rows, w]
        self.entry[rows, w] = _moved(poses, found.entry[on])
        self.exit[rows, w] = _moved(poses, found.exit[on])
        self.arc[rows, w] = found.arc_m[on]
        self.push[rows, w] = np.einsum("fij,fej->fei", poses[:, :3, :3], found.push[on])
        later = self.order[rows, gap:-1]
        self.order[rows, gap:] = np.column_stack([np.full(len(rows), w), later])


def _moved(poses: Array, points: Array) -> Array:
    """Return points (f, 3) moved each by its own pose (f, 4, 4)."""
    return np.einsum("fij,fj->fi", poses[:, :3, :3], points) + poses[:, :3, 3]
