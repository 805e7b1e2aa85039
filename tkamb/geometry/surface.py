"""A triangulated surface in SI units and one named frame."""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray

from tkamb.geometry.frames import Array, transform


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangulated surface, outward normals by the right-hand rule.

    Args:
        vertices: (n, 3) m, in the frame that the owner states.
        faces: (k, 3) indices into the vertices.
        name: what to call it in messages.
    """

    vertices: Array
    faces: NDArray[np.int64]
    name: str = "surface"

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The same surface for trimesh, unprocessed."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    @cached_property
    def triangles(self) -> Array:
        """Corner points (k, 3, 3), m."""
        return np.asarray(self.vertices[self.faces])

    @cached_property
    def face_normals(self) -> Array:
        """Unit outward normals (k, 3); zero for a degenerate triangle."""
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        return np.asarray(np.divide(cross, length, out=np.zeros_like(cross), where=length > 0))

    @cached_property
    def barycentric_rows(self) -> Array:
        """Rows (k, 2, 3), 1/m: times a point's offset from the first corner they give its
        second and third barycentric coordinate in the plane; NaN for a degenerate triangle.
        """
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        first, second = b - a, c - a
        normal = np.cross(first, second)
        square = np.einsum("ij,ij->i", normal, normal)[:, None, None]
        rows = np.stack([np.cross(second, normal), np.cross(normal, first)], axis=1)
        return np.divide(rows, square, out=np.full_like(rows, np.nan), where=square > 0)

    def barycentric(self, points: Array, faces: NDArray[np.int64]) -> Array:
        """Return the barycentric coordinates (n, 3) of points (n, 3), m, on triangles (n,).

        Those of a point beside its triangle are cut to 0 to 1; thirds on a degenerate one.
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
        """Lower and upper corner (2, 3), m."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of vertices and faces: the key for prepared operators."""
        digest = hashlib.sha256(np.ascontiguousarray(self.vertices, "<f8").tobytes())
        digest.update(np.ascontiguousarray(self.faces, "<i8").tobytes())
        return digest.hexdigest()

    def moved(self, pose_here_in_there: Array) -> "Surface":
        """Return the surface in another frame."""
        return Surface(transform(pose_here_in_there, self.vertices), self.faces, self.name)
