"""A triangulated surface with no edge longer than asked for, still closed, still the same shape."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import edge_use

Chosen = Callable[[Surface], NDArray[np.bool_]]

MOST_ROUNDS = 12
"""Halvings; an edge of a metre ends at a quarter of a millimetre."""


def refined(surface: Surface, longest: float, chosen: Chosen) -> Surface:
    """Return the surface with the edges of chosen faces halved until none exceeds `longest` (m).

    Both faces of an edge see the same new vertex, so that a closed surface stays closed; points
    of the surface stay where they are. First vertices are those of the surface.

    Args:
        surface: whose faces share their vertices.
        longest: m.
        chosen: says of a surface's faces (k,) which are to be refined.
    """
    for _ in range(MOST_ROUNDS):
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
