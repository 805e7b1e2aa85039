"""Taut strings between two points over several wrap objects at once.

Each object is passed in turn, with its neighbours' touching points held, until nothing moves:
then every straight part is tangent to the objects at both its ends, and the string is taut.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, inverse
from tkamb.opensim.model import WrapObject
from tkamb.opensim.wrapping import Index, Mask, touch

SWEEPS = 200
TAUT = 1e-10
"""m: what the last sweep may still move a touching point."""


@dataclass(frozen=True, eq=False)
class WrappedStrings:
    """Strings (f) over w objects.

    Args:
        order: (f, w) the objects each touches, from its start to its end; -1 where no more.
        entry: (f, w, 3) m, where it meets object w.
        exit: (f, w, 3) m, where it leaves object w.
        arc_m: (f, w) its length on object w; NaN where no taut string was found.
        push: (f, w, 2, 3) what object w, where it yields, does to the string's two ends.
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
    frames, count = allowed.shape
    order = np.full((frames, count), -1)
    entry, leave = np.zeros((2, frames, count, 3))
    arc, push = np.zeros((frames, count)), np.zeros((frames, count, 2, 3))
    back = inverse(poses)
    live = np.arange(frames)
    for _ in range(SWEEPS):
        was = order[live].copy(), entry[live].copy(), leave[live].copy()
        for w, wrap in enumerate(wraps):
            _remove(order, live, w)
            free = live[allowed[live, w]]
            for gap in range(count):
                free = free[(order[free] >= 0).sum(axis=1) >= gap]
                if not len(free):
                    break
                follower = order[free, gap]
                last = follower < 0
                before = start[free] if gap == 0 else leave[free, order[free, gap - 1]]
                after = np.where(last[:, None], end[free], entry[free, follower])
                is_end = np.stack([np.full(len(free), gap == 0), last], axis=1)
                found = touch(
                    wrap,
                    _moved(back[free, w], before),
                    _moved(back[free, w], after),
                    moves[free, w] & is_end,
                )
                hit = free[found.touches]
                entry[hit, w] = _moved(poses[hit, w], found.entry[found.touches])
                leave[hit, w] = _moved(poses[hit, w], found.exit[found.touches])
                arc[hit, w] = found.arc_m[found.touches]
                pushed = found.push[found.touches].swapaxes(-1, -2)
                push[hit, w] = (poses[hit, w, :3, :3] @ pushed).swapaxes(-1, -2)
                order[hit, gap:] = np.column_stack([np.full(len(hit), w), order[hit, gap:-1]])
                free = free[~found.touches]
        shift = np.abs(entry[live] - was[1]) + np.abs(leave[live] - was[2])
        same = (order[live] == was[0]).all(axis=1) & (shift.max(axis=(1, 2)) < TAUT)
        live = live[~same] if count > 1 else live[:0]
        if not len(live):
            break
    arc[live] = np.nan
    return WrappedStrings(order, entry, leave, arc, push)


def _moved(poses: Array, points: Array) -> Array:
    """Return points (f, 3) moved each by its own pose (f, 4, 4)."""
    return np.einsum("fij,fj->fi", poses[:, :3, :3], points) + poses[:, :3, 3]


def _remove(order: Index, rows: Index, w: int) -> None:
    """Take object w out of the orders of some rows, and close the gaps."""
    kept = np.where(order[rows] == w, -1, order[rows])
    closed = np.argsort(kept < 0, axis=1, kind="stable")
    order[rows] = np.take_along_axis(kept, closed, axis=1)
