"""A triangulated surface in SI units, and normals of the smooth surface that it approximates."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from tkamb.geometry.frames import MIRROR, Array, Index, Mask, pose, transform
from tkamb.geometry.topology import Ragged, edge_use, same_places

if TYPE_CHECKING:
    import trimesh

    from tkamb.geometry.curved import CurvedSurface
    from tkamb.geometry.defects import Defect
    from tkamb.geometry.nearest import NearestPoints, TriangleTree
    from tkamb.geometry.rays import RayCaster
    from tkamb.geometry.winding import WindingNumber

SHARP_EDGE = float(np.deg2rad(40.0))
"""rad: angle between the normals of neighbouring triangles above which their edge is sharp."""
NO_CREASE = float(np.pi)
"""rad: crease angle with which all triangles at a vertex count."""


# 1: difference below which two cosines are equal. It is above rounding.
COSINE_ROUNDING = 1e-9


SMOOTH_WITHIN = np.radians(30.0)
"""rad: angle between normals above which triangles belong to different smooth surfaces."""

NO_TURN = 1e-3
"""rad: angle between facets below which they are coplanar. Above the rounding of a file."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangulated surface; the right-hand rule gives the outward normals.

    Derived objects (trees, normals) are computed at first use.

    Args:
        vertices: (n, 3) m.
        faces: (k, 3) vertices of the triangles.
        merged: True if no two vertices are at the same place.
    """

    vertices: Array
    faces: Index
    name: str = "surface"
    merged: bool = False

    @cached_property
    def mesh(self) -> "trimesh.Trimesh":
        """The surface as an unprocessed mesh of trimesh."""
        import trimesh  # its import takes half a second

        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    @cached_property
    def triangles(self) -> Array:
        """Corner points (k, 3, 3), m."""
        return self.vertices[self.faces]

    @cached_property
    def face_normals(self) -> Array:
        """Unit outward normals (k, 3); zero for a degenerate triangle."""
        double = 2.0 * self.areas[:, None]
        return np.divide(self._cross, double, out=np.zeros_like(self._cross), where=double > 0)

    @cached_property
    def areas(self) -> Array:
        """Areas of the triangles (k,), m²."""
        return np.linalg.norm(self._cross, axis=1) / 2.0

    @cached_property
    def longest_edges(self) -> Array:
        """The longest edge (k,) of every triangle, m."""
        corners = np.moveaxis(self.triangles, (1, 2), (0, 1)).copy()  # contiguous rows are faster
        square = [
            (end - start) ** 2 for start, end in zip(corners, corners[[1, 2, 0]], strict=True)
        ]
        return np.sqrt(np.maximum.reduce([x + y + z for x, y, z in square]))

    @cached_property
    def _cross(self) -> Array:
        """Normals (k, 3) with a length of twice the triangle's area, m²."""
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def barycentric_rows(self) -> Array:
        """Rows (k, 2, 3), 1/m; NaN for a degenerate triangle.

        With a point's offset from the first corner they give the second and third barycentric
        coordinate.
        """
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        first, second, normal = b - a, c - a, self._cross
        square = np.einsum("ij,ij->i", normal, normal)[:, None, None]
        rows = np.stack([np.cross(second, normal), np.cross(normal, first)], axis=1)
        return np.divide(rows, square, out=np.full_like(rows, np.nan), where=square > 0)

    def barycentric(self, points: Array, faces: Index) -> Array:
        """Return the barycentric coordinates (n, 3) of points (n, 3), m, on triangles (n,).

        Outside a triangle they are clipped to 0 to 1; on a degenerate one they are one third.
        """
        weights = np.empty((len(points), 3))
        offset = points - self.triangles[faces, 0]
        np.einsum("nij,nj->ni", self.barycentric_rows[faces], offset, out=weights[:, 1:])
        weights[:, 0] = 1.0 - weights[:, 1] - weights[:, 2]
        beside = np.flatnonzero(~(weights.min(axis=1) >= 0.0))
        if beside.size:
            cut = np.clip(np.nan_to_num(weights[beside], nan=1 / 3), 0.0, 1.0)
            weights[beside] = cut / cut.sum(axis=1, keepdims=True)
        return weights

    @cached_property
    def bounds(self) -> Array:
        """Lower and upper corner (2, 3), m, of the bounding box."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def corner_vertices(self) -> Index:
        """Vertices (k, 3) of the faces; those at one place have one number."""
        return self.faces if self.merged else same_places(self.vertices)[1][self.faces]

    @cached_property
    def corners_at_vertices(self) -> Ragged:
        """Corners at each of the `corner_vertices`; the number of a corner is 3 face + corner."""
        vertex = self.corner_vertices.ravel()
        return Ragged.by_key(vertex, int(vertex.max(initial=-1)) + 1)

    @cached_property
    def corner_normals(self) -> Array:
        """Unit normals (k, 3, 3) at the corners, weighted by angle; edges over 40 deg stay sharp.

        The error of these normals is at most a tenth of the error of facet normals.
        """
        return corner_normals(self, SHARP_EDGE, corner_angles(self))

    @cached_property
    def vertex_normals(self) -> Array:
        """Unit normals (k, 3, 3) of the vertices, weighted by the areas of their triangles."""
        return corner_normals(self, NO_CREASE, self.areas[:, None] * np.ones(3))

    def vertex_normals_at(self, faces: Index, weights: Array) -> Array:
        """Return `vertex_normals` interpolated by barycentric weights (n, 3) on faces (n,)."""
        return _mean_normals(weights, self.vertex_normals[faces])

    @cached_property
    def _smooth_corner_normals(self) -> Array:
        return corner_normals(self, SMOOTH_WITHIN, corner_angles(self))

    def smooth_normals(self, points: Array, faces: Index) -> Array:
        """Return unit normals (n, 3) at points (n, 3), m, on triangles `faces` (n,).

        They are interpolated between angle-weighted corner normals. Triangles beyond a crease of 30
        deg do not count, so that a box has its face normals. On a faceted sphere they are radial to
        second order.
        """
        weights = self.barycentric(points, faces)
        return _mean_normals(weights, self._smooth_corner_normals[faces])

    @cached_property
    def curved(self) -> "CurvedSurface":
        """The smooth surface that the triangles approximate."""
        from tkamb.geometry.curved import CurvedSurface  # imports numba, which is slow

        return CurvedSurface.of(self)

    @cached_property
    def tree(self) -> "TriangleTree":
        """The tree of all triangles."""
        from tkamb.geometry.nearest import TriangleTree  # imports numba, which is slow

        return TriangleTree(self)

    @cached_property
    def upward_tree(self) -> "TriangleTree":
        """The tree of the triangles that face up (+y); of all triangles if none does.

        The topmost points of other triangles lie on edges of triangles that face up.
        """
        from tkamb.geometry.nearest import TriangleTree

        upward = np.flatnonzero(self.face_normals[:, 1] > 0.0)
        return TriangleTree(self, upward) if len(upward) else self.tree

    @cached_property
    def rays(self) -> "RayCaster":
        """Ray caster of the surface."""
        from tkamb.geometry.rays import RayCaster

        return RayCaster(self, self.tree)

    @cached_property
    def nearest(self) -> "NearestPoints":
        """Search for nearest points of the surface."""
        from tkamb.geometry.nearest import NearestPoints

        return NearestPoints(self, self.tree)

    @cached_property
    def winding(self) -> "WindingNumber":
        """Winding numbers of points about the surface."""
        from tkamb.geometry.winding import WindingNumber

        return WindingNumber(self)

    @cached_property
    def defects(self) -> "tuple[Defect, ...]":
        """The openings, spikes, noise and steps of the surface, or of what it was `remade` from."""
        from tkamb.geometry.defects import defects_of

        if self._original is None:
            return defects_of(self)
        original, pose_there_in_here = self._original
        return tuple(defect.moved(pose_there_in_here) for defect in original.defects)

    @cached_property
    def _original(self) -> "tuple[Surface, Array] | None":
        """The surface that this one was made of, and its affine map to here (4, 4)."""
        return None

    def facet_sag(self, near: Array | None = None, radius: float = np.inf) -> float:
        """Return the sag, m, of the facets' middles below the smooth surface.

        Facets of width w that meet at an angle t are chords of a circle of radius w/t, with a sag
        of w t/8. Sags of two directions add up: the result is twice the mean over edges of at most
        30 deg, without those between coplanar facets.

        Args:
            near: (n, 3) m, points; only edges near one of them count. None: all edges.
            radius: m, largest distance of such an edge's middle.
        """
        middle, sag = self._edge_sags
        if near is not None:
            distance = cKDTree(near).query(middle, distance_upper_bound=radius)[0]
            sag = sag[distance <= radius]
        return 2.0 * float(sag.mean()) if len(sag) else 0.0

    @cached_property
    def _edge_sags(self) -> tuple[Array, Array]:
        """Middles (m, 3), m, of the edges between curved facets, and the facets' sags (m,), m."""
        edge, count = edge_use(self.corner_vertices)
        face = np.repeat(np.arange(len(self.faces)), 3)
        order = np.argsort(edge, kind="stable")
        first = (np.cumsum(count) - count)[count == 2]
        one, other = face[order[first]], face[order[first + 1]]
        ends = np.roll(self.triangles, -1, axis=1)
        length = np.linalg.norm(ends - self.triangles, axis=2).reshape(-1)[order[first]]
        middle = (0.5 * (ends + self.triangles)).reshape(-1, 3)[order[first]]
        cosine = np.einsum("ij,ij->i", self.face_normals[one], self.face_normals[other])
        turn = np.arccos(np.clip(cosine, -1.0, 1.0))
        curved = (turn < SMOOTH_WITHIN) & (turn > NO_TURN) & (length > 0.0)
        width = (self.areas[one] + self.areas[other])[curved] / length[curved]
        return middle[curved], width * turn[curved] / 8.0

    @cached_property
    def volume(self) -> float:
        """Enclosed volume, m³; an overlap of two bodies counts twice."""
        a, b, c = np.moveaxis(self.triangles - self.bounds.mean(axis=0), 1, 0)
        return float(np.einsum("kj,kj->", a, np.cross(b, c)) / 6.0)

    def moved(self, pose_here_in_there: Array) -> "Surface":
        """Return the surface in another frame; itself for the identity."""
        if np.array_equal(pose_here_in_there, np.eye(4)):
            return self
        vertices = transform(pose_here_in_there, self.vertices)
        return self.remade(vertices, self.faces, pose_here_in_there)

    def mirrored(self) -> "Surface":
        """Return the mirror image in the sagittal plane (z to -z), with outward normals."""
        mirror = pose(MIRROR, np.zeros(3))
        return self.remade(self.vertices @ MIRROR + 0.0, self.faces[:, ::-1].copy(), mirror)

    def remade(
        self, vertices: Array, faces: Index, pose_here_in_there: Array | None = None
    ) -> "Surface":
        """Return a surface made of this one, with its defects.

        Args:
            vertices: (n, 3) m, moved, worn or more.
            pose_here_in_there: pose or mirror image (4, 4) that moves the defects; None: identity.
        """
        merged = self.merged and len(vertices) == len(self.vertices)
        remade = Surface(vertices, faces, self.name, merged)
        there = np.eye(4) if pose_here_in_there is None else pose_here_in_there
        remade.__dict__["_original"] = (self, there)
        return remade

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields and the defects; others are larger and computed again."""
        state = {field.name: getattr(self, field.name) for field in fields(self)}
        known = {} if "defects" not in self.__dict__ else {"defects": self.defects}
        return state | known


def corner_normals(surface: Surface, crease: float, weights: Array) -> Array:
    """Return unit normals (k, 3, 3), one per triangle and corner.

    It is the weighted mean over triangles at the vertex whose normals differ by at most `crease`,
    so that a sharp edge does not tilt the normals beside it. Vertices at one place count as one. A
    triangle without area has zero normals.

    Args:
        crease: rad; with `NO_CREASE` all corners at a vertex have the same normal.
        weights: (k, 3) weight of each triangle at its corners: `corner_angles`, or its area.
    """
    normals, vertex = np.repeat(surface.face_normals, 3, axis=0), surface.corner_vertices.ravel()
    weighted = weights.reshape(-1, 1) * normals
    mean = _sums(vertex, weighted)
    total = mean[vertex]
    if crease < NO_CREASE:
        # If all normals at a vertex are within half the crease angle of their mean, they are within
        # the crease angle of each other. Only other vertices need a comparison in pairs.
        lean = np.einsum("cj,cj->c", normals, _unit(mean)[vertex])
        rough = np.zeros(len(mean), bool)
        rough[vertex[~(lean > np.cos(crease / 2) + COSINE_ROUNDING)]] = True
        corners = np.flatnonzero(rough[vertex])
        corner_of_pair, neighbour = surface.corners_at_vertices.of(vertex[corners])
        turn = np.einsum("pj,pj->p", normals[corners[corner_of_pair]], normals[neighbour])
        counts = (turn >= np.cos(crease))[:, None]
        total[corners] = _sums(
            corner_of_pair, np.where(counts, weighted[neighbour], 0.0), len(corners)
        )
    return _unit(total).reshape(-1, 3, 3)


def corner_angles(surface: Surface) -> Array:
    """Return the angles (k, 3), rad, of triangles at their corners."""
    corners = surface.triangles
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(ahead, behind), axis=2)
    return np.arctan2(sine, np.einsum("ijk,ijk->ij", ahead, behind))


def _mean_normals(weights: Array, normals: Array) -> Array:
    return _unit(np.einsum("ij,ijk->ik", weights, normals))


def sharp_edges(surface: Surface, sharp: float = SHARP_EDGE) -> Mask:
    """Return whether the edge opposite each corner (k, 3) is sharp, or not shared by two faces."""
    edge, count = edge_use(surface.faces)
    cosine = 0.5 * (_sums(edge, np.repeat(surface.face_normals, 3, axis=0)) ** 2).sum(axis=1) - 1
    flags = (count != 2) | (cosine < np.cos(sharp))
    return np.roll(flags[edge].reshape(-1, 3), -1, axis=1)


def _sums(index: Index, rows: Array, count: int = 0) -> Array:
    """Return the sum (n,) of the rows (m, n) of each index (m,); at least `count` sums."""
    return np.stack([np.bincount(index, column, count) for column in rows.T], axis=1)


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
