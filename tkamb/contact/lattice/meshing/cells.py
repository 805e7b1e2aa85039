"""Cells of eight nodes: corners, springs, quality and shape functions.

Corners are in VTK hexahedron order, with the axes i, j, k along x, y, z.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index

CORNERS = np.array(
    [
        [0, 0, 0],
        [1, 0, 0],
        [1, 1, 0],
        [0, 1, 0],
        [0, 0, 1],
        [1, 0, 1],
        [1, 1, 1],
        [0, 1, 1],
    ]
)
"""Corner offsets (i, j, k) of a cell in the order of VTK's hexahedron."""

NEIGHBOURS = np.array(
    [
        [np.argmax((np.abs(o - e) == CORNERS).all(axis=1)) for e in np.eye(3, dtype=int)]
        for o in CORNERS
    ]
)
"""Number of the corner at the other end of each corner's edge along x, y and z, (8, 3)."""

PAIRS = np.array([(a, b) for a in range(8) for b in range(a + 1, 8)])
"""The 28 pairs of corners that springs join."""

PAIR_AXES = np.abs(np.diff(CORNERS[PAIRS], axis=1))[:, 0]
"""Axes along which a pair's corners differ, 0 or 1, (28, 3): one for an edge, two for a face
diagonal, three for a body diagonal.
"""

_GAUSS = 0.5 + (CORNERS - 0.5) / np.sqrt(3.0)

DIRECTIONS = np.array(
    [
        [1, 0, 0],
        [0, 1, 0],
        [0, 0, 1],
        [1, 1, 0],
        [1, -1, 0],
        [0, 1, 1],
        [0, 1, -1],
        [1, 0, 1],
        [1, 0, -1],
        [1, 1, 1],
        [1, 1, -1],
        [1, -1, 1],
        [-1, 1, 1],
    ]
)
"""The 13 directions of springs: edges x, y, z; face diagonals xy, yz, xz; body diagonals."""

FAMILY_SHARE = np.array([0.25] * 3 + [0.5] * 6 + [1.0] * 4)
"""Share of one cell in a spring of each direction: four cells share an edge, two a face."""

FACES = np.array(
    [[0, 3, 7, 4], [1, 2, 6, 5], [0, 1, 5, 4], [3, 2, 6, 7], [0, 1, 2, 3], [4, 5, 6, 7]]
)
"""Corners of the six faces: -x, +x, -y, +y, -z, +z."""


EDGES = np.array(
    [
        (a, b)
        for axis in range(3)
        for a in range(8)
        for b in range(8)
        if (CORNERS[b] - CORNERS[a]).tolist() == np.eye(3, dtype=int)[axis].tolist()
    ]
)
"""The 12 edges as pairs of corners, four along each of x, y, z."""


@dataclass(frozen=True, eq=False)
class Springs:
    """The springs of a lattice, each once.

    Args:
        ends: end nodes, (s, 2).
        family: row of DIRECTIONS, (s,).
        owners: number of cells that share the spring, (s,).
        of_cell: springs of each cell, in the order of PAIRS, (c, 28).
    """

    ends: Index
    family: NDArray[np.int8]
    owners: Index
    of_cell: Index


def join_springs(cells: Index, node_count: int) -> Springs:
    """Return the springs of cells (c, 8), each once."""
    offset = CORNERS[PAIRS[:, 1]] - CORNERS[PAIRS[:, 0]]
    # Cells that have both end nodes share a spring. Its first node and its direction identify it.
    forward = (offset[:, None, :] == DIRECTIONS).all(axis=2)
    backward = (-offset[:, None, :] == DIRECTIONS).all(axis=2)
    family = (forward | backward).argmax(axis=1)
    start = np.where(forward.any(axis=1), PAIRS[:, 0], PAIRS[:, 1])
    end = np.where(forward.any(axis=1), PAIRS[:, 1], PAIRS[:, 0])
    key = cells[:, start] * len(DIRECTIONS) + family
    owners = np.bincount(key.ravel(), minlength=node_count * len(DIRECTIONS))
    used = np.flatnonzero(owners)
    number = np.full(len(owners), -1)
    number[used] = np.arange(len(used))
    of_cell = number[key]
    ends = np.empty((len(used), 2), np.int64)
    ends[of_cell] = np.stack([cells[:, start], cells[:, end]], axis=-1)
    return Springs(ends, (used % len(DIRECTIONS)).astype(np.int8), owners[used], of_cell)


@compiled
def scaled_jacobians(points: Array) -> Array:
    """Return the least scaled Jacobian (c,) of cells (c, 8, 3): 1 for a box, <= 0 if inverted."""
    result, edges, lengths = np.full(len(points), np.inf), np.empty((3, 3)), np.empty(3)
    for cell in range(len(points)):
        for corner in range(8):
            for axis in range(3):
                sign = 1 - 2 * CORNERS[corner, axis]
                for d in range(3):
                    beside = points[cell, NEIGHBOURS[corner, axis], d]
                    edges[axis, d] = sign * (beside - points[cell, corner, d])
                lengths[axis] = np.sqrt((edges[axis] ** 2).sum())
            length, volume = lengths[0] * lengths[1] * lengths[2], 0.0
            for d in range(3):
                e, f = (d + 1) % 3, (d + 2) % 3
                volume += edges[2, d] * (edges[0, e] * edges[1, f] - edges[0, f] * edges[1, e])
            # This is the volume spanned by unit edges: 1 at a right-angled corner, 0 at a flat one.
            result[cell] = min(result[cell], volume / length if length > 0 else 0.0)
    return result


def shortest_edges(points: Array) -> Array:
    """Return the length (c,) of the shortest edge of cells (c, 8, 3), m."""
    edges = points[:, EDGES[:, 1]] - points[:, EDGES[:, 0]]
    return np.linalg.norm(edges, axis=2).min(axis=1)


def cell_volumes(points: Array) -> Array:
    """Return the exact volumes (c,) of trilinear cells (c, 8, 3), by 2 x 2 x 2 Gauss points."""
    return np.linalg.det(_jacobians(points)).sum(axis=1) / 8


def shape_gradients(at: Array) -> Array:
    """Return the gradients (8, 3) of the trilinear shape functions at a point of [0, 1]³."""
    # A shape function is the product of x or 1 - x for each axis.
    factor = np.where(CORNERS == 1, at, 1 - at)
    sign = np.where(CORNERS == 1, 1.0, -1.0)
    return np.stack(
        [sign[:, d] * factor[:, (d + 1) % 3] * factor[:, (d + 2) % 3] for d in range(3)], axis=1
    )


REFERENCE_GRADIENTS = np.stack([shape_gradients(at) for at in _GAUSS])
"""Gradients at the 2 x 2 x 2 Gauss points of [0, 1]³, (8 points, 8 nodes, 3)."""


def _jacobians(corners: Array) -> Array:
    return np.einsum("gnd,snx->sgdx", REFERENCE_GRADIENTS, corners)


def gauss_gradients(corners: Array) -> tuple[Array, Array]:
    """Return gradients (s, 8 points, 8 nodes, 3), 1/m, and weights (s, 8), m³, at Gauss points.

    The weights add up to the cell's volume; a cell with a weight <= 0 is inverted.
    """
    jacobian = _jacobians(corners)
    # The eight Gauss points of the unit cube have equal weights.
    weights = np.linalg.det(jacobian) / 8
    gradients = np.einsum("sgxd,gnd->sgnx", np.linalg.inv(jacobian), REFERENCE_GRADIENTS)
    return gradients, weights


@compiled
def mean_gradient(corners: Array) -> tuple[Array, Array]:
    """Return the volume-averaged gradients g_i (s, 8, 3), 1/m, and the volume (s,), m³.

    A linear field has its exact gradient: sum_i x_i g_i = identity (Flanagan & Belytschko, Int J
    Numer Meth Eng 17:679, 1981). The Jacobian's cofactors also suit inverted cells.
    """
    gradients, volume = np.zeros((len(corners), 8, 3)), np.zeros(len(corners))
    j, cofactor = np.empty((3, 3)), np.empty((3, 3))
    for cell in range(len(corners)):
        for point in range(8):
            j[:] = 0.0
            for node in range(8):
                for d in range(3):
                    for x in range(3):
                        j[d, x] += REFERENCE_GRADIENTS[point, node, d] * corners[cell, node, x]
            for d in range(3):
                e, f = (d + 1) % 3, (d + 2) % 3
                for x in range(3):
                    y, z = (x + 1) % 3, (x + 2) % 3
                    cofactor[d, x] = (j[e, y] * j[f, z] - j[e, z] * j[f, y]) / 8
            for x in range(3):
                volume[cell] += j[0, x] * cofactor[0, x]
            for node in range(8):
                for d in range(3):
                    for x in range(3):
                        gradients[cell, node, x] += (
                            cofactor[d, x] * REFERENCE_GRADIENTS[point, node, d]
                        )
        gradients[cell] /= volume[cell]
    return gradients, volume
