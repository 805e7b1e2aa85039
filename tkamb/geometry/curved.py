"""The smooth surface that a triangulation approximates: a curved patch over every triangle."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.subdivision import Coarsened, coarsened

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface

SMALLEST_COSINE = 0.1
"""1: smallest cosine of the angle between normal and direction by which a shift is divided."""


@dataclass(frozen=True, eq=False)
class CurvedSurface:
    """Quadratic patches over triangles, continuous across edges that are not sharp.

    With barycentric coordinates b, over a triangle of unit normal N

        h = 4 (b2 b3 s1 + b3 b1 s2 + b1 b2 s3),    s = t_i t_j / (2 (t_i + t_j))

    h is the height over the triangle, s the sagitta of the edge e from corner i to j, with corner
    normals n. t_i = -n_i.e / n_i.N is the height of the tangent plane of corner i over corner j,
    and t_j = n_j.e / n_j.N that of j over i. On a quadratic surface both are equal, and h is exact.
    If their signs differ, s is zero: a flat that meets a fillet stays flat. On a flat subdivision
    the patches are those of the coarser triangles (`coarsened`).

    Args:
        surface: triangles of the patches, with shared vertices.
        normals: (k, 3, 3) unit normals at the corners, see `Surface.corner_normals`.
        sagittas: (k, 3) m, sagitta of the edge opposite each corner, along the triangle's normal.
        finer: finer triangles on which points are given; None for those of `surface`.

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
        finer = coarsened(surface.vertices, surface.faces)
        if finer is not None:
            surface = surface.remade(surface.vertices, finer.faces)
        normals = surface.corner_normals
        return cls(surface, normals, _sagittas(surface, normals), finer)

    @cached_property
    def _patches(self) -> Array:
        """Corner normals, sagittas and normal, (k, 15)."""
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
    def quadratics(self) -> tuple[Index, Array, Array, Array, Array]:
        """The heights over the triangles as h = a.o + o.H o/2, with o the offset from corner 1.

        Patch (m,) of each triangle, of the finer surface if there is one; first corners (k, 3), m;
        unit normals (k, 3); a (k, 3); H (k, 3, 3), 1/m.
        """
        rows = np.nan_to_num(self.surface.barycentric_rows)  # a degenerate triangle stays flat
        slopes = 4.0 * (
            self.sagittas[:, 1, None] * rows[:, 1] + self.sagittas[:, 2, None] * rows[:, 0]
        )
        gradients = np.concatenate([-rows.sum(axis=1, keepdims=True), rows], axis=1)
        products = np.einsum("kai,kbj->kabij", gradients, gradients)
        half = np.einsum("ka,kaij->kij", 4.0 * self.sagittas, products[:, [1, 2, 0], [2, 0, 1]])
        curvatures = half + half.transpose(0, 2, 1)
        faces = np.arange(len(slopes)) if self.finer is None else self.finer.parent
        corners, normals = self.surface.triangles[:, 0], self.surface.face_normals
        heights = (np.ascontiguousarray(one) for one in (corners, normals, slopes, curvatures))
        return np.ascontiguousarray(faces), *heights  # type: ignore[return-value]


@compiled_as_written
def crossed_patch(
    quadratics: tuple[Index, Array, Array, Array, Array],
    patch: int,
    origin: Array,
    direction: Array,
    distance: float,
    gradient: Array,
) -> float:
    """Return the distance (m) of a ray's crossing with a patch, which is exact.

    The height above the patch has the gradient q and minus the second derivative H, both those of
    the surface that the ray meets. If the point moves by u, the distance changes by (q . u)/(q .
    direction). A ray that passes its patch keeps its distance.

    Args:
        origin: (3,) m, start of the ray along the unit vector `direction`.
        distance: m, to the triangle.
        gradient: (3,) output, q, outward, of a length of about 1.
    """
    _, corners, normals, slopes, curvatures = quadratics
    constant, linear, square = 0.0, 0.0, 0.0
    for i in range(3):
        bend, bent = 0.0, 0.0
        for j in range(3):
            offset = origin[j] + distance * direction[j] - corners[patch, j]
            bend += curvatures[patch, i, j] * offset
            bent += curvatures[patch, i, j] * direction[j]
        offset = origin[i] + distance * direction[i] - corners[patch, i]
        gradient[i] = normals[patch, i] - slopes[patch, i] - bend
        # The height above the patch is constant + linear t + square t² along the ray.
        constant += (normals[patch, i] - slopes[patch, i] - 0.5 * bend) * offset
        linear += gradient[i] * direction[i]
        square -= 0.5 * direction[i] * bent
    root = linear * linear - 4.0 * square * constant
    if root <= 0.0 or linear == 0.0:
        return distance
    travel = -2.0 * constant / (linear + np.copysign(np.sqrt(root), linear))
    for i in range(3):
        for j in range(3):
            gradient[i] -= curvatures[patch, i, j] * travel * direction[j]
    return distance + travel


@compiled_as_written
def _shifts(patches: Array, faces: Index, weights: Array, direction: Array) -> tuple[Array, Array]:
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
    """Return the sagittas (k, 3), m, opposite each corner."""
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
