"""Nested dissection of a lattice, and multifrontal Cholesky factorisation on its tree.

Only neighbouring nodes are joined, so a plane of nodes separates its two sides and is eliminated
last; the insert is wide and thin, so that planes across x and z are small separators (George, SIAM
J Numer Anal 10:345, 1973, doi:10.1137/0710032).

Each tree member adds its rows and its children's updates to a dense front, eliminates its own
unknowns and passes the update of the other unknowns to its parent (Duff & Reid, ACM TOMS 9:302,
1983, doi:10.1145/356044.356047). The factor stores W = [L11⁻¹; L21 L11⁻¹] of each front, so that a
forward or backward solve is one product per front. Forces on few nodes, and displacements of few
nodes, need only their fronts and the fronts above.

A solve takes as long as reading every W once, without the zeros of L11⁻¹. Compiled loops over
single rows read at two thirds of the memory's speed, faster than `einsum` and BLAS.
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
"""Number of trial divisions of the fronts between two threads."""


@dataclass(frozen=True, eq=False)
class Dissection:
    """A tree of separators in the order of elimination (children before parents).

    Args:
        own: nodes that each tree member eliminates.
        parent: index of each member's parent; -1 for a root.
    """

    own: list[Index]
    parent: list[int]


def dissect(index: Index, joined: sparse.csr_matrix, leaf: int = 48) -> Dissection:
    """Return the nested dissection of a lattice's nodes.

    Args:
        index: lattice index (i, j, k) of each node, (n, 3).
        joined: pattern of the joined nodes, (n, n).
        leaf: largest number of nodes of a part that is not cut.
    """
    own: list[Index] = []
    parent: list[int] = []

    def cut(part: Index) -> int:
        """Append the members of a part; return its topmost one."""
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
    """Return (low, high, separator), or None if no plane separates the part."""
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
    if (low | high).all():  # the pieces are apart, but a separator needs at least one node
        lower = np.flatnonzero(low)
        low[lower[position[lower, axis].argmax()]] = False
        if not low.any():
            return None
    return part[low], part[high], part[~(low | high)]


def _along_columns(index: Index, part: Index) -> Index:
    i, j, k = index[part].T
    return part[np.lexsort((j, k, i)) if np.ptp(i) >= np.ptp(k) else np.lexsort((j, i, k))]


@dataclass(frozen=True, eq=False)
class Front:
    """The front of one tree member after its elimination.

    Args:
        start: first own unknown in elimination order.
        boundary: later unknowns that the front is coupled with, increasing, (m,).
        block: W = [L11⁻¹; L21 L11⁻¹], (k + m, k).
    """

    start: int
    stop: int
    boundary: Index
    block: NDArray[Any]

    def rows(self, coarse: bool) -> tuple[NDArray[Any], Array]:
        """Return the rows of W, divided by their scales and without the zeros of L11⁻¹.

        Args:
            coarse: whether rows are rounded to 16-bit integers, with an error of 1.5e-5 of the
                largest entry of the row. If not, the scales are 1.
        """
        block, scale = self.block, np.ones(len(self.block), self.block.dtype)
        if coarse:
            largest = np.abs(block).max(axis=1, initial=0.0)
            scale = np.maximum(largest, np.finfo(np.float32).tiny) / np.iinfo(np.int16).max
            block = np.rint(block / scale[:, None]).astype(np.int16)
            scale = scale.astype(np.float32)
        count = self.stop - self.start
        triangle = block[:count][np.tri(count, dtype=bool)]
        return np.concatenate([triangle, block[count:].ravel()]), scale


@dataclass(frozen=True, eq=False)
class Shares:
    """Fronts of a factor, divided between two threads.

    No front of one thread lies above a front of the other.

    Args:
        first: fronts of the first thread, increasing.
        above: fronts above both, increasing, for one thread.
    """

    first: Index
    second: Index
    above: Index

    @property
    def fronts(self) -> Index:
        """All fronts, increasing."""
        return np.sort(np.concatenate([self.first, self.second, self.above]))


@dataclass(frozen=True, eq=False)
class CholeskyFactor:
    """P A Pᵀ = L Lᵀ of a symmetric positive definite matrix.

    W of a front has a row for each of its unknowns and of its boundary. The rows of front i begin
    at row `starts[i] + edges[i]` of all rows.

    Args:
        order: unknowns in elimination order, (n,).
        starts: first unknown of each front, children before parents, then the number of unknowns,
            (f + 1,).
        parents: front above each front, (f,); -1 at a root.
        edges: position in `boundary` at which each front's begins, then the length of `boundary`,
            (f + 1,).
        boundary: later unknowns that the fronts are coupled with, increasing within a front, (b,).
        values: rows of W without the zeros of L11⁻¹, each divided by its scale.
        scale: scales of the rows, (n + b,). Products have the type of this array.
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
        """Return the factor made of the fronts' boundaries and `Front.rows`; empty the lists."""
        values, scales = map(list, zip(*rows, strict=True)) if rows else ([], [])
        rows.clear()
        edges = np.cumsum([0, *map(len, boundaries)])
        boundary = joined(boundaries, np.dtype(np.int64))
        dtype = values[0].dtype if values else np.dtype(float)
        scale = joined(scales, scales[0].dtype if scales else dtype)
        parts = edges, boundary, joined(values, dtype), scale
        return cls(order, starts, np.array(parents, np.int64), *parts)

    @property
    def entries(self) -> int:
        """Number of entries of the factor."""
        return self.values.size

    @cached_property
    def firsts(self) -> Index:
        """Position in `values` of each front's rows, then the length of `values` (f + 1,)."""
        own, boundary = np.diff(self.starts), np.diff(self.edges)
        return np.cumsum(np.concatenate([[0], own * (own + 1) // 2 + own * boundary]))

    @cached_property
    def everything(self) -> Shares:
        """All fronts."""
        return self.shared(np.arange(len(self.parents)))

    def shared(self, fronts: Index) -> Shares:
        """Return fronts (increasing) divided between two threads."""
        share = _divided(fronts, self.parents, np.diff(self.firsts))
        return Shares(*(fronts[share == number] for number in range(3)))

    def solve(self, right_side: Array) -> Array:
        """Return the solution x (n,) of A x = right_side."""
        x = right_side[self.order].astype(np.float64)
        self.forward(x)
        self.backward(x)
        result = np.empty_like(x)
        result[self.order] = x
        return result

    def forward(self, x: Array, fronts: Shares | None = None) -> None:
        """Replace x (n,), in elimination order, by L⁻¹ x.

        Args:
            x: vector that is zero except in the unknowns of the fronts.
            fronts: fronts of the solve, with all fronts above them; by default all.
        """
        shares = self.everything if fronts is None else fronts
        # Both threads change unknowns above their fronts. So each has its own vector, and the
        # vectors are added in a fixed order.
        other = np.zeros_like(x)
        _copy(shares.second, self.starts, x, other)
        both(
            lambda: _forward(shares.first, *self._parts, x),
            lambda: _forward(shares.second, *self._parts, other),
        )
        _copy(shares.second, self.starts, other, x)
        _add(shares.above, self.starts, other, x)
        _forward(shares.above, *self._parts, x)

    def backward(self, x: Array, fronts: Shares | None = None) -> None:
        """Replace x (n,), in elimination order, by L⁻ᵀ x.

        Args:
            x: vector that has the result already in the fronts above those of the solve.
            fronts: fronts of the solve; by default all.
        """
        shares = self.everything if fronts is None else fronts
        _backward(shares.above, *self._parts, x)
        both(
            lambda: _backward(shares.first, *self._parts, x),
            lambda: _backward(shares.second, *self._parts, x),
        )

    @cached_property
    def _parts(self) -> tuple[Index, Index, Index, Index, NDArray[Any], Array]:
        return self.starts, self.edges, self.boundary, self.firsts, self.values, self.scale


def joined(parts: list[NDArray[Any]], dtype: DTypeLike) -> NDArray[Any]:
    """Return the parts joined; each part is freed after its copy."""
    result = np.empty(sum(part.size for part in parts), dtype)
    at = len(result)
    while parts:
        part = parts.pop()
        at -= part.size
        result[at : at + part.size] = part.ravel()
    return result


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
    """Apply the fronts' steps of L⁻¹ x.

    A step subtracts L21 L11⁻¹ x₁ from the boundary, and replaces the front's own unknowns x₁ by
    L11⁻¹ x₁.
    """
    dtype = scale.dtype.type
    for front in fronts:
        start, stop = starts[front], starts[front + 1]
        count, at, scales = stop - start, firsts[front], scale[start + edges[front] :]
        own = x[start:stop].astype(scale.dtype)
        for i in range(count):
            row, total = values[at : at + i + 1], dtype(0)
            for j in range(i + 1):
                total += dtype(row[j]) * own[j]
            x[start + i] = scales[i] * total
            at += i + 1
        later = boundary[edges[front] : edges[front + 1]]
        for i in range(len(later)):
            row, total = values[at : at + count], dtype(0)
            for j in range(count):
                total += dtype(row[j]) * own[j]
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
    """Apply the fronts' steps of L⁻ᵀ x, the last front first.

    A step replaces the front's own unknowns x₁ by Wᵀ [x₁; -x₂]. x₂ are those of the boundary.
    """
    dtype = scale.dtype.type
    for front in fronts[::-1]:
        start, stop = starts[front], starts[front + 1]
        count, at, scales = stop - start, firsts[front], scale[start + edges[front] :]
        total = np.zeros(count, scale.dtype)
        for i in range(count):
            row, factor = values[at : at + i + 1], dtype(scales[i] * x[start + i])
            for j in range(i + 1):
                total[j] += factor * dtype(row[j])
            at += i + 1
        later = boundary[edges[front] : edges[front + 1]]
        for i in range(len(later)):
            row, factor = values[at : at + count], dtype(-scales[count + i] * x[later[i]])
            for j in range(count):
                total[j] += factor * dtype(row[j])
            at += count
        for j in range(count):
            x[start + j] = total[j]


@compiled
def _copy(fronts: Index, starts: Index, source: Array, target: Array) -> None:
    for front in fronts:
        for i in range(starts[front], starts[front + 1]):
            target[i] = source[i]


@compiled
def _add(fronts: Index, starts: Index, source: Array, target: Array) -> None:
    for front in fronts:
        for i in range(starts[front], starts[front + 1]):
            target[i] += source[i]


@compiled
def _divided(fronts: Index, parents: Index, sizes: Index) -> Index:
    """Return the thread (k,) of each front: 0, 1, or 2 above both.

    Each trial assigns the subtrees, the largest first, to the thread with less work. Then the
    largest subtree loses its top, which becomes a front above both. Return the fastest. `fronts` is
    increasing, `sizes` is the work of every front.
    """
    count = len(fronts)
    place = np.full(len(parents), -1)
    place[fronts] = np.arange(count)
    above = np.empty(count, np.int64)
    weight = np.empty(count, np.int64)
    for i in range(count):
        parent = parents[fronts[i]]
        while parent >= 0 and place[parent] < 0:  # skip fronts that are not in the list
            parent = parents[parent]
        above[i] = place[parent] if parent >= 0 else -1
        weight[i] = sizes[fronts[i]]
    for i in range(count):  # children before parents
        if above[i] >= 0:
            weight[above[i]] += weight[i]
    is_top, cut = above < 0, np.zeros(count, np.bool_)
    thread = np.full(count, 2)
    best, above_work = np.inf, 0
    for _ in range(CUTS):
        tops = np.flatnonzero(is_top)
        tops = tops[np.argsort(-weight[tops])]
        loads, owner = np.zeros(2, np.int64), np.empty(len(tops), np.int64)
        for k in range(len(tops)):
            owner[k] = 0 if loads[0] <= loads[1] else 1
            loads[owner[k]] += weight[tops[k]]
        if above_work + loads.max() < best:
            best = above_work + loads.max()
            thread[:] = 2
            thread[tops] = owner
            for i in range(count - 1, -1, -1):
                if not is_top[i] and not cut[i]:
                    thread[i] = thread[above[i]]
        if len(tops) == 0:
            break
        heaviest = tops[0]
        is_top[heaviest], cut[heaviest] = False, True
        above_work += sizes[fronts[heaviest]]
        for i in range(count):
            if above[i] == heaviest:
                is_top[i] = True
    return thread


def fronts_of(
    matrix: sparse.csr_matrix,
    rank: Index,
    starts: Index,
    parent: list[int],
    precision: type[np.floating] = np.float64,
) -> Iterator[Front]:
    """Yield the fronts of the Cholesky factor, children before parents.

    Args:
        matrix: symmetric, positive definite on the unknowns that have a rank, (n, n).
        rank: place of each unknown in elimination order, (n,); -1 if it is excluded.
        starts: first place of each tree member, then the number of places, (f + 1,).
        precision: type of the yielded fronts, which are computed in float64.

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
    """Return the lower half of a symmetric matrix (n, n) in elimination order.

    Rows of a column are not sorted. `count` unknowns have a rank.
    """
    edges = np.zeros(count + 1, np.int64)
    _count_lower(matrix.indptr, matrix.indices, rank, edges)
    np.cumsum(edges, out=edges)
    rows, values = np.empty(edges[-1], np.int64), np.empty(edges[-1])
    _fill_lower(matrix.indptr, matrix.indices, matrix.data, rank, edges, rows, values)
    return sparse.csc_matrix((values, rows, edges), (count, count))


@compiled
def _count_lower(indptr: Index, indices: Index, rank: Index, counts: Index) -> None:
    """Write the entries of each column j into counts[j + 1]."""
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
    """Write each column from its position in `edges` on.

    The matrix is symmetric: its row i is its column i.
    """
    for i in range(len(rank)):
        if rank[i] >= 0:
            target = edges[rank[i]]
            for at in range(indptr[i], indptr[i + 1]):
                if rank[indices[at]] >= rank[i]:
                    rows[target], values[target] = rank[indices[at]], data[at]
                    target += 1


def _eliminate(
    matrix: sparse.csc_matrix,
    start: int,
    stop: int,
    children: list[tuple[Index, Array]],
    row: Index,
    precision: type[np.floating],
) -> tuple[Index, NDArray[Any], Array]:
    """Return the boundary and W of a tree member, and the update for its parent."""
    k = stop - start
    first, last = matrix.indptr[start], matrix.indptr[stop]
    rows, values = matrix.indices[first:last], matrix.data[first:last]
    columns = np.repeat(np.arange(k), np.diff(matrix.indptr[start : stop + 1]))
    below = rows >= stop
    boundary = np.unique(
        np.concatenate([rows[below], *(b[np.searchsorted(b, stop) :] for b, _ in children)])
    ).astype(np.int64)
    m = len(boundary)
    own, mixed, update = (np.zeros(size, order="F") for size in ((k, k), (m, k), (m, m)))
    inside = ~below
    own[rows[inside] - start, columns[inside]] = values[inside]
    row[boundary] = np.arange(m)
    mixed[row[rows[below]], columns[below]] = values[below]
    while children:  # each child's update is freed after it has been added
        indices, part = children.pop()
        split = int(np.searchsorted(indices, stop))
        own_rows, parent_rows = indices[:split] - start, row[indices[split:]]
        _extend_add(own, own_rows, own_rows, part[:split, :split], True)
        _extend_add(mixed, parent_rows, own_rows, part[split:, :split], False)
        _extend_add(update, parent_rows, parent_rows, part[split:, split:], True)
    lower, info = lapack.dpotrf(own, lower=1, clean=1, overwrite_a=1)
    if info:
        raise ComputationError("the stiffness matrix is not positive definite")
    inverse, _ = lapack.dtrtri(lower, lower=1, overwrite_c=1)
    if m:
        mixed = blas.dtrmm(1.0, inverse, mixed, side=1, lower=1, trans_a=1, overwrite_b=1)
        update = blas.dsyrk(-1.0, mixed, 1.0, update, lower=1, overwrite_c=1)
    block = np.empty((k + m, k), precision)
    block[:k], block[k:] = inverse, mixed
    if m:  # the stored precision is enough, because the factorisation does not use W
        multiply = get_blas_funcs("trmm", dtype=precision)
        # BLAS expects column-major arrays: it gets the transposes of row-major ones.
        multiply(1.0, block[:k].T, block[k:].T, overwrite_b=1)
    return boundary, block, update


@compiled
def _extend_add(target: Array, rows: Index, columns: Index, update: Array, lower: bool) -> None:
    """Add `update` to target[rows, columns]; if `lower`, skip entries above the diagonal."""
    for j in range(len(columns)):
        for i in range(j if lower else 0, len(rows)):
            target[rows[i], columns[j]] += update[i, j]
