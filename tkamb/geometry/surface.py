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
