"""The linear operator of one insert: factor, boundary conditions, response of contact nodes.

The memory that the factorisation will need is computed before it begins. The sizes of the fronts
follow from the dissection and the pattern alone (symbolic factorisation, on nodes instead of
unknowns). They are compared with the available memory of the machine.
"""

from collections.abc import Callable
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
    """The estimate of a lattice's memory before it is made."""

    unknowns_per_node: int = 3
    """Unknowns of a node. By definition: each boundary is counted as if all of its displacements
    were free."""
    cell_bytes: int = 20_000
    """Bytes of a cell while its stiffness is put into the global matrix. Measured: 9 to 22 kB."""
    entry_bytes: int = 36
    """Bytes of an entry of the global matrix: 20 for itself and its lower half in elimination
    order; the rest stands for the arrays of the compliance at that time. Measured: without
    it the estimate is 12 % low."""
    safety_factor: float = 1.1
    """1: factor for what the estimate leaves out. Chosen: a proposal that fits is better than one
    that nearly fits."""
    memory_exponent: float = 3.0
    """1: memory falls at least with this power of the cell size. Measured: 3.7."""
    cell_size_step: float = 0.05e-3
    """m: proposed cell sizes are multiples of it. Chosen: proposals are round numbers."""
    largest_cell_size: float = 5e-3
    """m: larger cells are not proposed. Chosen: a condyle's contact would be two cells wide."""


MEMORY_NEED = MemoryNeedSettings()


class TooLittleMemoryError(ComputationError):
    """What is to be computed does not fit into the available memory.

    Args:
        need: bytes that the next step needs.
        available: bytes that are available.
        likely: bytes that the whole computation is expected to need; 0: as many as `need`.
    """

    def __init__(self, need: float, available: float, likely: float) -> None:
        self.left, self.likely = available, max(need, likely)
        what = (
            f"{need / 1e9:.2g} GB of memory are needed, {max(available, 0) / 1e9:.2g} GB are left"
        )
        super().__init__(what, "lattice", "take a coarser resolution")

    def advice(self, size: float) -> str:
        """Return the advice: the cell size that fits instead of a size (m) that does not."""
        fits = size * (self.likely / max(self.left, 1.0)) ** (1.0 / MEMORY_NEED.memory_exponent)
        if fits > MEMORY_NEED.largest_cell_size:
            return "free some memory"
        step = MEMORY_NEED.cell_size_step
        # Rounded up, so that the proposed size fits; 1e-9 keeps a size that is a multiple already.
        proposal = np.ceil(fits / step * (1.0 - 1e-9)) * step
        return f"take {proposal / MILLIMETRE:g} mm or coarser"


def check_memory(need: float, likely: float = 0.0) -> None:
    """Raise unless a number of bytes is left.

    Args:
        need: bytes.
        likely: bytes that the whole computation is expected to need, for the advice.

    Raises:
        TooLittleMemoryError: they are not left.
    """
    available = available_memory()
    if MEMORY_NEED.safety_factor * need > available:
        raise TooLittleMemoryError(
            MEMORY_NEED.safety_factor * need, available, MEMORY_NEED.safety_factor * likely
        )


def check_assembly_memory(cells: int) -> None:
    """Raise unless the stiffness of a number of cells can be assembled.

    Raises:
        TooLittleMemoryError: the memory is not left.
    """
    need = MEMORY_NEED.cell_bytes * cells
    # The factor grows as cells^1.25; from about 3,000 cells it needs more memory than the assembly
    # (measured on inserts).
    check_memory(need, likely=1.5 * need * max(cells / 3000, 1.0) ** 0.25)


def factor_memory(
    tree: Dissection, joined: sparse.csr_matrix, touched: Mask, itemsize: int
) -> float:
    """Return the bytes that factor and half response take at their peak.

    Args:
        tree: dissection of n nodes.
        joined: (n, n) pattern: which nodes are joined.
        touched: (n,) nodes whose response is wanted.
        itemsize: bytes of a number that is kept; the factor is computed with 8.
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
        # W in 8 bytes and as it is kept, the update (m, m), and updates that no parent has added
        # yet.
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


@dataclass(frozen=True)
class OperatorSettings:
    """The linear operator of a lattice."""

    test_vector_seed: int = 20_240_501
    """Seed of the random vectors by which the operator's error is measured. Fixed, so that a
    run repeats."""
    max_fronts_ahead: int = 128
    """Fronts by which the factorisation may be ahead of the compliance. Chosen: they stay whole in
    memory for so long."""


OPERATOR = OperatorSettings()


@dataclass(frozen=True, eq=False)
class ElasticOperator:
    """K = L Lᵀ on the free unknowns, and L⁻¹ of unit forces at the contact nodes.

    Args:
        free: (3n,) which unknowns are free.
        factor: of the free part of the stiffness matrix.
        contact_nodes: (c,) nodes that the femoral component may touch.
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
            force: N; zero except on the nodes of the fronts.
            fronts: from `fronts_of`; all by default.
        """
        y = force.ravel()[self._unknown]
        self.factor.forward(y, fronts)
        return y

    def nodal(self, x: Array, nodes: Index | None = None) -> Array:
        """Return values (m, 3) of nodes, by default of all, from a vector in elimination order.

        Held unknowns have 0.
        """
        return _at_places(x, self._place if nodes is None else self._place[nodes])

    @cached_property
    def _unknown(self) -> Index:
        """Unknown, of the 3n, at each place of the elimination order."""
        return np.flatnonzero(self.free)[self.factor.order]

    @cached_property
    def _place(self) -> Index:
        """Place of each node's unknowns (n, 3) in elimination order, -1 where held."""
        place = np.full(len(self.free), -1)
        place[self._unknown] = np.arange(len(self._unknown))
        return place.reshape(-1, 3)

    def fronts_of(self, nodes: Index) -> Shares:
        """Return the fronts of the factor that eliminate the nodes, and all above them."""
        own = np.unique(self._front_of_node[nodes])
        return self.factor.shared(np.flatnonzero(self._above[own[own >= 0]].any(axis=0)))

    @cached_property
    def _above(self) -> Mask:
        """Which fronts are each front or lie above it (f, f)."""
        parents = self.factor.parents
        above = np.eye(len(parents), dtype=bool)
        for member in reversed(range(len(parents))):  # the parent's row is complete
            if parents[member] >= 0:
                above[member] |= above[parents[member]]
        return above

    @cached_property
    def _front_of_node(self) -> Index:
        """Front (n,) that eliminates each node; -1 for a node that is held."""
        own = np.diff(self.factor.starts)
        member = np.repeat(np.arange(len(own)), own)
        result = np.full(len(self.free) // 3, -1)
        result[self._unknown // 3] = member
        return result


@compiled
def _at_places(x: Array, places: Index) -> Array:
    """Return x (n,) at places (m, 3), 0 at those below 0."""
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
    """Return which of the 3n unknowns are held.

    Fixed bearing: all of the bottom nodes' unknowns. Mobile bearing: their y, and what takes away
    the rigid modes and hinders no strain: x of the two end nodes along z (those nearest to
    x = 0), and z of the node nearest to the middle between them. Each of several pieces slides
    by itself.

    Args:
        nodes: (n, 3) m.
        bottom: (b,) nodes in the flat bottom.
        bearing: "fixed" or "mobile".
        piece: (n,) of each node; None: all belong together.
        ends_held: hold x and z of both end nodes, as Sharma (2008), section 4.5.4. The insert
            then cannot grow wider between them, and a uniform pressure is uneven by up to 10 %.
    """
    fixed = np.zeros((len(nodes), 3), bool)
    if bearing == "fixed":
        fixed[bottom] = True
        return fixed.ravel()
    fixed[bottom, 1] = True
    pieces = [bottom]
    if piece is not None:
        pieces = [bottom[piece[bottom] == each] for each in np.unique(piece[bottom])]
    for own in pieces:
        z = nodes[own, 2]
        for end in (z.min(), z.max()):
            fixed[_nearest(nodes, own, end), [0, 2] if ends_held else 0] = True
        if not ends_held:
            fixed[_nearest(nodes, own, (z.min() + z.max()) / 2.0), 2] = True
    return fixed.ravel()


def _nearest(nodes: Array, some: Index, z: float) -> int:
    """Return the node nearest to a place along z; of those as near the one nearest to x = 0."""
    away = np.abs(nodes[some, 2] - z)
    tied = some[away <= away.min() + 1e-9 + 1e-6 * np.ptp(nodes[some, 2])]
    return int(tied[np.argmin(np.abs(nodes[tied, 0]))])


def prepare_operator(
    stiffness: sparse.csr_matrix,
    index: Index,
    fixed: Mask,
    contact_nodes: Index,
    precision: type[np.floating] = np.float64,
    coarse: bool = False,
) -> ElasticOperator:
    """Factorise a stiffness matrix (3n, 3n) and compute the contact nodes' half response.

    Args:
        stiffness: symmetric, positive definite on the free unknowns.
        index: (n, 3) lattice index of each node.
        fixed: (3n,) unknowns that are zero.
        contact_nodes: (c,).
        precision: in which the numbers are kept and the response is computed; the factor is
            computed in float64.
        coarse: keep the factor, not the response, in 16-bit integers: half the memory of single
            precision, and half to read in every solve.

    Raises:
        TooLittleMemoryError: they do not fit into the memory that is left.
        ComputationError: the matrix is not positive definite.
    """
    free = ~fixed
    number = np.cumsum(free) - 1
    some = np.flatnonzero(free.reshape(-1, 3).any(axis=1))
    joined = stiffness.tobsr((3, 3))
    joined = sparse.csr_matrix(
        (np.ones(len(joined.indices), np.int8), joined.indices, joined.indptr),
        (len(index), len(index)),
    )
    joined = joined[some][:, some]
    tree = dissect(index[some], joined)
    touched = np.isin(some, contact_nodes)
    check_memory(factor_memory(tree, joined, touched, np.dtype(precision).itemsize))
    unknowns = []
    for own in tree.own:
        unknown = (3 * some[own][:, None] + np.arange(3)).ravel()
        unknowns.append(number[unknown[free[unknown]]])
    order = np.concatenate(unknowns)
    rank = np.full(len(free), -1)
    rank[np.flatnonzero(free)[order]] = np.arange(len(order))
    unknown = rank[(3 * contact_nodes[:, None] + np.arange(3)).ravel()]
    starts = np.cumsum([0, *map(len, unknowns)])
    half = HalfSolves(starts, tree.parent, unknown, precision)
    fronts = fronts_of(stiffness, rank, starts, tree.parent, precision)
    del stiffness, joined  # as large as half of the factor, and not needed any more

    def taken(member: int, front: Front) -> tuple[NDArray[Any], Array]:
        half.add(member, front)
        return front.rows(coarse)

    # The response follows the factor in its own thread: BLAS lets both threads run.
    with ThreadPoolExecutor(1) as other:
        waiting: list[Future[tuple[NDArray[Any], Array]]] = []
        boundaries = []
        for member, front in enumerate(fronts):
            boundaries.append(front.boundary)
            waiting.append(other.submit(taken, member, front))
            if member >= OPERATOR.max_fronts_ahead:
                waiting[member - OPERATOR.max_fronts_ahead].result()
    rows = [one.result() for one in waiting]
    del waiting
    factor = CholeskyFactor.of(order, starts, tree.parent, boundaries, rows)
    return ElasticOperator(free, factor, contact_nodes, half.response())


def operator_error(
    operator: ElasticOperator, solid: Solid, response_read: Callable[[], None] | None = None
) -> float:
    """Return how far an operator is from its solid's stiffness K, relative.

    The largest of

        |K ũ - f| / |f|            f = K u of a random u, ũ = L⁻ᵀ L⁻¹ f
        |fᵀũ - ũᵀK ũ| / fᵀũ        f pressing on every contact node
        |Z g - L⁻¹ E g| / |L⁻¹ E g|    g random on the contact nodes

    with K summed from the cells. A random u is as rough as the grid, so that f is as large as
    K and u allow, and the relative rounding error does not depend on the condition of K (float32
    1e-6, 16-bit integers 5e-4). The second measures the soft, smooth displacements, and the third
    compares the stored response with the factor.
    Random numbers reach every entry of factor and response.

    Args:
        operator: the operator to check.
        solid: the solid whose operator it should be.
        response_read: called when all of the response has been read, and nothing of the factor.
    """
    chance = np.random.default_rng(OPERATOR.test_vector_seed)
    nodes, shape = operator.contact_nodes, solid.nodes.shape
    pressed, touched = np.zeros(shape), np.zeros(shape)
    pressed[nodes, 1] = -1.0
    touched[nodes] = chance.normal(size=(len(nodes), 3))
    stored = np.zeros(len(operator.factor.order))
    operator.half.apply(touched[nodes].ravel(), stored)
    if response_read is not None:
        response_read()
    displacement = np.where(operator.free.reshape(-1, 3), chance.normal(size=shape), 0.0)
    force = _carried(operator, solid, displacement)
    missing = _carried(operator, solid, operator.solve(force)) - force
    sunk = operator.solve(pressed)
    work, energy = (float((f * sunk).sum()) for f in (pressed, _carried(operator, solid, sunk)))
    directly = operator.start(touched)
    return max(
        _ratio(np.linalg.norm(missing), np.linalg.norm(force)),
        _ratio(work - energy, work),
        _ratio(np.linalg.norm(stored - directly), np.linalg.norm(directly)),
    )


def _carried(operator: ElasticOperator, solid: Solid, displacement: Array) -> Array:
    """Return K u, N, (n, 3), on the free unknowns; 0 where held."""
    return np.where(operator.free.reshape(-1, 3), solid.linear_force(displacement), 0.0)


def _ratio(part: float | np.floating, whole: float | np.floating) -> float:
    """Return |part / whole|; inf where that is no number, so that it passes no comparison."""
    value = abs(float(part)) / max(abs(float(whole)), 1e-300)
    return value if np.isfinite(value) else float("inf")
