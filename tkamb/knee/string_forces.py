"""Forces of taut strings over wrap objects on points and bodies, by virtual work.

A string of unit tension exerts a force on each path point, and on each wrap object at the points
where the string meets and leaves it. The forces of a string on all bodies balance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, Index
from tkamb.knee.taut_strings import WrappedStrings


@dataclass(frozen=True, eq=False)
class StraightParts:
    """The p straight parts of paths between different bodies.

    Args:
        frame: index of the coordinate set, in flattened order, shape (p,).
        line: index of the muscle or ligament, shape (p,).
        bodies: indices of the bodies at the start and end of each part, shape (p, 2).
        ends: start and end of each part in ground, m, shape (p, 2, 3).
    """

    frame: Index
    line: Index
    bodies: Index
    ends: Array

    def chosen(self, which: Index) -> "StraightParts":
        """Return the chosen parts."""
        return StraightParts(
            self.frame[which], self.line[which], self.bodies[which], self.ends[which]
        )

    @classmethod
    def joined(cls, several: Sequence["StraightParts"]) -> "StraightParts":
        """Return all parts of several objects in one object."""
        return cls(
            np.concatenate([parts.frame for parts in several]),
            np.concatenate([parts.line for parts in several]),
            np.concatenate([parts.bodies for parts in several]),
            np.concatenate([parts.ends for parts in several]),
        )


class Tension:
    """Forces of strings of unit tension on path points and bodies, summed part by part.

    Args:
        points: path points in ground, m, shape (f, k, 3).
        lines: index of each point's muscle or ligament, shape (k,).
        bodies: index of each point's body, shape (k,).
        count: number of muscles and ligaments, and number of bodies.
    """

    def __init__(self, points: Array, lines: Index, bodies: Index, count: tuple[int, int]) -> None:
        self.points, self.lines, self.bodies = points, lines, bodies
        self.wrenches = np.zeros((len(points), *count, 6))
        self.pulls = np.zeros_like(points)
        self.lengths = np.zeros(points.shape[:2])
        self._parts: list[tuple[Index, Index, Index, Index, Array, Array]] = []

    def pull(self, rows: Index, first: Index, second: Index) -> None:
        """Add straight strings between the path points `first` and `second` in frames `rows`."""
        start, end = self.points[rows, first], self.points[rows, second]
        u, distance = _direction(start, end)
        self.lengths[rows, first] += distance
        self.pulls[rows, first] += u
        self.pulls[rows, second] -= u
        self._add_part(rows, self.lines[first], self.bodies[first], self.bodies[second], start, end)

    def pull_wrapped(
        self, rows: Index, k: int, next_point: Index, strings: WrappedStrings, bodies: Index
    ) -> None:
        """Add strings from path point k to points `next_point` in frames `rows`, over wrap objects.

        `bodies` are the indices of the wrap objects' bodies.
        """
        owner, at = int(self.lines[k]), np.arange(len(rows))
        place, last = self.points[rows, k], np.full(len(rows), -1)
        for gap in range(len(bodies) + 1):
            upcoming = strings.order[at, gap] if gap < len(bodies) else np.full(len(rows), -1)
            touching = upcoming >= 0
            target = np.where(
                touching[:, None], strings.entry[at, upcoming], self.points[rows, next_point]
            )
            u, distance = _direction(place, target)
            self.lengths[rows, k] += distance
            behind = np.full(len(rows), self.bodies[k]) if gap == 0 else bodies[last]
            ahead = np.where(touching, bodies[upcoming], self.bodies[next_point])
            self._add_part(rows, np.full(len(rows), owner), behind, ahead, place, target)
            if gap == 0:
                self.pulls[rows, k] += u
            else:
                self._press(owner, rows, behind, place, u)
            free = ~touching
            self._press(owner, rows[touching], ahead[touching], target[touching], -u[touching])
            self.pulls[rows[free], next_point[free]] -= u[free]
            rows, next_point = rows[touching], next_point[touching]
            last, at = upcoming[touching], at[touching]
            self.lengths[rows, k] += strings.arc_m[at, last]
            for end, points in enumerate((np.full(len(rows), k), next_point)):
                push = strings.push[at, last, end]
                self.pulls[rows, points] += push
                self._press(owner, rows, bodies[last], self.points[rows, points], -push)
            place = strings.exit[at, last]

    def press_points(self) -> None:
        """Add the forces on the path points to the wrenches."""
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

    def _add_part(self, *part: Array | Index) -> None:
        self._parts.append(part)  # type: ignore[arg-type]


def _direction(start: Array, end: Array) -> tuple[Array, Array]:
    """Return unit vectors (f, 3) from start to end, and distances (f,).

    The vector is zero if start and end coincide.
    """
    step = end - start
    distance = np.linalg.norm(step, axis=-1)
    return step / np.maximum(distance, 1e-300)[:, None], distance
