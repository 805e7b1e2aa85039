"""A tree of bounding boxes over a surface's triangles, for rays and nearest points.

The triangles are halved at the median along the longest side of their box, again and again, until
a leaf holds a few. All leaves lie equally deep, so that the tree needs no pointers: the children
of box i are 2i and 2i + 1, from the root, 1. What asks it goes to the nearer child first and
leaves out boxes beyond what it has found. Triangles are looked at in double precision, each by
itself: which of them is found does not hang on the way there.
"""

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from tkamb.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface

LEAF = 4
"""Triangles in a leaf, at most."""
MARGIN = 1e-7
"""Of the surface's size: by so much boxes are wider, whatever the rounding."""
DEEPEST = 64
"""Boxes that wait at one time: one of each level."""
FLAT = 1e-14
"""A triangle whose squared area is less, relative to its edges', has no plane."""
STILL = 1e-200
"""A smaller part of a direction is none; its inverse times a length is still a number."""
PARALLEL = 1e-9
"""Sine of the angle to a triangle's plane below which a ray does not cross it."""
NO_TRIANGLE = -1


def rows(vectors: ArrayLike) -> Array:
    """Return vectors (n, 3) as the loops take them; one (3,) as (1, 3).

    Double precision, row after row, to be written: for others they would be compiled anew.
    """
    return np.require(vectors, np.float64, ["C", "W", "E"]).reshape(-1, 3)


class TriangleTree:
    """The tree of one surface, in its frame.

    Args:
        surface: of any triangles.
        chosen: which of them; None: all.

    Attributes:
        boxes: (2 p, 6) m, smallest and largest coordinates; those of leaf l are at p + l.
        faces: (p c,) the triangles of the leaves, c each; some of them twice.
    """

    def __init__(self, surface: "Surface", chosen: Index | None = None) -> None:
        self._surface, corners = surface, surface.triangles
        low, high = corners.min(axis=1), corners.max(axis=1)
        chosen = np.arange(len(corners)) if chosen is None else chosen
        # one without area has no normal, and its edges are those of others
        real = chosen[surface.areas[chosen] > 0.0]
        chosen = real if len(real) else chosen
        leaves = chosen[_halved(0.5 * (low + high)[chosen])]
        margin = MARGIN * float(np.linalg.norm(np.ptp(surface.bounds, axis=0)))
        count = len(leaves)
        self.faces = leaves.ravel()
        self.boxes = np.zeros((2 * count, 6))
        self.boxes[count:, :3] = low[leaves].min(axis=1) - margin
        self.boxes[count:, 3:] = high[leaves].max(axis=1) + margin
        while count > 1:
            pairs = self.boxes[count : 2 * count].reshape(-1, 2, 6)
            count //= 2
            self.boxes[count : 2 * count, :3] = pairs[:, :, :3].min(axis=1)
            self.boxes[count : 2 * count, 3:] = pairs[:, :, 3:].max(axis=1)

    @cached_property
    def corners(self) -> Array:
        """Corner points (p c, 9), m, of the leaves' triangles."""
        return self._surface.triangles.reshape(-1, 9)[self.faces]

    @cached_property
    def supports(self) -> Array:
        """Planes (2 p, 4) that all triangles of a box stay behind: unit normals n, and n . x, m.

        The normals are the mean ones of the triangles, so that the planes lie close where the
        surface is nearly flat; zero where there is none.
        """
        count = len(self.boxes) // 2
        planes = np.zeros((2 * count, 4))
        vertices = self.corners.reshape(-1, 3)
        total = (self._surface.areas[:, None] * self._surface.face_normals)[self.faces]
        while count:
            here, total = planes[count : 2 * count], total.reshape(count, -1, 3).sum(axis=1)
            length = np.linalg.norm(total, axis=1, keepdims=True)
            np.divide(total, length, out=here[:, :3], where=length > 0.0)
            along = vertices.reshape(count, -1, 3) @ here[:, :3, None]
            here[:, 3] = along[:, :, 0].max(axis=1)
            count //= 2
        return planes


def _halved(centres: Array) -> Index:
    """Return the triangles of the leaves (p, c), p a power of two; some twice, to fill them."""
    leaves = 1
    while leaves * LEAF < len(centres):
        leaves *= 2
    room = leaves * -(-len(centres) // leaves)
    order = np.arange(room) * len(centres) // room  # sorted ones stay sorted, and quickly parted
    _halve(np.ascontiguousarray(centres), order, leaves)
    return order.reshape(leaves, -1)


@compiled_as_written
def _halve(centres: Array, order: Index, leaves: int) -> None:
    """Order triangles: halves, quarters, eighths ... each parted along its longest side.

    Args:
        centres: (n, 3) m.
        order: (m,) triangles, to be sorted; m a multiple of the leaves.
        leaves: how many parts there are at last, a power of two.
    """
    parts = 1
    while parts < leaves:
        held = len(order) // parts
        for first in range(0, len(order), held):
            longest, axis = -1.0, 0
            for k in range(3):
                low, high = np.inf, -np.inf
                for n in range(first, first + held):
                    low, high = min(low, centres[order[n], k]), max(high, centres[order[n], k])
                if high - low > longest:
                    longest, axis = high - low, k
            _part(centres, order, axis, first, first + held - 1, first + held // 2)
        parts *= 2


@compiled_as_written
def _part(centres: Array, order: Index, axis: int, first: int, last: int, middle: int) -> None:
    """Bring the smaller ones of a part before its middle, the larger ones after (Hoare 1961).

    Args:
        centres: (n, 3) m.
        order: (m,).
        axis: by which they are compared.
        first: place of the first in the order.
        last: of the last.
        middle: of the one that is to stand where it would if all were sorted.
    """
    while first < last:
        pivot = centres[order[(first + last) // 2], axis]
        left, right = first, last
        while left <= right:
            while centres[order[left], axis] < pivot:
                left += 1
            while centres[order[right], axis] > pivot:
                right -= 1
            if left <= right:
                order[left], order[right] = order[right], order[left]
                left, right = left + 1, right - 1
        if middle <= right:
            last = right
        elif middle >= left:
            first = left
        else:
            return


@compiled_as_written
def _crossing(plane: Array, origin: Array, direction: Array) -> tuple[float, float, float]:
    """Return the distance at which a ray meets a triangle's plane, and its barycentrics 2 and 3.

    Args:
        plane: (12,) first corner, unit normal and `Surface.barycentric_rows`.
        origin: (3,) m.
        direction: (3,) unit.

    Returns:
        Distance (m), inf where the ray runs along the plane or the triangle has none.
    """
    x, y, z = origin[0] - plane[0], origin[1] - plane[1], origin[2] - plane[2]
    slope = direction[0] * plane[3] + direction[1] * plane[4] + direction[2] * plane[5]
    if not abs(slope) >= PARALLEL:
        return np.inf, np.nan, np.nan
    t = -(x * plane[3] + y * plane[4] + z * plane[5]) / slope
    x, y, z = x + t * direction[0], y + t * direction[1], z + t * direction[2]
    u = plane[6] * x + plane[7] * y + plane[8] * z
    v = plane[9] * x + plane[10] * y + plane[11] * z
    return t, u, v


@compiled_as_written
def _entry(box: Array, origin: Array, slowness: Array) -> float:
    """Return the distance at which a ray enters a box (6,), inf where it misses it, m.

    Args:
        box: (6,) m.
        origin: (3,) m.
        slowness: (3,) one over the unit direction.
    """
    enters, leaves = -np.inf, np.inf
    for axis in range(3):
        first = (box[axis] - origin[axis]) * slowness[axis]
        last = (box[axis + 3] - origin[axis]) * slowness[axis]
        enters, leaves = max(enters, min(first, last)), min(leaves, max(first, last))
    return enters if enters <= leaves and leaves >= 0.0 else np.inf


@compiled_as_written
def _set_direction(vector: Array, direction: Array, slowness: Array) -> None:
    """Write a vector (3,) at unit length, and one over that; a number where it does not go.

    One of no length makes a direction of NaN, which meets nothing.
    """
    length = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    for axis in range(3):
        along = vector[axis] / length
        direction[axis] = along
        slowness[axis] = 1.0 / along if abs(along) > STILL else 1.0 / STILL


@compiled_as_written
def first_crossings(
    boxes: Array,
    faces: Index,
    planes: Array,
    origins: Array,
    directions: Array,
    least: float,
    outside: float,
) -> tuple[Array, Index, Array]:
    """Return the first crossing of each ray; of equally near ones that of the lowest number.

    Args:
        boxes: (2 p, 6) m.
        faces: (p c,) triangles of the leaves.
        planes: (p c, 12) theirs, see `_crossing`.
        origins: (n, 3) m.
        directions: (n, 3) of any length, or (1, 3) for all.
        least: m, the smallest distance that counts.
        outside: barycentric units; so far outside its triangle a crossing still counts.

    Returns:
        Distance (n,) m, inf for none; triangle (n,), -1; barycentrics (n, 3), NaN.
    """
    count, leaves = len(origins), len(boxes) // 2
    held = len(faces) // leaves
    distance, face = np.full(count, np.inf), np.full(count, NO_TRIANGLE)
    weights = np.full((count, 3), np.nan)
    waiting, enters = np.empty(DEEPEST, np.int64), np.empty(DEEPEST)
    direction, slowness = np.empty(3), np.empty(3)
    for n in range(count):
        origin = origins[n]
        if n < len(directions):
            _set_direction(directions[n], direction, slowness)
        if not np.isfinite(origin[0] + origin[1] + origin[2]):
            continue
        best, found, size = np.inf, NO_TRIANGLE, 1
        waiting[0], enters[0] = 1, _entry(boxes[1], origin, slowness)
        while size > 0:
            size -= 1
            box = waiting[size]
            if enters[size] > best or enters[size] == np.inf:
                continue
            if box >= leaves:
                for place in range((box - leaves) * held, (box - leaves + 1) * held):
                    t, u, v = _crossing(planes[place], origin, direction)
                    if t < least or t > best or not min(u, v, 1.0 - u - v) >= -outside:
                        continue
                    if t < best or faces[place] < found:
                        best, found = t, faces[place]
                        weights[n, 0], weights[n, 1], weights[n, 2] = 1.0 - u - v, u, v
                continue
            one, other = 2 * box, 2 * box + 1
            near, far = _entry(boxes[one], origin, slowness), _entry(boxes[other], origin, slowness)
            if far < near:
                one, other, near, far = other, one, far, near
            if far < np.inf and far <= best:
                waiting[size], enters[size] = other, far
                size += 1
            if near < np.inf and near <= best:
                waiting[size], enters[size] = one, near
                size += 1
        distance[n], face[n] = best, found
    return distance, face, weights


@compiled_as_written
def all_crossings(
    boxes: Array,
    faces: Index,
    planes: Array,
    origins: Array,
    directions: Array,
    least: float,
    outside: float,
    ray: Index,
    distance: Array,
    face: Index,
) -> int:
    """Count every crossing of every ray, and write as many as there is room for.

    Args:
        boxes: see `first_crossings`, as all but the following.
        faces: (p c,).
        planes: (p c, 12).
        origins: (n, 3) m.
        directions: (n, 3) of any length, or (1, 3) for all.
        least: m.
        outside: barycentric units.
        ray: (m,) the ray of each crossing, to be written.
        distance: (m,) m, likewise.
        face: (m,), likewise.
    """
    leaves, number = len(boxes) // 2, 0
    held = len(faces) // leaves
    waiting, direction, slowness = np.empty(DEEPEST, np.int64), np.empty(3), np.empty(3)
    for n in range(len(origins)):
        origin = origins[n]
        if n < len(directions):
            _set_direction(directions[n], direction, slowness)
        if not np.isfinite(origin[0] + origin[1] + origin[2]):
            continue
        waiting[0], size = 1, 1
        while size > 0:
            size -= 1
            box = waiting[size]
            if _entry(boxes[box], origin, slowness) == np.inf:
                continue
            if box < leaves:
                waiting[size], waiting[size + 1] = 2 * box, 2 * box + 1
                size += 2
                continue
            for place in range((box - leaves) * held, (box - leaves + 1) * held):
                t, u, v = _crossing(planes[place], origin, direction)
                if t < least or t == np.inf or not min(u, v, 1.0 - u - v) >= -outside:
                    continue
                if number < len(ray):
                    ray[number], distance[number], face[number] = n, t, faces[place]
                number += 1
    return number


@compiled_as_written
def _apart(box: Array, point: Array) -> float:
    """Return the squared distance of a point from a box, m²."""
    total = 0.0
    for axis in range(3):
        beside = max(box[axis] - point[axis], point[axis] - box[axis + 3], 0.0)
        total += beside * beside
    return total


@compiled_as_written
def _on_edge(along: float, length: float) -> float:
    """Return where on an edge the nearest point lies, 0 to 1."""
    return min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0


@compiled_as_written
def _foot(corners: Array, point: Array) -> tuple[float, float, float]:
    """Return the squared distance of a triangle's nearest point and its barycentrics 2 and 3.

    The foot on the triangle's plane where that lies inside, else the nearest of the feet on the
    three edges. Free of absolute tolerances, so right for triangles of any size.

    Args:
        corners: (9,) m.
        point: (3,) m.
    """
    ux, uy, uz = corners[3] - corners[0], corners[4] - corners[1], corners[5] - corners[2]
    vx, vy, vz = corners[6] - corners[0], corners[7] - corners[1], corners[8] - corners[2]
    wx, wy, wz = point[0] - corners[0], point[1] - corners[1], point[2] - corners[2]
    uu, uv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz
    vv = vx * vx + vy * vy + vz * vz
    wu, wv = wx * ux + wy * uy + wz * uz, wx * vx + wy * vy + wz * vz
    area = uu * vv - uv * uv
    least, second, third = np.inf, 0.0, 0.0
    if area > FLAT * uu * vv:
        s, t = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
        if s >= 0.0 and t >= 0.0 and s + t <= 1.0:
            x, y, z = wx - s * ux - t * vx, wy - s * uy - t * vy, wz - s * uz - t * vz
            return x * x + y * y + z * z, s, t
    for edge in range(3):
        if edge == 0:
            s, t = _on_edge(wu, uu), 0.0
        elif edge == 1:
            s, t = 0.0, _on_edge(wv, vv)
        else:
            t = _on_edge(uu - uv + wv - wu, uu - 2.0 * uv + vv)
            s = 1.0 - t
        x, y, z = wx - s * ux - t * vx, wy - s * uy - t * vy, wz - s * uz - t * vz
        square = x * x + y * y + z * z
        if square < least:
            least, second, third = square, s, t
    return least, second, third


@compiled_as_written
def _nearest_place(
    boxes: Array,
    faces: Index,
    corners: Array,
    point: Array,
    reach: float,
    guess: int,
    waiting: Index,
    apart: Array,
) -> tuple[int, float, float, float]:
    """Return where the triangle lies that is nearest to a point, -1 for none within reach.

    Of equally near ones that of the lowest number.

    Args:
        boxes: (2 p, 6) m.
        faces: (p c,) triangles of the leaves.
        corners: (p c, 9) m, theirs.
        point: (3,) m.
        reach: m.
        guess: the place of a triangle that may be near, and spares looks then; -1: none.
        waiting: (`DEEPEST`,) to work in.
        apart: likewise.

    Returns:
        Place in `faces`, squared distance (m²), barycentrics 2 and 3 of the nearest point.
    """
    leaves, place, size = len(boxes) // 2, NO_TRIANGLE, 1
    held = len(faces) // leaves
    best, second, third = reach * reach, 0.0, 0.0
    if guess >= 0:
        square, s, t = _foot(corners[guess], point)
        if square <= best:
            place, best, second, third = guess, square, s, t
    waiting[0], apart[0] = 1, 0.0
    while size > 0:
        size -= 1
        box = waiting[size]
        if apart[size] > best:
            continue
        if box >= leaves:
            for here in range((box - leaves) * held, (box - leaves + 1) * held):
                square, s, t = _foot(corners[here], point)
                if square > best or (square == best and place >= 0 and faces[place] <= faces[here]):
                    continue
                place, best, second, third = here, square, s, t
            continue
        one, other = 2 * box, 2 * box + 1
        near, far = _apart(boxes[one], point), _apart(boxes[other], point)
        if far < near:
            one, other, near, far = other, one, far, near
        if far <= best:
            waiting[size], apart[size] = other, far
            size += 1
        if near <= best:
            waiting[size], apart[size] = one, near
            size += 1
    return place, best, second, third


@compiled_as_written
def nearest_points(
    boxes: Array, faces: Index, corners: Array, points: Array, reach: float
) -> tuple[Array, Index, Array]:
    """Return the nearest point to each of many, see `_nearest_place`.

    Args:
        boxes: (2 p, 6) m.
        faces: (p c,).
        corners: (p c, 9) m.
        points: (n, 3) m.
        reach: m.

    Returns:
        Distance (n,) m, inf for none and for points that are not finite; triangle (n,), -1;
        barycentrics (n, 3), NaN.
    """
    count = len(points)
    distance, face = np.full(count, np.inf), np.full(count, NO_TRIANGLE)
    weights = np.full((count, 3), np.nan)
    waiting, apart, guess = np.empty(DEEPEST, np.int64), np.empty(DEEPEST), int(NO_TRIANGLE)
    for n in range(count):
        point = points[n]
        if not np.isfinite(point[0] + point[1] + point[2]):
            continue
        place, square, s, t = _nearest_place(
            boxes, faces, corners, point, reach, guess, waiting, apart
        )
        if place >= 0:
            guess = place  # the next point may lie beside this one
            distance[n], face[n] = np.sqrt(square), faces[place]
            weights[n, 0], weights[n, 1], weights[n, 2] = 1.0 - s - t, s, t
    return distance, face, weights
