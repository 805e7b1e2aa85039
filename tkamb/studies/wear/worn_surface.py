"""Articular surface of the insert: refinement, tributary areas, and change by wear and creep."""

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
    """Surface from which wear is removed."""

    min_normal_y: float = 0.1
    """Smallest y component of the unit normal of a face that can wear. Such a face
    is inclined by 84 deg."""
    ray_offset: float = 1e-6
    """m: depth below the surface at which rays through the insert begin. Above the round-off
    of a mesh."""
    max_halvings: int = 12
    """Largest number of halvings of an edge. They reduce one metre to a quarter of a
    millimetre."""


WORN_SURFACE = WornSurfaceSettings()


@dataclass(frozen=True, eq=False)
class ArticularSurface:
    """The upward-facing vertices of the insert, with their tributary areas.

    A vertex has a third of the area vector of each of its triangles. Its normal n is the direction
    of the sum over its upward-facing triangles, so at the rim the wall has no effect. Its area is
    the y component of the sum over all its triangles, divided by n_y.

    A worn depth h along the normal moves the vertex down by h/n_y. The volume of a closed surface
    is linear in y, so for any depth exactly

        volume removed = sum over vertices of h times area

    Args:
        surface: insert in the insert frame, refined where it can wear.
        vertices: numbers of the n vertices that can wear, shape (n,).
        thickness: thickness of the unworn insert below each vertex along y, m, shape (n,).
    """

    surface: Surface
    vertices: NDArray[np.int64]
    thickness: Array

    @classmethod
    def of_insert(cls, insert: Surface, spacing: float) -> "ArticularSurface":
        """Return the articular surface of an insert, with edges of at most `spacing`, m."""
        merged = insert.mesh.copy()
        merged.merge_vertices()
        finer = refined(
            Surface(np.asarray(merged.vertices), np.asarray(merged.faces), insert.name),
            spacing,
            lambda s: s.face_normals[:, 1] > WORN_SURFACE.min_normal_y,
        )
        surface = insert.remade(finer.vertices, finer.faces)
        upward, total = area_vectors(surface)
        length = np.linalg.norm(upward, axis=1)
        up = np.flatnonzero((upward[:, 1] > WORN_SURFACE.min_normal_y * length) & (total[:, 1] > 0))
        points = surface.vertices[up]
        caster = RayCaster(surface)
        above = points.copy()
        above[:, 1] = surface.bounds[1, 1] + 1e-3
        first = caster.first(above, DOWN)[0]
        # a vertex below another part of the insert cannot wear
        top = np.abs(above[:, 1] - first - points[:, 1]) < 10 * WORN_SURFACE.ray_offset
        thickness = (
            WORN_SURFACE.ray_offset + caster.first(points + WORN_SURFACE.ray_offset * DOWN, DOWN)[0]
        )
        can_wear = top & np.isfinite(thickness)
        if not can_wear.any():
            raise InputError("no part of it faces upwards", insert.name, "check the mesh's axes")
        return cls(surface, up[can_wear], thickness[can_wear])

    def lowered(self, fall: Array) -> Surface:
        """Return the insert with its articular vertices moved down by `fall`, m, shape (n,)."""
        vertices = self.surface.vertices.copy()
        vertices[self.vertices, 1] -= fall
        return self.surface.remade(vertices, self.surface.faces)

    def normals_and_areas(self, lowered: Surface) -> tuple[Array, Array]:
        """Return unit normals (n, 3) and areas, m², (n,) of the vertices of a lowered surface."""
        upward, total = (vectors[self.vertices] for vectors in area_vectors(lowered))
        normals = upward / np.linalg.norm(upward, axis=1)[:, None]
        return normals, total[:, 1] / normals[:, 1]


def area_vectors(surface: Surface) -> tuple[Array, Array]:
    """Return a third of the summed area vectors of the triangles at each vertex, m², shape (n, 3).

    Returns:
        Sums over the upward-facing triangles, and over all triangles.
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
    """Return the surface with the edges of chosen faces halved until none exceeds `longest`.

    Both faces of an edge get the same new vertex, so a closed surface stays closed. The shape does
    not change, and the original vertices come first.

    Args:
        longest: largest length of an edge, m.
        chosen: function of a surface that returns whether to refine each face, shape (k,).
    """
    for _ in range(WORN_SURFACE.max_halvings):
        halved = _halved(surface, longest, chosen(surface))
        if halved is None:
            break
        surface = halved
    return surface


def _halved(surface: Surface, longest: float, chosen: NDArray[np.bool_]) -> Surface | None:
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
    """Return the faces after a division of their edges.

    `middle` has the number of the vertex in the middle of each edge, shape (k, 3); -1: not divided.
    """
    cut = middle >= 0
    cuts = cut.sum(axis=1)
    parts = [faces[cuts == 0]]
    # the first edge of a rotated face is its only divided or its only undivided edge
    for count, first in ((1, cut), (2, ~cut)):
        rows = np.flatnonzero(cuts == count)
        order = (first[rows].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[rows], order, axis=1).T
        ab, bc, ca = np.take_along_axis(middle[rows], order, axis=1).T
        if count == 1:
            parts += [np.stack([a, ab, c], 1), np.stack([ab, b, c], 1)]
            continue
        # a-b is undivided: cut off the corner c, then divide the rest along its shorter diagonal
        parts.append(np.stack([ca, bc, c], 1))
        shorter = np.linalg.norm(points[a] - points[bc], axis=1) <= np.linalg.norm(
            points[b] - points[ca], axis=1
        )
        first_half = np.stack(
            [np.where(shorter, a, b), np.where(shorter, b, bc), np.where(shorter, bc, ca)]
        )
        second_half = np.stack([a, np.where(shorter, bc, b), ca])
        parts += [first_half.T, second_half.T]
    rows = np.flatnonzero(cuts == 3)
    (a, b, c), (ab, bc, ca) = faces[rows].T, middle[rows].T
    parts += [np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(parts)
