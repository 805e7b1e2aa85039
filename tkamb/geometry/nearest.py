"""Nearest points of a triangulated surface, its tree of bounding boxes, and surface samples.

The tree halves the triangles along the longest side of their box, until a leaf contains a few. All
leaves are at one depth: the children of box i are 2i and 2i + 1, the root is 1. A search visits the
nearer child first and skips boxes farther away than the best result so far; its result does not
depend on the order.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


# Largest number of triangles in a leaf. Chosen for speed; results do not depend on it.
TRIANGLES_PER_LEAF = 4
# 1: distance by which boxes are enlarged, as a share of the surface's size. It is
# above rounding.
MARGIN = 1e-7


def rows(vectors: ArrayLike) -> Array:
    """Return vectors (n, 3) or (3,) as (n, 3), contiguous, writable, double: the compiled type."""
    return np.require(vectors, np.float64, ["C", "W", "E"]).reshape(-1, 3)


class TriangleTree:
    """The tree of one surface, in the surface's frame.

    Args:
        chosen: (m,) triangles of the tree; None for all triangles.

    Attributes:
        boxes: (2 p, 6) m, smallest and largest coordinates of each box; leaf l is box p + l.
        faces: (p c,) triangles of the p leaves, c per leaf; a few triangles appear twice.
    """

    def __init__(self, surface: "Surface", chosen: Index | None = None) -> None:
        self._surface, corners = surface, surface.triangles
        low, high = corners.min(axis=1), corners.max(axis=1)
        chosen = np.arange(len(corners)) if chosen is None else chosen
        # A triangle without area has no normal, and its edges belong to other triangles, too.
        with_area = chosen[surface.areas[chosen] > 0.0]
        chosen = with_area if len(with_area) else chosen
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
        """Plane of each box (2 p, 4); all triangles of the box lie behind its plane.

        A row is the unit normal n, the triangles' mean or zero if that vanishes, and the offset n .
        x (m).
        """
        count = len(self.boxes) // 2
        planes = np.zeros((2 * count, 4))
        vertices = self.corners.reshape(-1, 3)
        total = (self._surface.areas[:, None] * self._surface.face_normals)[self.faces]
        while count:
            level, total = planes[count : 2 * count], total.reshape(count, -1, 3).sum(axis=1)
            length = np.linalg.norm(total, axis=1, keepdims=True)
            np.divide(total, length, out=level[:, :3], where=length > 0.0)
            along = vertices.reshape(count, -1, 3) @ level[:, :3, None]
            level[:, 3] = along[:, :, 0].max(axis=1)
            count //= 2
        return planes


def _halved(centres: Array) -> Index:
    """Return triangles (p, c) of p leaves; some appear twice, to fill the rows."""
    leaves = 1
    while leaves * TRIANGLES_PER_LEAF < len(centres):
        leaves *= 2
    room = leaves * -(-len(centres) // leaves)
    order = np.arange(room) * len(centres) // room  # order of the input, which is often sorted
    _halve(np.ascontiguousarray(centres), order, leaves)
    return order.reshape(leaves, -1)


@compiled_as_written
def _halve(centres: Array, order: Index, leaves: int) -> None:
    """Sort triangle numbers (m,) into leaves, halving along the longest side.

    `leaves` is a power of two and divides m. `centres` (n, 3), m, are those of the triangles'
    boxes.
    """
    parts = 1
    while parts < leaves:
        part_size = len(order) // parts
        for first in range(0, len(order), part_size):
            longest, axis = -1.0, 0
            for k in range(3):
                low, high = np.inf, -np.inf
                for n in range(first, first + part_size):
                    low, high = min(low, centres[order[n], k]), max(high, centres[order[n], k])
                if high - low > longest:
                    longest, axis = high - low, k
            _part(centres, order, axis, first, first + part_size - 1, first + part_size // 2)
        parts *= 2


@compiled_as_written
def _part(centres: Array, order: Index, axis: int, first: int, last: int, middle: int) -> None:
    """Move smaller values along `axis` before `middle` (Hoare 1961)."""
    while first < last:
        pivot = centres[order[(first + last) // 2], axis]
        low, high = first, last
        while low <= high:
            while centres[order[low], axis] < pivot:
                low += 1
            while centres[order[high], axis] > pivot:
                high -= 1
            if low <= high:
                order[low], order[high] = order[high], order[low]
                low, high = low + 1, high - 1
        if middle <= high:
            last = high
        elif middle >= low:
            first = low
        else:
            return


# Largest number of samples of a surface. It limits memory and time.
MAX_SAMPLES = 150_000


FLAT = 1e-14
"""1: a triangle counts as a line if 4 area² / (edge² edge²) is smaller."""
DEEPEST = 64
"""Most boxes on the stack of a search: one per level of the tree."""
NO_TRIANGLE = -1


@dataclass(frozen=True, eq=False)
class Nearest:
    """The points of a surface that are nearest to n given points.

    Args:
        distance: (n,) m, from the given points.
        faces: (n,) triangles of the nearest points.
        weights: (n, 3) their barycentric coordinates.
    """

    distance: Array
    faces: Index
    weights: Array
    surface: "NearestPoints"

    @cached_property
    def points(self) -> Array:
        """The nearest points (n, 3), m."""
        return np.einsum("ij,ijk->ik", self.weights, self.surface.surface.triangles[self.faces])

    @cached_property
    def normals(self) -> Array:
        """Unit normals (n, 3) at the points, interpolated from the vertices."""
        return self.surface.surface.vertex_normals_at(self.faces, self.weights)


class NearestPoints:
    """Exact search for the nearest points of one surface; without a tree it is built."""

    def __init__(self, surface: "Surface", tree: TriangleTree | None = None) -> None:
        self.surface = surface
        tree = TriangleTree(surface) if tree is None else tree
        self._tree = tree.boxes, tree.faces, tree.corners

    def at(self, points: ArrayLike) -> Nearest:
        """Return the points of the surface nearest to `points` (n, 3), m, in the surface's frame.

        A point that is not finite has the distance inf, triangle -1 and NaN weights.
        """
        return self._search(points, np.inf)

    def within(self, points: Array, reach: float) -> tuple[Index, Nearest]:
        """Return the numbers of the points (n, 3) within `reach` (m), and their `Nearest`."""
        nearest = self._search(points, reach)
        near = np.flatnonzero(nearest.faces >= 0)
        return near, Nearest(
            nearest.distance[near], nearest.faces[near], nearest.weights[near], self
        )

    def _search(self, points: ArrayLike, reach: float) -> Nearest:
        return Nearest(*_nearest_points(*self._tree, rows(points), float(reach)), self)


def sampled(surface: "Surface", spacing: float) -> tuple[Array, Index, Array]:
    """Return samples (n, 3) of a surface, with triangle (n,) and area (n,).

    They are centres of similar parts of a triangle with edges of at most `spacing` (m). The spacing
    is increased if there are more than `MAX_SAMPLES`.
    """
    triangles = surface.triangles
    longest = surface.longest_edges
    cuts = np.maximum(np.ceil(longest / spacing).astype(int), 1)
    while (cuts**2).sum() > max(MAX_SAMPLES, len(triangles)) and cuts.max() > 1:
        spacing *= 1.2
        cuts = np.maximum(np.ceil(longest / spacing).astype(int), 1)
    area = surface.areas / cuts**2
    samples, faces = [], []
    for n in np.unique(cuts):
        members = np.flatnonzero(cuts == n)
        samples.append(np.einsum("sj,kjc->ksc", _centres(int(n)), triangles[members]))
        faces.append(np.repeat(members, n * n))
    owner = np.concatenate(faces)
    return np.concatenate([s.reshape(-1, 3) for s in samples]), owner, area[owner]


def _centres(n: int) -> Array:
    """Return barycentric centres (n², 3) of parts, n per edge."""
    i, j = np.divmod(np.arange(n * n), n)
    upright, inverted = i + j < n, i + j < n - 1
    first = np.concatenate([i[upright] + 1 / 3, i[inverted] + 2 / 3]) / n
    second = np.concatenate([j[upright] + 1 / 3, j[inverted] + 2 / 3]) / n
    return np.stack([1 - first - second, first, second], axis=1)


@compiled_as_written
def _apart(box: Array, point: Array) -> float:
    total = 0.0
    for axis in range(3):
        beside = max(box[axis] - point[axis], point[axis] - box[axis + 3], 0.0)
        total += beside * beside
    return total


@compiled_as_written
def _on_edge(along: float, length: float) -> float:
    return min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0


@compiled_as_written
def _foot(corners: Array, point: Array) -> tuple[float, float, float]:
    """Return the squared distance (m²) of a triangle's nearest point and its barycentrics 2 and 3.

    It is the projection onto the plane if inside, else the nearest one onto an edge. Without
    absolute tolerances it is correct for any size.
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
    stack: Index,
    squares: Array,
) -> tuple[int, float, float, float]:
    """Return the nearest point: place in `faces`, squared distance (m²), barycentrics 2 and 3.

    Of equally near triangles it is the one with the lowest number; -1 if none is within `reach`
    (m). Boxes, faces and corners: see `TriangleTree`. `guess`, a place probably near or -1, saves
    time; `stack` and `squares` (`DEEPEST`,) are work arrays.
    """
    leaves, place, size = len(boxes) // 2, NO_TRIANGLE, 1
    leaf_size = len(faces) // leaves
    best, second, third = reach * reach, 0.0, 0.0
    if guess >= 0:
        square, s, t = _foot(corners[guess], point)
        if square <= best:
            place, best, second, third = guess, square, s, t
    stack[0], squares[0] = 1, 0.0
    while size > 0:
        size -= 1
        box = stack[size]
        if squares[size] > best:
            continue
        if box >= leaves:
            for row in range((box - leaves) * leaf_size, (box - leaves + 1) * leaf_size):
                square, s, t = _foot(corners[row], point)
                if square > best or (square == best and place >= 0 and faces[place] <= faces[row]):
                    continue
                place, best, second, third = row, square, s, t
            continue
        near_box, far_box = 2 * box, 2 * box + 1
        near, far = _apart(boxes[near_box], point), _apart(boxes[far_box], point)
        if far < near:
            near_box, far_box, near, far = far_box, near_box, far, near
        if far <= best:
            stack[size], squares[size] = far_box, far
            size += 1
        if near <= best:
            stack[size], squares[size] = near_box, near
            size += 1
    return place, best, second, third


@compiled_as_written
def _nearest_points(
    boxes: Array, faces: Index, corners: Array, points: Array, reach: float
) -> tuple[Array, Index, Array]:
    """Return distance (n,), m, triangle (n,) and barycentrics (n, 3) of the nearest points.

    They are inf, -1 and NaN beyond reach and for points that are not finite.
    """
    count = len(points)
    distance, face = np.full(count, np.inf), np.full(count, NO_TRIANGLE)
    weights = np.full((count, 3), np.nan)
    stack, squares, guess = np.empty(DEEPEST, np.int64), np.empty(DEEPEST), int(NO_TRIANGLE)
    for n in range(count):
        point = points[n]
        if not np.isfinite(point[0] + point[1] + point[2]):
            continue
        place, square, s, t = _nearest_place(
            boxes, faces, corners, point, reach, guess, stack, squares
        )
        if place >= 0:
            guess = place  # the next point is often close to this one
            distance[n], face[n] = np.sqrt(square), faces[place]
            weights[n, 0], weights[n, 1], weights[n, 2] = 1.0 - s - t, s, t
    return distance, face, weights
