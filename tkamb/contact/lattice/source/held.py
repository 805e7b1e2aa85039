"""Displacements of the lattice while contact nodes are held at a height.

Sharma's loops prescribe y of the nodes in contact and ask for equilibrium of all other unknowns.
Which nodes are in contact changes from loop to loop, and so does the matrix of the free unknowns.
It is never factorised again. With K = L Lᵀ, the factor of the undeformed insert, and
Z = L⁻¹ E the response of the held unknowns (E picks them), which `prepare` stores,

    P = L⁻ᵀ (1 − Z (ZᵀZ)⁻¹ Zᵀ) L⁻¹

is the inverse of K on the free unknowns. A prescribed displacement d of the held unknowns moves
the lattice by L⁻ᵀ Z (ZᵀZ)⁻¹ d. The springs' tangent differs from K in the few springs that have
softened. The conjugate gradient method, preconditioned by P, solves with it in a few iterations
(Saad 2003, section 9.2). Rounding of the stored factor changes only the number of iterations.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import LinearOperator, cg

from tkamb.contact.lattice.linear.response import HalfResponse, unknowns_of
from tkamb.contact.lattice.problem import ContactProblem
from tkamb.contact.lattice.source.springs import SourceNetwork, Tangent
from tkamb.geometry.frames import Array, Index, Mask

VERTICAL = 1
"""Component of a node's displacement that the femoral component prescribes."""


@dataclass(frozen=True)
class ConjugateGradientSettings:
    """When the linear system of a tangent step of Sharma's loops counts as solved."""

    tolerance: float = 0.02
    """1: residual relative to the right-hand side. Smaller: more iterations for each tangent step.
    Larger: more tangent steps. A tangent step need not be exact, because the next one corrects its
    error."""
    max_iterations: int = 60
    """Largest number of iterations for a tangent step; the solution so far is then used. Smaller:
    more tangent steps. Larger: a step may take longer."""


CONJUGATE_GRADIENT = ConjugateGradientSettings()


class CandidateResponse:
    """Response to vertical forces on candidate nodes: the part of `prepare` that the loops use.

    Args:
        problem: solid and factor.
        candidates: (m,) positions among the contact nodes.
    """

    def __init__(self, problem: ContactProblem, candidates: Index) -> None:
        self.problem = problem
        self.nodes = problem.contact_nodes[candidates]
        unknowns = unknowns_of(candidates).reshape(-1, 3)[:, VERTICAL]
        self.half: HalfResponse = problem.operator.half.among(unknowns)

    @cached_property
    def compliance(self) -> Array:
        """Vertical displacement of each candidate (m, m), m/N, by a force on each."""
        return np.asarray(self.half.compliance(), float)


class HeldNodes:
    """The free unknowns of the lattice while y of the active candidates is prescribed.

    Args:
        response: of the candidates.
        active: (m,) which of them are held.
        settings: of the linear solutions.
    """

    def __init__(
        self,
        response: CandidateResponse,
        active: Mask,
        settings: ConjugateGradientSettings = CONJUGATE_GRADIENT,
    ) -> None:
        self._response, self._active, self._settings = response, active, settings
        self._operator = response.problem.operator
        self._chosen = np.flatnonzero(active)
        self.unknowns = 3 * response.nodes[active] + VERTICAL
        self.held = response.problem.held.copy()
        self.held[self.unknowns] = True

    @cached_property
    def _factor(self) -> tuple[Array, bool]:
        """Cholesky factor of ZᵀZ, the compliance of the held unknowns."""
        # Compliance of the active nodes; symmetric and positive definite.
        return cho_factor(self._response.compliance[np.ix_(self._chosen, self._chosen)])

    @property
    def slope(self) -> float:
        """Sum of forces (N) that move the active nodes down together, per metre (linear)."""
        # Forces that move all active nodes by one: their sum is the stiffness of the contact.
        return float(cho_solve(self._factor, np.ones(len(self._chosen))).sum())

    def spread(self, prescribed: Array) -> Array:
        """Return the displacement (n, 3), m, that given y (a,), m, of the active nodes cause.

        It is that of the undeformed lattice; the active nodes have the given y exactly.
        """
        count = len(self._response.problem.solid.nodes)
        if not len(prescribed):
            return np.zeros((count, 3))
        y = np.zeros(len(self._operator.factor.order))
        self._push(cho_solve(self._factor, prescribed), y)
        self._operator.factor.backward(y)
        field = self._operator.nodal(y)
        field.ravel()[self.unknowns] = prescribed
        return field

    def solve(self, tangent: Tangent, force: Array) -> Array:
        """Return the displacement (n, 3), m, of the free unknowns under a force (n, 3), N.

        Args:
            tangent: of the springs as they are.
            force: forces on held unknowns have no effect.
        """
        solid, settings = self._response.problem.solid, self._settings
        assert isinstance(solid, SourceNetwork)
        shape = force.shape

        def stiffness(x: Array) -> Array:
            return self._free(solid.tangent_force(tangent, x.reshape(shape)))

        def inverse(x: Array) -> Array:
            return self._free(self._solve_linear(x.reshape(shape)))

        size = (force.size, force.size)
        # The elastic factor is the preconditioner: near to the tangent, so that few iterations are
        # needed.
        solution, _ = cg(
            LinearOperator(size, matvec=stiffness, dtype=float),
            self._free(force),
            rtol=settings.tolerance,
            maxiter=settings.max_iterations,
            M=LinearOperator(size, matvec=inverse, dtype=float),
        )
        return np.asarray(solution.reshape(shape))

    def _free(self, values: Array) -> Array:
        """Return values (3n,) with zeros at the held unknowns."""
        return np.where(self.held, 0.0, values.ravel())

    def _solve_linear(self, force: Array) -> Array:
        """Return P f (n, 3) of a force (n, 3)."""
        y = self._operator.start(force)
        if len(self._chosen):
            projection = self._response.half.project(y)[self._chosen]
            # Reactions of the active nodes that bring their vertical displacement back to zero.
            self._push(-cho_solve(self._factor, projection), y)
        self._operator.factor.backward(y)
        return self._operator.nodal(y)

    def _push(self, force: Array, y: Array) -> None:
        """Add Z f to y, for vertical forces (a,) on the active nodes."""
        everywhere = np.zeros(len(self._active))
        everywhere[self._chosen] = force
        self._response.half.apply(everywhere, y)
