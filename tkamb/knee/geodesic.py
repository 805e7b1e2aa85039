"""The taut string over an ellipsoid: a straight part, a geodesic, and a second straight part.

The ellipsoid is Σ x²/a² = 1 with the gradient g = x/a². A geodesic x(s) of unit speed v obeys

    x'' = -(v·(v/a²) / g·g) g.

A neighbouring geodesic at the distance j obeys j'' = -K j (the Jacobi field), with the Gaussian
curvature K = 1/(a₁a₂a₃ g·g)². A string from P to Q first touches the ellipsoid on the contour of P,
whose tangent planes pass through P. The unknowns are the angle φ along the contour and the length s
of the geodesic; the tangent at its end must pass through Q. Newton's method solves these two
equations, with derivatives from j.

An affine map to the unit sphere keeps straight lines and tangency. There contours and plane
sections are circles, and a taut string in a plane has a closed form. The initial guess is the one
in any plane through P and Q that is shortest on the ellipsoid.

Reference: Scholz et al., Multibody Syst Dyn 36:195 (2016), doi:10.1007/s11044-015-9451-1, for
Newton's method with Jacobi fields.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import DOP853

from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array

# Number of Runge-Kutta steps along a geodesic. Few steps suffice: the method
# (DOP853) has order eight.
RUNGE_KUTTA_STEPS = 6
# A second string in a plane is also tried if its excess over the shortest is less than this share
# of its own arc. It may lead to the shortest geodesic.
RIVAL_SHARE = 0.1
# Number of half planes through both points that are tried. One every 15 deg.
PLANES = 24


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_FINE = (
    ((2.0 * np.arange(RUNGE_KUTTA_STEPS) + 1.0)[:, None] + _NODES) / RUNGE_KUTTA_STEPS - 1.0
).ravel()
_FINE_WEIGHTS = _WEIGHTS / RUNGE_KUTTA_STEPS
_NODES, _COARSE_WEIGHTS = np.polynomial.legendre.leggauss(6)
_COARSE, _ENDS = _NODES, np.array([-1.0, 1.0])
"""Parameters -1 to 1 on an arc: Gauss points of the whole arc, and the ends; `_FINE`: Gauss points
of each Runge-Kutta step.
"""


def planar_starts(
    p: Array, q: Array, axes: Array, half: Array | None
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return, for each p and q, the shortest string in a plane and the next local minimum.

    p and q (f, 3) are ends of strings, with the ellipsoid scaled to the unit sphere; `half` as in
    `shortest_strings`.

    Returns:
        Points where the two strings meet the sphere, (f, 2, 3). Their lengths on the
        ellipsoid in s steps of equal angle, m, (f, 2, s). Mask of the second strings that may
        lead to a shorter geodesic, (f,).
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
    rival = others[rows, other] - lengths[rows, best] < RIVAL_SHARE * arcs[rows, other]
    chosen = np.column_stack([best, other])
    speeds = planes.chosen(rows[:, None], chosen).speeds(_FINE, axes)
    pieces = speeds.reshape(len(p), 2, RUNGE_KUTTA_STEPS, -1) @ _FINE_WEIGHTS
    return points[rows[:, None], chosen, 0], pieces, rival


@dataclass(frozen=True, eq=False)
class _Planes:
    """k half planes through each line from p to q, and the circles that they cut from the sphere.

    Args:
        along: direction of the line, (f, 1, 3).
        outward: direction in the half plane, normal to the line, (f, k, 3).
        centre: centre of the circle, (f, k, 3).
        ends: angles from `outward` towards `along` at which the taut string meets and leaves the
            circle, rad, (2, f, k).
    """

    along: Array
    outward: Array
    centre: Array
    radius: Array
    ends: Array

    @classmethod
    def through(cls, p: Array, q: Array) -> "_Planes":
        along = unit(q - p)
        middle = p - dot(p, along)[:, None] * along
        offset = np.linalg.norm(middle, axis=1)
        # A line through the centre has no preferred normal direction.
        spare = np.eye(3)[np.abs(along).argmin(axis=1)]
        spare = spare - dot(spare, along)[:, None] * along
        first = unit(np.where(offset[:, None] > 1e-9, middle, spare))
        second = np.cross(along, first)
        angles = 2.0 * np.pi * np.arange(PLANES)[:, None] / PLANES
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
        return _Planes(
            self.along,
            self.outward[rows, planes],
            self.centre[rows, planes],
            self.radius[rows, planes],
            self.ends[:, rows, planes],
        )

    def points(self, places: Array) -> Array:
        """Return points (f, k, n, 3) of the arcs at parameters `places` (n,) from -1 to 1."""
        angle, radius = self._angles(places), self.radius[..., None]
        cosine, sine = radius * np.cos(angle), radius * np.sin(angle)
        outward, along = self.outward[:, :, None], self.along[:, :, None]
        return cosine[..., None] * outward + sine[..., None] * along + self.centre[:, :, None]

    def speeds(self, places: Array, axes: Array) -> Array:
        """Return the lengths (f, k, n), m, of the arcs' tangents by parameter, on the ellipsoid."""
        angle, along, outward = self._angles(places), self.along * axes, self.outward * axes
        cosine, sine = np.cos(angle), np.sin(angle)
        squared = cosine**2 * dot(along, along)[..., None]
        squared += sine**2 * dot(outward, outward)[..., None]
        squared -= 2.0 * cosine * sine * dot(along, outward)[..., None]
        size = 0.5 * (self.ends[1] - self.ends[0]) * self.radius
        return size[..., None] * np.sqrt(np.maximum(squared, 0.0))

    def _angles(self, places: Array) -> Array:
        middle, half = 0.5 * (self.ends[0] + self.ends[1]), 0.5 * (self.ends[1] - self.ends[0])
        return middle[..., None] + half[..., None] * places


def dot(a: Array, b: Array) -> Array:
    """Return the dot products (...) of vectors (..., 3)."""
    return np.asarray((a * b).sum(axis=-1))


def unit(vectors: Array) -> Array:
    """Return vectors (..., 3) scaled to unit length."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


# Largest number of Newton steps. Not studied.
MAX_ITERATIONS = 30
# rad: the iteration has converged if the error of the string's direction at its end is smaller.
# Not studied.
TOLERANCE = 1e-11
# rad: a geodesic that ends beyond its touching point is shortened if its direction error is
# smaller than this. The derivative may have the wrong sign at larger errors.
OVERSHOOT_BELOW = 0.05


@dataclass(frozen=True, eq=False)
class Strings:
    """Strings over an ellipsoid, in its frame.

    Args:
        entry: points where the strings meet the ellipsoid, m, (f, 3); they leave it at
            `exit`.
        arc_m: lengths on the ellipsoid, m, (f,).
        length_m: whole lengths, m, (f,).
        converged: mask of the taut strings, for which the iteration has converged, (f,).
    """

    entry: Array
    exit: Array
    arc_m: Array
    length_m: Array
    converged: NDArray[np.bool_]


def shortest_strings(start: Array, end: Array, axes: Array, half: Array | None = None) -> Strings:
    """Return the shortest strings around an ellipsoid.

    Args:
        start: points outside the ellipsoid, m, (f, 3), like `end`; the segment between them
            passes through the ellipsoid.
        axes: semi-axes, m, (3,).
        half: direction of the half on which the string must touch, (3,); None: either half.

    Returns:
        The strings. If there is no taut string on the half, `converged` is False.
    """
    count = len(start)
    contour, pieces, rival = planar_starts(start / axes, end / axes, axes, half)
    rows = np.concatenate([np.arange(count), np.flatnonzero(rival)])
    second = np.append(np.zeros(count, int), np.ones(len(rows) - count, int))
    result = _taut(start[rows], end[rows], axes, contour[rows, second], pieces[rows, second])
    converged = result.converged
    if half is not None:
        converged = converged & ((result.entry + result.exit) @ half > 0.0)
    lengths = np.full((count, 2), np.inf)
    lengths[rows, second] = np.where(converged, result.length_m, np.inf)
    place = np.column_stack([np.arange(count), count + np.cumsum(rival) - 1])
    chosen = np.where(lengths[:, 1] < lengths[:, 0], place[:, 1], place[:, 0])
    return Strings(
        result.entry[chosen],
        result.exit[chosen],
        result.arc_m[chosen],
        result.length_m[chosen],
        converged[chosen],
    )


def _taut(start: Array, end: Array, axes: Array, contour: Array, pieces: Array) -> Strings:
    """Return the strings that Newton's method finds.

    Starts and ends are (f, 3), m. `contour` (f, 3) are initial points on the contour, with the
    ellipsoid scaled to the unit sphere, `pieces` (f, s), m, initial lengths of steps along the
    geodesic.
    """
    p = start / axes
    squared = (p**2).sum(axis=1, keepdims=True)
    hub = p / squared
    radial = contour - hub
    radial -= (radial * p).sum(axis=1, keepdims=True) * hub
    size = np.sqrt(np.maximum(1.0 - 1.0 / squared, 0.0))
    radial *= size / np.maximum(np.linalg.norm(radial, axis=1, keepdims=True), 1e-300)
    sideways = np.cross(p / np.sqrt(squared), radial)
    shares = pieces / pieces.sum(axis=1, keepdims=True)
    angle, arc = np.zeros(len(p)), pieces.sum(axis=1)
    converged = np.zeros(len(p), bool)
    limit = 0.3 * axes.max()
    entry, leave = np.empty_like(start), np.empty_like(start)
    active = np.arange(len(p))
    for _ in range(MAX_ITERATIONS):
        angles = angle[active]
        shot = _Shot(
            start[active], end[active], axes, hub[active], radial[active], sideways[active]
        )
        residual, jacobian, entry[active], leave[active], ahead = shot.fire(
            angles, arc[active, None] * shares[active]
        )
        small = np.abs(residual).max(axis=1)
        is_converged = (small < TOLERANCE) & (ahead > 0.0)
        converged[active[is_converged]] = True
        if is_converged.all():
            break
        step = -np.linalg.solve(jacobian[~is_converged], residual[~is_converged][..., None])[..., 0]
        # `ahead` is negative if the geodesic ends beyond the touching point. The overshoot is then
        # about as long as the straight part that leads back.
        past = ((small < OVERSHOOT_BELOW) & (ahead <= 0.0))[~is_converged]
        step[past] = np.column_stack([np.zeros(past.sum()), 2.0 * ahead[~is_converged][past]])
        active = active[~is_converged]
        # Long steps are shortened, because derivatives far from the solution are unreliable.
        share = np.minimum(1.0, 0.4 / np.maximum(np.abs(step[:, 0]), 1e-300))
        share = np.minimum(share, limit / np.maximum(np.abs(step[:, 1]), 1e-300))
        angle[active] += share * step[:, 0]
        arc[active] = np.maximum(arc[active] + share * step[:, 1], -limit)
    converged &= arc > -TOLERANCE
    straight = np.linalg.norm(entry - start, axis=1) + np.linalg.norm(end - leave, axis=1)
    return Strings(entry, leave, arc, straight + arc, converged)


@dataclass(frozen=True, eq=False)
class _Shot:
    """Geodesics from the contour of `start`, to measure their direction errors at `end`."""

    start: Array
    end: Array
    axes: Array
    hub: Array
    radial: Array
    sideways: Array

    def fire(self, angle: Array, pieces: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return the errors of geodesics and their derivatives.

        `angle` (f,), rad, is along the contour, `pieces` (f, s), m, are steps along the geodesic.

        Returns:
            Residuals (f, 2); their derivatives (f, 2, 2) by angle and length; entry and exit
            points (f, 3), m; distances (f,) of `end` ahead of the exit, m. A negative distance
            means that the straight part would lead backwards.
        """
        cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
        entry = self.axes * (self.hub + cosine * self.radial + sine * self.sideways)
        tangent = self.axes * (cosine * self.sideways - sine * self.radial)
        distance = np.linalg.norm(entry - self.start, axis=1, keepdims=True)
        ahead = (entry - self.start) / distance
        across = (np.cross(_normal(entry, self.axes)[0], ahead) * tangent).sum(axis=1)
        state = np.column_stack([entry, ahead, across, across / distance[:, 0]])
        _follow_geodesics(state, pieces, self.axes, DOP853.A, DOP853.B)
        leave, direction = state[:, :3], state[:, 3:6]
        field, rate = state[:, 6], state[:, 7]
        normal, slope = _normal(leave, self.axes)
        binormal = np.cross(normal, direction)
        outgoing = self.end - leave
        reach = np.linalg.norm(outgoing, axis=1, keepdims=True)
        outgoing = outgoing / reach
        shift = (tangent * ahead).sum(axis=1)[:, None] * direction + field[:, None] * binormal
        by_arc, by_angle = (self._turn(v, normal, slope) for v in (direction, shift))
        residual = np.stack([dot(outgoing, normal), dot(outgoing, binormal)], axis=1)
        jacobian = np.empty((len(angle), 2, 2))
        jacobian[:, 0, 0] = dot(outgoing, by_angle)
        jacobian[:, 0, 1] = dot(outgoing, by_arc)
        jacobian[:, 1, 0] = (
            dot(outgoing, np.cross(by_angle, direction))
            - field / reach[:, 0]
            - rate * dot(outgoing, direction)
        )
        jacobian[:, 1, 1] = dot(outgoing, np.cross(by_arc, direction))
        return residual, jacobian, entry, leave, reach[:, 0] * dot(outgoing, direction)

    def _turn(self, velocity: Array, normal: Array, slope: Array) -> Array:
        gradient_rate = velocity / self.axes**2
        return (gradient_rate - dot(gradient_rate, normal)[:, None] * normal) / slope[:, None]


def _normal(points: Array, axes: Array) -> tuple[Array, Array]:
    """Return outward unit normals (f, 3), and the lengths (f,) of the gradients x/a²."""
    gradient = points / axes**2
    slope = np.linalg.norm(gradient, axis=1)
    return gradient / slope[:, None], slope


@compiled
def _follow_geodesics(
    states: Array, pieces: Array, axes: Array, weights: Array, last_weights: Array
) -> None:
    """Integrate geodesics and their Jacobi fields, in place, by an explicit Runge-Kutta method.

    Args:
        states: (x, v, j, j') at the starts, replaced by the values at the ends, (f, 8).
        pieces: lengths of the steps, m, (f, s).
        weights: weights of the earlier stages in each of the k stages, (k, k).
        last_weights: weights of the stages in a step, (k,).
    """
    count = len(last_weights)
    stages, point, gradient = np.empty((count, 8)), np.empty(8), np.empty(3)
    inverse_squares = 1.0 / axes**2
    curvature = inverse_squares[0] * inverse_squares[1] * inverse_squares[2]
    for n in range(len(states)):
        state = states[n]
        for step in pieces[n]:
            for k in range(count):
                for i in range(8):
                    point[i] = state[i]
                for before in range(k):
                    share = step * weights[k, before]
                    for i in range(8):
                        point[i] += share * stages[before, i]
                squared = bend = 0.0
                for i in range(3):
                    gradient[i] = point[i] * inverse_squares[i]
                    squared += gradient[i] * gradient[i]
                    bend += point[3 + i] * point[3 + i] * inverse_squares[i]
                for i in range(3):
                    stages[k, i] = point[3 + i]
                    stages[k, 3 + i] = -bend / squared * gradient[i]
                stages[k, 6] = point[7]
                stages[k, 7] = -curvature / (squared * squared) * point[6]
            for k in range(count):
                for i in range(8):
                    state[i] += step * last_weights[k] * stages[k, i]
