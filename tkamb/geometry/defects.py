"""Defects of a triangulated surface that change a contact: openings, spikes, noise and steps.

Each vertex is compared with a quadric through its nearest other vertices. On a smooth surface the
difference is far below a contact's approach (about 0.1 mm), whatever the size of the facets is. A
spike is one vertex far from the quadric of smooth neighbours; noise is a difference everywhere.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.spatial import cKDTree

from tkamb.geometry.frames import Array, Index, transform
from tkamb.geometry.topology import BoundaryLoop, boundary_loops
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface

Kind = Literal["opening", "spike", "noise", "steps"]


# Number of nearest vertices for a quadric: three times its six coefficients.
NEIGHBOURS = 18
# m: smallest height of a spike whose triangles have all their vertices among the nearest ones.
# Above the largest difference of 0.03 mm on the dishes of three inserts.
SPIKE = 0.05 * MILLIMETRE
# m: smallest height of another spike. Above the largest difference of 0.12 mm on the dishes
# of the same inserts; the nearest vertices then lie on one side.
SPIKE_OF_FAN = 0.2 * MILLIMETRE
# Smallest number of nearest vertices that share a triangle with a spike. By definition of a tip on
# a surface.
LEAST_RING = 3
# 1: smallest ratio of a spike's height to the roughness around it. Not studied.
SPIKE_RATIO = 6.0
# m: roughness of a noisy surface. A tenth of the approach of a knee's contact.
NOISE = 0.01 * MILLIMETRE
# Number of directions of the facets that marching cubes make of voxels.
DIRECTIONS = 26
# 1: smallest share of the area in that number of directions, on a surface of voxels. A
# smooth surface of an implant has less than half in so few.
DIRECTION_SHARE = 0.9
# Smallest number of equidistant levels of a surface of voxels. A component with
# flat cuts has fewer.
LEVELS = 6
# 1: smallest cosine between the normals of noisy neighbours and their mean; a smaller one is a
# crease. The edge of a component turns by more than twice this angle.
LEAST_COSINE = 0.8
# 1: smallest eigenvalue of the normal equations, at neighbours within the unit disc. With a
# smaller one the quadric is not determined. Not studied.
LEAST_EIGENVALUE = 1e-3
# 1: mean cosine between a surface beside a loop and the way to the loop's centre, above which the
# surface lies within the loop. By definition 0 for a tube. Not studied otherwise.
SHEET = 0.3
# m: spacing of the points that fill an opening. Below the cells of a map.
CAP_SPACING = 0.5 * MILLIMETRE


@dataclass(frozen=True, eq=False)
class Defect:
    """A defect of a surface.

    Args:
        words: the defect in words, like "an opening 6 mm wide".
        places: (m, 3) m, points of the defect, frame of the surface.
    """

    kind: Kind
    words: str
    places: Array

    def moved(self, pose_here_in_there: Array) -> "Defect":
        """Return the defect in another frame, of a pose or a mirror image (4, 4)."""
        return replace(self, places=transform(pose_here_in_there, self.places))


def defect_words(defects: Iterable[Defect]) -> tuple[str, ...]:
    """Return words for each kind of defect, like "a spike of 0.5 mm and 2 more"."""
    found: dict[str, list[str]] = {}
    for defect in defects:
        found.setdefault(defect.kind, []).append(defect.words)
    return tuple(
        words[0] + (f" and {len(words) - 1} more" if len(words) > 1 else "")
        for words in found.values()
    )


def mesh_words(surface: "Surface") -> tuple[str, ...]:
    """Return the defects of a whole mesh in words.

    Noise counts if most vertices have it: creases of a smooth part are rough, too.
    """
    most = 0.5 * len(np.unique(surface.corner_vertices))
    return defect_words(d for d in surface.defects if d.kind != "noise" or len(d.places) > most)


def defects_of(surface: "Surface") -> tuple[Defect, ...]:
    """Return the defects of a surface."""
    found = [_opening(surface, loop) for loop in _loops(surface)]
    steps = _steps(surface)
    if steps is not None:
        return (*found, steps)
    vertices = np.unique(surface.corner_vertices)
    if len(vertices) <= NEIGHBOURS + 1:
        return tuple(found)
    points = surface.vertices[vertices]
    near: Index = cKDTree(points).query(points, NEIGHBOURS + 1)[1][:, 1:]
    height, roughness = _heights(points, _normals(surface)[vertices], near)
    calm = roughness < NOISE
    spikes = calm & (np.abs(height) > np.maximum(SPIKE, SPIKE_RATIO * roughness))
    for n in np.flatnonzero(spikes):
        # The tip of a fan of long triangles is no spike: its neighbours are on other surfaces.
        ring = surface.corner_vertices[(surface.corner_vertices == vertices[n]).any(axis=1)]
        others = np.setdiff1d(ring, vertices[n])
        count = np.isin(others, vertices[near[n]]).sum()
        high = abs(height[n]) > SPIKE_OF_FAN
        if count < (LEAST_RING if high else len(others)):
            continue
        words = f"a spike of {abs(height[n]) / MILLIMETRE:.2g} mm"
        found.append(Defect("spike", words, points[n : n + 1]))
    rough = ~calm & ~spikes[near].any(axis=1)
    if rough.any():
        size = float(np.median(roughness[rough]))
        words = f"noise of about {size / MILLIMETRE:.1g} mm"
        found.append(Defect("noise", words, points[rough]))
    return tuple(found)


def _loops(surface: "Surface") -> list[BoundaryLoop]:
    return boundary_loops(surface.vertices, surface.corner_vertices)


def _opening(surface: "Surface", loop: BoundaryLoop) -> Defect:
    """Return an opening, with points on the smooth cap that would close it.

    The cap is a paraboloid over the loop's mean plane, with half the mean height of the loop's
    tangent planes above the centre. If the surface lies within the loop, like a sheet within its
    edge, the points are the edge.
    """
    ring = surface.vertices[loop.vertices]
    words = f"an opening {loop.width / MILLIMETRE:.2g} mm wide"
    if _inward(surface, loop) > SHEET:
        return Defect("opening", words, ring)
    normals = _normals(surface)[loop.vertices]
    axis = normals.sum(axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-12)
    lean = normals @ axis
    height = np.einsum("ij,ij->i", ring - loop.centre, normals)
    steep = lean < 0.5
    sagitta = 0.0 if steep.all() else 0.5 * float(np.mean(height[~steep] / lean[~steep]))
    reach = float(np.linalg.norm(ring - loop.centre, axis=1).max())
    count = int(np.clip(np.ceil(reach / CAP_SPACING), 1, 40)) + 1
    share = np.linspace(0.0, 1.0, count)[:, None, None]
    cap = loop.centre + share * (ring - loop.centre) + (1.0 - share**2) * sagitta * axis
    return Defect("opening", words, cap.reshape(-1, 3))


def _inward(surface: "Surface", loop: BoundaryLoop) -> float:
    """Return the mean cosine between the surface beside a loop and the way to the loop's centre."""
    on_loop = np.isin(surface.corner_vertices, loop.vertices)
    beside = on_loop.sum(axis=1) == 2
    corners = surface.vertices[surface.corner_vertices[beside]]
    edge = on_loop[beside][..., None]
    middle = (corners * edge).sum(axis=1) / 2.0
    away, inward = (corners * ~edge).sum(axis=1) - middle, loop.centre - middle
    length = np.linalg.norm(away, axis=1) * np.linalg.norm(inward, axis=1)
    cosine = np.einsum("ij,ij->i", away, inward) / np.maximum(length, 1e-18)
    return float(cosine.mean()) if len(cosine) else 0.0


def _normals(surface: "Surface") -> Array:
    """Return area-weighted unit normals (n, 3); zero for unused vertices."""
    weighted = surface.areas[:, None] * surface.face_normals
    vertex = surface.corner_vertices.ravel()
    rows = np.repeat(weighted, 3, axis=0)
    total = np.stack([np.bincount(vertex, c, len(surface.vertices)) for c in rows.T], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.divide(total, length, out=np.zeros_like(total), where=length > 0)


def _heights(points: Array, normals: Array, near: Index) -> tuple[Array, Array]:
    """Return heights (n,), m, over the neighbours' quadric, and its root mean square residual (n,).

    Both are zero beside a crease, or without a determined quadric.
    """
    axis = normals[near].sum(axis=1)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
    cosine = np.einsum("nkj,nj->nk", normals[near], axis)
    other = np.where(np.abs(axis[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(axis, other)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(axis, first)
    offset = points[near] - points[:, None]
    scale = np.maximum(np.linalg.norm(offset, axis=2).max(axis=1), 1e-12)[:, None]
    u, v, w = (np.einsum("nkj,nj->nk", offset, a) / scale for a in (first, second, axis))
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    turned = np.swapaxes(terms, 1, 2)
    square = turned @ terms + 1e-9 * np.eye(6)
    fit = np.linalg.solve(square, turned @ w[..., None])[..., 0]
    left = w - (terms @ fit[..., None])[..., 0]
    residual = np.sqrt((left**2).mean(axis=1)) * scale[:, 0]
    height = -fit[:, 0] * scale[:, 0]
    known = np.ones(len(points), bool)
    odd = (np.abs(height) > SPIKE) | (residual > NOISE)
    known[odd] = np.linalg.eigvalsh(square[odd])[:, 0] > LEAST_EIGENVALUE
    # A spike tilts the normals beside it, but its neighbours fit a quadric.
    facing = known & (cosine > 0.0).all(axis=1)
    smooth = known & (cosine > LEAST_COSINE).all(axis=1)
    calm = facing & (residual < NOISE)
    return np.where(smooth | calm, height, 0.0), np.where(smooth, residual, 0.0)


def _steps(surface: "Surface") -> Defect | None:
    """Return the steps of a surface of voxels, or None."""
    normals, areas = surface.face_normals, surface.areas
    key = np.round(normals / 0.02).astype(np.int64) @ [1, 1000, 1000000]
    _, group = np.unique(key, return_inverse=True)
    area = np.bincount(group.reshape(-1), areas)
    largest = np.argsort(-area)[:DIRECTIONS]
    if area[largest].sum() < DIRECTION_SHARE * areas.sum():
        return None
    members = np.flatnonzero(group.reshape(-1) == largest[0])
    axis = normals[members].mean(axis=0)
    level = np.sort(surface.triangles[members].mean(axis=1) @ axis)
    gap = np.diff(level)
    gap = gap[gap > NOISE]
    if len(gap) < LEVELS - 1 or not (np.abs(gap / np.median(gap) - 1.0) < 0.05).mean() > 0.7:
        return None
    words = f"steps of {np.median(gap) / MILLIMETRE:.2g} mm"
    return Defect("steps", words, surface.vertices)
