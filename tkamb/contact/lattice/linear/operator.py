"""The linear operator of one insert: factor, boundary conditions, response of contact nodes.

The memory for the factorisation is estimated before it begins, and compared with the available
memory. The estimate is a symbolic factorisation on nodes instead of unknowns: the sizes of the
fronts follow from the dissection and the pattern alone.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from tkamb.contact.lattice.linear.compliance import HalfResponse, HalfSolves
from tkamb.contact.lattice.linear.multifrontal import (
    CholeskyFactor,
    Dissection,
    Front,
    Shares,
    dissect,
    fronts_of,
)
from tkamb.contact.lattice.solid import Solid
from tkamb.contact.pair import Bearing
from tkamb.errors import ComputationError
from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.memory import available_memory
from tkamb.units import MILLIMETRE


@dataclass(frozen=True)
class MemoryNeedSettings:
    """The estimate of the memory that a lattice needs."""

    unknowns_per_node: int = 3
    """Unknowns of a node. By definition; held unknowns are counted too."""
    cell_bytes: int = 20_000
    """Bytes for a cell during the assembly of the stiffness. Measured: 9 to 22 kB, which
    `safety_factor` covers."""
    entry_bytes: int = 36
    """Bytes for an entry of the stiffness matrix: 20 for the entry and its copy in elimination
    order, 16 for the arrays of the compliance. Measured: without these 16 the estimate is 12 %
    low."""
    safety_factor: float = 1.1
    """1: factor on the estimate. The proposed cell size must fit."""
    memory_exponent: float = 3.0
    """1: the memory is proportional to at least this power of 1 / cell size. Measured: 3.7."""
    cell_size_step: float = 0.05e-3
    """m: proposed cell sizes are multiples of it. It gives round numbers."""
    largest_cell_size: float = 5e-3
    """m: largest cell size that is proposed. A condyle's contact is then two cells
    wide."""


MEMORY_NEED = MemoryNeedSettings()


class TooLittleMemoryError(ComputationError):
    """The computation does not fit into the available memory.

    Args:
        need: memory for the next step, bytes.
        available: available memory, bytes.
        likely: expected memory for the whole computation, bytes; 0: as much as `need`.
    """

    def __init__(self, need: float, available: float, likely: float) -> None:
        self.available, self.likely = available, max(need, likely)
        what = (
            f"{need / 1e9:.2g} GB of memory are needed, {max(available, 0) / 1e9:.2g} GB are left"
        )
        super().__init__(what, "lattice", "take a coarser resolution")

    def advice(self, size: float) -> str:
        """Return a cell size that fits, in words, when `size` (m) does not."""
        ratio = self.likely / max(self.available, 1.0)
        least_size = size * ratio ** (1.0 / MEMORY_NEED.memory_exponent)
        if least_size > MEMORY_NEED.largest_cell_size:
            return "free some memory"
        step = MEMORY_NEED.cell_size_step
        # Rounded up, so that the proposed size fits. An exact multiple stays, because of the 1e-9.
        proposal = np.ceil(least_size / step * (1.0 - 1e-9)) * step
        return f"take {proposal / MILLIMETRE:g} mm or coarser"


def check_memory(need: float, likely: float = 0.0) -> None:
    """Raise an error if the available memory is too small.

    Args:
        need: memory for the next step, bytes.
        likely: expected memory for the whole computation, bytes; for the advice.

    Raises:
        TooLittleMemoryError: the available memory is too small.
    """
    available = available_memory()
    if MEMORY_NEED.safety_factor * need > available:
        raise TooLittleMemoryError(
            MEMORY_NEED.safety_factor * need, available, MEMORY_NEED.safety_factor * likely
        )


def check_assembly_memory(cells: int) -> None:
    """Raise an error if the memory is too small to assemble the stiffness of the cells.

    Raises:
        TooLittleMemoryError: the available memory is too small.
    """
    need = MEMORY_NEED.cell_bytes * cells
    # The factor grows as cells^1.25; from about 3,000 cells it needs more memory than the assembly
    # (measured on inserts).
    check_memory(need, likely=1.5 * need * max(cells / 3000, 1.0) ** 0.25)


def factor_memory(
    tree: Dissection, joined: sparse.csr_matrix, touched: Mask, itemsize: int
) -> float:
    """Return the peak memory of the factor and the half response, bytes.

    Args:
        tree: dissection of n nodes.
        joined: pattern of the joined nodes, (n, n).
        touched: mask of the contact nodes, (n,).
        itemsize: bytes of a stored number. A computed number has 8 bytes.
    """
    rank = np.empty(joined.shape[0], np.int64)
    rank[np.concatenate(tree.own)] = np.arange(len(rank))
    stored = live = peak = response = 0.0
    columns = np.zeros(len(tree.own))
    below: dict[int, list[Index]] = {}
    start = 0
    for member, own in enumerate(tree.own):
        stop, parent = start + len(own), tree.parent[member]
        children = below.pop(member, [])
        later = np.unique(np.concatenate([rank[joined[own].indices], *children]))
        boundary = later[later >= stop]
        k, m = (
            MEMORY_NEED.unknowns_per_node * len(own),
            MEMORY_NEED.unknowns_per_node * len(boundary),
        )
        # In memory are the stored W of all fronts so far and, with 8 bytes for a number, W and the
        # update (m, m) of this front, and the updates that wait for their parents.
        block = float(k + m) * k
        stored += block
        peak = max(peak, itemsize * stored + 8.0 * (live + block + float(m) * m))
        live += float(m) * m - sum(
            (MEMORY_NEED.unknowns_per_node * len(child)) ** 2.0 for child in children
        )
        columns[member] += MEMORY_NEED.unknowns_per_node * touched[own].sum()
        response += k * columns[member]
        if parent >= 0:
            columns[parent] += columns[member]
            if len(boundary):
                below.setdefault(parent, []).append(boundary)
        start = stop
    entries = MEMORY_NEED.unknowns_per_node**2 * joined.nnz
    return MEMORY_NEED.entry_bytes * entries + max(peak, itemsize * (stored + response))


# Seed of the random vectors that measure the operator's error. It is fixed, so that runs are
# reproducible.
TEST_VECTOR_SEED = 20_240_501
# Fronts that may wait in memory for the computation of their compliance. Larger: more memory.
# Smaller: the factorisation waits more often.
MAX_FRONTS_AHEAD = 128


@dataclass(frozen=True, eq=False)
class ElasticOperator:
    """K = L Lᵀ on the free unknowns, and L⁻¹ E of unit forces E on the contact nodes.

    Args:
        free: mask of the free unknowns, (3n,).
        factor: factor of the free part of the stiffness matrix.
        contact_nodes: nodes of the contact surface, (c,).
        half: L⁻¹ E of their 3c unit forces.
    """

    free: Mask
    factor: CholeskyFactor
    contact_nodes: Index
    half: HalfResponse

    def solve(self, force: Array) -> Array:
        """Return the displacement (n, 3), m, under nodal forces (n, 3), N."""
        y = self.start(force)
        self.factor.backward(y)
        return self.nodal(y)

    def start(self, force: Array, fronts: Shares | None = None) -> Array:
        """Return y = L⁻¹ f in elimination order, for nodal forces (n, 3).

        Args:
            force: nodal forces, N; zero except on the nodes of the fronts.
            fronts: result of `fronts_of`; by default all fronts.
        """
        y = force.ravel()[self._unknown]
        self.factor.forward(y, fronts)
        return y

    def nodal(self, x: Array, nodes: Index | None = None) -> Array:
        """Return the values (m, 3) at nodes, by default all, of a vector in elimination order.

        Held unknowns have the value 0.
        """
        return _at_places(x, self._place if nodes is None else self._place[nodes])

    @cached_property
    def _unknown(self) -> Index:
        """The unknown at each place of the elimination order."""
        return np.flatnonzero(self.free)[self.factor.order]

    @cached_property
    def _place(self) -> Index:
        """Place of each node's unknowns (n, 3) in elimination order, -1 where held."""
        place = np.full(len(self.free), -1)
        place[self._unknown] = np.arange(len(self._unknown))
        return place.reshape(-1, 3)

    def fronts_of(self, nodes: Index) -> Shares:
        """Return the fronts of the factor that eliminate the nodes, and all above them."""
        fronts = np.unique(self._front_of_node[nodes])
        return self.factor.shared(np.flatnonzero(self._above[fronts[fronts >= 0]].any(axis=0)))

    @cached_property
    def _above(self) -> Mask:
        """Mask (f, f): row i marks front i and all fronts above it."""
        parents = self.factor.parents
        above = np.eye(len(parents), dtype=bool)
        for member in reversed(range(len(parents))):  # the parent's row is complete
            if parents[member] >= 0:
                above[member] |= above[parents[member]]
        return above

    @cached_property
    def _front_of_node(self) -> Index:
        """Front (n,) that eliminates each node; -1 for a held node."""
        sizes = np.diff(self.factor.starts)
        result = np.full(len(self.free) // 3, -1)
        result[self._unknown // 3] = np.repeat(np.arange(len(sizes)), sizes)
        return result


@compiled
def _at_places(x: Array, places: Index) -> Array:
    """Return x (n,) at places (m, 3), and 0 where a place is negative."""
    result = np.zeros(places.shape)
    for i in range(len(places)):
        for axis in range(3):
            if places[i, axis] >= 0:
                result[i, axis] = x[places[i, axis]]
    return result


def fixed_unknowns(
    nodes: Array,
    bottom: Index,
    bearing: Bearing,
    piece: Index | None = None,
    ends_held: bool = False,
) -> Mask:
    """Return the mask (3n,) of the held unknowns.

    A fixed bearing holds all unknowns of the bottom nodes. A mobile bearing holds their y. It also
    holds x of the two end nodes along z (those nearest to x = 0) and z of the node nearest to the
    middle. This prevents rigid motion and allows every strain. Each separate piece of the insert is
    held so.

    Args:
        nodes: m, (n, 3).
        bottom: nodes in the flat bottom, (b,).
        piece: number of each node's piece, (n,); None: there is one piece.
        ends_held: whether x and z of both end nodes are held, as in Sharma (2008), section 4.5.4.
            Then the insert cannot widen. A pressure that should be uniform varies by up to 10 %.
    """
    fixed = np.zeros((len(nodes), 3), bool)
    if bearing == "fixed":
        fixed[bottom] = True
        return fixed.ravel()
    fixed[bottom, 1] = True
    pieces = [bottom]
    if piece is not None:
        pieces = [bottom[piece[bottom] == each] for each in np.unique(piece[bottom])]
    for subset in pieces:
        z = nodes[subset, 2]
        for end in (z.min(), z.max()):
            fixed[_nearest(nodes, subset, end), [0, 2] if ends_held else 0] = True
        if not ends_held:
            fixed[_nearest(nodes, subset, (z.min() + z.max()) / 2.0), 2] = True
    return fixed.ravel()


def _nearest(nodes: Array, subset: Index, z: float) -> int:
    """Return the node nearest to z; among equals the nearest to x = 0."""
    distance = np.abs(nodes[subset, 2] - z)
    tied = subset[distance <= distance.min() + 1e-9 + 1e-6 * np.ptp(nodes[subset, 2])]
    return int(tied[np.argmin(np.abs(nodes[tied, 0]))])


def prepare_operator(
    stiffness: sparse.csr_matrix,
    index: Index,
    fixed: Mask,
    contact_nodes: Index,
    precision: type[np.floating] = np.float64,
    coarse: bool = False,
) -> ElasticOperator:
    """Factorise a stiffness matrix and compute the contact nodes' half response.

    Args:
        stiffness: symmetric, positive definite on the free unknowns, (3n, 3n).
        index: lattice index of each node, (n, 3).
        fixed: mask of the held unknowns, (3n,).
        contact_nodes: nodes of the contact surface, (c,).
        precision: type of the stored numbers and of the response. The factor is computed in
            float64.
        coarse: whether the factor is stored in 16-bit integers, in half the memory of single
            precision. The response is not.

    Raises:
        TooLittleMemoryError: factor and response do not fit.
        ComputationError: the matrix is not positive definite.
    """
    free = ~fixed
    number = np.cumsum(free) - 1
    free_nodes = np.flatnonzero(free.reshape(-1, 3).any(axis=1))
    joined = stiffness.tobsr((3, 3))
    joined = sparse.csr_matrix(
        (np.ones(len(joined.indices), np.int8), joined.indices, joined.indptr),
        (len(index), len(index)),
    )
    joined = joined[free_nodes][:, free_nodes]
    tree = dissect(index[free_nodes], joined)
    touched = np.isin(free_nodes, contact_nodes)
    check_memory(factor_memory(tree, joined, touched, np.dtype(precision).itemsize))
    unknowns = []
    for own in tree.own:
        unknown = (3 * free_nodes[own][:, None] + np.arange(3)).ravel()
        unknowns.append(number[unknown[free[unknown]]])
    order = np.concatenate(unknowns)
    rank = np.full(len(free), -1)
    rank[np.flatnonzero(free)[order]] = np.arange(len(order))
    unknown = rank[(3 * contact_nodes[:, None] + np.arange(3)).ravel()]
    starts = np.cumsum([0, *map(len, unknowns)])
    half = HalfSolves(starts, tree.parent, unknown, precision)
    fronts = fronts_of(stiffness, rank, starts, tree.parent, precision)
    del stiffness, joined  # they are as large as half of the factor

    def add_to_response(member: int, front: Front) -> tuple[NDArray[Any], Array]:
        half.add(member, front)
        return front.rows(coarse)

    # A second thread computes the response, because BLAS releases the interpreter lock.
    with ThreadPoolExecutor(1) as thread:
        waiting: list[Future[tuple[NDArray[Any], Array]]] = []
        boundaries = []
        for member, front in enumerate(fronts):
            boundaries.append(front.boundary)
            waiting.append(thread.submit(add_to_response, member, front))
            if member >= MAX_FRONTS_AHEAD:
                waiting[member - MAX_FRONTS_AHEAD].result()
    rows = [future.result() for future in waiting]
    del waiting
    factor = CholeskyFactor.of(order, starts, tree.parent, boundaries, rows)
    return ElasticOperator(free, factor, contact_nodes, half.response())


def operator_error(operator: ElasticOperator, solid: Solid) -> float:
    """Return the relative error of an operator, against its solid's K, applied cell by cell.

    The error is the largest of

        |K ũ - f| / |f|                f = K u of a random u, ũ = L⁻ᵀ L⁻¹ f
        |fᵀũ - ũᵀK ũ| / fᵀũ            f: unit forces down on every contact node
        |Z g - L⁻¹ E g| / |L⁻¹ E g|    g random on the contact nodes

    The first tests rough displacements; its rounding error does not depend on the condition of K
    (float32: 1e-6, 16-bit integers: 5e-4). The second tests smooth ones, the third compares the
    stored response with the factor. The random vectors involve every stored number.
    """
    generator = np.random.default_rng(TEST_VECTOR_SEED)
    nodes, shape = operator.contact_nodes, solid.nodes.shape
    pressed, touched = np.zeros(shape), np.zeros(shape)
    pressed[nodes, 1] = -1.0
    touched[nodes] = generator.normal(size=(len(nodes), 3))
    stored = np.zeros(len(operator.factor.order))
    operator.half.apply(touched[nodes].ravel(), stored)
    displacement = np.where(operator.free.reshape(-1, 3), generator.normal(size=shape), 0.0)
    force = _free_force(operator, solid, displacement)
    difference = _free_force(operator, solid, operator.solve(force)) - force
    smooth = operator.solve(pressed)
    inner = _free_force(operator, solid, smooth)
    work, energy = (float((f * smooth).sum()) for f in (pressed, inner))
    from_factor = operator.start(touched)
    return max(
        _ratio(np.linalg.norm(difference), np.linalg.norm(force)),
        _ratio(work - energy, work),
        _ratio(np.linalg.norm(stored - from_factor), np.linalg.norm(from_factor)),
    )


def _free_force(operator: ElasticOperator, solid: Solid, displacement: Array) -> Array:
    """Return K u, N, (n, 3), with 0 at the held unknowns."""
    return np.where(operator.free.reshape(-1, 3), solid.linear_force(displacement), 0.0)


def _ratio(part: float | np.floating, whole: float | np.floating) -> float:
    """Return |part / whole|, or inf where it is not finite, to fail every test."""
    value = abs(float(part)) / max(abs(float(whole)), 1e-300)
    return value if np.isfinite(value) else float("inf")
