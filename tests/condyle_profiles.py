"""Sagittal profile of a femoral condyle, as a curve that continues beyond 90 deg of flexion.

The profile is the part of a sagittal section that a horizontal plate under the femur touches
between -20 and 160 deg of flexion. It runs from anterior to posterior.
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
"""rad: flexion at which a plate touches the anterior and the posterior end of a profile."""
SPACING = 5e-4
"""m: spacing of the points of a profile."""
WELD = 1e-8
"""m: distance below which two ends of a section's segments are one point."""


@dataclass(frozen=True, eq=False)
class CondyleProfile:
    """Sagittal section of a condyle in the femoral frame, by arc length.

    Args:
        z: m, plane of the section.
        arc: (m,) m, arc length from the lowest point in extension, positive to posterior.
        points: (m, 2) m, x and y at equal steps of the arc length.
    """

    z: float
    arc: Array
    points: Array

    def at(self, arc: Array) -> Array:
        """Return the points (n, 2), m, at arc lengths (n,), m, on a cubic spline."""
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
        """Return the arc lengths (n,), m, of the lowest points at flexions (n,), rad.

        The femur is rotated about z. The lowest point is the minimum of a parabola through the
        three lowest points of the profile.
        """
        flexion = np.atleast_1d(np.asarray(flexion, float))
        height = np.sin(flexion)[:, None] * self.points[:, 0]
        height = height + np.cos(flexion)[:, None] * self.points[:, 1]
        least = np.clip(height.argmin(axis=1), 1, len(self.arc) - 2)
        row = np.arange(len(least))
        before, middle, after = (height[row, least + d] for d in (-1, 0, 1))
        bend = before - 2.0 * middle + after
        offset = np.divide(before - after, 2.0 * bend, out=np.zeros_like(bend), where=bend > 0)
        spacing = self.arc[1] - self.arc[0]
        return np.asarray(self.arc[least] + np.clip(offset, -1.0, 1.0) * spacing)


def condyle_profile(femoral: Surface, z: float) -> CondyleProfile:
    """Return the profile of a femoral component (femoral frame) in the plane at z (m).

    Raises:
        InputError: the plane does not meet the component.
    """
    loop = _longest_chain(sagittal_section(femoral, z), femoral.name, z)
    ends = [_support(loop, angle) for angle in (LEAST_FLEXION, 60.0 * DEGREE, MOST_FLEXION)]
    run = _between(loop, *ends)
    arc, points = _even(run)
    profile = CondyleProfile(z, arc, points)
    return CondyleProfile(z, arc - profile.lowest(np.zeros(1))[0], points)


def _even(run: Array) -> tuple[Array, Array]:
    """Return arc lengths and points at equal steps on a cubic spline through a chain."""
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(run, axis=0), axis=1)))
    even = np.linspace(0.0, arc[-1], max(int(arc[-1] / SPACING), 8) + 1)
    chosen = np.unique(np.searchsorted(arc, even).clip(max=len(arc) - 1))
    points = CubicSpline(arc[chosen], run[chosen])(even)
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
    remaining = set(neighbours)
    while remaining:
        chain = _next_chain(neighbours, remaining)
        chains.append(ends[first[chain]])
    return max(chains, key=lambda c: float(np.linalg.norm(np.diff(c, axis=0), axis=1).sum()))


def _next_chain(neighbours: dict[int, list[int]], remaining: set[int]) -> NDArray[np.int64]:
    """Return one chain of points, and remove them from `remaining`.

    The chain begins at an open end if there is one.
    """
    start = min((p for p in remaining if len(neighbours[p]) == 1), default=min(remaining))
    chain = [start]
    remaining.discard(start)
    while True:
        following = [p for p in neighbours[chain[-1]] if p in remaining]
        if not following:
            return np.array(chain)
        chain.append(following[0])
        remaining.discard(following[0])
