"""Nested dissection of a lattice, and multifrontal Cholesky factorisation on its tree.

A plane of lattice nodes separates the nodes on its two sides, since only neighbours are
joined: such planes are eliminated last. The insert is wide and thin, so planes across x and z
leave small separators (George, SIAM J Numer Anal 10:345, 1973, doi:10.1137/0710032).

Each tree member gathers its rows and its children's updates into a dense front, eliminates
its own unknowns and hands the rest up (Duff & Reid, ACM TOMS 9:302, 1983,
doi:10.1145/356044.356047). The factor keeps, per member, W = [L11⁻¹; L21 L11⁻¹], so that
either half of a solve is one product per member. Forces on few members need only the members
above them, and so do displacements of few.

The products of a solve read every W once, without the zeros of L11⁻¹. Their time is that of reading
memory. A compiled loop over one row after the other reads at two thirds of the memory's speed,
twice as fast as over four rows at a time, and faster than `einsum` and BLAS.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import DTypeLike, NDArray
from scipy.linalg import blas, get_blas_funcs, lapack

from tkamb.errors import ComputationError
from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.threads import both

CUTS = 16
"""Number of ways to divide fronts between two threads that are tried; the best is taken."""


@dataclass(frozen=True, eq=False)
class Dissection:
    """A tree of separators in the order of elimination (children before parents).

    Args:
        own: nodes that each tree member eliminates.
        parent: index of the parent of each member, -1 for a root.
    """

    own: list[Index]
    parent: list[int]


def dissect(index: Index, joined: sparse.csr_matrix, leaf: int = 48) -> Dissection:
    """Return the dissection of the nodes with lattice index (n, 3).

    Args:
        index: lattice position of each node.
        joined: (n, n) pattern: which nodes are joined.
        leaf: parts of at most this number of nodes are not cut further.
    """
    own: list[Index] = []
    parent: list[int] = []

    def cut(part: Index) -> int:
        """Append the members of a part; return the position of its topmost one."""
        halves = None if len(part) <= leaf else _halves(index, joined, part)
        if halves is None:
            own.append(_along_columns(index, part))
            parent.append(-1)
            return len(own) - 1
        low, high, separator = halves
        tops = [cut(low), cut(high)]
        own.append(_along_columns(index, separator))
        parent.append(-1)
        for top in tops:
            parent[top] = len(own) - 1
        return len(own) - 1

    if len(index):
        cut(np.arange(len(index)))
    return Dissection(own, parent)


def _halves(
    index: Index, joined: sparse.csr_matrix, part: Index
) -> tuple[Index, Index, Index] | None:
    """Return (low, high, separator), or None if no plane leaves two sides."""
    position = index[part]
    for axis in np.argsort(-np.ptp(position, axis=0), kind="stable"):
        plane = int(np.median(position[:, axis]))
        low, high = position[:, axis] < plane, position[:, axis] > plane
        if low.any() and high.any():
            break
    else:
        return None
    across = joined[part[low]][:, part[high]]
    if across.nnz:
        low[np.flatnonzero(low)[np.unique(across.nonzero()[0])]] = False
        if not low.any():
            return None
    if (low | high).all():  # two pieces apart: a member without unknowns of its own is none
        lower = np.flatnonzero(low)
        low[lower[position[lower, axis].argmax()]] = False
        if not low.any():
            return None
    return part[low], part[high], part[~(low | high)]


def _along_columns(index: Index, part: Index) -> Index:
    """Return the part sorted so that a stretch of columns is a stretch of the list."""
    i, j, k = index[part].T
    return part[np.lexsort((j, k, i)) if np.ptp(i) >= np.ptp(k) else np.lexsort((j, i, k))]


@dataclass(frozen=True, eq=False)
class Front:
    """One member of the factor, as it is made.

    Args:
        start: first own unknown in elimination order.
        stop: one past the last own unknown.
        boundary: (m,) later unknowns that it touches, increasing.
        block: (k + m, k) W = [L11⁻¹; L21 L11⁻¹].
    """

    start: int
    stop: int
    boundary: Index
    block: NDArray[Any]

    def rows(self, coarse: bool) -> tuple[NDArray[Any], Array]:
        """Return W row by row without the zeros of L11⁻¹, rows over their scales, and the scales.

        Args:
            coarse: in 16-bit integers, entries to 1.5e-5 of the largest in their row; else as
                they are, and the scales are 1.
        """
        block, scale = self.block, np.ones(len(self.block), self.block.dtype)
        if coarse:
            largest = np.abs(block).max(axis=1, initial=0.0)
            scale = np.maximum(largest, np.finfo(np.float32).tiny) / np.iinfo(np.int16).max
            block = np.rint(block / scale[:, None]).astype(np.int16)
            scale = scale.astype(np.float32)
        count = self.stop - self.start
        own = block[:count][np.tri(count, dtype=bool)]
        return np.concatenate([own, block[count:].ravel()]), scale


@dataclass(frozen=True, eq=False)
class Shares:
    """Fronts of a factor, divided so that two threads may go through them.

    No front of one of the first two is above one of the other.

    Args:
        first: increasing.
        second: increasing.
        above: increasing; none is below one of the first two.
    """

    first: Index
    second: Index
    above: Index

    @property
    def fronts(self) -> Index:
        """All of them, increasing."""
        return np.sort(np.concatenate([self.first, self.second, self.above]))


@dataclass(frozen=True, eq=False)
class CholeskyFactor:
    """P A Pᵀ = L Lᵀ of a symmetric positive definite matrix.

    Of a front's unknowns and boundary together, f + m, each has a row of W. All fronts' rows
    follow each other; the first `edges[i] + starts[i]` of them are those of the fronts before i.

    Args:
        order: (n,) unknowns in elimination order.
        starts: (f + 1,) first unknown of each front in elimination order, children before
            parents, and how many there are.
        parents: (f,) front above each, -1 at a root.
        edges: (f + 1,) first place of each front's boundary in `boundary`, and its length.
        boundary: (b,) later unknowns that the fronts touch, increasing within a front.
        values: the rows of W, without the zeros of L11⁻¹, each over its scale.
        scale: (n + b,) of the rows; its type is that of all products with them.
    """

    order: Index
    starts: Index
    parents: Index
    edges: Index
    boundary: Index
    values: NDArray[Any]
    scale: Array

    @classmethod
    def of(
        cls,
        order: Index,
        starts: Index,
        parents: list[int],
        boundaries: list[Index],
        rows: list[tuple[NDArray[Any], Array]],
    ) -> "CholeskyFactor":
        """Return the factor of fronts' boundaries and `Front.rows`; the lists are emptied."""
        values, scales = map(list, zip(*rows, strict=True)) if rows else ([], [])
        rows.clear()
        edges = np.cumsum([0, *map(len, boundaries)])
        boundary = joined(boundaries, np.dtype(np.int64))
        number = values[0].dtype if values else np.dtype(float)
        scale = joined(scales, scales[0].dtype if scales else number)
        parts = edges, boundary, joined(values, number), scale
        return cls(order, starts, np.array(parents, np.int64), *parts)

    @property
    def entries(self) -> int:
        """Number of entries of the factor."""
        return self.values.size

    @cached_property
    def firsts(self) -> Index:
        """Where the rows of each front begin in `values`, and its length at the end (f + 1,)."""
        own, touched = np.diff(self.starts), np.diff(self.edges)
        return np.cumsum(np.concatenate([[0], own * (own + 1) // 2 + own * touched]))

    @cached_property
    def everything(self) -> Shares:
        """All fronts."""
        return self.shared(np.arange(len(self.parents)))

    def shared(self, fronts: Index) -> Shares:
        """Return fronts (increasing) divided between two threads."""
        share = _divided(fronts, self.parents, np.diff(self.firsts))
        return Shares(*(fronts[share == number] for number in range(3)))

    def solve(self, right: Array) -> Array:
        """Return x (n,) of A x = right."""
        x = right[self.order].astype(np.float64)
        self.forward(x)
        self.backward(x)
        result = np.empty_like(x)
        result[self.order] = x
        return result

    def forward(self, x: Array, fronts: Shares | None = None) -> None:
        """Turn x (n,) into L⁻¹ x in place, in elimination order.

        Args:
            x: zero except on the fronts.
            fronts: with everything above each of them; all by default.
        """
        some = self.everything if fronts is None else fronts
        # Both threads change unknowns above: each in a vector of its own, added in a fixed order.
        other = np.zeros_like(x)
        _copy(some.second, self.starts, x, other)
        both(
            lambda: _forward(some.first, *self._parts, x),
            lambda: _forward(some.second, *self._parts, other),
        )
        _copy(some.second, self.starts, other, x)
        _add(some.above, self.starts, other, x)
        _forward(some.above, *self._parts, x)

    def backward(self, x: Array, fronts: Shares | None = None) -> None:
        """Turn x (n,) into L⁻ᵀ x in place, in elimination order.

        Args:
            x: L⁻ᵀ x already on what lies above the fronts and is none of them.
            fronts: all by default.
        """
        some = self.everything if fronts is None else fronts
        _backward(some.above, *self._parts, x)
        both(
            lambda: _backward(some.first, *self._parts, x),
            lambda: _backward(some.second, *self._parts, x),
        )

    @cached_property
    def _parts(self) -> tuple[Index, Index, Index, Index, NDArray[Any], Array]:
        return self.starts, self.edges, self.boundary, self.firsts, self.values, self.scale


def joined(parts: list[NDArray[Any]], number: DTypeLike) -> NDArray[Any]:
    """Return the parts joined into one array; each is freed when it has been copied."""
    whole = np.empty(sum(part.size for part in parts), number)
    at = len(whole)
    while parts:
        part = parts.pop()
        at -= part.size
        whole[at : at + part.size] = part.ravel()
    return whole


@compiled
def _forward(
    fronts: Index,
    starts: Index,
    edges: Index,
    boundary: Index,
    firsts: Index,
    values: NDArray[Any],
    scale: Array,
    x: Array,
) -> None:
    """Take steps of L⁻¹ x: own unknowns times L11⁻¹, what lies above less the rest of W."""
    number = scale.dtype.type
    for front in fronts:
        start, stop = starts[front], starts[front + 1]
        count, at, scales = stop - start, firsts[front], scale[start + edges[front] :]
        own = x[start:stop].astype(scale.dtype)
        for i in range(count):
            row, total = values[at : at + i + 1], number(0)
            for j in range(i + 1):
                total += number(row[j]) * own[j]
            x[start + i] = scales[i] * total
            at += i + 1
        later = boundary[edges[front] : edges[front + 1]]
        for i in range(len(later)):
            row, total = values[at : at + count], number(0)
            for j in range(count):
                total += number(row[j]) * own[j]
            x[later[i]] -= scales[count + i] * total
            at += count


@compiled
def _backward(
    fronts: Index,
    starts: Index,
    edges: Index,
    boundary: Index,
    firsts: Index,
    values: NDArray[Any],
    scale: Array,
    x: Array,
) -> None:
    """Take steps of L⁻ᵀ x: Wᵀ times own unknowns and minus those above, the last front first."""
    number = scale.dtype.type
    for front in fronts[::-1]:
        start, stop = starts[front], starts[front + 1]
        count, at, scales = stop - start, firsts[front], scale[start + edges[front] :]
        total = np.zeros(count, scale.dtype)
        for i in range(count):
            row, right = values[at : at + i + 1], number(scales[i] * x[start + i])
            for j in range(i + 1):
                total[j] += right * number(row[j])
            at += i + 1
        later = boundary[edges[front] : edges[front + 1]]
        for i in range(len(later)):
            row, right = values[at : at + count], number(-scales[count + i] * x[later[i]])
            for j in range(count):
                total[j] += right * number(row[j])
            at += count
        for j in range(count):
            x[start + j] = total[j]


@compiled
def _copy(fronts: Index, starts: Index, source: Array, target: Array) -> None:
    """Copy the unknowns of some fronts from one vector to another."""
    for front in fronts:
        for i in range(starts[front], starts[front + 1]):
            target[i] = source[i]


@compiled
def _add(fronts: Index, starts: Index, source: Array, target: Array) -> None:
    """Add the unknowns of some fronts in one vector to another."""
    for front in fronts:
        for i in range(starts[front], starts[front + 1]):
            target[i] += source[i]


@compiled
def _divided(fronts: Index, parents: Index, sizes: Index) -> Index:
    """Return the thread of each of some fronts (k,), increasing: 0, 1, or 2 for above both.

    The subtree with the most work is cut below its top, repeatedly, and each time the subtrees go
    to the thread with less work, the largest first; the division that ends soonest is kept.
    """
    count = len(fronts)
    place = np.full(len(parents), -1)
    place[fronts] = np.arange(count)
    above = np.empty(count, np.int64)
    weight = np.empty(count, np.int64)
    for i in range(count):
        parent = parents[fronts[i]]
        while parent >= 0 and place[parent] < 0:  # of those left out, what is above
            parent = parents[parent]
        above[i] = place[parent] if parent >= 0 else -1
        weight[i] = sizes[fronts[i]]
    for i in range(count):  # children before parents
        if above[i] >= 0:
            weight[above[i]] += weight[i]
    open_, cut = above < 0, np.zeros(count, np.bool_)
    whose = np.full(count, 2)
    best, on_top = np.inf, 0
    for _ in range(CUTS):
        tops = np.flatnonzero(open_)
        tops = tops[np.argsort(-weight[tops])]
        loads, owner = np.zeros(2, np.int64), np.empty(len(tops), np.int64)
        for k in range(len(tops)):
            owner[k] = 0 if loads[0] <= loads[1] else 1
            loads[owner[k]] += weight[tops[k]]
        if on_top + loads.max() < best:
            best = on_top + loads.max()
            whose[:] = 2
            whose[tops] = owner
            for i in range(count - 1, -1, -1):
                if not open_[i] and not cut[i]:
                    whose[i] = whose[above[i]]
        if len(tops) == 0:
            break
        heaviest = tops[0]
        open_[heaviest], cut[heaviest] = False, True
        on_top += sizes[fronts[heaviest]]
        for i in range(count):
            if above[i] == heaviest:
                open_[i] = True
    return whose


def fronts_of(
    matrix: sparse.csr_matrix,
    rank: Index,
    starts: Index,
    parent: list[int],
    precision: type[np.floating] = np.float64,
) -> Iterator[Front]:
    """Yield the fronts of the Cholesky factor, children before parents.

    Args:
        matrix: (n, n) symmetric, positive definite on the unknowns that have a rank.
        rank: (n,) place of each unknown in elimination order, -1 for one left out.
        starts: (f + 1,) first place of each tree member, and how many there are.
        parent: index of the parent of each member, -1 for a root.
        precision: in which the fronts are yielded; they are computed in float64.

    Raises:
        ComputationError: the matrix is not positive definite.
    """
    columns = _lower_columns(matrix, rank, int(starts[-1]))
    del matrix
    updates: dict[int, list[tuple[Index, Array]]] = {}
    row = np.empty(columns.shape[0], np.int64)
    for member, (start, stop) in enumerate(pairwise(starts.tolist())):
        children = updates.pop(member, [])
        boundary, block, update = _eliminate(columns, start, stop, children, row, precision)
        if len(boundary):
            updates.setdefault(parent[member], []).append((boundary, update))
        yield Front(start, stop, boundary, block)


def _lower_columns(matrix: sparse.csr_matrix, rank: Index, count: int) -> sparse.csc_matrix:
    """Return the lower half of a symmetric matrix in elimination order, by columns.

    The rows of a column are in no order.

    Args:
        matrix: (n, n).
        rank: (n,) place of each unknown, -1 for one left out.
        count: how many have one.
    """
    edges = np.zeros(count + 1, np.int64)
    _count_lower(matrix.indptr, matrix.indices, rank, edges)
    np.cumsum(edges, out=edges)
    rows, values = np.empty(edges[-1], np.int64), np.empty(edges[-1])
    _fill_lower(matrix.indptr, matrix.indices, matrix.data, rank, edges, rows, values)
    return sparse.csc_matrix((values, rows, edges), (count, count))


@compiled
def _count_lower(indptr: Index, indices: Index, rank: Index, counts: Index) -> None:
    """Put the number of entries of each column j into counts[j + 1]: a row read as a column."""
    for i in range(len(rank)):
        for at in range(indptr[i], indptr[i + 1]):
            if 0 <= rank[i] <= rank[indices[at]]:
                counts[rank[i] + 1] += 1


@compiled
def _fill_lower(
    indptr: Index,
    indices: Index,
    data: Array,
    rank: Index,
    edges: Index,
    rows: Index,
    values: Array,
) -> None:
    """Put rows and values at the place of their column in `edges`."""
    for i in range(len(rank)):
        if rank[i] >= 0:
            free = edges[rank[i]]
            for at in range(indptr[i], indptr[i + 1]):
                if rank[indices[at]] >= rank[i]:
                    rows[free], values[free] = rank[indices[at]], data[at]
                    free += 1


def _eliminate(
    matrix: sparse.csc_matrix,
    start: int,
    stop: int,
    children: list[tuple[Index, Array]],
    row: Index,
    precision: type[np.floating],
) -> tuple[Index, NDArray[Any], Array]:
    """Return a member's boundary, its W, and the update for its parent."""
    k = stop - start
    first, last = matrix.indptr[start], matrix.indptr[stop]
    rows, values = matrix.indices[first:last], matrix.data[first:last]
    columns = np.repeat(np.arange(k), np.diff(matrix.indptr[start : stop + 1]))
    below = rows >= stop
    boundary = np.unique(
        np.concatenate([rows[below], *(b[np.searchsorted(b, stop) :] for b, _ in children)])
    ).astype(np.int64)
    m = len(boundary)
    own, mixed, rest = (np.zeros(size, order="F") for size in ((k, k), (m, k), (m, m)))
    inside = ~below
    own[rows[inside] - start, columns[inside]] = values[inside]
    row[boundary] = np.arange(m)
    mixed[row[rows[below]], columns[below]] = values[below]
    while children:  # each is freed when it has been added
        indices, update = children.pop()
        split = int(np.searchsorted(indices, stop))
        own_rows, parent_rows = indices[:split] - start, row[indices[split:]]
        _extend_add(own, own_rows, own_rows, update[:split, :split], True)
        _extend_add(mixed, parent_rows, own_rows, update[split:, :split], False)
        _extend_add(rest, parent_rows, parent_rows, update[split:, split:], True)
    lower, info = lapack.dpotrf(own, lower=1, clean=1, overwrite_a=1)
    if info:
        raise ComputationError("the stiffness matrix is not positive definite")
    inverse, _ = lapack.dtrtri(lower, lower=1, overwrite_c=1)
    if m:
        mixed = blas.dtrmm(1.0, inverse, mixed, side=1, lower=1, trans_a=1, overwrite_b=1)
        rest = blas.dsyrk(-1.0, mixed, 1.0, rest, lower=1, overwrite_c=1)
    block = np.empty((k + m, k), precision)
    block[:k], block[k:] = inverse, mixed
    if m:  # in the precision in which W is kept: it is used for nothing else of the factor
        times = get_blas_funcs("trmm", dtype=precision)
        # BLAS reads column by column, so it sees the transpose of an array that is kept row by row.
        times(1.0, block[:k].T, block[k:].T, overwrite_b=1)
    return boundary, block, rest


@compiled
def _extend_add(target: Array, rows: Index, columns: Index, update: Array, lower: bool) -> None:
    """Add update to target[rows, columns]; of a square one only what is below the diagonal."""
    for j in range(len(columns)):
        for i in range(j if lower else 0, len(rows)):
            target[rows[i], columns[j]] += update[i, j]
