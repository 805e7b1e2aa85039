"""Geometry of an eight-node cell: pairs, mean gradient, Gauss points, repeated shapes.

Corners are in VTK hexahedron order with the cell's own axes along x, y and z.
"""

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.cells import CORNERS, PAIRS
from tkamb.geometry.frames import Array

PAIR_AXES = np.abs(np.diff(CORNERS[PAIRS], axis=1))[:, 0]
"""Axes along which the ends of each pair differ (28, 3), 0 or 1: 1 edge, 2 face, 3 body."""

_GAUSS = 0.5 + (CORNERS - 0.5) / np.sqrt(3.0)


def shape_gradients(at: Array) -> Array:
    """Return reference gradients (8, 3) of the trilinear shape functions at a point of [0, 1]³."""
    factor = np.where(CORNERS == 1, at, 1 - at)
    sign = np.where(CORNERS == 1, 1.0, -1.0)
    return np.stack(
        [sign[:, d] * factor[:, (d + 1) % 3] * factor[:, (d + 2) % 3] for d in range(3)], axis=1
    )


def gauss_gradients(corners: Array) -> tuple[Array, Array]:
    """Return shape-function gradients and weights at the 2×2×2 Gauss points.

    Args:
        corners: (s, 8, 3) m.

    Returns:
        Gradients (s, 8 points, 8 nodes, 3), 1/m, and weights (s, 8), m³, whose sum is the
        cell's volume. A weight that is not positive marks an inverted cell.
    """
    reference = np.stack([shape_gradients(at) for at in _GAUSS])
    jacobian = np.einsum("gnd,snx->sgdx", reference, corners)
    weights = np.linalg.det(jacobian) / 8
    gradients = np.einsum("sgxd,gnd->sgnx", np.linalg.inv(jacobian), reference)
    return gradients, weights


def mean_gradient(corners: Array) -> tuple[Array, Array]:
    """Return the volume-averaged gradients (s, 8, 3), 1/m, and the volume (s,), m³.

    They reproduce a linear field exactly: sum_i x_i g_i = identity
    (Flanagan & Belytschko, Int J Numer Meth Eng 17:679, 1981).
    """
    gradients, weights = gauss_gradients(corners)
    volume = weights.sum(axis=1)
    return np.einsum("sg,sgnx->snx", weights, gradients) / volume[:, None, None], volume


def group_shapes(corners: Array, tolerance: float = 1e-9) -> tuple[Array, NDArray[np.int64]]:
    """Return the distinct cell shapes (s, 8, 3) and each cell's shape (c,).

    Cells of a regular lattice repeat: what depends on shape alone is worked out once. Two
    shapes are the same when their corners differ by less than about `tolerance` (m).
    """
    relative = corners - corners[:, :1]
    keys = np.round(relative.reshape(len(corners), 24) / tolerance).astype(np.int64)
    _, first, shape = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return relative[first], shape.reshape(-1).astype(np.int64)
