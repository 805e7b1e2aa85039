"""The insert's articular surface, finely enough divided, as wear and creep change it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import edge_use

Chosen = Callable[[Surface], NDArray[np.bool_]]

DOWN = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True)
class WornSurfaceSettings:
    """The surface from which wear is removed."""

    min_normal_y: float = 0.1
    """1: smallest y component of the normal of a face that can be worn from above. Chosen: 84 deg
    from the horizontal."""
    ray_offset: float = 1e-6
    """m; rays through the insert start so far below its surface. Chosen: above the rounding of a
    mesh."""
    max_halvings: int = 12
    """Halvings of an edge. Chosen: one of a metre ends at a quarter of a millimetre."""


WORN_SURFACE = WornSurfaceSettings()


@dataclass(frozen=True, eq=False)
class ArticularSurface:
    """The vertices of the insert that face upwards, with their tributary areas.

    A vertex owns a third of each of its triangles. Its normal n is the direction of the summed
    area vectors of those that face upwards. Its area is the sum of the y components of all, over
    n_y: a rim has the normal of the surface, not of the wall. A depth h along the normal is
    removed by moving the vertex down by h/n_y. x and z do not change, and the volume of a closed
    surface is then linear in y, so that

        volume removed = sum over vertices of h times area

    exactly, however far it is worn.

    Args:
        surface: the insert, refined where it can be worn, insert frame.
        vertices: (n,) numbers of the vertices that can be worn.
        thickness: (n,) m of the unworn insert below each, along y.
    """

    surface: Surface
    vertices: NDArray[np.int64]
    thickness: Array

    @classmethod
    def of_insert(cls, insert: Surface, spacing: float) -> "ArticularSurface":
        """Return the articular surface of an insert with no edge longer than `spacing` (m).

        Raises:
            InputError: nothing of the insert faces upwards.
        """
        merged = insert.mesh.copy()
        merged.merge_vertices()
        surface = refined(
            Surface(np.asarray(merged.vertices), np.asarray(merged.faces), insert.name),
            spacing,
            lambda s: s.face_normals[:, 1] > WORN_SURFACE.min_normal_y,
        )
        upward, whole = area_vectors(surface)
        length = np.linalg.norm(upward, axis=1)
        up = np.flatnonzero((upward[:, 1] > WORN_SURFACE.min_normal_y * length) & (whole[:, 1] > 0))
        points = surface.vertices[up]
        caster = RayCaster(surface)
        above = points.copy()
        above[:, 1] = surface.bounds[1, 1] + 1e-3
        first = caster.first(above, DOWN)[0]
        top = np.abs(above[:, 1] - first - points[:, 1]) < 10 * WORN_SURFACE.ray_offset
        thickness = (
            WORN_SURFACE.ray_offset + caster.first(points + WORN_SURFACE.ray_offset * DOWN, DOWN)[0]
        )
        sampled = top & np.isfinite(thickness)
        if not sampled.any():
            raise InputError("no part of it faces upwards", insert.name, "check the mesh's axes")
        return cls(surface, up[sampled], thickness[sampled])

    def lowered(self, fall: Array) -> Surface:
        """Return the insert with its articular vertices moved down by `fall` (n,) m."""
        vertices = self.surface.vertices.copy()
        vertices[self.vertices, 1] -= fall
        return Surface(vertices, self.surface.faces, self.surface.name)

    def normals_and_areas(self, lowered: Surface) -> tuple[Array, Array]:
        """Return unit normals (n, 3) and areas (n,) m² of the vertices of a lowered surface."""
        upward, whole = (vectors[self.vertices] for vectors in area_vectors(lowered))
        normals = upward / np.linalg.norm(upward, axis=1)[:, None]
        return normals, whole[:, 1] / normals[:, 1]


def area_vectors(surface: Surface) -> tuple[Array, Array]:
    """Return a third of the area vectors of each vertex's triangles, summed, (n, 3) m².

    Returns:
        The sums over those that face upwards, and over all.
    """
    a, b, c = np.moveaxis(surface.triangles, 1, 0)
    vector = np.cross(b - a, c - a) / 6.0
    corners, count = surface.faces.T.ravel(), len(surface.vertices)

    def summed(each: Array) -> Array:
        return np.stack([np.bincount(corners, np.tile(v, 3), count) for v in each.T], axis=1)

    up = surface.face_normals[:, 1] > WORN_SURFACE.min_normal_y
    return summed(np.where(up[:, None], vector, 0.0)), summed(vector)


def volume(surface: Surface) -> float:
    """Return the volume inside a closed surface, m³."""
    a, b, c = np.moveaxis(surface.triangles - surface.bounds.mean(axis=0), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def refined(surface: Surface, longest: float, chosen: Chosen) -> Surface:
    """Return the surface with the edges of chosen faces halved until none exceeds `longest` (m).

    Both faces of an edge see the same new vertex, so that a closed surface stays closed; points
    of the surface stay where they are. First vertices are those of the surface.

    Args:
        surface: mesh whose faces share their vertices.
        longest: m.
        chosen: says of a surface's faces (k,) which are to be refined.
    """
    for _ in range(WORN_SURFACE.max_halvings):
        halved = _halved(surface, longest, chosen(surface))
        if halved is None:
            break
        surface = halved
    return surface


def _halved(surface: Surface, longest: float, chosen: NDArray[np.bool_]) -> Surface | None:
    """Return the surface with every long edge of chosen faces halved; None: there is none."""
    faces, vertices = surface.faces, surface.vertices
    edge, count = edge_use(faces)
    edge = edge.reshape(-1, 3)  # edges 01, 12, 20 of each face
    start, end = faces, np.roll(faces, -1, axis=1)
    long = np.linalg.norm(vertices[end] - vertices[start], axis=2) > longest
    marked = np.zeros(len(count), bool)
    marked[edge[long & chosen[:, None]]] = True
    if not marked.any():
        return None
    number = np.full(len(count), -1)
    number[marked] = len(vertices) + np.arange(marked.sum())
    middles = np.empty((marked.sum(), 3))
    middles[number[edge[marked[edge]]] - len(vertices)] = (
        0.5 * (vertices[start] + vertices[end])[marked[edge]]
    )
    points = np.concatenate([vertices, middles])
    return Surface(points, _split(faces, number[edge], points), surface.name)


def _split(faces: NDArray[np.int64], middle: NDArray[np.int64], points: Array) -> NDArray[np.int64]:
    """Return the faces cut at the middles (k, 3) of their edges; -1: not halved."""
    cut = middle >= 0
    many = cut.sum(axis=1)
    parts = [faces[many == 0]]
    for count, first in ((1, cut), (2, ~cut)):  # turn each face so that its odd edge comes first
        rows = np.flatnonzero(many == count)
        turn = (first[rows].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[rows], turn, axis=1).T
        ab, bc, ca = np.take_along_axis(middle[rows], turn, axis=1).T
        if count == 1:
            parts += [np.stack([a, ab, c], 1), np.stack([ab, b, c], 1)]
            continue
        # a-b is whole: the tip c comes off, the rest is cut along its shorter diagonal
        parts.append(np.stack([ca, bc, c], 1))
        shorter = np.linalg.norm(points[a] - points[bc], axis=1) <= np.linalg.norm(
            points[b] - points[ca], axis=1
        )
        one = np.stack(
            [np.where(shorter, a, b), np.where(shorter, b, bc), np.where(shorter, bc, ca)]
        )
        two = np.stack([a, np.where(shorter, bc, b), ca])
        parts += [one.T, two.T]
    rows = np.flatnonzero(many == 3)
    (a, b, c), (ab, bc, ca) = faces[rows].T, middle[rows].T
    parts += [np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(parts)
