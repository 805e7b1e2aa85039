"""Taut strings between two points over several wrap objects at once.

Each object is passed in turn, with its neighbours' touching points held, until nothing moves:
then every straight part is tangent to the objects at both its ends, and the string is taut.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, inverse
from tkamb.opensim.model import WrapObject
from tkamb.opensim.wrapping import touch

SWEEPS = 200
TAUT = 1e-12
"""m: what the last sweep may still move a touching point."""


@dataclass(frozen=True, eq=False)
class WrappedStrings:
    """Strings (f) over w objects.

    Args:
        order: (f, w) the objects each touches, from its start to its end; -1 where no more.
        entry: (f, w, 3) m, where it meets object w.
        exit: (f, w, 3) m, where it leaves object w.
        arc_m: (f, w) its length on object w; NaN where no taut string was found.
    """

    order: Array
    entry: Array
    exit: Array
    arc_m: Array


def strings_over(
    wraps: Sequence[WrapObject], poses: Array, start: Array, end: Array, allowed: Array
) -> WrappedStrings:
    """Return the taut strings from start to end (f, 3) over the objects that lie in the way.

    Args:
        wraps: w objects, in the order in which they are tried.
        poses: (f, w, 4, 4) of the objects, in the frame of the points.
        start: (f, 3) m.
        end: (f, 3) m.
        allowed: (f, w) whether a string may touch an object.
    """
    frames, count = allowed.shape
    order = np.full((frames, count), -1)
    entry, leave = np.zeros((2, frames, count, 3))
    arc = np.zeros((frames, count))
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
                before = start[free] if gap == 0 else leave[free, order[free, gap - 1]]
                after = np.where(
                    (order[free, gap] < 0)[:, None], end[free], entry[free, order[free, gap]]
                )
                found = touch(wrap, _moved(back[free, w], before), _moved(back[free, w], after))
                hit = free[found.touches]
                entry[hit, w] = _moved(poses[hit, w], found.entry[found.touches])
                leave[hit, w] = _moved(poses[hit, w], found.exit[found.touches])
                arc[hit, w] = found.arc_m[found.touches]
                order[hit, gap:] = np.column_stack([np.full(len(hit), w), order[hit, gap:-1]])
                free = free[~found.touches]
        shift = np.abs(entry[live] - was[1]) + np.abs(leave[live] - was[2])
        same = (order[live] == was[0]).all(axis=1) & (shift.max(axis=(1, 2)) < TAUT)
        live = live[~same] if count > 1 else live[:0]
        if not len(live):
            break
    arc[live] = np.nan
    return WrappedStrings(order, entry, leave, arc)


def _moved(poses: Array, points: Array) -> Array:
    """Return points (f, 3) moved each by its own pose (f, 4, 4)."""
    return np.einsum("fij,fj->fi", poses[:, :3, :3], points) + poses[:, :3, 3]


def _remove(order: Array, rows: Array, w: int) -> None:
    """Take object w out of the orders of some rows, and close the gaps."""
    kept = np.where(order[rows] == w, -1, order[rows])
    closed = np.argsort(kept < 0, axis=1, kind="stable")
    order[rows] = np.take_along_axis(kept, closed, axis=1)
