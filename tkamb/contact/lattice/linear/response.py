"""Response of the contact nodes to unit forces on them, from half a solve.

With K = L Lᵀ and Z = L⁻¹ E (E picks the contact nodes' unknowns) the compliance between them
is Eᵀ K⁻¹ E = Zᵀ Z: the backward half of the solves is never done. A column of Z is zero but on
the path from its node to the root of the elimination tree, and the columns of one subtree
follow each other, so Z is kept as one dense block per member of the tree, column by column:
what is asked of few nodes reads their columns alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_blas_funcs

from tkamb.compiled import compiled
from tkamb.contact.lattice.linear.multifrontal import Front
from tkamb.geometry.frames import Array, Index

Precision = type[np.floating[Any]]

SINGLE: Precision = np.float32
"""What a stored operator is kept in: it halves what every solve has to read."""


FEW = 12
"""Columns up to which products with others are taken where these lie: no copy for BLAS."""


@dataclass(frozen=True, eq=False)
class Block:
    """Rows [start, stop) of Z in its columns [first, last), the columns in sorted order.

    Args:
        start: first row, in elimination order.
        stop: one past the last row.
        first: first column.
        last: one past the last column.
        values: (v, stop - start) columns of Z, float64 or float32.
        which: (last - first,) of these.
    """

    start: int
    stop: int
    first: int
    last: int
    values: NDArray[Any]
    which: Index

    @classmethod
    def of(cls, start: int, stop: int, first: int, last: int, values: NDArray[Any]) -> "Block":
        """Return the block whose columns are all of `values`."""
        return cls(start, stop, first, last, values, np.arange(last - first))


@dataclass(frozen=True, eq=False)
class HalfResponse:
    """Z = L⁻¹ E of q unknowns.

    Args:
        rank: (q,) sorted column of each unknown as the caller numbers them; -1 if it is held.
        blocks: rows of Z that are not zero.
    """

    rank: Index
    blocks: list[Block]

    def apply(self, force: Array, y: Array) -> None:
        """Add Z f to y (in elimination order), for forces (q,) on the unknowns."""
        ordered = np.zeros(self.columns)
        ordered[self.rank[self.rank >= 0]] = force[self.rank >= 0]
        pushed = np.flatnonzero(ordered)
        for block, a, b in self._parts(pushed):
            columns = pushed[a:b]
            which = block.which[columns - block.first]
            _add_columns(block.values, which, ordered[columns], y[block.start : block.stop])

    def project(self, y: Array) -> Array:
        """Return Zᵀ y (q,): displacement of the unknowns under the load whose L⁻¹ f is y."""
        ordered = np.zeros(self.columns)
        for block in self.blocks:
            part = y[block.start : block.stop]
            if part.any():
                _add_products(block.values, block.which, part, ordered[block.first : block.last])
        return np.where(self.rank >= 0, ordered[np.maximum(self.rank, 0)], 0.0)

    def among(self, unknowns: Index) -> "HalfResponse":
        """Return the response of some of the unknowns (u,) alone; it shares the columns."""
        wanted = self.rank[unknowns]
        live = np.flatnonzero(wanted >= 0)
        order = live[np.argsort(wanted[live])]
        rank = np.full(len(unknowns), -1)
        rank[order] = np.arange(len(order))
        columns = wanted[order]
        return HalfResponse(
            rank,
            [
                Block(
                    *(block.start, block.stop, a, b, block.values),
                    block.which[columns[a:b] - block.first],
                )
                for block, a, b in self._parts(columns)
            ],
        )

    def compliance(self, some: Index | None = None) -> Array:
        """Return the compliance (s, q), m/N, of some unknowns, by default all, to all."""
        rank = self.rank if some is None else self.rank[some]
        rows, live = np.unique(rank[rank >= 0]), self.rank >= 0
        inner = np.zeros((len(rows), self.columns))
        for block, a, b in self._parts(rows):
            few = block.values[block.which[rows[a:b] - block.first]]
            if len(few) <= FEW:
                product = _products(block.values, block.which, few)
            else:
                product = few @ block.values[block.which].T
            inner[a:b, block.first : block.last] += product
        result = np.zeros((len(rank), len(self.rank)))
        index = np.searchsorted(rows, rank[rank >= 0])
        result[np.ix_(rank >= 0, live)] = inner[np.ix_(index, self.rank[live])]
        return result

    @property
    def entries(self) -> int:
        """How many numbers Z holds."""
        return sum(block.values.size for block in self.blocks)

    @property
    def columns(self) -> int:
        """How many columns Z has."""
        return int((self.rank >= 0).sum())

    def _parts(self, columns: Index) -> Iterator[tuple[Block, int, int]]:
        """Yield the blocks of some sorted columns (u,), and which [a, b) of these are theirs."""
        first, last = np.searchsorted(columns, self._spans)
        for number in np.flatnonzero(last > first):
            yield self.blocks[number], int(first[number]), int(last[number])

    @cached_property
    def _spans(self) -> Index:
        """First column (row 0) and one past the last column (row 1) of each block."""
        return np.array([(b.first, b.last) for b in self.blocks], np.int64).reshape(-1, 2).T


@compiled
def _add_columns(values: Array, which: Index, factors: Array, y: Array) -> None:
    """Add the sum of some columns times factors to y, worked out in their precision."""
    total = np.zeros(len(y), values.dtype)
    for k in range(len(which)):
        column, factor = values[which[k]], values.dtype.type(factors[k])
        for i in range(len(total)):
            total[i] += factor * column[i]
    for i in range(len(y)):
        y[i] += total[i]


@compiled
def _add_products(values: Array, which: Index, y: Array, products: Array) -> None:
    """Add some columns' products with y to `products`, worked out in their precision."""
    own = y.astype(values.dtype)
    for k in range(len(which)):
        column, total = values[which[k]], values.dtype.type(0)
        for i in range(len(own)):
            total += column[i] * own[i]
        products[k] += total


@compiled
def _products(values: Array, which: Index, few: Array) -> Array:
    """Return the products (f, k) of a few columns (f, n) with some others, in their precision."""
    result = np.empty((len(few), len(which)), values.dtype)
    for k in range(len(which)):
        column = values[which[k]]
        for f in range(len(few)):
            own, total = few[f], values.dtype.type(0)
            for i in range(len(own)):
                total += column[i] * own[i]
            result[f, k] = total
    return result


@compiled
def _take_away(target: Array, columns: Index, values: Array) -> None:
    """Take values (n, k) from some columns (k,) of the target."""
    for i in range(len(values)):
        for j in range(len(columns)):
            target[i, columns[j]] -= values[i, j]


def unknowns_of(nodes: Index) -> Index:
    """Return the three unknowns of each node (n,), one node after the other (3n,)."""
    return (3 * nodes[:, None] + np.arange(3)).ravel()


class HalfSolves:
    """L⁻¹ of unit forces on some unknowns, worked out front by front as the factor is.

    Work and memory go along the paths to the root only. It is worked out in `precision`: in
    single precision compliances are right to 1e-6 of the largest.

    Args:
        starts: (f + 1,) first unknown of each front in elimination order, and how many there are.
        parents: front above each, -1 at a root.
        unknowns: (q,) in elimination order, -1 = held.
        precision: of what is worked out and kept.
    """

    def __init__(
        self, starts: Index, parents: list[int], unknowns: Index, precision: Precision
    ) -> None:
        live = np.flatnonzero(unknowns >= 0)
        order = live[np.argsort(unknowns[live])]
        self._rows, self._rank = unknowns[order], np.full(len(unknowns), -1)
        self._rank[order] = np.arange(len(order))
        self._starts, self._parents, self._precision = starts, parents, precision
        self._spans = self._column_spans()
        self._waiting: dict[int, NDArray[Any]] = {}
        self._blocks: list[Block] = []

    def add(self, member: int, front: Front) -> None:
        """Take the next front, before its numbers are made coarser."""
        first, last = self._spans[member]
        if last == first:
            return
        right = self._of(member)
        del self._waiting[member]
        a, b = np.searchsorted(self._rows, [front.start, front.stop])
        right[np.arange(a, b) - first, self._rows[a:b] - front.start] += 1.0
        count = front.stop - front.start
        if len(front.boundary):
            self._pass_up(member, front.boundary, right @ front.block[count:].T)
        # Of arrays kept row by row BLAS, which reads column by column, sees the transposes.
        times = get_blas_funcs("trmm", dtype=self._precision)
        own = times(1.0, front.block[:count].T, right.T, trans_a=1, overwrite_b=1).T
        self._blocks.append(Block.of(front.start, front.stop, first, last, own))

    def response(self) -> HalfResponse:
        """Return what all fronts have made."""
        return HalfResponse(self._rank, self._blocks)

    def _of(self, member: int) -> NDArray[Any]:
        """Return a front's right-hand side so far (its columns, own unknowns)."""
        if member not in self._waiting:
            first, last = self._spans[member]
            shape = (last - first, self._starts[member + 1] - self._starts[member])
            self._waiting[member] = np.zeros(shape, self._precision)
        return self._waiting[member]

    def _column_spans(self) -> list[tuple[int, int]]:
        """Return for each front the columns [first, last) whose path to the root meets it."""
        edges = np.searchsorted(self._rows, self._starts).tolist()
        spans = list(pairwise(edges))
        for member, parent in enumerate(self._parents):
            first, last = spans[member]
            if parent >= 0 and last > first:
                begin, end = spans[parent]
                empty = end == begin
                spans[parent] = (first if empty else min(begin, first), max(last, end))
        return spans

    def _pass_up(self, member: int, boundary: Index, passed: NDArray[Any]) -> None:
        """Take a front's products (columns, m) from the right-hand sides of those above it."""
        above, at = self._parents[member], 0
        first, last = self._spans[member]
        while at < len(boundary):
            end = int(np.searchsorted(boundary, self._starts[above + 1]))
            if end > at:
                start = self._spans[above][0]
                local = boundary[at:end] - self._starts[above]
                _take_away(self._of(above)[first - start : last - start], local, passed[:, at:end])
            above, at = self._parents[above], end
