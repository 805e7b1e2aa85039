"""Crossings of rays with a triangulated surface, in double precision."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.nearest import TriangleTree, rows
from tkamb.geometry.threads import in_halves
from tkamb.geometry.topology import connected_parts

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


# 1: largest distance of a crossing outside a triangle, in barycentric coordinates.
# It is above rounding.
EDGE_TOLERANCE = 1e-9
# 1: distance below which two crossings of a ray are one crossing, as a share of half the diagonal
# of the bounding box. It is above rounding.
SAME_CROSSING = 1e-10
# Number of crossings per ray for which memory is allocated at first. Most rays have
# fewer.
USUAL_CROSSINGS = 4
# Number of rays from which two threads share the work. With fewer rays the second
# thread costs more time than it saves.
THREADED_RAYS = 500


STILL = 1e-200
"""1: smallest component of a direction that is inverted, so that the inverse stays finite."""
PARALLEL = 1e-9
"""1: sine of the angle between ray and triangle below which they do not cross."""
DEEPEST = 64
"""Most boxes on the stack of a search: one per level of the tree."""
NO_TRIANGLE = -1
"""Number in place of a triangle where a ray crosses none."""


# m: distance below which two shells touch. It is above the rounding of a mesh.
TOUCHING_DISTANCE = 1e-6


class RayCaster:
    """Crossings of rays with one surface.

    No ray passes between two triangles; one that touches the outline may cross or not. The error of
    a distance is about 1e-16 m divided by the sine of the angle to the surface.

    Attributes:
        tree: boxes (2 p, 6), m, and triangles (p c,) of the leaves, see `TriangleTree`; planes
            (p c, 12) of these triangles, see `_crossing`; distance (m) before the origin from which
            a crossing counts.
    """

    def __init__(self, surface: "Surface", tree: TriangleTree | None = None) -> None:
        self.surface = surface
        tree = TriangleTree(surface) if tree is None else tree
        lower, upper = surface.bounds
        self._same = SAME_CROSSING * float(np.linalg.norm(upper - lower)) / 2.0
        rows = surface.barycentric_rows.reshape(-1, 6)
        planes = np.hstack([surface.triangles[:, 0], surface.face_normals, rows])
        self.tree = tree.boxes, tree.faces, planes[tree.faces], self._same

    def first(self, origins: ArrayLike, directions: ArrayLike) -> tuple[Array, Index]:
        """Return the nearest crossing of each ray at or beyond its origin.

        Args:
            origins: (n, 3) m.
            directions: (n, 3) or (3,), any length but zero.

        Returns:
            distance (n,), m, and face (n,); inf and -1 without a crossing.
        """
        distance, face, _ = self.first_in_face(origins, directions)
        return distance, face

    def last_exit(self, origins: ArrayLike, directions: ArrayLike) -> Array:
        """Return the distance (n,), m, of the first exit that counts on each ray; inf without exit.

        An exit through an inner wall, where the next shell begins, or into a closed void, which has
        its own shell, does not count. An exit into an undercut does, although the ray enters again
        behind it.

        Arguments as in `first`.
        """
        origins, directions = _rays(origins, directions)
        ray, along, face = self.all(origins, directions)
        direction_of_crossing = np.broadcast_to(directions, origins.shape)[ray]
        leaves = np.einsum("ij,ij->i", self.surface.face_normals[face], direction_of_crossing) > 0.0
        last = np.full(len(origins), np.inf)
        np.minimum.at(last, ray[leaves], along[leaves])
        several = np.flatnonzero(np.bincount(ray[leaves], minlength=len(origins)) > 1)
        shell = self._shells() if len(several) else np.empty(0, np.int64)
        for number in several:
            first, end = np.searchsorted(ray, [number, number + 1])
            distances, exits = along[first:end], leaves[first:end]
            shells = shell[face[first:end]]
            for k in np.flatnonzero(exits):
                last[number] = distances[k]
                entries = np.flatnonzero(
                    ~exits
                    & (distances >= distances[k] - TOUCHING_DISTANCE)
                    & (np.arange(len(distances)) != k)
                )
                later_entries = entries[distances[entries] > distances[0] + TOUCHING_DISTANCE]
                if not len(later_entries):
                    break
                next_entry = later_entries[0]
                touching = distances[next_entry] - distances[k] <= TOUCHING_DISTANCE
                void = shells[k] == shells[next_entry] != shells[0]
                if not (touching or void):
                    break
        return last

    def _shells(self) -> Index:
        _, merged = np.unique(np.round(self.surface.vertices, 9), axis=0, return_inverse=True)
        return connected_parts(np.asarray(merged).reshape(-1)[self.surface.faces])

    def first_in_face(
        self, origins: ArrayLike, directions: ArrayLike
    ) -> tuple[Array, Index, Array]:
        """Return the result of `first`, and barycentrics (n, 3), NaN without a crossing."""
        origins, directions = _rays(origins, directions)

        def crossings(part: slice) -> tuple[Array, Index, Array]:
            along = directions[part] if len(directions) > 1 else directions
            return _first_crossings(self.tree, origins[part], along)

        if len(origins) < THREADED_RAYS:
            return crossings(slice(0, len(origins)))
        first_half, second_half = in_halves(crossings, len(origins))
        distance, face, weights = (
            np.concatenate(halves) for halves in zip(first_half, second_half, strict=True)
        )
        return distance, face, weights

    def all(self, origins: ArrayLike, directions: ArrayLike) -> tuple[Index, Array, Index]:
        """Return every crossing of every ray at or beyond its origin.

        A crossing at an edge or a vertex appears once if its triangles face in the same direction.

        Arguments as in `first`.

        Returns:
            ray (m,), distance (m,), m, and face (m,), sorted by ray, then by distance.
        """
        rays = _rays(origins, directions)
        number, capacity = USUAL_CROSSINGS * len(rays[0]), -1
        while number > capacity:
            capacity = number
            ray, distance, face = (np.empty(capacity, kind) for kind in (np.int64, float, np.int64))
            number = _all_crossings(self.tree, *rays, ray, distance, face)
        return self._merged(ray[:number], distance[:number], face[:number], rays[1])

    def _merged(
        self, ray: Index, t: Array, face: Index, directions: Array
    ) -> tuple[Index, Array, Index]:
        """Return the sorted crossings, one for each place and facing."""
        along = directions[ray] if len(directions) > 1 else directions
        entering = (along * self.surface.face_normals[face]).sum(axis=1) < 0.0
        order = np.lexsort((face, t, entering, ray))
        ray, t, face, entering = ray[order], t[order], face[order], entering[order]
        same = (np.diff(ray) == 0) & (np.diff(t) <= self._same)
        keep = np.ones(len(ray), bool)
        keep[1:] = ~(same & (entering[1:] == entering[:-1]))
        ray, t, face = ray[keep], t[keep], face[keep]
        order = np.lexsort((t, ray))
        return ray[order], t[order], face[order]


def _rays(origins: ArrayLike, directions: ArrayLike) -> tuple[Array, Array]:
    rays = rows(origins), rows(directions)
    if len(rays[1]) not in (1, len(rays[0])):
        raise ValueError(f"{len(rays[1])} directions for {len(rays[0])} rays")
    return rays


@compiled_as_written
def _crossing(plane: Array, origin: Array, direction: Array) -> tuple[float, float, float]:
    """Return the distance (m) of a ray to a triangle's plane, and barycentrics 2 and 3.

    `plane` (12,): first corner, unit normal and `Surface.barycentric_rows`. The distance is inf for
    a parallel ray or a triangle without area.
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
    """Return the distance (m) at which a ray enters a box (6,); inf without a crossing.

    `slowness` (3,): inverse components of the unit direction.
    """
    enters, leaves = -np.inf, np.inf
    for axis in range(3):
        first = (box[axis] - origin[axis]) * slowness[axis]
        last = (box[axis + 3] - origin[axis]) * slowness[axis]
        enters, leaves = max(enters, min(first, last)), min(leaves, max(first, last))
    return enters if enters <= leaves and leaves >= 0.0 else np.inf


@compiled_as_written
def _set_direction(vector: Array, direction: Array, slowness: Array) -> None:
    """Write the unit vector of a vector (3,), and its finite inverse components; NaN, without
    crossings, for zero length.
    """
    length = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    for axis in range(3):
        along = vector[axis] / length
        direction[axis] = along
        slowness[axis] = 1.0 / along if abs(along) > STILL else 1.0 / STILL


@compiled_as_written
def first_crossing(
    tree: tuple[Array, Index, Array, float],
    origin: Array,
    vector: Array,
    guess: int,
    work: tuple[Array, Array, Index, Array],
) -> tuple[float, int]:
    """Return the distance of a ray's first crossing, and the place of its triangle in `tree`.

    Of equally near triangles it is the one of the lowest number; inf and -1 without a crossing.
    `tree`: see `RayCaster.tree`; `guess`: place of a triangle that the ray may cross, or -1;
    `vector` (3,) has any length but zero.
    """
    boxes, faces, planes, same = tree
    direction, slowness, stack, enters = work
    best, best_place = np.inf, NO_TRIANGLE
    _set_direction(vector, direction, slowness)
    if not np.isfinite(origin[0] + origin[1] + origin[2]):
        return best, best_place
    leaves = len(boxes) // 2
    leaf_size = len(faces) // leaves
    if guess >= 0:
        t, u, v = _crossing(planes[guess], origin, direction)
        if -same <= t < np.inf and min(u, v, 1.0 - u - v) >= -EDGE_TOLERANCE:
            best, best_place = t, guess
    stack[0], enters[0], size = 1, _entry(boxes[1], origin, slowness), 1
    while size > 0:
        size -= 1
        box = stack[size]
        if enters[size] > best or enters[size] == np.inf:
            continue
        if box >= leaves:
            for place in range((box - leaves) * leaf_size, (box - leaves + 1) * leaf_size):
                t, u, v = _crossing(planes[place], origin, direction)
                if t < -same or t > best or not min(u, v, 1.0 - u - v) >= -EDGE_TOLERANCE:
                    continue
                if t < best or faces[place] < faces[best_place]:
                    best, best_place = t, place
            continue
        near_box, far_box = 2 * box, 2 * box + 1
        near, far = (
            _entry(boxes[near_box], origin, slowness),
            _entry(boxes[far_box], origin, slowness),
        )
        if far < near:
            near_box, far_box, near, far = far_box, near_box, far, near
        if far < np.inf and far <= best:
            stack[size], enters[size] = far_box, far
            size += 1
        if near < np.inf and near <= best:
            stack[size], enters[size] = near_box, near
            size += 1
    return best, best_place


@compiled_as_written
def ray_work() -> tuple[Array, Array, Index, Array]:
    """Return the work arrays of `first_crossing`."""
    return np.empty(3), np.empty(3), np.empty(DEEPEST, np.int64), np.empty(DEEPEST)


@compiled_as_written
def _first_crossings(
    tree: tuple[Array, Index, Array, float], origins: Array, directions: Array
) -> tuple[Array, Index, Array]:
    """Return distance (n,), m, triangle (n,) and barycentrics (n, 3) of each ray's first crossing.

    inf, -1 and NaN without a crossing. `directions` (n, 3) of any length, or (1, 3) for all rays.
    """
    count, (_, faces, planes, _) = len(origins), tree
    distance, face = np.full(count, np.inf), np.full(count, NO_TRIANGLE)
    weights, work = np.full((count, 3), np.nan), ray_work()
    for n in range(count):
        vector = directions[n if len(directions) > 1 else 0]
        distance[n], place = first_crossing(tree, origins[n], vector, NO_TRIANGLE, work)
        if place >= 0:
            face[n] = faces[place]
            _, u, v = _crossing(planes[place], origins[n], work[0])
            weights[n, 0], weights[n, 1], weights[n, 2] = 1.0 - u - v, u, v
    return distance, face, weights


@compiled_as_written
def _all_crossings(
    tree: tuple[Array, Index, Array, float],
    origins: Array,
    directions: Array,
    ray: Index,
    distance: Array,
    face: Index,
) -> int:
    """Return the number of all crossings, and write those that fit (m,)."""
    boxes, faces, planes, same = tree
    leaves, number = len(boxes) // 2, 0
    leaf_size = len(faces) // leaves
    stack, direction, slowness = np.empty(DEEPEST, np.int64), np.empty(3), np.empty(3)
    for n in range(len(origins)):
        origin = origins[n]
        if n < len(directions):
            _set_direction(directions[n], direction, slowness)
        if not np.isfinite(origin[0] + origin[1] + origin[2]):
            continue
        stack[0], size = 1, 1
        while size > 0:
            size -= 1
            box = stack[size]
            if _entry(boxes[box], origin, slowness) == np.inf:
                continue
            if box < leaves:
                stack[size], stack[size + 1] = 2 * box, 2 * box + 1
                size += 2
                continue
            for place in range((box - leaves) * leaf_size, (box - leaves + 1) * leaf_size):
                t, u, v = _crossing(planes[place], origin, direction)
                if t < -same or t == np.inf or not min(u, v, 1.0 - u - v) >= -EDGE_TOLERANCE:
                    continue
                if number < len(ray):
                    ray[number], distance[number], face[number] = n, t, faces[place]
                number += 1
    return number
