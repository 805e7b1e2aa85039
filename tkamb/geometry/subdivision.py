"""The coarser triangles of a mesh that is a flat subdivision.

There every edge of a coarser mesh was halved without a change of shape, so that only the coarser
triangles show the curvature.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tkamb.geometry.frames import Array, Index
from tkamb.geometry.topology import Ragged, edge_use

# 1: largest distance of a vertex from the middle of a coarser edge, as a share of the surface's
# size. Files round coordinates by less.
HALVING_TOLERANCE = 1e-6
# Largest number of subdivisions that are undone. 8 subdivisions make 65,536
# triangles of one.
MOST_LEVELS = 8
# Largest number of connected parts; a surface of more parts stays unchanged. No
# implant has as many.
MOST_PARTS = 100


@dataclass(frozen=True, eq=False)
class Coarsened:
    """The coarser triangles of a subdivided mesh, and the positions of the finer ones on them.

    Args:
        faces: (m, 3) vertices of the coarser triangles.
        parent: (k,) coarser triangle that contains each finer triangle.
        corners: (k, 3, 3) barycentric coordinates, on the parent, of each finer triangle's corners.
    """

    faces: Index
    parent: Index
    corners: Array


def coarsened(vertices: Array, faces: Index) -> Coarsened | None:
    """Return the coarsest triangles that subdivide flatly into these; None if there are none.

    Each connected part, with shared vertices, is undone as a whole or not at all.
    """
    coarse: Coarsened | None = None
    for _ in range(MOST_LEVELS):
        step = _coarsened_once(vertices, faces if coarse is None else coarse.faces)
        if step is None:
            break
        if coarse is None:
            coarse = step
        else:
            corners = coarse.corners @ step.corners[coarse.parent]
            coarse = Coarsened(step.faces, step.parent[coarse.parent], corners)
    return coarse


def _coarsened_once(vertices: Array, faces: Index) -> Coarsened | None:
    across = _across(faces)
    count, part = _parts(across)
    if count > MOST_PARTS:
        return None
    search = _Search(vertices, faces, across)
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
    return Coarsened(tips, parent, corners)


class _Search:
    """Search for the middle triangles of coarser triangles that were divided into four.

    A middle's corners halve the edges between its neighbours' tips, the corners of the coarser
    triangle. The search spreads from one middle across these tips.
    """

    def __init__(self, vertices: Array, faces: Index, across: Index) -> None:
        self._points, self._faces, self._across = vertices, faces, across
        self._near = HALVING_TOLERANCE * float(np.linalg.norm(np.ptp(vertices, axis=0)))
        self._corners = Ragged.by_key(faces.ravel(), len(vertices))

    def tips(self, middle: Index) -> Index:
        """Return tips (m, 3): the vertex of each neighbour that the middle lacks."""
        neighbours, corners = self._faces[self._across[middle]], self._faces[middle]
        shared = (neighbours[:, :, :, None] == corners[:, None, None]).any(axis=3)
        return np.take_along_axis(neighbours, np.argmin(shared, axis=2)[..., None], axis=2)[..., 0]

    def middles_of(self, part: Index) -> Index:
        """Return a connected part's middle triangles; none if it was not subdivided."""
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
        """Return whether all corners halve the edges between their neighbours' tips."""
        if (faces < 0).any() or (self._across[faces] < 0).any():
            return False
        a, b, c = np.moveaxis(self._points[self.tips(faces)], 1, 0)
        halves = 0.5 * np.stack([b + c, c + a, a + b], axis=1)
        return bool(np.abs(halves - self._points[self._faces[faces]]).max() <= self._near)

    def _beyond(self, tips: Index) -> Index:
        """Return the faces across the edges opposite to the tips."""
        return np.unique(self._across.ravel()[self._corners.of(tips)[1]])


def _across(faces: Index) -> Index:
    """Return (k, 3) the face opposite each corner; -1 for none or several."""
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
    face, corner = np.nonzero(across >= 0)
    ones = np.ones(len(face), np.int8)
    graph = coo_array((ones, (face, across[face, corner])), shape=(len(across),) * 2)
    count, part = connected_components(graph.tocsr(), directed=False)
    return int(count), part.astype(np.int64)
