"""The compliance of the contact nodes: displacements under unit forces on them.

K = L Lᵀ is the stiffness, and the columns of E are unit forces on the contact nodes' unknowns. With
Z = L⁻¹ E the compliance is Eᵀ K⁻¹ E = Zᵀ Z, so that no backward solve is needed. A column of Z is
zero except on the path from its node to the root of the elimination tree. So Z is stored as one
dense block per front (node of this tree), column by column. A product for few nodes reads only
their columns.
"""

from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from threading import Lock
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
"""Precision of a stored operator, unless its factor is stored in 16-bit integers. A solve reads
half as many bytes as in double precision."""


@dataclass(frozen=True)
class ResponseSettings:
    """Products of columns of Z, for the compliance."""

    gathered_columns: int = 512
    """Columns that are copied for BLAS at a time. Their 3 MB fit into a processor's
    cache."""
    few_columns: int = 12
    """Largest number of columns that are multiplied without BLAS. The copy costs more time than it
    saves for so few.
    """


RESPONSE = ResponseSettings()


@dataclass(frozen=True, eq=False)
class HalfResponse:
    """Z = L⁻¹ E of q unknowns.

    Args:
        rank: column of Z of each unknown, (q,); -1 if the unknown is held.
        blocks: nonzero blocks of Z, (b, 4): first row, end of the rows, first column, end of the
            columns. An end is one past the last. Rows are in elimination order, and no two blocks
            share a row.
        values: the columns of the blocks, one after the other, float64 or float32, (v,).
        places: position in `values` of each column of each block, (w,).
    """

    rank: Index
    blocks: Index
    values: NDArray[Any]
    places: Index

    @classmethod
    def of(cls, rank: Index, blocks: Index, values: NDArray[Any]) -> "HalfResponse":
        """Return the response from `values` without gaps, block after block."""
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
        """Return Zᵀ y (q,). With y = L⁻¹ f it is the unknowns' displacement under a load f."""
        ordered = np.zeros(self.columns)

        def add(half: slice) -> None:
            _add_products(*self._parts, y, ordered, half.start, half.stop)

        in_halves(add, self.columns)
        return np.where(self.rank >= 0, ordered[np.maximum(self.rank, 0)], 0.0)

    def among(self, unknowns: Index) -> "HalfResponse":
        """Return the response of a subset (u,) of the unknowns; `values` is not copied."""
        ranks = self.rank[unknowns]
        free = np.flatnonzero(ranks >= 0)
        order = free[np.argsort(ranks[free])]
        rank = np.full(len(unknowns), -1)
        rank[order] = np.arange(len(order))
        blocks, places = _of_columns(*self._parts[:3], ranks[order])
        return HalfResponse(rank, blocks, self.values, places)

    def compliance(self, subset: Index | None = None) -> Array:
        """Return the displacements (s, q), m/N, under unit forces on all q unknowns.

        Args:
            subset: unknowns whose displacements are returned, (s,); all by default.
        """
        rank = self.rank if subset is None else self.rank[subset]
        rows, free = np.unique(rank[rank >= 0]), self.rank >= 0
        # Zᵀ Z is the sum of the products of the blocks. The rows of `few` and `others` are columns
        # of Z.
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
        result[np.ix_(rank >= 0, free)] = inner[np.ix_(index, self.rank[free])]
        return result

    @property
    def entries(self) -> int:
        """Number of entries of Z."""
        return self.values.size

    @property
    def columns(self) -> int:
        """Number of columns of Z."""
        return int((self.rank >= 0).sum())

    @property
    def _parts(self) -> tuple[Index, Index, Index, NDArray[Any]]:
        return self.blocks, self._edges, self.places, self.values

    @cached_property
    def _edges(self) -> Index:
        """Index in `places` at which each block begins, then the number of places (b + 1,)."""
        return np.cumsum(np.concatenate([[0], self.blocks[:, 3] - self.blocks[:, 2]]))

    @cached_property
    def _middle(self) -> int:
        """Leading blocks that hold half of the entries."""
        # Two threads get about the same work, which is rows times columns.
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
    """Add factors times columns [begin, end) to y, in the precision of `values`."""
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
    """Add the products of columns [begin, end) with y, in the type of `values`."""
    for block in range(len(blocks)):
        first = blocks[block, 2]
        lower, upper = max(first, begin), min(blocks[block, 3], end)
        if lower < upper:
            part = y[blocks[block, 0] : blocks[block, 1]].astype(values.dtype)
            for number in range(lower, upper):
                place = places[edges[block] + number - first]
                column, total = values[place : place + len(part)], values.dtype.type(0)
                for i in range(len(part)):
                    total += column[i] * part[i]
                products[number] += total


@compiled
def _of_columns(blocks: Index, edges: Index, places: Index, columns: Index) -> tuple[Index, Index]:
    """Return the `blocks` and `places` of a response with some of its columns.

    Args:
        edges: index in `places` at which each block begins, (b + 1,).
        columns: numbers of the columns of the subset, increasing, (u,).
    """
    firsts, lasts = np.searchsorted(columns, blocks[:, 2]), np.searchsorted(columns, blocks[:, 3])
    nonempty = np.flatnonzero(lasts > firsts)
    subset_blocks, at = blocks[nonempty], 0
    subset_places = np.empty((lasts - firsts).sum(), np.int64)
    for number, block in enumerate(nonempty):
        first, last = firsts[block], lasts[block]
        for k in range(first, last):
            subset_places[at] = places[edges[block] + columns[k] - blocks[block, 2]]
            at += 1
        subset_blocks[number, 2], subset_blocks[number, 3] = first, last
    return subset_blocks, subset_places


@compiled
def _gathered(values: Array, places: Index, length: int) -> Array:
    """Return the columns (k, length) that begin at places (k,)."""
    result = np.empty((len(places), length), values.dtype)
    for k in range(len(places)):
        result[k] = values[places[k] : places[k] + length]
    return result


@compiled
def _products(values: Array, places: Index, few: Array) -> Array:
    """Return the products (f, k) of columns `few` (f, n) with the columns at places (k,)."""
    result = np.empty((len(few), len(places)), values.dtype)
    for k in range(len(places)):
        column = values[places[k] : places[k] + few.shape[1]]
        for f in range(len(few)):
            other, total = few[f], values.dtype.type(0)
            for i in range(len(other)):
                total += column[i] * other[i]
            result[f, k] = total
    return result


@compiled
def _subtract_columns(target: Array, columns: Index, values: Array) -> None:
    """Subtract values (n, k) from columns (k,) of the target."""
    for i in range(len(values)):
        for j in range(len(columns)):
            target[i, columns[j]] -= values[i, j]


def unknowns_of(nodes: Index) -> Index:
    """Return the three unknowns of each node (n,), one node after the other (3n,)."""
    return (3 * nodes[:, None] + np.arange(3)).ravel()


class HalfSolves:
    """Computes Z = L⁻¹ E of some unknowns, front by front while the factor is computed.

    Only fronts on the paths to the root take time and memory. In single precision the error of
    compliances is 1e-6 of the largest.

    Args:
        starts: first unknown of each front in elimination order, then the number of unknowns.
        parents: front above each front; -1 at a root.
        unknowns: positions in elimination order, (q,); -1 if held.
    """

    def __init__(
        self, starts: Index, parents: list[int], unknowns: Index, precision: Precision
    ) -> None:
        free = np.flatnonzero(unknowns >= 0)
        order = free[np.argsort(unknowns[free])]
        self._rows, self._rank = unknowns[order], np.full(len(unknowns), -1)
        self._rank[order] = np.arange(len(order))
        self._starts, self._parents, self._precision = starts, parents, precision
        self._spans = self._column_spans()
        self._waiting: dict[int, NDArray[Any]] = {}
        self._blocks: list[tuple[int, int, int, int]] = []
        self._columns: list[NDArray[Any]] = []

    def add(self, member: int, front: Front) -> None:
        """Add the columns of the next front, from its block before rounding."""
        first, last = self._spans[member]
        if last == first:
            return
        right_side = self._right_side(member)
        del self._waiting[member]
        a, b = np.searchsorted(self._rows, [front.start, front.stop])
        # Unit forces on the contact unknowns that this front eliminates.
        right_side[np.arange(a, b) - first, self._rows[a:b] - front.start] += 1.0
        count = front.stop - front.start
        if len(front.boundary):
            self._pass_up(member, front.boundary, right_side @ front.block[count:].T)
        # BLAS expects column-major arrays: it gets the transposes of row-major ones.
        multiply = get_blas_funcs("trmm", dtype=self._precision)
        columns = multiply(1.0, front.block[:count].T, right_side.T, trans_a=1, overwrite_b=1).T
        self._blocks.append((front.start, front.stop, first, last))
        self._columns.append(columns)

    def response(self) -> HalfResponse:
        """Return the response, and release its stored columns."""
        blocks = np.array(self._blocks, np.int64).reshape(-1, 4)
        return HalfResponse.of(self._rank, blocks, joined(self._columns, self._precision))

    def _right_side(self, member: int) -> NDArray[Any]:
        """Return a front's current right-hand side (columns of its span, unknowns of the front)."""
        if member not in self._waiting:
            first, last = self._spans[member]
            shape = (last - first, self._starts[member + 1] - self._starts[member])
            self._waiting[member] = np.zeros(shape, self._precision)
        return self._waiting[member]

    def _column_spans(self) -> list[tuple[int, int]]:
        """Return for each front its nonzero columns [first, last)."""
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
        """Subtract a front's products (columns, m) from the fronts above it."""
        above, at = self._parents[member], 0
        first, last = self._spans[member]
        while at < len(boundary):
            end = int(np.searchsorted(boundary, self._starts[above + 1]))
            if end > at:
                start = self._spans[above][0]
                local = boundary[at:end] - self._starts[above]
                target = self._right_side(above)[first - start : last - start]
                _subtract_columns(target, local, passed[:, at:end])
            above, at = self._parents[above], end


@dataclass(frozen=True)
class ComplianceSettings:
    """The stored compliance of candidate nodes."""

    max_nodes: int = 1500
    """Nodes of the stored compliance; the matrix then takes 80 MB."""
    spare_nodes: int = 100
    """Nodes that may be added before the arrays grow. Larger: more memory, fewer copies."""


COMPLIANCE = ComplianceSettings()


@dataclass(frozen=True, eq=False)
class ContactResponse:
    """Displacements under forces on candidate nodes.

    Args:
        whole: response of a set of nodes that contains the candidates.
        candidates: positions of the candidates in this set, (m,).
        compliance: m/N, (3, m, 3, m): component and node of the displacement, then component and
            node of the force.
    """

    whole: HalfResponse
    candidates: Index
    compliance: Array

    @classmethod
    def of(cls, half: HalfResponse) -> "ContactResponse":
        """Return the response in which all nodes of `half` are candidates."""
        return cls(half, np.arange(len(half.rank) // 3), by_component(half.compliance()))

    @cached_property
    def _half(self) -> HalfResponse:
        """The response of the candidates alone; a linear material does not need it."""
        return self.whole.among(unknowns_of(self.candidates))

    def push(self, force: Array, y: Array) -> None:
        """Add L⁻¹ of forces (m, 3), N, to y (in elimination order)."""
        self._half.apply(force.ravel(), y)

    def displacement(self, y: Array) -> Array:
        """Return the candidates' displacement (m, 3), m, under a load f, from y = L⁻¹ f."""
        return self._half.project(y).reshape(-1, 3)

    def along(self, normals: Array) -> tuple[Array, Array]:
        """Return displacements under unit forces along the normals (m, 3).

        Returns:
            Displacements along the normals (m, m), m/N, and displacement vectors (3, m, m), m/N.
        """
        n = np.ascontiguousarray(normals.T, dtype=self.compliance.dtype)
        vectors = np.einsum("aibj,bj->aij", self.compliance, n)
        return np.einsum("aij,ai->ij", vectors, n).astype(np.float64), vectors


def displacement_under(vectors: Array, force: Array) -> Array:
    """Return the displacement (m, 3), m, under forces (m,), N, along normals.

    `vectors` (3, m, m), m/N, are the displacement vectors of `ContactResponse.along`.
    """
    return np.einsum("aij,j->ia", vectors, force.astype(vectors.dtype))


def by_component(matrix: Array) -> Array:
    """Return a compliance (3p, 3p), ordered by node, as (3, p, 3, p)."""
    count = len(matrix) // 3
    return np.ascontiguousarray(matrix.reshape(count, 3, count, 3).transpose(1, 0, 3, 2))


@dataclass
class ComplianceCache:
    """The compliance of the contact nodes requested so far.

    Apart from rounding, results do not depend on which nodes are stored.

    Args:
        whole: response of all contact nodes.
        nodes: stored contact nodes in the order in which they were added, (p,).
        stored: compliance, m/N, (3, s, 3, s) with s >= p, see `ContactResponse`.
    """

    whole: HalfResponse
    nodes: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    stored: Array = field(default_factory=lambda: np.zeros((3, 0, 3, 0), SINGLE))
    _lock: Lock = field(default_factory=Lock)

    def among(self, needed: Index) -> ContactResponse:
        """Return the response of contact nodes at increasing positions (m,)."""
        with self._lock:
            places = self._places(needed)
            compliance = _entries(_entries(self.stored, places, 1), places, 3)
        return ContactResponse(self.whole, needed, compliance)

    def displacement(self, nodes: Index, loaded: Index, force: Array) -> Array:
        """Return the displacement (m, 3), m, of contact nodes under forces on contact nodes.

        Args:
            nodes: positions of the displaced nodes, increasing, (m,).
            loaded: positions of the loaded nodes, increasing, (k,).
            force: N, (k, 3).
        """
        with self._lock:
            places = self._places(np.concatenate([nodes, loaded]))
            displaced, pushed = places[: len(nodes)], places[len(nodes) :]
            compliance = _entries(_entries(self.stored, displaced, 1), pushed, 3)
        return np.einsum("aibj,jb->ia", compliance, force)

    def _places(self, needed: Index) -> Index:
        """Return the positions of nodes (m,) in `stored`; missing nodes are added."""
        place = np.full(len(self.whole.rank) // 3, -1)
        place[self.nodes] = np.arange(len(self.nodes))
        if (place[needed] < 0).any():
            requested = np.unique(needed)
            if len(self.nodes) + np.count_nonzero(place[requested] < 0) > COMPLIANCE.max_nodes:
                self.nodes, place[:] = self.nodes[:0], -1
            self._store(requested[place[requested] < 0])
            place[self.nodes] = np.arange(len(self.nodes))
        return place[needed]

    def _store(self, nodes: Index) -> None:
        old, new = len(self.nodes), len(nodes)
        count = old + new
        if count > self.stored.shape[1]:
            larger: Array = np.empty(
                (3, count + COMPLIANCE.spare_nodes, 3, count + COMPLIANCE.spare_nodes), SINGLE
            )
            larger[:, :old, :, :old] = self.stored[:, :old, :, :old]
            self.stored = larger
        self.nodes = np.concatenate([self.nodes, nodes])
        half = self.whole.among(unknowns_of(self.nodes))
        rows = half.compliance(unknowns_of(np.arange(old, count))).reshape(new, 3, count, 3)
        self.stored[:, old:count, :, :count] = rows.transpose(1, 0, 3, 2)
        self.stored[:, :count, :, old:count] = rows.transpose(3, 2, 1, 0)


def _entries(values: Array, index: Index, axis: int) -> Array:
    """All positions are in range, so that "clip" lets numpy omit a buffer."""
    return np.take(values, index, axis=axis, mode="clip")
