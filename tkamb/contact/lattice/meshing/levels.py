"""Layers of nodes that follow the top of the insert.

On a grid of level layers a dish is a staircase: wherever the number of cells in a column
changes, a wedge under the surface belongs to no cell (3.4 to 4 % of real inserts at 1 mm with
the half-cell rule alone). So the layers between the flat bottom and one reference layer are
stretched, column by column, to the top surface, as far as the edge ratio permits:

    y_j(x, z) = j H(x, z) / J          0 <= j <= J

Above the reference layer (a post, an eminence) and below the bottom (a peg) the spacing is the
grid's own. H is the top where that is smooth, and is carried on underneath what stands out.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from tkamb.geometry.frames import Array, Index


@dataclass(frozen=True)
class LayerSettings:
    """The layers of cells below the articular surface."""

    max_edge_ratio: float = 1.4
    """1: longest over shortest edge of a cell before its nodes are moved onto the surface. Chosen:
    flatter hexahedra are too stiff in bending."""
    max_slope: float = 1.0
    """1: steepest slope, rise over run, that the layers follow (45 deg). Chosen: steeper layers
    would shear the cells."""
    max_low_share: float = 0.01
    """1: largest share of the columns that may be too low for the layers. Chosen: a few columns at
    the rim."""


LAYER = LayerSettings()


@dataclass(frozen=True, eq=False)
class Levels:
    """Heights of the node layers over the columns of the grid.

    Args:
        reference: (nx, nz) m, height H of the reference layer.
        layers: J, cells between the bottom and the reference layer.
        below: layers under the bottom.
        spacing: m, of the layers above the reference layer and below the bottom.
        count: number of layers of nodes.
    """

    reference: Array
    layers: int
    below: int
    spacing: float
    count: int

    def position(self, height: Array, i: Index, k: Index) -> Array:
        """Return the position of heights (m,) among the layers of columns (i, k); a fraction."""
        reference = self.reference[i, k]
        within = np.clip(height, 0.0, reference) * self.layers / reference
        outside = np.minimum(height, 0.0) + np.maximum(height - reference, 0.0)
        return self.below + within + outside / self.spacing

    def heights(self) -> Array:
        """Return the heights (nx, count, nz) of all grid nodes, m."""
        j = np.arange(self.count)[None, :, None] - self.below
        within = np.clip(j, 0, self.layers) * self.reference[:, None, :] / self.layers
        outside = np.minimum(j, 0) + np.maximum(j - self.layers, 0)
        return within + outside * self.spacing


def follow_top(top: Array, lowest: float, spacing: Array) -> Levels:
    """Return the layers for columns whose highest point is `top`.

    Args:
        top: (nx, nz) m, NaN where the column misses the part.
        lowest: m, lowest point of the part; the flat bottom is y = 0.
        spacing: (3,) m, of the grid.
    """
    across = spacing[[0, 2]]
    thinnest, thickest = across.max() / LAYER.max_edge_ratio, across.min() * LAYER.max_edge_ratio
    layers = _reference_layers(top[np.isfinite(top)], thinnest, thickest, spacing[1])
    clipped = np.clip(top, layers * thinnest, layers * thickest)
    reference = _filled(_slope_limited(_smooth_part(clipped, across), across))
    excess = np.nanmax(top - reference)
    above = max(int(np.ceil(excess / spacing[1] - 1e-6)), 0) + 1
    below = max(int(np.ceil(-lowest / spacing[1] - 0.5)), 0)
    return Levels(reference, layers, below, float(spacing[1]), below + layers + above + 1)


def _reference_layers(top: Array, thinnest: float, thickest: float, spacing: float) -> int:
    """Return the number of layers that can follow the largest part of the top.

    Where the top is more than half a layer too low for them, the layers end in a step, whose
    edge has a cell on one side only and half the support: no number is taken that puts such
    steps into the dishes. On a step higher up no condyle stands.
    """
    candidates = np.arange(1, int(np.ceil(top.max() / thinnest)) + 1)
    stepped = np.array([np.mean(top < (n - 0.5) * thinnest) for n in candidates])
    candidates = candidates[stepped <= max(LAYER.max_low_share, stepped.min())]
    covered = [np.mean((top >= n * thinnest) & (top <= n * thickest)) for n in candidates]
    best = candidates[np.isclose(covered, np.max(covered), atol=1e-3)]
    return int(best[np.argmin(np.abs(best - np.median(top) / spacing))])


def _smooth_part(height: Array, across: Array) -> Array:
    """Return the heights of the largest patch of columns joined by slopes <= 1, else NaN."""
    number = np.arange(height.size).reshape(height.shape)
    links = []
    for axis in range(2):
        gentle = np.abs(np.diff(height, axis=axis)) <= LAYER.max_slope * across[axis] * (1.0 + 1e-9)
        low = np.delete(number, -1, axis=axis)[gentle]
        high = np.delete(number, 0, axis=axis)[gentle]
        links.append(np.stack([low, high]))
    a, b = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(height.size, height.size))
    label = connected_components(graph, directed=False)[1].reshape(height.shape)
    finite = np.isfinite(height)
    largest = np.bincount(label[finite]).argmax()
    return np.where(finite & (label == largest), height, np.nan)


def _slope_limited(height: Array, across: Array) -> Array:
    """Return the largest function below `height` whose slope is at most MAX_SLOPE."""
    result = np.where(np.isfinite(height), height, np.inf)
    while True:
        before = result.copy()
        for axis in range(2):
            rise = LAYER.max_slope * across[axis]
            along_axis = np.moveaxis(result, axis, 0)
            along_axis[1:] = np.minimum(along_axis[1:], along_axis[:-1] + rise)
            along_axis[:-1] = np.minimum(along_axis[:-1], along_axis[1:] + rise)
        if np.array_equal(before, result):
            return np.where(np.isfinite(height), result, np.nan)


def _filled(height: Array) -> Array:
    """Return the heights with NaN replaced by the harmonic continuation of the others."""
    unknown = np.isnan(height)
    if not unknown.any():
        return height
    number = np.arange(height.size).reshape(height.shape)
    pairs = np.concatenate(
        [
            np.stack([number[:-1].ravel(), number[1:].ravel()]),
            np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()]),
        ],
        axis=1,
    )
    a, b = np.concatenate([pairs, pairs[::-1]], axis=1)
    ones = np.ones(len(a))
    weights = coo_array((ones, (a, b)), shape=(height.size, height.size)).tocsr()
    degree = np.bincount(a, minlength=height.size)
    free, fixed = np.flatnonzero(unknown), np.flatnonzero(~unknown)
    laplacian = (
        coo_array(
            (degree[free].astype(float), (np.arange(len(free)), np.arange(len(free))))
        ).tocsr()
        - (weights[free][:, free])
    )
    result = height.ravel().copy()
    result[free] = spsolve(laplacian.tocsc(), weights[free][:, fixed] @ result[fixed])
    return result.reshape(height.shape)
