"""A taut string past one wrap object: cylinder, sphere, ellipsoid or torus.

Everything is in the object's frame and for many strings at once. The string touches where the
straight line would pass through the object, or on the wrong side of it where a half is
prescribed. A string with an end inside the object passes it as if it were not there, as in
OpenSim. Lengths are those of the shortest string, so that dL/dq follows from the directions
at its ends alone.

Around a circle of radius r, from the distance d₁ to d₂, swept angle Δ about the centre:

    θ = Δ - acos(r/d₁) - acos(r/d₂),   S = √(d₁² - r²) + r θ + √(d₂² - r²),   touching if θ > 0.

On a cylinder the whole unrolls: L = √(S² + Δz²), z linear in S.

A path point of another body that moves into an ellipsoid would lose it at once: lengths then
jump, in OpenSim by up to 14 mm. Here the ellipsoid shrinks with the point, so that the length is
continuous: with the size k = |P/a|, and L homogeneous of degree one in P, Q and k,

    ∂L/∂k = (L + P·u_P - Q·u_Q) / k,

u the string's directions at P and Q; the point is pushed out by -∂L/∂k ∂k/∂P.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.io.opensim.geodesic import shortest_strings
from tkamb.io.opensim.lines import WrapObject
from tkamb.io.opensim.plane_strings import dot, unit


@dataclass(frozen=True)
class WrapSettings:
    """How a string is laid around a single wrap object."""

    ring_places: int = 48
    """Places around a torus's ring that are tried for where the string presses against it. Chosen:
    one every 7.5 deg."""
    ellipsoid_clearance: float = 1e-3
    """Share of its size by which an ellipsoid keeps clear of a point that moves into it. Chosen:
    above rounding, and without effect on a muscle's length."""


WRAP = WrapSettings()


Mask = NDArray[np.bool_]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Touch:
    """Where strings (f) touch an object.

    Args:
        touches: (f,) whether they do; the rest holds for these alone.
        entry: (f, 3) m, where they meet it, in its frame.
        exit: (f, 3) m, where they leave it.
        arc_m: (f,) length on it.
        push: (f, 2, 3) force of a shrinking object on start and end, per unit tension.
    """

    touches: Mask
    entry: Array
    exit: Array
    arc_m: Array
    push: Array


def touch(wrap: WrapObject, start: Array, end: Array, moves: Mask) -> Touch:
    """Return where strings touch a wrap object, in its frame.

    Args:
        wrap: the object.
        start: (f, 3) m.
        end: (f, 3) m.
        moves: (f, 2) whether start and end are path points of another body than the object's.
    """
    if wrap.shape == "cylinder":
        return _cylinder(start, end, wrap.dimensions[0], wrap.dimensions[1], wrap.quadrant)
    if wrap.shape == "sphere":
        return _sphere(start, end, wrap.dimensions[0], wrap.quadrant)
    if wrap.shape == "torus":
        return _torus(start, end, *wrap.dimensions)
    return _ellipsoid(start, end, np.array(wrap.dimensions), wrap.quadrant, moves)


def _no_push(start: Array) -> Array:
    return np.zeros((len(start), 2, 3))


def _polar(points: Array) -> tuple[Array, Array]:
    """Return distance and angle (f,) of points (f, 2) of a plane."""
    return np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])


def _wrapped(angles: Array) -> Array:
    """Return angles within ±pi."""
    return np.asarray(angles - 2.0 * np.pi * np.round(angles / (2.0 * np.pi)))


def _around(
    distances: tuple[Array, Array], sweep: Array, radius: float
) -> tuple[Array, Array, tuple[Array, Array]]:
    """Return a taut string around a circle.

    Args:
        distances: (f,) m, of start and end from the centre.
        sweep: (f,) rad, signed, from start to end about the centre, on the side it passes.
        radius: m.

    Returns:
        Signed turn (f,) on the circle, 0 where it does not touch; angle (f,) from the start to
        where it meets the circle; lengths (f,) of the straight parts.
    """
    first, second = (np.sqrt(np.maximum(d**2 - radius**2, 0.0)) for d in distances)
    away = np.arctan2(first, radius), np.arctan2(second, radius)
    turn = np.sign(sweep) * np.maximum(np.abs(sweep) - away[0] - away[1], 0.0)
    outside = (distances[0] >= radius) & (distances[1] >= radius)
    return np.where(outside, turn, 0.0), np.sign(sweep) * away[0], (first, second)


def _cylinder(
    start: Array, end: Array, radius: float, length: float, quadrant: tuple[int, int] | None
) -> Touch:
    """Return strings around a cylinder along z; none where they touch beyond both its ends."""
    (near, angle), (far, last) = _polar(start), _polar(end)
    if quadrant is None or quadrant[0] == 2:
        sweep = _wrapped(last - angle)
    else:
        # Counted from the half's middle: a string never crosses the middle of the other half.
        axis, sign = quadrant
        middle = 0.5 * np.pi * axis + (np.pi if sign < 0 else 0.0)
        sweep = _wrapped(last - middle) - _wrapped(angle - middle)
    turn, ahead, straight = _around((near, far), sweep, radius)
    on_circle = radius * np.abs(turn)
    rise = (end[:, 2] - start[:, 2]) / np.maximum(sum(straight) + on_circle, 1e-300)
    heights = start[:, 2] + rise * straight[0], end[:, 2] - rise * straight[1]
    entry, leave = (
        np.column_stack([radius * np.cos(a), radius * np.sin(a), z])
        for a, z in zip((angle + ahead, angle + ahead + turn), heights, strict=True)
    )
    off = np.minimum(np.abs(heights[0]), np.abs(heights[1])) > length / 2.0
    arc = on_circle * np.hypot(1.0, rise)
    return Touch((turn != 0.0) & ~off, entry, leave, arc, _no_push(start))


def _sphere(start: Array, end: Array, radius: float, quadrant: tuple[int, int] | None) -> Touch:
    """Return strings around a sphere: in the plane of both ends and its centre.

    A string that must pass on one half goes the long way round if that is where it leads,
    unless both its ends lie on that half.
    """
    near, far = np.linalg.norm(start, axis=1), np.linalg.norm(end, axis=1)
    along, towards = start / near[:, None], end / far[:, None]
    across = towards - dot(towards, along)[:, None] * along
    size = np.linalg.norm(across, axis=1)
    across /= np.maximum(size, 1e-300)[:, None]
    sweep = np.arctan2(size, dot(towards, along))
    turn, ahead, _ = _around((near, far), sweep, radius)
    touches = turn != 0.0
    if quadrant is not None:
        axis, sign = quadrant
        wrong = (along + towards)[:, axis] * sign < 0.0
        wrong &= np.minimum(start[:, axis] * sign, end[:, axis] * sign) < 0.0
        sweep = np.where(wrong, sweep - 2.0 * np.pi, sweep)
        turn, ahead, _ = _around((near, far), sweep, radius)
    entry, leave = (
        radius * (np.cos(a)[:, None] * along + np.sin(a)[:, None] * across)
        for a in (ahead, ahead + turn)
    )
    return Touch(touches, entry, leave, radius * np.abs(turn), _no_push(start))


def _torus(start: Array, end: Array, ring: float, tube: float) -> Touch:
    """Return strings through a torus about z, pressed against the inside of its ring.

    The ring is taken as a cylinder along its tangent at the place that it is pressed most:
    where the string is longest, so that its place does not enter dL/dq.
    """
    rows = np.arange(len(start))

    def at(places: Array) -> tuple[Touch, Array, Array]:
        """Return touches, lengths and frames with the ring taken straight at angles (f,)."""
        inward = -np.column_stack([np.cos(places), np.sin(places), np.zeros_like(places)])
        up = np.broadcast_to([0.0, 0.0, 1.0], inward.shape)
        frame = np.stack([inward, up, np.cross(inward, up)], axis=1)
        centre = -ring * inward
        first, second = (np.einsum("fij,fj->fi", frame, p - centre) for p in (start, end))
        result = _cylinder(first, second, tube, np.inf, (0, 1))
        wrapped = np.linalg.norm(result.entry - first, axis=1) + result.arc_m
        wrapped += np.linalg.norm(second - result.exit, axis=1)
        return result, np.where(result.touches, wrapped, -np.inf), frame

    tried = 2.0 * np.pi * np.arange(WRAP.ring_places) / WRAP.ring_places
    lengths = np.stack([at(np.full(len(start), place))[1] for place in tried])
    low = tried[lengths.argmax(axis=0)] - tried[1]
    high = low + 2.0 * tried[1]
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    for _ in range(40):
        left, right = high - golden * (high - low), low + golden * (high - low)
        shorter = at(left)[1] < at(right)[1]
        low, high = np.where(shorter, left, low), np.where(shorter, high, right)
    result, lengths, frame = at(0.5 * (low + high))
    centre = -ring * frame[rows, 0]
    entry, leave = (np.einsum("fji,fj->fi", frame, p) + centre for p in (result.entry, result.exit))
    touches = result.touches & np.isfinite(lengths)
    return Touch(touches, entry, leave, result.arc_m, _no_push(start))


def _ellipsoid(
    start: Array, end: Array, axes: Array, quadrant: tuple[int, int] | None, moves: Mask
) -> Touch:
    """Return strings around an ellipsoid: geodesics where the straight line would cut it."""
    p, q = start / axes, end / axes
    depth = np.stack([np.linalg.norm(p, axis=1), np.linalg.norm(q, axis=1)], axis=1)
    size = np.where(moves, depth / (1.0 + WRAP.ellipsoid_clearance), 1.0).min(axis=1)
    size = np.minimum(size, 1.0)
    step = q - p
    share = np.clip(-dot(p, step) / np.maximum(dot(step, step), 1e-300), 0.0, 1.0)
    nearest = np.linalg.norm(p + share[:, None] * step, axis=1)
    touches = (depth.min(axis=1) > size) & (nearest < size)
    entry, leave, arc = np.zeros_like(start), np.zeros_like(end), np.zeros(len(start))
    push = _no_push(start)
    if touches.any():
        k, a, second = size[touches, None], start[touches], end[touches]
        half = None if quadrant is None else quadrant[1] * np.eye(3)[quadrant[0]]
        strings = shortest_strings(a / k, second / k, axes, half)
        entry[touches], leave[touches] = k * strings.entry, k * strings.exit
        arc[touches] = np.where(strings.converged, k[:, 0] * strings.arc_m, np.nan)
        first, last = (unit(v) for v in (strings.entry - a / k, second / k - strings.exit))
        growth = strings.length_m + (dot(a, first) - dot(second, last)) / k[:, 0]
        yields = moves & (depth <= size[:, None] * (1.0 + WRAP.ellipsoid_clearance) * (1.0 + 1e-12))
        yields &= (size < 1.0)[:, None]
        by_point = (
            np.stack([p, q], axis=1) / (depth * (1.0 + WRAP.ellipsoid_clearance))[..., None] / axes
        )
        push[touches] = -(growth[:, None] * yields[touches])[..., None] * by_point[touches]
    return Touch(touches, entry, leave, arc, push)
