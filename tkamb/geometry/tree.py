"""A tree of bounding boxes over a surface's triangles, for rays and nearest points.

The triangles are halved at the median along the longest side of their box, again and again, until
a leaf holds a few. All leaves lie equally deep, so that the tree needs no pointers: the children
of box i are 2i and 2i + 1, from the root, 1. A search visits the nearer child first and skips
boxes beyond its best result. Every triangle is evaluated by itself in double precision, so that
the result does not depend on the order of the search.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


@dataclass(frozen=True)
class BoxTreeSettings:
    """The tree of boxes around a surface's triangles."""

    triangles_per_leaf: int = 4
    """Triangles in a leaf, at most. Chosen: it changes speed alone."""
    margin: float = 1e-7
    """1: boxes are wider by this share of the surface's size. Chosen: above rounding."""


BOX_TREE = BoxTreeSettings()


def rows(vectors: ArrayLike) -> Array:
    """Return vectors (n, 3) as the loops take them; one (3,) as (1, 3).

    Contiguous, writable, double precision: other arrays would compile the loops again.
    """
    return np.require(vectors, np.float64, ["C", "W", "E"]).reshape(-1, 3)


class TriangleTree:
    """The tree of one surface, in its frame.

    Args:
        surface: of any triangles.
        chosen: which of them; None: all.

    Attributes:
        boxes: (2 p, 6) m, smallest and largest coordinates; those of leaf l are at p + l.
        faces: (p c,) the triangles of the leaves, c each; some of them twice.
    """

    def __init__(self, surface: "Surface", chosen: Index | None = None) -> None:
        self._surface, corners = surface, surface.triangles
        low, high = corners.min(axis=1), corners.max(axis=1)
        chosen = np.arange(len(corners)) if chosen is None else chosen
        # A triangle without area has no normal, and its edges belong to other triangles, too.
        real = chosen[surface.areas[chosen] > 0.0]
        chosen = real if len(real) else chosen
        leaves = chosen[_halved(0.5 * (low + high)[chosen])]
        margin = BOX_TREE.margin * float(np.linalg.norm(np.ptp(surface.bounds, axis=0)))
        count = len(leaves)
        self.faces = leaves.ravel()
        self.boxes = np.zeros((2 * count, 6))
        self.boxes[count:, :3] = low[leaves].min(axis=1) - margin
        self.boxes[count:, 3:] = high[leaves].max(axis=1) + margin
        while count > 1:
            pairs = self.boxes[count : 2 * count].reshape(-1, 2, 6)
            count //= 2
            self.boxes[count : 2 * count, :3] = pairs[:, :, :3].min(axis=1)
            self.boxes[count : 2 * count, 3:] = pairs[:, :, 3:].max(axis=1)

    @cached_property
    def corners(self) -> Array:
        """Corner points (p c, 9), m, of the leaves' triangles."""
        return self._surface.triangles.reshape(-1, 9)[self.faces]

    @cached_property
    def supports(self) -> Array:
        """Planes (2 p, 4) that all triangles of a box stay behind: unit normals n, and n . x, m.

        The normals are the mean ones of the triangles, so that the planes lie close where the
        surface is nearly flat; zero where there is none.
        """
        count = len(self.boxes) // 2
        planes = np.zeros((2 * count, 4))
        vertices = self.corners.reshape(-1, 3)
        total = (self._surface.areas[:, None] * self._surface.face_normals)[self.faces]
        while count:
            level, total = planes[count : 2 * count], total.reshape(count, -1, 3).sum(axis=1)
            length = np.linalg.norm(total, axis=1, keepdims=True)
            np.divide(total, length, out=level[:, :3], where=length > 0.0)
            along = vertices.reshape(count, -1, 3) @ level[:, :3, None]
            level[:, 3] = along[:, :, 0].max(axis=1)
            count //= 2
        return planes


def _halved(centres: Array) -> Index:
    """Return the triangles of the leaves (p, c), p a power of two; some twice, to fill them."""
    leaves = 1
    while leaves * BOX_TREE.triangles_per_leaf < len(centres):
        leaves *= 2
    room = leaves * -(-len(centres) // leaves)
    order = np.arange(room) * len(centres) // room  # sorted ones stay sorted, and quickly parted
    _halve(np.ascontiguousarray(centres), order, leaves)
    return order.reshape(leaves, -1)


@compiled_as_written
def _halve(centres: Array, order: Index, leaves: int) -> None:
    """Order triangles: halves, quarters, eighths ... each parted along its longest side.

    Args:
        centres: (n, 3) m.
        order: (m,) triangles, to be sorted; m a multiple of the leaves.
        leaves: how many parts there are at last, a power of two.
    """
    parts = 1
    while parts < leaves:
        part_size = len(order) // parts
        for first in range(0, len(order), part_size):
            longest, axis = -1.0, 0
            for k in range(3):
                low, high = np.inf, -np.inf
                for n in range(first, first + part_size):
                    low, high = min(low, centres[order[n], k]), max(high, centres[order[n], k])
                if high - low > longest:
                    longest, axis = high - low, k
            _part(centres, order, axis, first, first + part_size - 1, first + part_size // 2)
        parts *= 2


@compiled_as_written
def _part(centres: Array, order: Index, axis: int, first: int, last: int, middle: int) -> None:
    """Move smaller values before the middle of a part, larger ones behind it (Hoare 1961).

    Args:
        centres: (n, 3) m.
        order: (m,).
        axis: by which they are compared.
        first: place of the first in the order.
        last: of the last.
        middle: place whose item is the one that a full sort would put there.
    """
    while first < last:
        pivot = centres[order[(first + last) // 2], axis]
        low, high = first, last
        while low <= high:
            while centres[order[low], axis] < pivot:
                low += 1
            while centres[order[high], axis] > pivot:
                high -= 1
            if low <= high:
                order[low], order[high] = order[high], order[low]
                low, high = low + 1, high - 1
        if middle <= high:
            last = high
        elif middle >= low:
            first = low
        else:
            return
