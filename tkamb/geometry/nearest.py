"""Nearest points of a triangulated surface, and samples that cover one."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.normals import NO_CREASE, corner_normals, mean_normals
from tkamb.geometry.tree import TriangleTree, rows

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


@dataclass(frozen=True)
class NearestSettings:
    """Nearest points of two surfaces."""

    max_samples: int = 150_000
    """Samples of a surface at most. Chosen: it bounds memory and time."""


NEAREST = NearestSettings()

FLAT = 1e-14
"""1: a triangle with a smaller ratio of squared area to squared edges has no plane."""
DEEPEST = 64
"""Largest number of boxes on the stack: one of each level."""
NO_TRIANGLE = -1


@dataclass(frozen=True, eq=False)
class Nearest:
    """Nearest points of a surface to n points.

    Args:
        distance: (n,) m.
        faces: (n,) triangle of each.
        weights: (n, 3) barycentric coordinates in it.
        surface: whose points they are.
    """

    distance: Array
    faces: Index
    weights: Array
    surface: "NearestPoints"

    @cached_property
    def points(self) -> Array:
        """The points (n, 3), m, on the surface."""
        return np.einsum("ij,ijk->ik", self.weights, self.surface.surface.triangles[self.faces])

    @cached_property
    def normals(self) -> Array:
        """Unit normals (n, 3) there, interpolated from the vertices."""
        return mean_normals(self.weights, self.surface.corner_normals[self.faces])


class NearestPoints:
    """Answers for the nearest points of one surface, exactly.

    Args:
        surface: whose points they are.
        tree: of its triangles, if there is one."""

    def __init__(self, surface: "Surface", tree: TriangleTree | None = None) -> None:
        self.surface = surface
        tree = TriangleTree(surface) if tree is None else tree
        self._tree = tree.boxes, tree.faces, tree.corners

    @cached_property
    def corner_normals(self) -> Array:
        """Unit normals (k, 3, 3) of the vertices, weighted by the areas of their triangles."""
        area = self.surface.areas[:, None] * np.ones(3)
        return corner_normals(self.surface, NO_CREASE, area)

    def at(self, points: ArrayLike) -> Nearest:
        """Return the nearest points to `points` (n, 3), m, in the surface's frame.

        NaN, infinitely far, in the triangle -1, for a point that is not finite.
        """
        return self._found(points, np.inf)

    def within(self, points: Array, reach: float) -> tuple[Index, Nearest]:
        """Return which points (n, 3) have one within `reach`, m, and what `at` says of those."""
        nearest = self._found(points, reach)
        near = np.flatnonzero(nearest.faces >= 0)
        return near, Nearest(
            nearest.distance[near], nearest.faces[near], nearest.weights[near], self
        )

    def _found(self, points: ArrayLike, reach: float) -> Nearest:
        return Nearest(*_nearest_points(*self._tree, rows(points), float(reach)), self)


def sampled(surface: "Surface", spacing: float) -> tuple[Array, Index, Array]:
    """Return samples (n, 3) that cover every triangle, the triangle (n,) and area (n,) of each.

    A triangle is cut into n² like ones so that no edge is longer than the spacing; the
    samples are their centres. The spacing grows where a surface would need more than
    150 000 samples.
    """
    triangles = surface.triangles
    longest = surface.longest_edges
    cuts = np.maximum(np.ceil(longest / spacing).astype(int), 1)
    while (cuts**2).sum() > max(NEAREST.max_samples, len(triangles)) and cuts.max() > 1:
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
    """Return barycentric centres (n², 3) of a triangle cut n times along each edge."""
    i, j = np.divmod(np.arange(n * n), n)
    upright, inverted = i + j < n, i + j < n - 1
    first = np.concatenate([i[upright] + 1 / 3, i[inverted] + 2 / 3]) / n
    second = np.concatenate([j[upright] + 1 / 3, j[inverted] + 2 / 3]) / n
    return np.stack([1 - first - second, first, second], axis=1)


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
        guess: place of a triangle that is likely to be near, which speeds up the search; -1: none.
        waiting: (`DEEPEST`,) to work in.
        apart: likewise.

    Returns:
        Place in `faces`, squared distance (m²), barycentrics 2 and 3 of the nearest point.
    """
    leaves, place, size = len(boxes) // 2, NO_TRIANGLE, 1
    leaf_size = len(faces) // leaves
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
            for row in range((box - leaves) * leaf_size, (box - leaves + 1) * leaf_size):
                square, s, t = _foot(corners[row], point)
                if square > best or (square == best and place >= 0 and faces[place] <= faces[row]):
                    continue
                place, best, second, third = row, square, s, t
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
def _nearest_points(
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
            guess = place  # the next point is often close to this one
            distance[n], face[n] = np.sqrt(square), faces[place]
            weights[n, 0], weights[n, 1], weights[n, 2] = 1.0 - s - t, s, t
    return distance, face, weights
