"""Sagittal profile of a femoral condyle, as a curve that goes on past 90 deg of flexion.

Seen from below, the posterior condyle is no height field in deep flexion. Its sagittal section
is a curve all the same: the profile runs from the anterior to the posterior end of what a
plate under the femur can touch between -20 and 160 deg of flexion.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.polygons import sagittal_section
from tkamb.geometry.surface import Surface
from tkamb.units import DEGREE, MILLIMETRE

LEAST_FLEXION, MOST_FLEXION = -20.0 * DEGREE, 160.0 * DEGREE
"""rad; a plate touches the profile somewhere within its ends between these."""
SPACING = 5e-4
"""m between the points of a profile."""
WELD = 1e-8
"""m; ends of cuts nearer than this are one point."""


@dataclass(frozen=True, eq=False)
class CondyleProfile:
    """Sagittal section of a condyle in the femoral frame, by arc length.

    Args:
        z: m, plane of the section.
        arc: (m,) m, from the point that is lowest in extension, positive backwards.
        points: (m, 2) x and y, m, even in arc length.
    """

    z: float
    arc: Array
    points: Array

    def at(self, arc: Array) -> Array:
        """Return the points (n, 2) m at arc lengths (n,) m; a cubic spline."""
        return np.asarray(CubicSpline(self.arc, self.points)(arc))

    def locate(self, points: Array) -> Array:
        """Return the arc lengths (n,) m of the profile's points nearest to points (n, 2)."""
        a, b = self.points[:-1], self.points[1:]
        edge, offset = b - a, np.asarray(points, float)[:, None] - a
        share = np.clip(np.einsum("nmi,mi->nm", offset, edge) / (edge**2).sum(axis=1), 0.0, 1.0)
        distance = np.linalg.norm(offset - share[..., None] * edge, axis=2)
        nearest = distance.argmin(axis=1)
        within = share[np.arange(len(nearest)), nearest]
        return np.asarray(self.arc[nearest] + within * np.diff(self.arc)[nearest])

    def lowest(self, flexion: Array) -> Array:
        """Return the arc lengths (n,) m of the points that are lowest at flexion (n,) rad.

        The femur is turned about z only. A parabola through the three lowest points of the
        profile places the minimum between them.
        """
        flexion = np.atleast_1d(np.asarray(flexion, float))
        height = np.sin(flexion)[:, None] * self.points[:, 0]
        height = height + np.cos(flexion)[:, None] * self.points[:, 1]
        least = np.clip(height.argmin(axis=1), 1, len(self.arc) - 2)
        row = np.arange(len(least))
        before, here, after = (height[row, least + d] for d in (-1, 0, 1))
        bend = before - 2.0 * here + after
        offset = np.divide(before - after, 2.0 * bend, out=np.zeros_like(bend), where=bend > 0)
        spacing = self.arc[1] - self.arc[0]
        return np.asarray(self.arc[least] + np.clip(offset, -1.0, 1.0) * spacing)


def condyle_profile(femoral: Surface, z: float) -> CondyleProfile:
    """Return the profile of a femoral component (femoral frame) in the plane at z (m).

    Raises:
        InputError: the plane misses the component, or cuts it into pieces none of which runs
            from its anterior to its posterior end.
    """
    loop = _longest_chain(sagittal_section(femoral, z), femoral.name, z)
    ends = [_support(loop, angle) for angle in (LEAST_FLEXION, 60.0 * DEGREE, MOST_FLEXION)]
    run = _between(loop, *ends)
    arc, points = _even(run)
    profile = CondyleProfile(z, arc, points)
    return CondyleProfile(z, arc - profile.lowest(np.zeros(1))[0], points)


def _even(run: Array) -> tuple[Array, Array]:
    """Return arc lengths and points, even on the cubic spline through a chain (thinned)."""
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(run, axis=0), axis=1)))
    even = np.linspace(0.0, arc[-1], max(int(arc[-1] / SPACING), 8) + 1)
    kept = np.unique(np.searchsorted(arc, even).clip(max=len(arc) - 1))
    points = CubicSpline(arc[kept], run[kept])(even)
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    even = np.linspace(0.0, arc[-1], len(arc))
    return even, CubicSpline(arc, points)(even)


def _support(points: Array, flexion: float) -> int:
    return int(np.argmin(np.sin(flexion) * points[:, 0] + np.cos(flexion) * points[:, 1]))


def _between(loop: Array, first: int, middle: int, last: int) -> Array:
    """Return the part of a chain from `first` over `middle` to `last`."""
    n = len(loop)
    closed = np.linalg.norm(loop[0] - loop[-1]) < 10.0 * SPACING
    if not closed:
        low, high = sorted((first, last))
        run = loop[low : high + 1]
        return run if first < last else run[::-1]
    forward = np.arange(first, first + (last - first) % n + 1) % n
    if middle in forward:
        return loop[forward]
    return loop[np.arange(first, first - (first - last) % n - 1, -1) % n]


def _longest_chain(segments: Array, name: str, z: float) -> Array:
    """Return the points (m, 2) of the longest chain of segments (k, 2, 2), in order."""
    if not len(segments):
        raise InputError(f"the plane z = {z / MILLIMETRE:g} mm misses the part", name)
    ends = segments.reshape(-1, 2)
    _, first, number = np.unique(
        np.round(ends / WELD).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    links = number.reshape(-1, 2)
    links = links[links[:, 0] != links[:, 1]]
    neighbours: dict[int, list[int]] = {}
    for a, b in links.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    chains: list[Array] = []
    left = set(neighbours)
    while left:
        chain = _walk(neighbours, left)
        chains.append(ends[first[chain]])
    return max(chains, key=lambda c: float(np.linalg.norm(np.diff(c, axis=0), axis=1).sum()))


def _walk(neighbours: dict[int, list[int]], left: set[int]) -> NDArray[np.int64]:
    """Return one chain of points, from an open end if it has one; take its points off `left`."""
    start = min((p for p in left if len(neighbours[p]) == 1), default=min(left))
    chain = [start]
    left.discard(start)
    while True:
        onward = [p for p in neighbours[chain[-1]] if p in left]
        if not onward:
            return np.array(chain)
        chain.append(onward[0])
        left.discard(onward[0])
