"""Response of the contact nodes to unit forces on them, from half a solve.

With K = L Lᵀ and Z = L⁻¹ E (E picks the contact nodes' unknowns) the compliance between them
is Eᵀ K⁻¹ E = Zᵀ Z: the backward half of the solves is never done. A column of Z is zero but on
the path from its node to the root of the elimination tree, and the columns of one subtree
follow each other, so Z is kept as one dense block per member of the tree, column by column:
what is asked of few nodes reads their columns alone.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_blas_funcs

from tkamb.contact.lattice.linear.multifrontal import Front, joined
from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.threads import both, in_halves

Precision = type[np.floating[Any]]

SINGLE: Precision = np.float32
"""What a stored operator is kept in: it halves what every solve has to read."""


@dataclass(frozen=True)
class ResponseSettings:
    """Products of the factor with columns of forces."""

    gathered_columns: int = 512
    """Columns that are copied for BLAS at a time. Chosen: 3 MB, about the size of a processor's
    cache."""
    few_columns: int = 12
    """Columns up to which products are taken in place. Chosen: a copy for BLAS costs more than it
    gains."""


RESPONSE = ResponseSettings()


@dataclass(frozen=True, eq=False)
class HalfResponse:
    """Z = L⁻¹ E of q unknowns.

    Args:
        rank: (q,) sorted column of each unknown as the caller numbers them; -1 if it is held.
        blocks: (b, 4) rows of Z that are not zero: first row, in elimination order, one past the
            last, first column and one past the last column. No two share a row.
        values: (v,) float64 or float32, columns of Z, each as long as its block has rows.
        places: (w,) where in `values` each column of each block begins, block after block.
    """

    rank: Index
    blocks: Index
    values: NDArray[Any]
    places: Index

    @classmethod
    def of(cls, rank: Index, blocks: Index, values: NDArray[Any]) -> "HalfResponse":
        """Return the response whose columns lie one after the other, block after block."""
        lengths = np.repeat(blocks[:, 1] - blocks[:, 0], blocks[:, 3] - blocks[:, 2])
        return cls(rank, blocks, values, np.cumsum(lengths) - lengths)

    def apply(self, force: Array, y: Array) -> None:
        """Add Z f to y (in elimination order), for forces (q,) on the unknowns."""
        ordered = np.zeros(self.columns)
        ordered[self.rank[self.rank >= 0]] = force[self.rank >= 0]

        def add(first: int, last: int) -> None:
            _add_columns(*self._parts, ordered, y, first, last)

        both(lambda: add(0, self._middle), lambda: add(self._middle, len(self.blocks)))

    def project(self, y: Array) -> Array:
        """Return Zᵀ y (q,): displacement of the unknowns under the load whose L⁻¹ f is y."""
        ordered = np.zeros(self.columns)

        def add(some: slice) -> None:
            _add_products(*self._parts, y, ordered, some.start, some.stop)

        in_halves(add, self.columns)
        return np.where(self.rank >= 0, ordered[np.maximum(self.rank, 0)], 0.0)

    def among(self, unknowns: Index) -> "HalfResponse":
        """Return the response of some of the unknowns (u,) alone; it shares the columns."""
        ranks = self.rank[unknowns]
        live = np.flatnonzero(ranks >= 0)
        order = live[np.argsort(ranks[live])]
        rank = np.full(len(unknowns), -1)
        rank[order] = np.arange(len(order))
        blocks, places = _of_columns(*self._parts[:3], ranks[order])
        return HalfResponse(rank, blocks, self.values, places)

    def compliance(self, some: Index | None = None) -> Array:
        """Return the compliance (s, q), m/N, of some unknowns, by default all, to all."""
        rank = self.rank if some is None else self.rank[some]
        rows, live = np.unique(rank[rank >= 0]), self.rank >= 0
        # C = H Hᵀ with H the half solves: the compliance is summed block by block of the
        # elimination tree.
        inner = np.zeros((len(rows), self.columns))
        firsts, lasts = np.searchsorted(rows, self.blocks[:, 2:]).T
        for block in np.flatnonzero(lasts > firsts):
            start, stop, first, last = self.blocks[block].tolist()
            places = self.places[self._edges[block] : self._edges[block + 1]]
            a, b = int(firsts[block]), int(lasts[block])
            few = _gathered(self.values, places[rows[a:b] - first], stop - start)
            if len(few) <= RESPONSE.few_columns:
                inner[a:b, first:last] += _products(self.values, places, few)
                continue
            for part in range(0, last - first, RESPONSE.gathered_columns):
                others = _gathered(
                    self.values, places[part : part + RESPONSE.gathered_columns], stop - start
                )
                inner[a:b, first + part : min(first + part + RESPONSE.gathered_columns, last)] += (
                    few @ others.T
                )
        result = np.zeros((len(rank), len(self.rank)))
        index = np.searchsorted(rows, rank[rank >= 0])
        result[np.ix_(rank >= 0, live)] = inner[np.ix_(index, self.rank[live])]
        return result

    @property
    def entries(self) -> int:
        """How many numbers Z holds."""
        return self.values.size

    @property
    def columns(self) -> int:
        """How many columns Z has."""
        return int((self.rank >= 0).sum())

    @property
    def _parts(self) -> tuple[Index, Index, Index, NDArray[Any]]:
        return self.blocks, self._edges, self.places, self.values

    @cached_property
    def _edges(self) -> Index:
        """Where the places of each block (b + 1,) begin, and how many there are."""
        return np.cumsum(np.concatenate([[0], self.blocks[:, 3] - self.blocks[:, 2]]))

    @cached_property
    def _middle(self) -> int:
        """How many of the blocks hold half of the numbers."""
        # Blocks are halved by their work, which is rows times columns, for two threads.
        sizes = (self.blocks[:, 1] - self.blocks[:, 0]) * (self.blocks[:, 3] - self.blocks[:, 2])
        return int(np.searchsorted(np.cumsum(sizes), sizes.sum() / 2))


@compiled
def _add_columns(
    blocks: Index,
    edges: Index,
    places: Index,
    values: Array,
    factors: Array,
    y: Array,
    begin: int,
    end: int,
) -> None:
    """Add the columns times factors to y in the rows of blocks [begin, end), in their precision."""
    for block in range(begin, end):
        start, stop, first = blocks[block, 0], blocks[block, 1], blocks[block, 2]
        total = np.zeros(stop - start, values.dtype)
        for k in range(edges[block + 1] - edges[block]):
            factor = values.dtype.type(factors[first + k])
            if factor != 0:
                place = places[edges[block] + k]
                column = values[place : place + len(total)]
                for i in range(len(total)):
                    total[i] += factor * column[i]
        for i in range(len(total)):
            y[start + i] += total[i]


@compiled
def _add_products(
    blocks: Index,
    edges: Index,
    places: Index,
    values: Array,
    y: Array,
    products: Array,
    begin: int,
    end: int,
) -> None:
    """Add the products of columns [begin, end) with y to `products`, in their precision."""
    for block in range(len(blocks)):
        first = blocks[block, 2]
        some, last = max(first, begin), min(blocks[block, 3], end)
        if some < last:
            own = y[blocks[block, 0] : blocks[block, 1]].astype(values.dtype)
            for column in range(some, last):
                place = places[edges[block] + column - first]
                part, total = values[place : place + len(own)], values.dtype.type(0)
                for i in range(len(own)):
                    total += part[i] * own[i]
                products[column] += total


@compiled
def _of_columns(blocks: Index, edges: Index, places: Index, columns: Index) -> tuple[Index, Index]:
    """Return blocks and places of some columns (u,), increasing, in their numbers."""
    firsts, lasts = np.searchsorted(columns, blocks[:, 2]), np.searchsorted(columns, blocks[:, 3])
    nonempty = np.flatnonzero(lasts > firsts)
    some, at = blocks[nonempty], 0
    chosen = np.empty((lasts - firsts).sum(), np.int64)
    for number, block in enumerate(nonempty):
        first, last = firsts[block], lasts[block]
        for k in range(first, last):
            chosen[at] = places[edges[block] + columns[k] - blocks[block, 2]]
            at += 1
        some[number, 2], some[number, 3] = first, last
    return some, chosen


@compiled
def _gathered(values: Array, places: Index, length: int) -> Array:
    """Return the columns (k, length) that begin at places (k,)."""
    result = np.empty((len(places), length), values.dtype)
    for k in range(len(places)):
        result[k] = values[places[k] : places[k] + length]
    return result


@compiled
def _products(values: Array, places: Index, few: Array) -> Array:
    """Return the products (f, k) of a few columns (f, n) with some others, in their precision."""
    result = np.empty((len(few), len(places)), values.dtype)
    for k in range(len(places)):
        column = values[places[k] : places[k] + few.shape[1]]
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
        self._blocks: list[tuple[int, int, int, int]] = []
        self._columns: list[NDArray[Any]] = []

    def add(self, member: int, front: Front) -> None:
        """Take the next front, before its numbers are made coarser."""
        first, last = self._spans[member]
        if last == first:
            return
        right = self._of(member)
        del self._waiting[member]
        a, b = np.searchsorted(self._rows, [front.start, front.stop])
        # Unit forces at the contact unknowns that this front eliminates.
        right[np.arange(a, b) - first, self._rows[a:b] - front.start] += 1.0
        count = front.stop - front.start
        if len(front.boundary):
            self._pass_up(member, front.boundary, right @ front.block[count:].T)
        # Of arrays kept row by row BLAS, which reads column by column, sees the transposes.
        times = get_blas_funcs("trmm", dtype=self._precision)
        own = times(1.0, front.block[:count].T, right.T, trans_a=1, overwrite_b=1).T
        self._blocks.append((front.start, front.stop, first, last))
        self._columns.append(own)

    def response(self) -> HalfResponse:
        """Return what all fronts have made; it is taken away."""
        blocks = np.array(self._blocks, np.int64).reshape(-1, 4)
        return HalfResponse.of(self._rank, blocks, joined(self._columns, self._precision))

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
