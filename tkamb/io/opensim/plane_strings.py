"""Strings over an ellipsoid that stay in one plane: initial guesses of the taut string.

Scaled to the unit sphere, each half plane through both ends cuts out a circle, and the taut
string in it is known in closed form; its length is that of the arc on the ellipsoid.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class PlaneStringSettings:
    """Initial guesses of a string around an ellipsoid or torus, in planes through its end
    points."""

    runge_kutta_steps: int = 6
    """Runge-Kutta steps along a geodesic of an initial guess. Chosen: they give an initial guess
    only."""
    rival_share: float = 0.1
    """Share of its arc by which a plane string may be longer than the shortest and is still tried.
    Chosen: it may lead to the shortest geodesic."""
    planes: int = 24
    """Planes through both points that are tried. Chosen: one every 7.5 deg of half a turn."""


PLANE_STRING = PlaneStringSettings()


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_FINE = (
    ((2.0 * np.arange(PLANE_STRING.runge_kutta_steps) + 1.0)[:, None] + _NODES)
    / PLANE_STRING.runge_kutta_steps
    - 1.0
).ravel()
_FINE_WEIGHTS = _WEIGHTS / PLANE_STRING.runge_kutta_steps
_NODES, _COARSE_WEIGHTS = np.polynomial.legendre.leggauss(6)
_COARSE, _ENDS = _NODES, np.array([-1.0, 1.0])
"""Places on an arc, -1 to 1: for its length in each step, for its whole, and its ends."""


def planar_starts(
    p: Array, q: Array, axes: Array, half: Array | None
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the shortest plane strings, and the next shortest that stand apart from them.

    Args:
        p: (f, 3) start, in the space where the ellipsoid is the unit sphere.
        q: (f, 3) end, likewise.
        axes: (3,) m.
        half: as in `shortest_strings`.

    Returns:
        Where they meet the ellipsoid (f, 2, 3), in that space; (f, 2, STEPS) m, their lengths
        on it in steps of equal angle; (f,) whether the second may turn out the shorter.
    """
    planes = _Planes.through(p, q)
    points = planes.points(_ENDS)
    arcs = planes.speeds(_COARSE, axes) @ _COARSE_WEIGHTS
    lengths = arcs + sum(
        np.linalg.norm((points[:, :, k] - end[:, None]) * axes, axis=-1)
        for k, end in enumerate((p, q))
    )
    if half is not None:
        touches = (points.sum(axis=2) * axes) @ half > 0.0
        lengths = np.where(touches, lengths, np.inf)
    rows = np.arange(len(p))
    best = lengths.argmin(axis=1)
    lower = (lengths <= np.roll(lengths, 1, axis=1)) & (lengths <= np.roll(lengths, -1, axis=1))
    lower[rows, best] = False
    others = np.where(lower, lengths, np.inf)
    other = others.argmin(axis=1)
    rival = others[rows, other] - lengths[rows, best] < PLANE_STRING.rival_share * arcs[rows, other]
    chosen = np.column_stack([best, other])
    speeds = planes.chosen(rows[:, None], chosen).speeds(_FINE, axes)
    pieces = speeds.reshape(len(p), 2, PLANE_STRING.runge_kutta_steps, -1) @ _FINE_WEIGHTS
    return points[rows[:, None], chosen, 0], pieces, rival


@dataclass(frozen=True, eq=False)
class _Planes:
    """Half planes k through the line from p to q, and the circles they cut out of a unit sphere.

    Args:
        along: (f, 1, 3) direction of the line.
        outward: (f, k, 3) direction across it.
        centre: (f, k, 3) of the circle.
        radius: (f, k) of the circle.
        ends: (2, f, k) rad, where the taut string in the plane meets and leaves the circle,
            counted from outward to along.
    """

    along: Array
    outward: Array
    centre: Array
    radius: Array
    ends: Array

    @classmethod
    def through(cls, p: Array, q: Array) -> "_Planes":
        """Return planes at equal angles through lines from p to q (f, 3)."""
        along = unit(q - p)
        middle = p - dot(p, along)[:, None] * along
        offset = np.linalg.norm(middle, axis=1)
        # Any direction across will do where the line passes through the centre.
        spare = np.eye(3)[np.abs(along).argmin(axis=1)]
        spare = spare - dot(spare, along)[:, None] * along
        first = unit(np.where(offset[:, None] > 1e-9, middle, spare))
        second = np.cross(along, first)
        angles = 2.0 * np.pi * np.arange(PLANE_STRING.planes)[:, None] / PLANE_STRING.planes
        outward = np.cos(angles) * first[:, None] + np.sin(angles) * second[:, None]
        height = offset[:, None] * np.cos(angles[:, 0])
        radius = np.sqrt(np.maximum(1.0 - (offset[:, None] * np.sin(angles[:, 0])) ** 2, 1e-12))
        ends = []
        for point, sign in ((p, 1.0), (q, -1.0)):
            ahead = dot(point - middle, along)[:, None]
            reach = np.maximum(np.hypot(ahead, height), radius)
            ends.append(np.arctan2(ahead, height) + sign * np.arccos(radius / reach))
        centre = middle[:, None] - height[..., None] * outward
        return cls(along[:, None], outward, centre, radius, np.stack(ends))

    def chosen(self, rows: NDArray[np.int64], planes: NDArray[np.int64]) -> "_Planes":
        """Return some planes of each line."""
        return _Planes(
            self.along,
            self.outward[rows, planes],
            self.centre[rows, planes],
            self.radius[rows, planes],
            self.ends[:, rows, planes],
        )

    def points(self, places: Array) -> Array:
        """Return points (f, k, n, 3) at places (n,) in -1…1 of the arcs."""
        angle, radius = self._angles(places), self.radius[..., None]
        cosine, sine = radius * np.cos(angle), radius * np.sin(angle)
        outward, along = self.outward[:, :, None], self.along[:, :, None]
        return cosine[..., None] * outward + sine[..., None] * along + self.centre[:, :, None]

    def speeds(self, places: Array, axes: Array) -> Array:
        """Return the speed (f, k, n), m per unit of place, of a point along the arcs.

        Args:
            places: in -1…1 of the arcs.
            axes: (3,) m, of the ellipsoid.
        """
        angle, along, outward = self._angles(places), self.along * axes, self.outward * axes
        cosine, sine = np.cos(angle), np.sin(angle)
        squared = cosine**2 * dot(along, along)[..., None]
        squared += sine**2 * dot(outward, outward)[..., None]
        squared -= 2.0 * cosine * sine * dot(along, outward)[..., None]
        size = 0.5 * (self.ends[1] - self.ends[0]) * self.radius
        return size[..., None] * np.sqrt(np.maximum(squared, 0.0))

    def _angles(self, places: Array) -> Array:
        """Return the angles (f, k, n), rad, of places (n,)."""
        middle, half = 0.5 * (self.ends[0] + self.ends[1]), 0.5 * (self.ends[1] - self.ends[0])
        return middle[..., None] + half[..., None] * places


def dot(a: Array, b: Array) -> Array:
    """Return the products of vectors (..., 3) one by one."""
    return np.asarray((a * b).sum(axis=-1))


def unit(vectors: Array) -> Array:
    """Return vectors (..., 3) made unit vectors."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
