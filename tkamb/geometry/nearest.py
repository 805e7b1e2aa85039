"""Nearest points of a triangulated surface."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from tkamb.geometry.frames import Array, Index
from tkamb.geometry.normals import NO_CREASE, corner_normals, interpolated

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


_MOST_SAMPLES = 150_000
_CANDIDATES = 8
_BATCH = 512
LEAF = 32
"""Samples of a leaf of the tree; an unbalanced one of leaves twice the default size is built and
asked a third faster."""
FLAT = 1e-14
"""A triangle whose squared area is less, relative to its edges', has no plane."""


@dataclass(frozen=True, eq=False)
class Nearest:
    """Nearest points of a surface to n points.

    Args:
        distance: (n,) m.
        points: (n, 3) m, on the surface.
        faces: (n,) triangle of each.
        surface: whose points they are.
    """

    distance: Array
    points: Array
    faces: Index
    surface: "NearestPoints"

    @cached_property
    def normals(self) -> Array:
        """Unit normals (n, 3) there, interpolated from the vertices."""
        return self.surface.normals_at(self.points, self.faces)


class NearestPoints:
    """Answers for the nearest points of one surface.

    Samples of the surface in a k-d tree pick a few triangles for each point; the nearest
    point of those triangles is exact. A triangle can be missed only where another one is as
    near to within second order of the spacing (tested against all triangles: < 1 µm at the
    default spacing on implants).
    """

    def __init__(self, surface: "Surface", spacing: float = 7e-4) -> None:
        self.surface = surface
        self._samples, self._faces, _ = sampled(surface, spacing)
        self._tree = cKDTree(self._samples, leafsize=LEAF, balanced_tree=False)

    @cached_property
    def _corner_normals(self) -> Array:
        """Unit normals (k, 3, 3) of the vertices, weighted by the areas of their triangles."""
        area = self.surface.areas[:, None] * np.ones(3)
        return corner_normals(self.surface, NO_CREASE, area)

    def at(self, points: ArrayLike) -> Nearest:
        """Return the nearest points to `points` (n, 3), m, in the surface's frame."""
        points = np.asarray(points, float).reshape(-1, 3)
        count = min(_CANDIDATES, len(self._faces))
        near = self._tree.query(points, k=count)[1].reshape(len(points), count)
        candidates = self._faces[near]
        best = self._squared_distances(points, candidates).argmin(axis=1)
        faces = candidates[np.arange(len(points)), best]
        feet = nearest_on_triangles(self.surface.triangles[faces], points)
        return Nearest(np.linalg.norm(feet - points, axis=1), feet, faces, self)

    def farthest(self, points: Array) -> float:
        """Return the largest of the distances `at` points (n, 3), m.

        The nearest sample's bounds each from above, so that few are measured.
        """
        bound = self._tree.query(points)[0]
        order, largest = np.argsort(-bound), 0.0
        for start in range(0, len(order), _BATCH):
            batch = order[start : start + _BATCH]
            if bound[batch[0]] <= largest:
                break
            largest = max(largest, float(self.at(points[batch]).distance.max()))
        return largest

    @cached_property
    def _edges(self) -> tuple[Array, Array, Array, Array]:
        """First corner (k, 3), the edges from it to the others, and their products (k, 3)."""
        a, b, c = np.moveaxis(self.surface.triangles, 1, 0)
        u, v = b - a, c - a
        return a, u, v, np.stack([_dot(u, u), _dot(u, v), _dot(v, v)], axis=1)

    def _squared_distances(self, points: Array, faces: Index) -> Array:
        """Return the squared distance (n, m), m², of points (n, 3) to triangles (n, m).

        By the products of w, from the first corner to the point, and the edges u and v: where
        the foot on the plane lies outside, the least of the distances to the three edges.
        """
        corner, u, v, products = self._edges
        uu, uv, vv = np.moveaxis(products[faces], -1, 0)
        w = points[:, None] - corner[faces]
        wu, wv = np.einsum("ijk,ijk->ij", w, u[faces]), np.einsum("ijk,ijk->ij", w, v[faces])
        ww = np.einsum("ijk,ijk->ij", w, w)
        area = uu * vv - uv * uv
        area = np.where(area > FLAT * uu * vv, area, np.nan)
        second, third = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
        within = (second >= 0) & (third >= 0) & (second + third <= 1)
        across, length = uu - uv + wv - wu, uu - 2 * uv + vv  # of the edge between the others
        edges = ww - _gain(wu, uu), ww - _gain(wv, vv), ww - 2 * wu + uu - _gain(across, length)
        return np.where(within, ww - second * wu - third * wv, np.minimum.reduce(edges))

    @cached_property
    def _spacing(self) -> float:
        """The longest edge of the parts of triangles that samples are the centres of, m."""
        cuts = np.sqrt(np.bincount(self._faces))
        return float((self.surface.longest_edges / cuts).max())

    def heights(self, points: Array, reach: float) -> Array:
        """Return the heights (n,) of points (n, 3) above the surface's nearest sample, m.

        A quick estimate of the signed distance for points near a smooth part: the error is
        of second order in the spacing of the samples. Infinite where the surface is sure to be
        farther away than `reach`, m, which the tree says ten times as fast.
        """
        bound = reach + self._spacing
        distance, sample = self._tree.query(points, distance_upper_bound=bound)
        near, heights = np.isfinite(distance), np.full(len(points), np.inf)
        sample = sample[near]
        heights[near] = _dot(points[near] - self._samples[sample], self._sample_normals[sample])
        return heights

    @cached_property
    def _sample_normals(self) -> Array:
        return self.normals_at(self._samples, self._faces)

    def normals_at(self, points: Array, faces: Index) -> Array:
        """Return the interpolated unit normals (n, 3) at points (n, 3) of given triangles."""
        return interpolated(self.surface, self._corner_normals, points, faces)


def sampled(surface: "Surface", spacing: float) -> tuple[Array, Index, Array]:
    """Return samples (n, 3) that cover every triangle, the triangle (n,) and area (n,) of each.

    A triangle is cut into n² like ones so that no edge is longer than the spacing; the
    samples are their centres. The spacing grows where a surface would need more than
    150 000 samples.
    """
    triangles = surface.triangles
    longest = surface.longest_edges
    cuts = np.maximum(np.ceil(longest / spacing).astype(int), 1)
    while (cuts**2).sum() > max(_MOST_SAMPLES, len(triangles)) and cuts.max() > 1:
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


def nearest_on_triangles(triangles: Array, points: Array) -> Array:
    """Return for each point (n, 3) the nearest one (n, 3) of its own triangle (n, 3, 3).

    The foot on the triangle's plane where that lies inside, else the nearest of the feet on
    the three edges. Free of absolute tolerances, so right for triangles of any size.
    """
    weights = _plane_weights(triangles, points)
    feet = np.einsum("ij,ijk->ik", weights, triangles)
    outside = ~(weights >= 0).all(axis=1)
    start, target = triangles[outside], points[outside, None]
    along = np.roll(start, -1, axis=1) - start
    length = np.einsum("ijk,ijk->ij", along, along)
    part = np.einsum("ijk,ijk->ij", target - start, along)
    part = np.clip(np.divide(part, length, out=np.zeros_like(part), where=length > 0), 0, 1)
    on_edges = start + part[:, :, None] * along
    nearest = ((on_edges - target) ** 2).sum(axis=2).argmin(axis=1)
    feet[outside] = on_edges[np.arange(len(start)), nearest]
    return feet


def _plane_weights(triangles: Array, points: Array) -> Array:
    """Return barycentric coordinates (n, 3) of the feet on the planes; NaN without area."""
    a = triangles[:, 0]
    u, v, w = triangles[:, 1] - a, triangles[:, 2] - a, points - a
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    wu, wv = _dot(w, u), _dot(w, v)
    scale = uu * vv - uv * uv
    scale = np.where(scale > FLAT * uu * vv, scale, np.nan)
    second, third = (vv * wu - uv * wv) / scale, (uu * wv - uv * wu) / scale
    return np.stack([1 - second - third, second, third], axis=1)


def _gain(along: Array, length: Array) -> Array:
    """Return by how much m² the foot on an edge is nearer than its start.

    Args:
        along: m², product of the edge and the way from its start to the point.
        length: m², of the edge.
    """
    part = np.clip(np.divide(along, length, out=np.zeros_like(along), where=length > 0), 0, 1)
    return np.asarray(part * (2 * along - part * length))


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ij,ij->i", a, b)


def _centres(n: int) -> Array:
    """Return barycentric centres (n², 3) of a triangle cut n times along each edge."""
    i, j = np.divmod(np.arange(n * n), n)
    upright, inverted = i + j < n, i + j < n - 1
    first = np.concatenate([i[upright] + 1 / 3, i[inverted] + 2 / 3]) / n
    second = np.concatenate([j[upright] + 1 / 3, j[inverted] + 2 / 3]) / n
    return np.stack([1 - first - second, first, second], axis=1)
