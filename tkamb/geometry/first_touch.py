"""How far the femoral component must travel along -y until it first touches the insert."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tkamb.geometry.ceiling import Ceiling
from tkamb.geometry.frames import Array, inverse, rotate, transform
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

UP = np.array([0.0, 1.0, 0.0])
EDGE_BAND = 0.03
"""Edges whose ends lie within this share of their length of the smallest clearance are tried
against each other: the sagitta of a chord over a radius of four chords."""
MOST_EDGES = 1500
FIRST_LOOK = 64
"""So many promising vertices of each condyle give the bound that spares the others a ray."""


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
    one meets the other, or where two edges cross in the projection. Every vertex is tried
    that a coarse bound of the insert's height does not rule out, and the edges near the
    smallest clearance of those. The insert is taken as seen from above, the femoral
    component as seen from below.

    Args:
        femoral: in the femoral frame.
        insert: in the insert frame.
        split: z between the condyles in the femoral frame, m; None: one condyle (medial).
    """

    def __init__(self, femoral: Surface, insert: Surface, split: float | None = None) -> None:
        self._femoral, self._insert, self._split = femoral, insert, split
        self._femoral_rays, self._insert_rays = RayCaster(femoral), RayCaster(insert)
        self._femoral_edges = np.asarray(femoral.mesh.edges_unique, np.int64)
        self._insert_edges = np.asarray(insert.mesh.edges_unique, np.int64)
        self._insert_tops = _with_face_towards(insert, UP)
        self._ceiling = Ceiling(insert)

    def at(self, pose: ArrayLike) -> tuple[Touch | None, Touch | None]:
        """Return the touch of the medial and of the lateral condyle.

        None where no part of that condyle lies over the insert.

        Args:
            pose: (4, 4) pose_femoral_in_insert; its y is where the travel starts.
        """
        pose = np.asarray(pose, float)
        femoral = transform(pose, self._femoral.vertices)
        sides = self._sides(pose)
        clearances = self._clearances(pose, femoral, sides)
        edges = (
            _finite_edges(self._femoral_edges, clearances[0]),
            _finite_edges(self._insert_edges, clearances[1]),
        )
        return tuple(  # type: ignore[return-value]
            self._lowest(femoral, clearances, (sides[0] == side, sides[1] == side), edges)
            for side in (0, 1)
        )

    def travel(self, pose: ArrayLike) -> float:
        """Return the travel (m) until either condyle touches; NaN if none lies over the insert."""
        touches = [touch.travel for touch in self.at(pose) if touch is not None]
        return min(touches, default=float("nan"))

    def _sides(self, pose: Array) -> tuple[Index, Index]:
        """Return 0 (medial) or 1 (lateral) for the vertices of both bodies."""
        if self._split is None:
            return tuple(np.zeros(len(s.vertices), int) for s in (self._femoral, self._insert))  # type: ignore[return-value]
        insert = transform(inverse(pose), self._insert.vertices)
        z = (self._femoral.vertices[:, 2], insert[:, 2])
        return (z[0] >= self._split).astype(int), (z[1] >= self._split).astype(int)

    def _clearances(
        self, pose: Array, femoral: Array, sides: tuple[Index, Index]
    ) -> tuple[Array, Array]:
        """Return the clearance at the vertices of both; inf where there is none, or too high."""
        over = _within(femoral, self._insert.bounds)
        down = self._femoral.face_normals @ rotate(pose.T, -UP) > 0
        bottom = np.zeros(len(femoral), bool)
        bottom[self._femoral.faces[down].ravel()] = True
        bottoms = np.flatnonzero(over & bottom)
        at_least = femoral[bottoms, 1] - self._ceiling.over(femoral[bottoms])
        of_femoral = np.full(len(femoral), np.inf)
        bounds = np.full(2, np.inf)
        for side in (0, 1):
            mine = np.flatnonzero(sides[0][bottoms] == side)
            look = bottoms[mine[np.argsort(at_least[mine])[:FIRST_LOOK]]]
            of_femoral[look] = self._over_insert(femoral[look])
            bounds[side] = of_femoral[look].min(initial=np.inf)
        bound = bounds[sides[0]]
        rest = bottoms[(at_least <= bound[bottoms]) & ~np.isfinite(of_femoral[bottoms])]
        of_femoral[rest] = self._over_insert(femoral[rest])
        of_insert = np.full(len(self._insert.vertices), np.inf)
        tops = self._near_tops(femoral, np.flatnonzero(down), bound)
        of_insert[tops] = self._under_femoral(pose, femoral, self._insert.vertices[tops])
        return of_femoral, of_insert

    def _near_tops(self, femoral: Array, down: Index, bound: Array) -> Index:
        """Return the insert's vertices over which a femoral triangle may be low enough.

        `bound` (n,) is the clearance known for the side of each femoral vertex.
        """
        extent = np.stack([femoral.min(axis=0), femoral.max(axis=0)])
        tops = self._insert_tops & _within(self._insert.vertices, extent)
        faces = self._femoral.faces[down]
        a, b, c = (femoral[faces[:, corner]] for corner in range(3))
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        highest = np.maximum.reduce([bound[faces[:, corner]] for corner in range(3)])
        likely = low[:, 1] - self._insert.bounds[1, 1] <= highest
        low, high, highest = low[likely], high[likely], highest[likely]
        near = low[:, 1] - self._ceiling.over_rectangles(low[:, ::2], high[:, ::2]) <= highest
        tops &= self._ceiling.vertices_in_rectangles(low[near, ::2], high[near, ::2])
        return np.flatnonzero(tops)

    def _over_insert(self, points: Array) -> Array:
        start = points.copy()
        start[:, 1] = self._insert.bounds[1, 1] + 1e-3
        distance, _ = self._insert_rays.first(start, -UP)
        return np.asarray(points[:, 1] - start[:, 1] + distance)

    def _under_femoral(self, pose: Array, femoral: Array, points: Array) -> Array:
        start = points.copy()
        start[:, 1] = femoral[:, 1].min() - 1e-3
        back = inverse(pose)
        distance, _ = self._femoral_rays.first(transform(back, start), rotate(back, UP))
        return np.asarray(start[:, 1] + distance - points[:, 1])

    def _lowest(
        self,
        femoral: Array,
        clearances: tuple[Array, Array],
        chosen: tuple[Mask, Mask],
        edges: tuple[Index, Index],
    ) -> Touch | None:
        of_femoral = np.where(chosen[0], clearances[0], np.inf)
        of_insert = np.where(chosen[1], clearances[1], np.inf)
        f, i = int(of_femoral.argmin()), int(of_insert.argmin())
        if not np.isfinite(min(of_femoral[f], of_insert[i])):
            return None
        best = Touch(float(of_insert[i]), self._insert.vertices[i].copy())
        if of_femoral[f] < best.travel:
            best = Touch(float(of_femoral[f]), femoral[f] - of_femoral[f] * UP)
        a = _near_edges(edges[0], femoral, of_femoral, best.travel)
        b = _near_edges(edges[1], self._insert.vertices, of_insert, best.travel)
        crossing = _crossing(femoral[a], self._insert.vertices[b])
        return best if crossing is None or crossing.travel >= best.travel else crossing


def _with_face_towards(surface: Surface, direction: Array) -> Mask:
    """Say which vertices (n,) belong to a triangle that faces `direction`."""
    facing = surface.faces[surface.face_normals @ direction > 0]
    mask = np.zeros(len(surface.vertices), bool)
    mask[facing.ravel()] = True
    return mask


def _within(points: Array, bounds: Array) -> Mask:
    """Say which points (n, 3) lie within bounds (2, 3) in x and z."""
    x, z, (low, high) = points[:, 0], points[:, 2], bounds
    return np.asarray((x >= low[0]) & (x <= high[0]) & (z >= low[2]) & (z <= high[2]))


def _finite_edges(edges: Index, clearance: Array) -> Index:
    """Return the edges (k, 2) with an end whose clearance is known."""
    known = np.isfinite(clearance)
    return edges[known[edges[:, 0]] | known[edges[:, 1]]]


def _near_edges(edges: Index, vertices: Array, clearance: Array, smallest: float) -> Index:
    """Return the edges (k, 2) with an end close to the smallest clearance."""
    some = _finite_edges(edges, clearance)
    length = np.linalg.norm(vertices[some[:, 0]] - vertices[some[:, 1]], axis=1)
    above = clearance[some].min(axis=1) - smallest - EDGE_BAND * length
    near = np.flatnonzero(above <= EDGE_BAND * np.median(length)) if len(some) else some[:, 0]
    return np.asarray(some[near[np.argsort(above[near])[:MOST_EDGES]]])


def _crossing(upper: Array, lower: Array) -> Touch | None:
    """Return the lowest crossing in projection of edges (m, 2, 3) over edges (n, 2, 3)."""
    p, q = upper[:, None, 0], lower[None, :, 0]
    u, v = (upper[:, 1] - upper[:, 0])[:, None], (lower[:, 1] - lower[:, 0])[None]
    w = q - p
    determinant = u[..., 0] * v[..., 2] - u[..., 2] * v[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (w[..., 0] * v[..., 2] - w[..., 2] * v[..., 0]) / determinant
        t = (w[..., 0] * u[..., 2] - w[..., 2] * u[..., 0]) / determinant
        high, low = p[..., 1] + s * u[..., 1], q[..., 1] + t * v[..., 1]
        inside = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        clearance = np.where(inside, high - low, np.inf)
    if clearance.size == 0 or not np.isfinite(clearance.min()):
        return None
    m, n = np.unravel_index(clearance.argmin(), clearance.shape)
    return Touch(float(clearance[m, n]), lower[n, 0] + t[m, n] * (lower[n, 1] - lower[n, 0]))
