"""How far the femoral component must travel along -y until it first touches the insert."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tkamb.geometry.bounds import HeightBound, Patches
from tkamb.geometry.frames import Array, Index, Mask, inverse, rotate, transform
from tkamb.geometry.ragged import Ragged
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import each_edge

UP = np.array([0.0, 1.0, 0.0])
EDGE_BAND = 0.03
"""Edges whose ends lie within this share of their length of the smallest clearance are tried
against each other: the sagitta of a chord over a radius of four chords."""
MOST_EDGES = 1500
FIRST_PATCHES = 12
FIRST_LOOK = 64
"""So many promising vertices of so many patches give the bound that spares the others a ray."""
CLEARANCE_ROUNDING = 1e-12
"""m; what a bound may be wrong by."""


@dataclass(frozen=True, eq=False)
class Touch:
    """Where one condyle comes down first.

    Args:
        travel: m along -y until it touches; negative when it is in the insert already.
        point: (3,) m, insert frame, on the insert.
    """

    travel: float
    point: Array


class FirstTouch:
    """Vertical clearance between two triangulated surfaces, exact for their triangles.

    The clearance of two piecewise linear surfaces over x and z is smallest where a vertex of
    one meets the other, or where two edges cross in the projection. The boxes about small
    patches of the femoral component and the insert's largest height under each of them bound
    the clearance from below; vertices are tried only where that does not rule them out, and
    the edges near the smallest clearance. The insert is taken as seen from above, the femoral
    component as seen from below.

    Args:
        femoral: in the femoral frame.
        insert: in the insert frame.
        split: z between the condyles in the femoral frame, m; None: one condyle (medial).
    """

    def __init__(self, femoral: Surface, insert: Surface, split: float | None = None) -> None:
        self._femoral, self._insert, self._split = femoral, insert, split
        self._insert_tops = _with_face_towards(insert, UP)
        self._femoral_edges = _Edges(femoral, np.ones(len(femoral.vertices), bool))
        self._insert_edges = _Edges(insert, self._insert_tops)
        self._height_bound = HeightBound(insert, self._insert_edges.reach)
        self._patches = Patches(femoral, self._femoral_edges.reach)

    def at(self, pose: ArrayLike) -> tuple[Touch | None, Touch | None]:
        """Return the touch of the medial and of the lateral condyle.

        None where no part of that condyle lies over the insert.

        Args:
            pose: (4, 4) pose_femoral_in_insert; its y is where the travel starts.
        """
        pose = np.asarray(pose, float)
        if self._split is None:
            return self._touch(pose, None), None
        return self._touch(pose, 0), self._touch(pose, 1)

    def travel(self, pose: ArrayLike) -> float:
        """Return the travel (m) until either condyle touches; NaN if none lies over the insert."""
        touch = self.either(pose)
        return float("nan") if touch is None else touch.travel

    def either(self, pose: ArrayLike) -> Touch | None:
        """Return the first touch of either condyle; None if none lies over the insert."""
        return self._touch(np.asarray(pose, float), None)

    def _touch(self, pose: Array, side: int | None) -> Touch | None:
        """Return the touch of one condyle, 0 (medial) or 1 (lateral), or of either."""
        patches, least = self._near_patches(pose)
        look, _ = self._bottoms(pose, patches[np.argsort(least)[:FIRST_PATCHES]], side)
        look = look[np.argsort(self._at_least(pose, look))[:FIRST_LOOK]]
        bound = self._over_insert(self._placed(pose, look)).min(initial=np.inf)
        near = patches[least <= bound + self._patches.reach[patches]]
        bottoms, faces = self._bottoms(pose, near, side)
        reach = self._femoral_edges.reach[bottoms]
        bottoms = bottoms[self._at_least(pose, bottoms) <= bound + reach]
        clearance = self._over_insert(self._placed(pose, bottoms))
        bound = clearance.min(initial=np.inf)
        tops = self._near_tops(pose, faces, bound, side)
        under = self._under_femoral(pose, self._insert.vertices[tops])
        return self._lowest(pose, (bottoms, clearance), (tops, under))

    def _near_patches(self, pose: Array) -> tuple[Index, Array]:
        """Return the femoral patches over the insert and lower bounds of their clearance."""
        low, high = self._patches.extent(pose)
        planes = self._height_bound.planes(low[:, ::2], high[:, ::2])
        over = np.flatnonzero(np.isfinite(planes[:, 2]))
        least = self._patches.least(pose, over, _normals_of(planes[over]))
        return over, least - planes[over, 2] - CLEARANCE_ROUNDING

    def _placed(self, pose: Array, vertices: Index) -> Array:
        return transform(pose, self._femoral.vertices[vertices])

    def _bottoms(self, pose: Array, patches: Index, side: int | None) -> tuple[Index, Index]:
        """Return the vertices of a side and all triangles in the patches that face down."""
        faces = self._patches.faces(patches)
        faces = faces[self._femoral.face_normals[faces] @ rotate(pose.T, -UP) > 0]
        vertices = np.unique(self._femoral.faces[faces])
        if side is not None and self._split is not None:
            lateral = self._femoral.vertices[vertices, 2] >= self._split
            vertices = vertices[lateral == bool(side)]
        return vertices, faces

    def _at_least(self, pose: Array, vertices: Index) -> Array:
        """Return a lower bound (n,) of the clearance of femoral vertices; inf beside the insert."""
        points = self._placed(pose, vertices)
        least = points[:, 1] - self._height_bound.over(points) - CLEARANCE_ROUNDING
        return np.where(_within(points, self._insert.bounds), least, np.inf)

    def _near_tops(self, pose: Array, faces: Index, bound: float, side: int | None) -> Index:
        """Return the insert's vertices over which one of the triangles may be low enough."""
        corners = [transform(pose, self._femoral.triangles[faces, corner]) for corner in range(3)]
        low, high = np.minimum.reduce(corners)[:, ::2], np.maximum.reduce(corners)[:, ::2]
        planes = self._height_bound.planes(low, high)
        normals = _normals_of(planes)
        above = np.minimum.reduce([np.einsum("ij,ij->i", c, normals) for c in corners])
        near = above - planes[:, 3] - CLEARANCE_ROUNDING <= bound
        tops = self._height_bound.vertices_in_rectangles(low[near], high[near])
        tops = tops[self._insert_tops[tops]]
        if side is not None and self._split is not None:
            z = transform(inverse(pose), self._insert.vertices[tops])[:, 2]
            tops = tops[(z >= self._split) == bool(side)]
        return tops

    def _over_insert(self, points: Array) -> Array:
        start = points.copy()
        start[:, 1] = self._insert.bounds[1, 1] + 1e-3
        distance, _ = self._insert.rays.first(start, -UP)
        return points[:, 1] - start[:, 1] + distance

    def _under_femoral(self, pose: Array, points: Array) -> Array:
        start, back = points.copy(), inverse(pose)
        radius = float(np.abs(self._femoral.bounds).max())
        start[:, 1] = pose[1, 3] - 2 * radius - 1e-3
        distance, _ = self._femoral.rays.first(transform(back, start), rotate(back, UP))
        return start[:, 1] + distance - points[:, 1]

    def _lowest(
        self, pose: Array, bottoms: tuple[Index, Array], tops: tuple[Index, Array]
    ) -> Touch | None:
        """Return the lowest of the vertices' clearances and the edges' near them."""
        points = self._placed(pose, bottoms[0])
        f, i = (int(np.argmin(c)) if len(c) else -1 for _, c in (bottoms, tops))
        lowest = [float(c[k]) if k >= 0 else np.inf for (_, c), k in ((bottoms, f), (tops, i))]
        if not np.isfinite(min(lowest)):
            return None
        if lowest[0] < lowest[1]:
            best = Touch(lowest[0], points[f] - lowest[0] * UP)
        else:
            best = Touch(lowest[1], self._insert.vertices[tops[0][i]].copy())
        a = self._femoral_edges.near(*bottoms, best.travel)
        b = self._insert_edges.near(*tops, best.travel)
        upper = self._placed(pose, a.ravel()).reshape(-1, 2, 3)
        crossing = _crossing(upper, self._insert.vertices[b])
        return best if crossing is None or crossing.travel >= best.travel else crossing


class _Edges:
    """The edges of a surface between chosen vertices (n,), by the vertices that they join.

    Attributes:
        reach: (n,) m, how far above the smallest clearance a vertex may be whose edges count.
    """

    def __init__(self, surface: Surface, chosen: Mask) -> None:
        edges = each_edge(surface.faces)
        self._ends = edges[chosen[edges].all(axis=1)]
        ends = surface.vertices[self._ends]
        self._band = EDGE_BAND * np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        self._band += np.median(self._band) if len(self._band) else 0.0
        corner = self._ends.ravel()
        self._at_vertex = Ragged.by_key(corner, len(surface.vertices))
        self.reach = np.zeros(len(surface.vertices))
        np.maximum.at(self.reach, corner, np.repeat(self._band, 2))

    def near(self, vertices: Index, clearance: Array, smallest: float) -> Index:
        """Return the edges (k, 2) with an end close to the smallest clearance (m).

        Args:
            vertices: (n,) whose clearance is known.
            clearance: (n,) m.
            smallest: m.
        """
        above = clearance - smallest
        close = np.flatnonzero(above <= self.reach[vertices])
        vertex, corner = self._at_vertex.of(vertices[close])
        edges = corner // 2
        beyond = above[close][vertex] - self._band[edges]
        order = np.argsort(beyond, kind="stable")
        edges = edges[order[beyond[order] <= 0]]
        return self._ends[np.unique(edges[: 2 * MOST_EDGES])]


def _with_face_towards(surface: Surface, direction: Array) -> Mask:
    """Say which vertices (n,) belong to a triangle that faces `direction`."""
    facing = surface.faces[surface.face_normals @ direction > 0]
    mask = np.zeros(len(surface.vertices), bool)
    mask[facing.ravel()] = True
    return mask


def _normals_of(planes: Array) -> Array:
    """Return d (n, 3) with d . x the height of x over the slopes of planes (n, 4)."""
    return np.stack([-planes[:, 0], np.ones(len(planes)), -planes[:, 1]], axis=1)


def _within(points: Array, bounds: Array) -> Mask:
    """Say which points (n, 3) lie within bounds (2, 3) in x and z."""
    x, z, (low, high) = points[:, 0], points[:, 2], bounds
    return (x >= low[0]) & (x <= high[0]) & (z >= low[2]) & (z <= high[2])


def _crossing(upper: Array, lower: Array) -> Touch | None:
    """Return the lowest crossing in projection of edges (m, 2, 3) over edges (n, 2, 3)."""
    pairs = _overlapping(upper[:, :, ::2], lower[:, :, ::2])
    p, q = upper[pairs[0], 0], lower[pairs[1], 0]
    u, v = upper[pairs[0], 1] - p, lower[pairs[1], 1] - q
    w = q - p
    determinant = u[:, 0] * v[:, 2] - u[:, 2] * v[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (w[:, 0] * v[:, 2] - w[:, 2] * v[:, 0]) / determinant
        t = (w[:, 0] * u[:, 2] - w[:, 2] * u[:, 0]) / determinant
        inside = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        clearance = np.where(inside, p[:, 1] + s * u[:, 1] - q[:, 1] - t * v[:, 1], np.inf)
    if not np.isfinite(clearance.min(initial=np.inf)):
        return None
    k = int(clearance.argmin())
    return Touch(float(clearance[k]), q[k] + t[k] * v[k])


def _overlapping(upper: Array, lower: Array) -> tuple[Index, Index]:
    """Return the pairs (k,), (k,) of edges (m, 2, 2) and (n, 2, 2) whose boxes overlap."""
    first, last = upper.min(axis=1), upper.max(axis=1)
    low, high = lower.min(axis=1), lower.max(axis=1)
    i, j = np.nonzero((first[:, None, 0] <= high[:, 0]) & (last[:, None, 0] >= low[:, 0]))
    both = (first[i, 1] <= high[j, 1]) & (last[i, 1] >= low[j, 1])
    return i[both], j[both]
