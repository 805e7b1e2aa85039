"""The linear operator of one insert: factor, boundary conditions, response of contact nodes."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from tkamb.contact.lattice.linear.memory_need import check_memory, factor_memory
from tkamb.contact.lattice.linear.multifrontal import (
    CholeskyFactor,
    Front,
    Shares,
    dissect,
    fronts_of,
)
from tkamb.contact.lattice.linear.response import HalfResponse, HalfSolves
from tkamb.contact.lattice.solids.solid import Solid
from tkamb.contact.pair import Bearing
from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index, Mask


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
            force: N; zero but on the nodes that the fronts are for.
            fronts: from `fronts_of`; all by default.
        """
        y = force.ravel()[self._unknown]
        self.factor.forward(y, fronts)
        return y

    def nodal(self, x: Array, nodes: Index | None = None) -> Array:
        """Return values (m, 3) of nodes, by default of all, from a vector in elimination order.

        They are 0 where held.
        """
        return _at_places(x, self._place if nodes is None else self._place[nodes])

    @cached_property
    def _unknown(self) -> Index:
        """Which of the 3n unknowns each in elimination order is."""
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
    nodes: Array, bottom: Index, bearing: Bearing, piece: Index | None = None
) -> Mask:
    """Return which of the 3n unknowns are held.

    Fixed bearing: all of the bottom nodes' unknowns. Mobile bearing: their y, and x and z of
    the two end nodes along z, which takes away the rigid modes (those nearest to x = 0). Each of
    several pieces slides by itself.

    Args:
        nodes: (n, 3) m.
        bottom: (b,) nodes in the flat bottom.
        bearing: "fixed" or "mobile".
        piece: (n,) of each node; None: all belong together.
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
        x, z = np.abs(nodes[own, 0]), nodes[own, 2]
        tolerance = 1e-9 + 1e-6 * np.ptp(z)
        for end in (z.min(), z.max()):
            at_end = own[np.abs(z - end) <= tolerance]
            fixed[at_end[np.argmin(x[np.abs(z - end) <= tolerance])], [0, 2]] = True
    return fixed.ravel()


def prepare_operator(
    stiffness: sparse.csr_matrix,
    index: Index,
    fixed: Mask,
    contact_nodes: Index,
    precision: type[np.floating] = np.float64,
    coarse: bool = False,
) -> ElasticOperator:
    """Factorise a stiffness matrix (3n, 3n) and work out the contact nodes' half response.

    Args:
        stiffness: symmetric, positive definite on the free unknowns.
        index: (n, 3) lattice index of each node.
        fixed: (3n,) unknowns that are zero.
        contact_nodes: (c,).
        precision: in which the numbers are kept, and the response is worked out; the factor is
            worked out in float64.
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

    # The response follows the factor in a thread of its own: BLAS lets both go on.
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
    K and u allow, and rounding leaves its share of it whatever the condition of K (float32 1e-6,
    16-bit integers 5e-4); the second looks at
    the soft, smooth displacements, and the third holds the stored response against the factor.
    Nothing of factor or response is left out by random numbers.

    Args:
        operator: to be looked at.
        solid: that it should be of.
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
