"""Taut strings over wrap objects, and their forces on points and bodies by virtual work.

Strings around one object are computed in its frame, many at once. A string touches it if the
straight line would pass through it or, with a prescribed half of a cylinder, on the wrong side. A
string with an end inside the object ignores it, as in OpenSim (ellipsoids: see below). Each string
is the shortest, so that dL/dq follows from its directions at the ends alone.

Let r be the radius of a circle, d₁ and d₂ the distances of the string's ends from its centre, and Δ
the angle between the ends. The arc θ and the length S are

    θ = Δ - acos(r/d₁) - acos(r/d₂),   S = √(d₁² - r²) + r θ + √(d₂² - r²),   touching if θ > 0.

A cylinder is unrolled: L = √(S² + Δz²), with z linear in S.

A path point P of another body may move into an ellipsoid. OpenSim then ignores it
(docs/opensim.md); here the ellipsoid shrinks with the point by the factor k = |P/a|, so that the
length is continuous. L is homogeneous of degree one in P, Q and k, so that

    ∂L/∂k = (L + P·u_P - Q·u_Q) / k,

where u_P and u_Q are the string's directions at P and Q. The force on the point is -∂L/∂k ∂k/∂P.

For several objects, the touching points are updated in turn until none moves: every straight part
is then tangent to the objects at its ends.

A string of unit tension exerts balanced forces on each path point, and on each wrap object where it
meets and leaves it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, Index, Mask, inverse
from tkamb.knee.geodesic import dot, shortest_strings, unit
from tkamb.knee.wrap_object import WrapObject
from tkamb.knee.wrapping import is_inside, taut_path

# Number of angles on a torus's ring at which the string is tried. One every 7.5 deg.
RING_PLACES = 48
# Gap between a shrunken ellipsoid and the point inside the original one, as a share of the
# ellipsoid's size. Not studied.
ELLIPSOID_CLEARANCE = 1e-3


@dataclass(frozen=True, eq=False)
class WrapTouch:
    """Touching points of f strings on a wrap object, in its frame.

    Args:
        touches: mask of the strings that touch, (f,). Other values hold only for these.
        entry: points where the strings meet the object, m, (f, 3); they leave it at `exit`.
        arc_m: lengths on the object, m, (f,).
        push: force of a shrinking object on start and end, per unit tension, (f, 2, 3).
    """

    touches: Mask
    entry: Array
    exit: Array
    arc_m: Array
    push: Array


def touch(wrap: WrapObject, start: Array, end: Array, moves: Mask) -> WrapTouch:
    """Return the touching points of strings on a wrap object.

    `start` and `end` (f, 3), m, are in the object's frame; `moves` (f, 2) marks path points of
    another body than the object's.
    """
    if wrap.shape == "cylinder":
        return _cylinder(start, end, wrap.dimensions[0], wrap.dimensions[1], wrap.quadrant)
    if wrap.shape == "sphere":
        return _sphere(start, end, wrap.dimensions[0], wrap.quadrant)
    if wrap.shape == "torus":
        return _torus(start, end, *wrap.dimensions)
    if wrap.shape == "section":
        assert wrap.outline is not None
        return _section(start, end, wrap.outline)
    return _ellipsoid(start, end, np.array(wrap.dimensions), wrap.quadrant, moves)


def _no_push(start: Array) -> Array:
    return np.zeros((len(start), 2, 3))


def _polar(points: Array) -> tuple[Array, Array]:
    """Return distances (f,), m, from the z axis and polar angles (f,), rad, of points (f, 3), m."""
    return np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])


def _wrapped(angles: Array) -> Array:
    return np.asarray(angles - 2.0 * np.pi * np.round(angles / (2.0 * np.pi)))


def _around(
    distances: tuple[Array, Array], sweep: Array, radius: float
) -> tuple[Array, Array, tuple[Array, Array]]:
    """Return a taut string around a circle.

    `distances` (f,), m, of start and end are from the centre; `sweep` (f,), rad, is the signed
    angle about it from start to end, on the string's side.

    Returns:
        Signed angle of the arc (f,), rad, zero if the string does not touch; angle (f,) from the
        start to the touching point, rad; lengths of the two straight parts (f,), m.
    """
    first, second = (np.sqrt(np.maximum(d**2 - radius**2, 0.0)) for d in distances)
    tangent_angles = np.arctan2(first, radius), np.arctan2(second, radius)
    turn = np.sign(sweep) * np.maximum(np.abs(sweep) - tangent_angles[0] - tangent_angles[1], 0.0)
    outside = (distances[0] >= radius) & (distances[1] >= radius)
    return np.where(outside, turn, 0.0), np.sign(sweep) * tangent_angles[0], (first, second)


def _cylinder(
    start: Array, end: Array, radius: float, length: float, quadrant: tuple[int, int] | None
) -> WrapTouch:
    """A string does not touch if both touching points lie beyond the ends of the cylinder."""
    (near, angle), (far, last) = _polar(start), _polar(end)
    if quadrant is None or quadrant[0] == 2:
        sweep = _wrapped(last - angle)
    else:
        # Angles are relative to the middle of the prescribed half. A string thus never crosses the
        # middle of the other half.
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
    is_beyond = np.minimum(np.abs(heights[0]), np.abs(heights[1])) > length / 2.0
    arc = on_circle * np.hypot(1.0, rise)
    return WrapTouch((turn != 0.0) & ~is_beyond, entry, leave, arc, _no_push(start))


def _sphere(start: Array, end: Array, radius: float, quadrant: tuple[int, int] | None) -> WrapTouch:
    """Return strings in the plane of their ends and the centre.

    If the short way passes on the half that is not prescribed, a string takes the long way, unless
    both of its ends lie on the prescribed half.
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
    return WrapTouch(touches, entry, leave, radius * np.abs(turn), _no_push(start))


def _section(start: Array, end: Array, outline: Array) -> WrapTouch:
    """Return strings in front of a convex outline (n, 2), m, that is extruded along z.

    A string with an end inside the outline does not touch.
    """
    entry, leave, arc = start.copy(), end.copy(), np.zeros(len(start))
    touches = np.zeros(len(start), bool)
    for k in range(len(start)):
        if is_inside(start[k], outline) or is_inside(end[k], outline):
            continue
        path = taut_path(start[k], end[k], outline)
        if path.wrapped:
            touches[k], entry[k], leave[k] = True, path.points[1], path.points[-2]
            arc[k] = np.linalg.norm(np.diff(path.points[1:-1], axis=0), axis=1).sum()
    return WrapTouch(touches, entry, leave, arc, _no_push(start))


def inside(wrap: WrapObject, points: Array) -> Mask:
    """Return whether points (f, 3), m, in the object's frame lie where strings ignore the object.

    No string ignores an ellipsoid, because it shrinks, or a torus.
    """
    if wrap.shape == "cylinder":
        radius, length = wrap.dimensions
        within = np.hypot(points[:, 0], points[:, 1]) < radius
        return np.asarray(within & (np.abs(points[:, 2]) <= 0.5 * length))
    if wrap.shape == "sphere":
        return np.asarray(np.linalg.norm(points, axis=1) < wrap.dimensions[0])
    if wrap.shape == "section":
        assert wrap.outline is not None
        return np.array([is_inside(point, wrap.outline) for point in points], bool)
    return np.zeros(len(points), bool)


def _torus(start: Array, end: Array, ring: float, tube: float) -> WrapTouch:
    """Return strings through a torus about z, in contact with the inside of its ring.

    A cylinder along the ring's tangent replaces it, at the angle at which the string is longest:
    there dL/dq does not depend on the angle's change.
    """
    rows = np.arange(len(start))

    def at(places: Array) -> tuple[WrapTouch, Array, Array]:
        """Return touching points, lengths (f,), m, and frames of cylinders at angles (f,), rad."""
        inward = -np.column_stack([np.cos(places), np.sin(places), np.zeros_like(places)])
        up = np.broadcast_to([0.0, 0.0, 1.0], inward.shape)
        frame = np.stack([inward, up, np.cross(inward, up)], axis=1)
        centre = -ring * inward
        first, second = (np.einsum("fij,fj->fi", frame, p - centre) for p in (start, end))
        result = _cylinder(first, second, tube, np.inf, (0, 1))
        wrapped = np.linalg.norm(result.entry - first, axis=1) + result.arc_m
        wrapped += np.linalg.norm(second - result.exit, axis=1)
        return result, np.where(result.touches, wrapped, -np.inf), frame

    tried = 2.0 * np.pi * np.arange(RING_PLACES) / RING_PLACES
    lengths = np.stack([at(np.full(len(start), place))[1] for place in tried])
    low = tried[lengths.argmax(axis=0)] - tried[1]
    high = low + 2.0 * tried[1]
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    for _ in range(40):
        inner_low, inner_high = high - golden * (high - low), low + golden * (high - low)
        shorter = at(inner_low)[1] < at(inner_high)[1]
        low, high = np.where(shorter, inner_low, low), np.where(shorter, high, inner_high)
    result, lengths, frame = at(0.5 * (low + high))
    centre = -ring * frame[rows, 0]
    entry, leave = (np.einsum("fji,fj->fi", frame, p) + centre for p in (result.entry, result.exit))
    touches = result.touches & np.isfinite(lengths)
    return WrapTouch(touches, entry, leave, result.arc_m, _no_push(start))


def _ellipsoid(
    start: Array, end: Array, axes: Array, quadrant: tuple[int, int] | None, moves: Mask
) -> WrapTouch:
    """A string touches if its straight line would cut the ellipsoid."""
    p, q = start / axes, end / axes
    depth = np.stack([np.linalg.norm(p, axis=1), np.linalg.norm(q, axis=1)], axis=1)
    size = np.where(moves, depth / (1.0 + ELLIPSOID_CLEARANCE), 1.0).min(axis=1)
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
        yields = moves & (depth <= size[:, None] * (1.0 + ELLIPSOID_CLEARANCE) * (1.0 + 1e-12))
        yields &= (size < 1.0)[:, None]
        by_point = (
            np.stack([p, q], axis=1) / (depth * (1.0 + ELLIPSOID_CLEARANCE))[..., None] / axes
        )
        push[touches] = -(growth[:, None] * yields[touches])[..., None] * by_point[touches]
    return WrapTouch(touches, entry, leave, arc, push)


# Largest number of sweeps over all objects. A string that needs more fails. Not studied.
MAX_SWEEPS = 100
# Largest extrapolation, as a multiple of the last step. Two sweeps do not support a
# larger one.
MAX_EXTRAPOLATION = 10.0
# m: a string has converged if a sweep changes no coordinate of a touching point by more.
# Not studied.
TOLERANCE = 1e-10


@dataclass(frozen=True, eq=False)
class WrappedStrings:
    """f strings over w objects.

    Args:
        order: indices of the objects that a string touches, from start to end, then -1, (f, w).
        entry: points where the strings meet the objects, m, (f, w, 3); they leave at `exit`.
        arc_m: lengths on the objects, m, (f, w); NaN if the iteration has not converged.
        push: force of a shrinking object on start and end, per unit tension, (f, w, 2, 3).
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
    """Return the taut strings between points, over the objects between them.

    Args:
        wraps: w objects, tried in this order.
        poses: of the objects in the frame of the points, (f, w, 4, 4).
        allowed: whether a string may touch an object, (f, w).
        moves: whether start and end belong to another body than object w, (f, w, 2).
    """
    strings = _Strings(wraps, poses, start, end, moves)
    if len(wraps) == 1:
        strings.insert(0, np.flatnonzero(allowed[:, 0]))
        return strings.result()
    active = np.arange(len(start))
    point, order = strings.places(), strings.order.copy()
    value = residual = np.full_like(point, np.nan)
    for _ in range(MAX_SWEEPS):
        strings.sweep(active, allowed)
        same = (strings.order == order).all(axis=1)
        order, (last_value, last_residual) = strings.order.copy(), (value, residual)
        value = strings.places()
        residual = np.where(same[:, None], value - point, np.nan)
        active = active[~(np.abs(residual[active]).max(axis=1) < TOLERANCE)]
        if not len(active):
            break
        point = value.copy()
        point[active] += _leap(value, last_value, residual, last_residual)[active]
        strings.place(point)
    strings.arc[active] = np.nan
    return strings.result()


def _leap(value: Array, last_value: Array, residual: Array, last_residual: Array) -> Array:
    """Return the extrapolation (f, 6w), m, from the last two sweeps (Aitken, Anderson).

    It is zero until two sweeps touch the same objects, or beyond `max_extrapolation`.
    """
    change = residual - last_residual
    squared = np.maximum((change**2).sum(axis=1), 1e-300)
    share = (residual * change).sum(axis=1) / squared
    sound = np.abs(share) < MAX_EXTRAPOLATION
    leap = -np.where(sound, share, 0.0)[:, None] * (value - last_value)
    return np.where(sound[:, None], leap, 0.0)


class _Strings:
    def __init__(
        self, wraps: Sequence[WrapObject], poses: Array, start: Array, end: Array, moves: Mask
    ) -> None:
        self.wraps, self.poses, self.back = wraps, poses, inverse(poses)
        self.start, self.end, self.moves = start, end, moves
        shape = poses.shape[:2]
        self.order = np.full(shape, -1)
        self.entry, self.exit = np.zeros((*shape, 3)), np.zeros((*shape, 3))
        self.arc, self.push = np.zeros(shape), np.zeros((*shape, 2, 3))

    def result(self) -> WrappedStrings:
        return WrappedStrings(self.order, self.entry, self.exit, self.arc, self.push)

    def places(self) -> Array:
        return np.concatenate([self.entry, self.exit], axis=2).reshape(len(self.start), -1)

    def place(self, places: Array) -> None:
        points = places.reshape(*self.order.shape, 6)
        self.entry, self.exit = points[..., :3].copy(), points[..., 3:].copy()

    def sweep(self, rows: Index, allowed: Mask) -> None:
        """Update the touching points on each allowed object (f, w) in turn."""
        for w in range(len(self.wraps)):
            self.remove(w, rows)
            self.insert(w, rows[allowed[rows, w]])

    def remove(self, w: int, rows: Index) -> None:
        order = np.where(self.order[rows] == w, -1, self.order[rows])
        closed = np.argsort(order < 0, axis=1, kind="stable")
        self.order[rows] = np.take_along_axis(order, closed, axis=1)

    def insert(self, w: int, free: Index) -> None:
        """Wrap some strings around object w, in the first straight part that meets it."""
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

    def _touch(self, w: int, gap: int, rows: Index, contact: WrapTouch) -> None:
        touches, poses = contact.touches, self.poses[rows, w]
        self.entry[rows, w] = _moved(poses, contact.entry[touches])
        self.exit[rows, w] = _moved(poses, contact.exit[touches])
        self.arc[rows, w] = contact.arc_m[touches]
        self.push[rows, w] = np.einsum("fij,fej->fei", poses[:, :3, :3], contact.push[touches])
        later = self.order[rows, gap:-1]
        self.order[rows, gap:] = np.column_stack([np.full(len(rows), w), later])


def _moved(poses: Array, points: Array) -> Array:
    """Return points (f, 3), each transformed by its own pose (f, 4, 4)."""
    return np.einsum("fij,fj->fi", poses[:, :3, :3], points) + poses[:, :3, 3]


@dataclass(frozen=True, eq=False)
class StraightParts:
    """The p straight parts of paths between different bodies.

    Args:
        frame: index of the coordinate set, in flattened order, (p,).
        line: index of the muscle or ligament, (p,).
        bodies: indices of the bodies at the start and end of each part, (p, 2).
        ends: start and end in ground, m, (p, 2, 3).
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
    """Forces of strings of unit tension on path points and bodies.

    `points` (f, k, 3), m, are in ground; `lines` and `bodies` (k,) are each point's muscle or
    ligament and body; `count` the numbers of both.
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
        """Add strings in frames `rows` from path point k to `next_point`, over wrap objects."""
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
    """Return unit vectors (f, 3), zero if both coincide, and distances (f,)."""
    step = end - start
    distance = np.linalg.norm(step, axis=-1)
    return step / np.maximum(distance, 1e-300)[:, None], distance
