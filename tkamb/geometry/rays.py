"""Rays against a triangulated surface: embree finds the triangle, float64 the distance.

Embree works in single precision: on an 80 mm part it misplaces a crossing by about 10 nm and
may name the neighbour of the triangle that the ray really crosses. Here it only proposes. Its
copy of the surface is centred and scaled to unit size, rays start at the surface's bounding
sphere, and every triangle that shares a vertex with the proposed one is then intersected in
double precision. Rays that embree misses are offered once more from four points beside them,
so that a ray along a rim, or through an edge, still finds what it touches.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike

from tkamb.geometry.frames import Array, Index, Mask

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


EDGE_TOLERANCE = 1e-9
"""How far outside a triangle, in barycentric units, a crossing still belongs to it."""
SAME_CROSSING = 1e-10
"""Crossings of one ray nearer than this, relative to the part's radius, are one crossing."""
NUDGE = 2e-6
"""Step past a crossing, and beside a ray that missed, relative to the part's radius."""
PARALLEL = 1e-9
"""Sine of the angle to a triangle's plane below which a ray does not cross it."""


class RayCaster:
    """Crossings of rays with one surface.

    A ray that touches an edge or vertex of the surface's outline may be a hit or a miss; on
    edges and vertices inside the surface there are no leaks. Distances are exact to rounding
    (about 1e-16 m over the sine of the incidence) in the plane of the triangle reported.

    Args:
        surface: (n, 3) vertices in metres, any frame; rays are given in the same frame.
    """

    def __init__(self, surface: "Surface") -> None:
        self.surface = surface
        lower, upper = surface.bounds
        self._centre = 0.5 * (lower + upper)
        self._radius = float(np.linalg.norm(upper - lower)) / 2.0
        self._nudge = NUDGE * self._radius
        rows = surface.barycentric_rows.reshape(-1, 6)
        self._planes = np.hstack([surface.triangles[:, 0], surface.face_normals, rows])
        self._narrowest = _least_altitudes(surface)
        self._scene: Any = EmbreeScene(robust=True)
        scaled = ((surface.vertices - self._centre) / self._radius).astype(np.float32)
        TriangleMesh(self._scene, scaled, surface.faces.astype(np.int32))

    def first(self, origins: ArrayLike, directions: ArrayLike) -> tuple[Array, Index]:
        """Return the nearest crossing of each ray at or beyond its origin.

        Args:
            origins: (n, 3) m.
            directions: (n, 3) or (3,), any length but zero.

        Returns:
            distance (n,) m, inf where nothing is hit; face (n,), -1 where nothing is hit.
        """
        distance, face, _ = self.first_in_face(origins, directions)
        return distance, face

    def first_in_face(
        self, origins: ArrayLike, directions: ArrayLike
    ) -> tuple[Array, Index, Array]:
        """Return what `first` does, and where in the triangle each ray crosses.

        Returns:
            distance (n,) m, face (n,), barycentric coordinates (n, 3), NaN where nothing is hit.
        """
        origins, directions, start = self._prepared(origins, directions)
        face = self._propose(origins, directions, start)
        distance, weights = self._intersect(origins, directions, face)
        inside = (weights.min(axis=1) > EDGE_TOLERANCE) & (distance > start + self._nudge)
        left = np.flatnonzero(~inside & (face >= 0))
        if left.size:
            ray, t, hit = self._around(origins[left], directions[left], start[left], face[left])
            order = np.lexsort((t, ray))
            ray, t, hit = ray[order], t[order], hit[order]
            found, head = np.unique(ray, return_index=True)
            distance[left], face[left] = np.inf, -1
            distance[left[found]], face[left[found]] = t[head], hit[head]
            self._look_behind(origins, directions, distance, face, left)
            hit = left[face[left] >= 0]
            points = origins[hit] + distance[hit, None] * directions[hit]
            weights[hit] = self.surface.barycentric(points, face[hit])
        weights[face < 0] = np.nan
        return distance, face, weights

    def all(self, origins: ArrayLike, directions: ArrayLike) -> tuple[Index, Array, Index]:
        """Return every crossing of every ray at or beyond its origin.

        A crossing at an edge or vertex shared by triangles that face the same way is reported
        once. Two sheets nearer to each other than about 2e-6 of the part's radius that share
        no vertex may be reported as one.

        Args:
            origins: (n, 3) m.
            directions: (n, 3) or (3,), any length but zero.

        Returns:
            ray (m,), distance (m,) m and face (m,), sorted by ray, then by distance.
        """
        origins, directions, start = self._prepared(origins, directions)
        live = np.arange(len(origins))
        step = np.full(len(origins), self._nudge)
        last = np.full(len(origins), -1)
        begin = start.copy()
        found: list[tuple[Index, Array, Index]] = []
        while live.size:
            at = start[live]
            face = self._propose(origins[live], directions[live], at)
            reached = self._crossings_at(origins, directions, begin, live, face, found)
            step[live] = np.where(face == last[live], 2.0 * step[live], self._nudge)
            start[live] = np.maximum(at, np.where(np.isfinite(reached), reached, at)) + step[live]
            last[live] = face
            live = live[face >= 0]
        return self._merged(found, directions)

    def _crossings_at(
        self,
        origins: Array,
        directions: Array,
        begin: Array,
        live: Index,
        face: Index,
        found: list[tuple[Index, Array, Index]],
    ) -> Array:
        """Append the crossings at proposed triangles; return the distances to their planes.

        A crossing farther inside its triangle than two nudges stands alone; otherwise the
        triangles around are asked too.
        """
        t, weights = self._intersect(origins[live], directions[live], face)
        alone = weights.min(axis=1) * self._narrowest[face] > 2.0 * self._nudge
        alone &= t >= begin[live]
        found.append((live[alone], t[alone], face[alone]))
        rest = np.flatnonzero(~alone & (face >= 0))
        at = live[rest]
        ray, near, hit = self._around(origins[at], directions[at], begin[at], face[rest])
        found.append((at[ray], near, hit))
        return self._plane_distance(origins[live], directions[live], face)

    def _prepared(self, origins: ArrayLike, directions: ArrayLike) -> tuple[Array, Array, Array]:
        """Return origins, unit directions and the distance at which each ray's search begins."""
        origins = np.atleast_2d(np.asarray(origins, float))
        directions = np.asarray(directions, float)
        directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        directions = np.ascontiguousarray(np.broadcast_to(directions, origins.shape))
        nearest = np.einsum("ij,ij->i", self._centre - origins, directions)
        return origins, directions, np.maximum(nearest - 1.01 * self._radius, 0.0)

    def _propose(self, origins: Array, directions: Array, start: Array) -> Index:
        """Return the triangle that embree finds first beyond `start`, -1 for none."""
        points = origins + start[:, None] * directions
        face = self._fire(points, directions)
        missed = np.flatnonzero(face < 0)
        missed = missed[self._meets_sphere(points[missed], directions[missed])]
        if not missed.size:
            return face
        u, v = _normal_plane(directions[missed])
        step = self._nudge
        beside = [points[missed] + step * (a * u + b * v) for a in (1, -1) for b in (1, -1)]
        found = self._fire(np.concatenate(beside), np.tile(directions[missed], (4, 1)))
        found = found.reshape(4, -1)
        face[missed] = found[(found >= 0).argmax(axis=0), np.arange(len(missed))]
        return face

    def _fire(self, points: Array, directions: Array) -> Index:
        if not len(points):
            return np.zeros(0, np.int64)
        scaled = ((points - self._centre) / self._radius).astype(np.float32)
        return np.asarray(self._scene.run(scaled, directions.astype(np.float32)), np.int64)

    def _meets_sphere(self, points: Array, directions: Array) -> Mask:
        offset = self._centre - points
        along = np.einsum("ij,ij->i", offset, directions)
        off_axis = np.linalg.norm(offset - along[:, None] * directions, axis=1)
        return (off_axis <= 1.01 * self._radius) & (along >= -self._radius)

    def _intersect(self, origins: Array, directions: Array, face: Index) -> tuple[Array, Array]:
        """Return the distance to each triangle's plane and the barycentrics (n, 3) there."""
        corner, normal, rows = np.split(self._planes[face], [3, 6], axis=1)
        offset = origins - corner
        slope = np.einsum("ij,ij->i", directions, normal)
        height = np.einsum("ij,ij->i", offset, normal)
        lost = (face < 0) | ~(np.abs(slope) >= PARALLEL)
        t = -height / np.where(lost, 1.0, slope)
        there = offset + t[:, None] * directions
        u, v = np.einsum("nij,nj->in", rows.reshape(-1, 2, 3), there)
        weights = np.stack([1.0 - u - v, u, v], axis=1)
        lost |= ~np.isfinite(weights[:, 0])
        t[lost], weights[lost] = np.inf, -np.inf
        return t, weights

    def _around(
        self, origins: Array, directions: Array, start: Array, face: Index
    ) -> tuple[Index, Array, Index]:
        """Return crossings (ray, distance, face) with triangles at the vertices of `face`."""
        ray, candidate = self._sharing_a_vertex(face)
        t, weights = self._intersect(origins[ray], directions[ray], candidate)
        keep = (weights.min(axis=1) >= -EDGE_TOLERANCE) & (
            t >= start[ray] - SAME_CROSSING * self._radius
        )
        return ray[keep], t[keep], candidate[keep]

    def _sharing_a_vertex(self, face: Index) -> tuple[Index, Index]:
        """Return (place in `face`, triangle) of all at the vertices of each `face` but -1."""
        known, count = np.flatnonzero(face >= 0), len(self.surface.faces)
        vertices = self.surface.corner_vertices[face[known]].ravel()
        place, corner = self.surface.corners_at_vertices.of(vertices)
        key = np.unique(known[place // 3] * count + corner // 3)  # each pair once
        return key // count, key % count

    def _look_behind(
        self, origins: Array, directions: Array, distance: Array, face: Index, left: Index
    ) -> None:
        """Fire again behind proposals that the exact test refused (outline, in place)."""
        again = left[face[left] < 0]
        if not again.size:
            return
        ray, t, hit = self.all(origins[again], directions[again])
        found, head = np.unique(ray, return_index=True)
        distance[again[found]], face[again[found]] = t[head], hit[head]

    def _plane_distance(self, origins: Array, directions: Array, face: Index) -> Array:
        corner, normal, _ = np.split(self._planes[face], [3, 6], axis=1)
        height = np.einsum("ij,ij->i", corner - origins, normal)
        slope = np.einsum("ij,ij->i", directions, normal)
        safe = (face >= 0) & (np.abs(slope) > PARALLEL)
        return np.divide(height, slope, out=np.full(len(face), np.inf), where=safe)

    def _merged(
        self, found: list[tuple[Index, Array, Index]], directions: Array
    ) -> tuple[Index, Array, Index]:
        """Return the crossings sorted, one per place and facing."""
        ray = np.concatenate([part[0] for part in found] or [np.zeros(0, np.int64)])
        t = np.concatenate([part[1] for part in found] or [np.zeros(0)])
        face = np.concatenate([part[2] for part in found] or [np.zeros(0, np.int64)])
        entering = np.einsum("ij,ij->i", directions[ray], self.surface.face_normals[face]) < 0.0
        order = np.lexsort((face, t, entering, ray))
        ray, t, face, entering = ray[order], t[order], face[order], entering[order]
        same = (np.diff(ray) == 0) & (np.diff(t) <= SAME_CROSSING * self._radius)
        keep = np.ones(len(ray), bool)
        keep[1:] = ~(same & (entering[1:] == entering[:-1]))
        ray, t, face = ray[keep], t[keep], face[keep]
        order = np.lexsort((t, ray))
        return ray[order], t[order], face[order]


def _least_altitudes(surface: "Surface") -> Array:
    """Return the least altitude (k,) of every triangle, m."""
    edges = np.roll(surface.triangles, 1, axis=1) - surface.triangles
    doubled = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    longest = surface.longest_edges
    return np.divide(doubled, longest, out=np.zeros_like(doubled), where=longest > 0.0)


def _normal_plane(directions: Array) -> tuple[Array, Array]:
    """Return two unit vectors (n, 3) normal to each unit direction and to each other.

    Duff et al., J Comput Graph Tech 6(1):1 (2017).
    """
    x, y, z = directions.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return u, np.stack([b, sign + y * y * a, -y], axis=1)
