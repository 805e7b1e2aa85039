"""Loads of strings of unit tension on the bodies that they pass, summed part by part."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.io.opensim.strings import WrappedStrings
from tkamb.io.opensim.wrapping import Index


@dataclass(frozen=True, eq=False)
class StraightParts:
    """Straight parts of paths from one body to another, p of them.

    Args:
        frame: (p,) coordinate set, counted as if they were flat.
        line: (p,) muscle or ligament.
        bodies: (p, 2) where a part begins and ends, in the order of the path.
        ends: (p, 2, 3) m, in ground.
    """

    frame: Index
    line: Index
    bodies: Index
    ends: Array

    def chosen(self, which: Index) -> "StraightParts":
        """Return some of the parts."""
        return StraightParts(
            self.frame[which], self.line[which], self.bodies[which], self.ends[which]
        )

    @classmethod
    def joined(cls, several: Sequence["StraightParts"]) -> "StraightParts":
        """Return the parts of several in one."""
        return cls(
            np.concatenate([parts.frame for parts in several]),
            np.concatenate([parts.line for parts in several]),
            np.concatenate([parts.bodies for parts in several]),
            np.concatenate([parts.ends for parts in several]),
        )


class Tension:
    """Strings of unit tension on points and bodies; see `LineSet` for what they belong to.

    Args:
        points: (f, k, 3) m, path points in ground.
        lines: (k,) line that each point belongs to.
        bodies: (k,) body that carries it.
        count: number of lines and of bodies.
    """

    def __init__(self, points: Array, lines: Index, bodies: Index, count: tuple[int, int]) -> None:
        self.points, self.lines, self.bodies = points, lines, bodies
        self.wrenches = np.zeros((len(points), *count, 6))
        self.pulls = np.zeros_like(points)
        self.lengths = np.zeros(points.shape[:2])
        self._parts: list[tuple[Index, Index, Index, Index, Array, Array]] = []

    def pull(self, rows: Index, first: Index, second: Index) -> None:
        """Add straight strings between points of some rows."""
        start, end = self.points[rows, first], self.points[rows, second]
        u, distance = _direction(start, end)
        self.lengths[rows, first] += distance
        self.pulls[rows, first] += u
        self.pulls[rows, second] -= u
        self._keep(rows, self.lines[first], self.bodies[first], self.bodies[second], start, end)

    def pull_wrapped(
        self, rows: Index, k: int, there: Index, strings: WrappedStrings, bodies: Index
    ) -> None:
        """Add strings from point k to others of some rows, over objects fixed to bodies."""
        owner, at = int(self.lines[k]), np.arange(len(rows))
        place, last = self.points[rows, k], np.full(len(rows), -1)
        for gap in range(len(bodies) + 1):
            upcoming = strings.order[at, gap] if gap < len(bodies) else np.full(len(rows), -1)
            touching = upcoming >= 0
            target = np.where(
                touching[:, None], strings.entry[at, upcoming], self.points[rows, there]
            )
            u, distance = _direction(place, target)
            self.lengths[rows, k] += distance
            behind = np.full(len(rows), self.bodies[k]) if gap == 0 else bodies[last]
            ahead = np.where(touching, bodies[upcoming], self.bodies[there])
            self._keep(rows, np.full(len(rows), owner), behind, ahead, place, target)
            if gap == 0:
                self.pulls[rows, k] += u
            else:
                self._press(owner, rows, behind, place, u)
            on = touching
            self._press(owner, rows[on], ahead[on], target[on], -u[on])
            self.pulls[rows[~on], there[~on]] -= u[~on]
            rows, there, last, at = rows[on], there[on], upcoming[on], at[on]
            self.lengths[rows, k] += strings.arc_m[at, last]
            for end, points in enumerate((np.full(len(rows), k), there)):
                push = strings.push[at, last, end]
                self.pulls[rows, points] += push
                self._press(owner, rows, bodies[last], self.points[rows, points], -push)
            place = strings.exit[at, last]

    def press_points(self) -> None:
        """Add the pulls on the path points to the wrenches."""
        wrenches = np.concatenate([np.cross(self.points, self.pulls), self.pulls], axis=-1)
        count = self.wrenches.shape[2]
        place = self.lines * count + self.bodies
        by_place = np.argsort(place, kind="stable")
        places, first = np.unique(place[by_place], return_index=True)
        sums = np.add.reduceat(wrenches[:, by_place], first, axis=1)
        self.wrenches[:, places // count, places % count] += sums

    def parts(self) -> StraightParts:
        """Return the straight parts between different bodies."""
        frame, line, behind, ahead, start, end = (
            np.concatenate(column) for column in zip(*self._parts, strict=True)
        )
        bodies, ends = np.stack([behind, ahead], axis=1), np.stack([start, end], axis=1)
        whole = StraightParts(frame, line, bodies, ends)
        return whole.chosen(np.flatnonzero(behind != ahead))

    def _press(self, owner: int, rows: Index, bodies: Index, points: Array, forces: Array) -> None:
        self.wrenches[rows, owner, bodies] += np.hstack([np.cross(points, forces), forces])

    def _keep(self, *part: Array | Index) -> None:
        self._parts.append(part)  # type: ignore[arg-type]


def _direction(start: Array, end: Array) -> tuple[Array, Array]:
    """Return unit vectors (f, 3) from start to end, 0 where they coincide, and distances (f,)."""
    step = end - start
    distance = np.linalg.norm(step, axis=-1)
    return step / np.maximum(distance, 1e-300)[:, None], distance
