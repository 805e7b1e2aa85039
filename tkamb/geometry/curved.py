"""The smooth surface that a triangulation approximates: a curved patch over every triangle.

Some meshes are flat subdivisions: every edge of a coarser mesh was halved without a change of
shape. Then only the coarser triangles show the curvature. `coarsened` finds them.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.topology import Ragged, edge_use

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface

# 1: largest distance of a vertex from the middle of a coarser edge, as a share of the surface's
# size. Chosen because files round coordinates by less.
HALVING_TOLERANCE = 1e-6
# Largest number of subdivisions that are undone. Chosen because 8 subdivisions make 65,536
# triangles of one.
MOST_LEVELS = 8
# Largest number of connected parts; a surface of more parts stays unchanged. Chosen because no
# implant has as many.
MOST_PARTS = 100


@dataclass(frozen=True, eq=False)
class Coarsened:
    """The coarser triangles of a subdivided surface, and the positions of the finer ones on them.

    Args:
        surface: the coarser triangles.
        parent: (k,) coarser triangle that contains each finer triangle.
        corners: (k, 3, 3) barycentric coordinates, on the parent, of each finer triangle's corners.
    """

    surface: "Surface"
    parent: Index
    corners: Array


def coarsened(surface: "Surface") -> Coarsened | None:
    """Return the coarsest surface that subdivides flatly into this one; None if there is none.

    Each connected part is examined separately. Its subdivision is undone as a whole or not at all.
    """
    coarse: Coarsened | None = None
    for _ in range(MOST_LEVELS):
        step = _coarsened_once(surface if coarse is None else coarse.surface)
        if step is None:
            break
        if coarse is None:
            coarse = step
        else:
            corners = coarse.corners @ step.corners[coarse.parent]
            coarse = Coarsened(step.surface, step.parent[coarse.parent], corners)
    return coarse


def _coarsened_once(surface: "Surface") -> Coarsened | None:
    faces = surface.faces
    across = _across(faces)
    count, part = _parts(across)
    if count > MOST_PARTS:
        return None
    search = _Search(surface, across)
    middles = [search.middles_of(np.flatnonzero(part == number)) for number in range(count)]
    middle = np.concatenate(middles) if middles else np.zeros(0, np.int64)
    if not middle.size:
        return None
    numbers = np.arange(len(middle))
    parent = np.full(len(faces), -1)
    parent[middle] = numbers
    parent[across[middle]] = numbers[:, None]
    unchanged = np.flatnonzero(parent < 0)
    parent[unchanged] = len(middle) + np.arange(len(unchanged))
    tips = np.concatenate([search.tips(middle), faces[unchanged]])
    halves = np.concatenate([faces[middle], np.full((len(unchanged), 3), -1)])
    at_tip = faces[:, :, None] == tips[parent][:, None]
    at_half = faces[:, :, None] == halves[parent][:, None]
    corners = at_tip + 0.5 * (at_half.any(axis=2, keepdims=True) & ~at_half)
    return Coarsened(replace(surface, faces=tips, merged=False), parent, corners)


class _Search:
    """Search for the middle triangles of coarser triangles that were divided into four.

    The corners of a middle triangle halve the edges between the tips of its three neighbours; a tip
    is a corner of the coarser triangle. The search begins at one middle triangle and finds the next
    ones across the neighbours' tips.
    """

    def __init__(self, surface: "Surface", across: Index) -> None:
        self._faces, self._points, self._across = surface.faces, surface.vertices, across
        self._near = HALVING_TOLERANCE * float(np.linalg.norm(np.ptp(surface.bounds, axis=0)))
        self._corners = Ragged.by_key(surface.faces.ravel(), len(surface.vertices))

    def tips(self, middle: Index) -> Index:
        """Return the tips (m, 3): the vertex of each neighbour that the middle does not share."""
        neighbours, corners = self._faces[self._across[middle]], self._faces[middle]
        shared = (neighbours[:, :, :, None] == corners[:, None, None]).any(axis=3)
        return np.take_along_axis(neighbours, np.argmin(shared, axis=2)[..., None], axis=2)[..., 0]

    def middles_of(self, part: Index) -> Index:
        """Return the middle triangles of a connected part; none if it was not subdivided."""
        first = part[0]
        starts = [[first], *([face] for face in self._across[first])]
        if len(part) % 4 == 0:
            for start in starts:
                centres = self._spread(np.array(start))
                if centres is not None and 4 * len(centres) == len(part):
                    return centres
        return np.zeros(0, np.int64)

    def _spread(self, start: Index) -> Index | None:
        """Return the middle triangles that follow from a first one; None if they contradict."""
        kind = np.zeros(len(self._faces), np.int8)  # 1: middle triangle, 2: triangle at a tip
        is_tip = np.zeros(len(self._points), bool)
        new, layers = start, []
        while new.size:
            if not self._are_middles(new) or (kind[new] == 2).any():
                return None
            kind[new] = 1
            layers.append(new)
            if (kind[self._across[new]] == 1).any():
                return None
            kind[self._across[new]] = 2
            tips = np.unique(self.tips(new))
            tips = tips[~is_tip[tips]]
            is_tip[tips] = True
            new = self._beyond(tips)
            new = new[kind[new] != 1] if (new >= 0).all() else np.array([-1])
        middles = np.concatenate(layers)
        return None if is_tip[self._faces[middles]].any() else middles

    def _are_middles(self, faces: Index) -> bool:
        """Return whether all corners of faces halve the edges between their neighbours' tips."""
        if (faces < 0).any() or (self._across[faces] < 0).any():
            return False
        a, b, c = np.moveaxis(self._points[self.tips(faces)], 1, 0)
        halves = 0.5 * np.stack([b + c, c + a, a + b], axis=1)
        return bool(np.abs(halves - self._points[self._faces[faces]]).max() <= self._near)

    def _beyond(self, tips: Index) -> Index:
        """Return the faces across the edges that are opposite to the tips."""
        return np.unique(self._across.ravel()[self._corners.of(tips)[1]])


def _across(faces: Index) -> Index:
    """Return the face (k, 3) across the edge opposite each corner; -1 for none or several."""
    edge, count = edge_use(faces)
    order = np.argsort(edge, kind="stable")
    first = np.cumsum(count) - count
    pair = np.full((len(count), 2), -1)
    two = count == 2
    pair[two] = order[first[two][:, None] + [0, 1]] // 3
    edges = pair[edge].reshape(-1, 3, 2)
    number = np.arange(len(faces))[:, None]
    other = np.where(edges[..., 0] == number, edges[..., 1], edges[..., 0])
    return np.roll(other, -1, axis=1)


def _parts(across: Index) -> tuple[int, Index]:
    """Return the number of parts that are connected across edges, and each face's part (k,)."""
    face, corner = np.nonzero(across >= 0)
    ones = np.ones(len(face), np.int8)
    graph = coo_array((ones, (face, across[face, corner])), shape=(len(across),) * 2)
    count, part = connected_components(graph.tocsr(), directed=False)
    return int(count), part.astype(np.int64)


SMALLEST_COSINE = 0.1
"""1: smallest cosine of the angle between normal and direction by which a shift is divided."""


@dataclass(frozen=True, eq=False)
class CurvedSurface:
    """Quadratic patches over triangles, continuous across edges that are not sharp.

    With barycentric coordinates b, over a triangle of unit normal N

        h = 4 (b2 b3 s1 + b3 b1 s2 + b1 b2 s3),    s = t_i t_j / (2 (t_i + t_j))

    h is the height of the patch over the triangle, and s is the sagitta of the edge e from corner i
    to j, with corner normals n. t_i = -n_i.e / n_i.N is the height of the tangent plane of corner i
    over corner j, and t_j = n_j.e / n_j.N that of corner j over i. On a quadratic surface both are
    equal, and h is exact. If the signs of t_i and t_j differ, s is zero. A flat that meets a fillet
    therefore stays flat. On a flat subdivision the patches are those of the coarser triangles
    (`coarsened`).

    Args:
        surface: triangles of the patches, with shared vertices.
        normals: (k, 3, 3) unit normals at the corners, see `Surface.corner_normals`.
        sagittas: (k, 3) m, sagitta of the edge opposite each corner, along the triangle's normal.
        finer: finer triangles on which points are given; None if points are given on the triangles
            of `surface`.

    Reference:
        Vlachos et al., Curved PN triangles, Proc I3D 2001, doi:10.1145/364338.364387 (the
        idea of patches from corner normals).
    """

    surface: "Surface"
    normals: Array
    sagittas: Array
    finer: Coarsened | None = None

    @classmethod
    def of(cls, surface: "Surface") -> "CurvedSurface":
        """Return the patches of a surface from its corner normals."""
        finer = coarsened(surface)
        surface = surface if finer is None else finer.surface
        normals = surface.corner_normals
        return cls(surface, normals, _sagittas(surface, normals), finer)

    @cached_property
    def _patches(self) -> Array:
        """Corner normals, sagittas and the triangle's normal, in one row per triangle (k, 15)."""
        return np.hstack([self.normals.reshape(-1, 9), self.sagittas, self.surface.face_normals])

    def shift(self, faces: Index, weights: Array, direction: Array) -> tuple[Array, Array]:
        """Return the distance from points on triangles to the patches along a direction.

        The distance is correct to first order in the patch's height.

        Args:
            faces: (n,) triangles, of the finer surface if there is one; -1 for no triangle.
            weights: (n, 3) barycentric coordinates of the points on these triangles.
            direction: (3,) unit vector.

        Returns:
            Signed distance (n,), m, and outward unit normals (n, 3), interpolated between the
            corners; NaN for the triangle -1.
        """
        if self.finer is not None:
            weights = np.einsum("ij,ijk->ik", weights, self.finer.corners[faces])
            faces = np.where(faces < 0, faces, self.finer.parent[faces])
        return _shifts(self._patches, faces, weights, direction)

    @cached_property
    def sag(self) -> float:
        """m, largest height of a patch over its triangle."""
        return float(self.sagittas.max(initial=0.0))

    @cached_property
    def _quadratics(self) -> tuple[Array, Array, Array, Array]:
        """The heights over the triangles as h = a.o + o.H o/2, with o the offset from corner 1.

        First corners (k, 3), m; unit normals (k, 3); a (k, 3); H (k, 3, 3), 1/m.
        """
        rows = np.nan_to_num(self.surface.barycentric_rows)  # a degenerate triangle stays flat
        slopes = 4.0 * (
            self.sagittas[:, 1, None] * rows[:, 1] + self.sagittas[:, 2, None] * rows[:, 0]
        )
        gradients = np.concatenate([-rows.sum(axis=1, keepdims=True), rows], axis=1)
        products = np.einsum("kai,kbj->kabij", gradients, gradients)
        half = np.einsum("ka,kaij->kij", 4.0 * self.sagittas, products[:, [1, 2, 0], [2, 0, 1]])
        curvatures = half + half.transpose(0, 2, 1)
        return self.surface.triangles[:, 0], self.surface.face_normals, slopes, curvatures

    def cross(
        self, faces: Index, origins: Array, directions: Array, distances: Array
    ) -> tuple[Array, Array]:
        """Move the crossings of rays from triangles to their patches, which is exact.

        The height above the patches has the gradient q and minus the second derivative H. Both are
        those of the surface that the ray meets, so that the distance t of a point that moves by u
        changes by (q . u)/(q . direction).

        Args:
            faces: (n,) triangles, of the finer surface if there is one; -1 for no triangle.
            origins: (n, 3) m, starts of the rays.
            directions: (n, 3) unit vectors.
            distances: (n,) m, to the triangles; changed in place to the distances to the patches.
                Those that are not finite stay. A ray that passes its patch keeps its distance.

        Returns:
            q (n, 3), outward, of a length of about 1; H (n, 3, 3), 1/m; zero without a crossing.
        """
        if self.finer is not None:
            faces = np.where(faces < 0, faces, self.finer.parent[faces])
        gradients, curvatures = np.zeros_like(origins), np.zeros((len(origins), 3, 3))
        _cross(*self._quadratics, faces, origins, directions, distances, gradients, curvatures)
        return gradients, curvatures


@compiled_as_written
def _cross(
    corners: Array,
    normals: Array,
    slopes: Array,
    curvatures: Array,
    faces: Index,
    origins: Array,
    directions: Array,
    distances: Array,
    gradients: Array,
    turns: Array,
) -> None:
    """Solve a quadratic for each ray; see `CurvedSurface.cross`."""
    offset = np.empty(3)
    for n in range(len(faces)):
        face = faces[n]
        if face < 0 or not np.isfinite(distances[n]):
            continue
        constant, linear, square = 0.0, 0.0, 0.0
        for i in range(3):
            offset[i] = origins[n, i] + distances[n] * directions[n, i] - corners[face, i]
        for i in range(3):
            bend, bent = 0.0, 0.0
            for j in range(3):
                turns[n, i, j] = curvatures[face, i, j]
                bend += curvatures[face, i, j] * offset[j]
                bent += curvatures[face, i, j] * directions[n, j]
            gradients[n, i] = normals[face, i] - slopes[face, i] - bend
            # The height above the patch is constant + linear t + square t² along the ray.
            constant += (normals[face, i] - slopes[face, i] - 0.5 * bend) * offset[i]
            linear += gradients[n, i] * directions[n, i]
            square -= 0.5 * directions[n, i] * bent
        root = linear * linear - 4.0 * square * constant
        if root <= 0.0 or linear == 0.0:
            continue
        travel = -2.0 * constant / (linear + np.copysign(np.sqrt(root), linear))
        distances[n] += travel
        for i in range(3):
            for j in range(3):
                gradients[n, i] -= curvatures[face, i, j] * travel * directions[n, j]


@compiled_as_written
def _shifts(patches: Array, faces: Index, weights: Array, direction: Array) -> tuple[Array, Array]:
    """Return the result of `CurvedSurface.shift` from rows of `CurvedSurface._patches`."""
    shifts, normals = np.full(len(faces), np.nan), np.full((len(faces), 3), np.nan)
    for n in range(len(faces)):
        if faces[n] < 0:
            continue
        patch, (a, b, c) = patches[faces[n]], weights[n]
        x = a * patch[0] + b * patch[3] + c * patch[6]
        y = a * patch[1] + b * patch[4] + c * patch[7]
        z = a * patch[2] + b * patch[5] + c * patch[8]
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        height = 4.0 * (b * c * patch[9] + c * a * patch[10] + a * b * patch[11])
        along = x * patch[12] + y * patch[13] + z * patch[14]
        cosine = x * direction[0] + y * direction[1] + z * direction[2]
        steep = np.copysign(max(abs(cosine), SMALLEST_COSINE), cosine)
        shifts[n] = height * along / steep
        normals[n, 0], normals[n, 1], normals[n, 2] = x, y, z
    return shifts, normals


def _sagittas(surface: "Surface", normals: Array) -> Array:
    """Return the sagittas (k, 3), m, of the edges opposite each corner."""
    corners = surface.triangles
    lean = np.einsum("kij,kj->ki", normals, surface.face_normals)
    slant = normals / np.where(lean > 0.0, lean, np.inf)[..., None]
    start, end = np.roll(slant, -1, axis=1), np.roll(slant, -2, axis=1)
    edge = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    start_height = -np.einsum("kij,kij->ki", start, edge)
    end_height = np.einsum("kij,kij->ki", end, edge)
    product, total = start_height * end_height, start_height + end_height
    same_sign = product > 0.0
    return np.where(same_sign, 0.5 * product / np.where(same_sign, total, 1.0), 0.0)
