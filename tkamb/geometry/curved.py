"""The smooth surface that a triangulation stands for: a curved patch over every triangle."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.subdivision import Coarsened, coarsened
from tkamb.geometry.surface import Surface

SMALLEST_COSINE = 0.1
"""Smallest cosine between normal and direction by which a shift is divided: 84 deg."""


@dataclass(frozen=True, eq=False)
class CurvedSurface:
    """Quadratic patches over triangles, continuous across edges that are not sharp.

    With barycentric coordinates b, over a triangle of unit normal N

        h = 4 (b2 b3 s1 + b3 b1 s2 + b1 b2 s3),    s = t_i t_j / (2 (t_i + t_j))

    s is the sagitta of the edge e from corner i to j, t_i = -n_i.e / n_i.N and
    t_j = n_j.e / n_j.N how far the tangent planes at its ends rise over it. On a quadratic
    surface t_i = t_j and h is exact. Where they differ, s uses their harmonic mean; where they
    have opposite signs, s is zero. So a flat that meets a fillet stays flat; the arithmetic mean
    would swell it. Where triangles were subdivided without being curved, the patches are those of
    the coarser triangles (`coarsened`).

    Args:
        surface: its triangles share their vertices.
        normals: (k, 3, 3) unit normals at the corners, see `Surface.corner_normals`.
        sagittas: (k, 3) m, of the edge opposite each corner, along the triangle's normal.
        finer: the triangles that points are given on, and where they lie on the surface's;
            None: they are the surface's own.

    Reference:
        Vlachos et al., Curved PN triangles, Proc I3D 2001, doi:10.1145/364338.364387 (the
        idea of patches from corner normals).
    """

    surface: Surface
    normals: Array
    sagittas: Array
    finer: Coarsened | None = None

    @classmethod
    def of(cls, surface: Surface) -> "CurvedSurface":
        """Return the patches of a surface from its own corner normals."""
        finer = coarsened(surface)
        surface = surface if finer is None else finer.surface
        normals = surface.corner_normals
        return cls(surface, normals, _sagittas(surface, normals), finer)

    @cached_property
    def _patches(self) -> Array:
        """Corner normals, sagittas and plane's normal side by side (k, 15)."""
        return np.hstack([self.normals.reshape(-1, 9), self.sagittas, self.surface.face_normals])

    def shift(self, faces: Index, weights: Array, direction: Array) -> tuple[Array, Array]:
        """Return how far the patches are from points on their triangles along a direction.

        To first order in the patch's height.

        Args:
            faces: (n,) triangles, of the finer surface if there is one; -1 for none.
            weights: (n, 3) barycentric coordinates of points on them.
            direction: (3,) unit vector.

        Returns:
            Signed distance (n,), m, and outward unit normals (n, 3), which are interpolated
            between the corners; NaN without a triangle.
        """
        if self.finer is not None:
            weights = np.einsum("ij,ijk->ik", weights, self.finer.corners[faces])
            faces = np.where(faces < 0, faces, self.finer.parent[faces])
        return _shifts(self._patches, faces, weights, direction)


@compiled_as_written
def _shifts(patches: Array, faces: Index, weights: Array, direction: Array) -> tuple[Array, Array]:
    """Return what `CurvedSurface.shift` does, from corner normals, sagittas and planes (k, 15)."""
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


def _sagittas(surface: Surface, normals: Array) -> Array:
    """Return the sagittas (k, 3), m, of the edges opposite each corner."""
    corners = surface.triangles
    lean = np.einsum("kij,kj->ki", normals, surface.face_normals)
    slant = normals / np.where(lean > 0.0, lean, np.inf)[..., None]
    start, end = np.roll(slant, -1, axis=1), np.roll(slant, -2, axis=1)
    edge = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    leaving = -np.einsum("kij,kij->ki", start, edge)
    coming = np.einsum("kij,kij->ki", end, edge)
    product, total = leaving * coming, leaving + coming
    alike = product > 0.0
    return np.where(alike, 0.5 * product / np.where(alike, total, 1.0), 0.0)
