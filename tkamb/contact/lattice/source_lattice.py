"""The lattice of Sharma (2008) and its own loops, for comparison (`lattice-source`).

Nodes in contact get the vertical displacement that brings them onto the femoral component, and
slide freely in x and z; all others have no load (section 4.5.5; docs/lattice.md).

Linear: a unit displacement of these nodes gives the slope of the reaction F. One correction of the
approach D then gives the load, if the contact set does not change. Nonlinear: at fixed D, Newton
steps with the tangent springs bring the free nodes to equilibrium, then D_new = D (load/F)^(1/m).
Penetrated nodes are added, nodes in tension released.

No step factorises a matrix. `prepare` stores the factor of the undeformed insert, K = L Lᵀ, and the
response of the held unknowns, Z = L⁻¹ E (the columns of E are their unit forces). With these,

    P = L⁻ᵀ (1 − Z (ZᵀZ)⁻¹ Zᵀ) L⁻¹

is the inverse of K on the free unknowns. A prescribed displacement d of the held unknowns displaces
the lattice by L⁻ᵀ Z (ZᵀZ)⁻¹ d. The tangent stiffness differs from K only in the few softened
springs, so the conjugate gradient method, preconditioned by P, needs few iterations (Saad 2003,
section 9.2). The rounding of the stored factor changes only their number.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import LinearOperator, cg

from tkamb.contact.lattice.active_set import ContactForces
from tkamb.contact.lattice.initial_guess import InitialGuess
from tkamb.contact.lattice.linear.compliance import HalfResponse, unknowns_of
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.lattice.model import CellContact
from tkamb.contact.lattice.nonlinear_balance import Residual
from tkamb.contact.lattice.problem import ContactProblem, Direction, TangentPlanes
from tkamb.contact.lattice.report import PressureRule
from tkamb.contact.lattice.settings import LatticeSolverSettings
from tkamb.contact.lattice.solid import Solid
from tkamb.contact.lattice.solver import SlidingNodes, Solution
from tkamb.contact.lattice.source_springs import SourceNetwork, Tangent
from tkamb.contact.materials import LinearElastic, Material
from tkamb.geometry.frames import Array, Index, Mask

VERTICAL = 1
"""Component y of a node's displacement, which the femoral component prescribes."""


@dataclass(frozen=True)
class ConjugateGradientSettings:
    """When the linear system of a tangent step of Sharma's loops counts as solved."""

    tolerance: float = 0.02
    """1: largest residual relative to the right-hand side. The next tangent step corrects the
    error.
    """
    max_iterations: int = 60
    """Largest number of iterations for a tangent step; then the last iterate is used."""


CONJUGATE_GRADIENT = ConjugateGradientSettings()


class CandidateResponse:
    """Stored response to vertical forces on the candidate nodes, `candidates` (m,)."""

    def __init__(self, problem: ContactProblem, candidates: Index) -> None:
        self.problem = problem
        self.nodes = problem.contact_nodes[candidates]
        unknowns = unknowns_of(candidates).reshape(-1, 3)[:, VERTICAL]
        self.half: HalfResponse = problem.operator.half.among(unknowns)

    @cached_property
    def compliance(self) -> Array:
        """Vertical displacements under vertical unit forces on the candidates (m, m), m/N."""
        return np.asarray(self.half.compliance(), float)


class HeldNodes:
    """The lattice while the vertical displacement of the `active` (m,) candidates is prescribed."""

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
        """Cholesky factor of ZᵀZ, the compliance of the active nodes along y."""
        return cho_factor(self._response.compliance[np.ix_(self._chosen, self._chosen)])

    @property
    def slope(self) -> float:
        """Stiffness of the contact, N/m: sum of the forces per common displacement (linear)."""
        return float(cho_solve(self._factor, np.ones(len(self._chosen))).sum())

    def spread(self, prescribed: Array) -> Array:
        """Return the displacement (n, 3), m, of the linear lattice for prescribed y (a,), m."""
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

        Forces on held unknowns have no effect.
        """
        solid, settings = self._response.problem.solid, self._settings
        assert isinstance(solid, SourceNetwork)
        shape = force.shape

        def stiffness(x: Array) -> Array:
            return self._free(solid.tangent_force(tangent, x.reshape(shape)))

        def inverse(x: Array) -> Array:
            return self._free(self._solve_linear(x.reshape(shape)))

        size = (force.size, force.size)
        # P is a good preconditioner, because the tangent stiffness differs little from K.
        solution, _ = cg(
            LinearOperator(size, matvec=stiffness, dtype=float),
            self._free(force),
            rtol=settings.tolerance,
            maxiter=settings.max_iterations,
            M=LinearOperator(size, matvec=inverse, dtype=float),
        )
        return np.asarray(solution.reshape(shape))

    def _free(self, values: Array) -> Array:
        return np.where(self.held, 0.0, values.ravel())

    def _solve_linear(self, force: Array) -> Array:
        """Return P f (n, 3), m, of a force f (n, 3), N."""
        y = self._operator.start(force)
        if len(self._chosen):
            projection = self._response.half.project(y)[self._chosen]
            # Reactions make the vertical displacement of the active nodes zero.
            self._push(-cho_solve(self._factor, projection), y)
        self._operator.factor.backward(y)
        return self._operator.nodal(y)

    def _push(self, force: Array, y: Array) -> None:
        """Add Z f to y, for vertical forces f (a,), N."""
        candidate_force = np.zeros(len(self._active))
        candidate_force[self._chosen] = force
        self._response.half.apply(candidate_force, y)


@dataclass(frozen=True)
class LoopSettings:
    """How Sharma's loops begin and end (`lattice-source` with the option loops = "source").

    D is the approach. `LatticeSolverSettings` has the tolerances that all solvers share.
    """

    max_loops: int = 60
    """Largest number of changes of the contact set or of D."""
    max_steps: int = 30
    """Largest number of tangent steps at one D."""
    first_depth: float = 0.8
    """1: first D, relative to the depth that the candidates cover. The candidates
    cover 1.25 times the expected approach, and 1 / 1.25 = 0.8."""
    load: float = 0.1
    """1: largest relative error of the load, relative to the solver's `force_tolerance`. The forces
    have the same relative error as the load.
    """
    balance: float = 0.01
    """1: the tangent steps at one D end when the residual of the free nodes is below this share of
    the relative error of the load (or of the solver's `force_tolerance`, if that is larger).
    Larger: the reaction that corrects D is less accurate.
    """
    smallest_step: float = 0.05
    """1: smallest share of a tangent step: one that raises the residual is halved until about this
    share.
    """


LOOP = LoopSettings()


@dataclass(frozen=True)
class SourceLattice(CellContact):
    """Springs of equal stiffness k = E·C between neighbours; see `source_springs`.

    Contact is vertical as in Sharma (2008): nodes slide freely in x and z. The model is for
    comparison: with free sides it is too stiff (12 % on a cube of 12 cells), and its Poisson's
    ratio is 0.35 for every material.

    Args:
        law: "nonlinear" (the material's curve for every spring) or "linear".
        loops: "stored" (the solver of the other lattice models) or "source" (Sharma's own
            displacement-driven loops; the same result, slower).
    """

    name: ClassVar[str] = "lattice-source"
    assumes: ClassVar[str] = (
        "Sharma's springs k = E C (nu 0.35, too stiff at free sides), vertical contact"
    )
    needs: ClassVar[str] = "a closed insert; seconds to prepare, then tenths of a second"

    pressure_rule: PressureRule = "source"
    law: Literal["nonlinear", "linear"] = "nonlinear"
    loops: Literal["stored", "source"] = "stored"

    ends_held: ClassVar[bool] = True
    direction: ClassVar[Direction] = "vertical"

    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the network of equal springs."""
        if self.law == "linear":
            material = replace(material, law=LinearElastic())
        return SourceNetwork(
            lattice.nodes, lattice.cells, lattice.spacing, material, lattice.springs.ends
        )

    def _solution(
        self,
        problem: ContactProblem,
        pose: Array,
        load: float | None,
        guess: InitialGuess,
        settings: LatticeSolverSettings,
        covered: float,
    ) -> Solution:
        if self.loops == "source":
            return solve_by_loops(problem, pose, load, guess, settings)
        return super()._solution(problem, pose, load, guess, settings, covered)


@dataclass(frozen=True, eq=False)
class _Pressed:
    """Equilibrium at one D.

    Args:
        force: vertical forces on the candidates, N, (m,).
        field: displacement of all nodes, m, (n, 3).
        slope: change of the reaction with D, N/m; NaN for a nonlinear material.
        residual: residual of the free nodes, relative to the reaction (sums of absolute values).
    """

    force: Array
    field: Array
    slope: float
    residual: float


def solve_by_loops(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    guess: InitialGuess,
    solver: LatticeSolverSettings,
    settings: LoopSettings = LOOP,
) -> Solution:
    """Return the result of `solver.solve` by Sharma's loops.

    The problem's `direction` is "vertical". Of the guess, only candidates, planes and reach are
    used.
    """
    nodes = problem.contact_nodes[guess.candidates]
    points = problem.surface_points[guess.candidates]
    response = CandidateResponse(problem, guess.candidates)
    sliding = SlidingNodes(problem, points, np.zeros_like(points), pose, guess.planes)
    depth = 0.0 if load is None else settings.first_depth * float(guess.reach)
    field, loops, load_error = np.zeros_like(problem.solid.nodes), 0, 1.0
    active, history = sliding.planes.gap(points) < depth, []
    while True:
        loops += 1
        planes = sliding.planes
        target = settings.balance * max(solver.force_tolerance, load_error)
        pressed = _press(response, points, planes, active, depth, field, target, settings)
        field, displacement = pressed.field, pressed.field[nodes]
        reaction = float(pressed.force.sum())
        load_error = 0.0 if load is None else abs(reaction - load) / load
        next_active = _next_active(points + displacement, planes, active, pressed.force, depth)
        opening = np.where(active, 0.0, planes.gap(points + displacement) - depth)
        force = np.where(active, np.maximum(pressed.force, 0), 0.0)
        forces = ContactForces(force, opening, depth, active, loops, True)
        last = loops == settings.max_loops
        gap_closed = sliding.follow(displacement, forces) <= solver.gap_tolerance
        same_set = bool((next_active == active).all())
        load_reached = load_error <= settings.load * solver.force_tolerance
        in_balance = pressed.residual <= solver.force_tolerance
        converged = same_set and gap_closed and load_reached and in_balance
        if converged or last:
            return _solution(guess, forces, planes, pressed, nodes, loops, load_error, converged)
        if load is not None and same_set:
            history.append((depth, reaction))
            depth = _next_depth(problem, history, load, pressed.slope)
            penetrated = sliding.planes.gap(points + displacement) < depth
            next_active = next_active | penetrated & ~active
        if not load_reached or not (next_active == active).all():
            # A new set or depth moves the nodes, which must not count as oscillation.
            sliding = SlidingNodes(problem, points, displacement, pose, planes)
        active = next_active


def _next_depth(
    problem: ContactProblem, history: list[tuple[float, float]], load: float, slope: float
) -> float:
    """Return D by stiffness (linear) or growth exponent m (nonlinear)."""
    depth, reaction = history[-1]
    if problem.solid.material.is_linear:
        return depth + (load - reaction) / slope
    growth = 1.0
    if len(history) > 1 and depth != history[-2][0] and min(reaction, history[-2][1]) > 0:
        growth = np.log(reaction / history[-2][1]) / np.log(depth / history[-2][0])
    ratio = (load / max(reaction, 1e-12)) ** (1 / max(growth, 1.0))
    return depth * float(np.clip(ratio, 0.25, 4.0))


def _next_active(
    positions: Array, planes: TangentPlanes, active: Mask, force: Array, depth: float
) -> Mask:
    return (active & (force >= 0)) | (~active & (planes.gap(positions) < depth))


def _press(
    response: CandidateResponse,
    points: Array,
    planes: TangentPlanes,
    active: Mask,
    depth: float,
    field: Array,
    target: float,
    settings: LoopSettings,
) -> _Pressed:
    """Return the equilibrium for prescribed vertical displacements of the active nodes.

    Tangent steps follow a first linear step, as in Sharma (2008), until the residual is below
    `target` times the contact force. A step that raises it is halved.
    """
    solid = response.problem.solid
    assert isinstance(solid, SourceNetwork)
    active_nodes = HeldNodes(response, active)
    prescribed = planes.points[active, 1] - depth - points[active, 1]
    prescribed -= field.ravel()[active_nodes.unknowns]
    u = field + active_nodes.spread(prescribed)
    force, residual, internal = _balance(solid, u, active_nodes)
    steps = 0
    while residual > target and steps < settings.max_steps:
        steps += 1
        step = -active_nodes.solve(solid.spring_tangent(u), internal)
        share, last = 1.0, residual
        while True:
            force, residual, internal = _balance(solid, u + share * step, active_nodes)
            if residual < last or share < settings.smallest_step:
                break
            share /= 2
        u = u + share * step
    candidate_force = np.zeros(len(active))
    candidate_force[active] = force
    slope = active_nodes.slope if solid.material.is_linear else np.nan
    return _Pressed(candidate_force, u, slope, residual)


def _balance(solid: SourceNetwork, u: Array, active_nodes: HeldNodes) -> tuple[Array, float, Array]:
    internal = solid.internal_force(u)
    force = -internal.ravel()[active_nodes.unknowns]
    size = max(float(np.abs(force).sum()), 1e-300)
    residual = (
        float(np.abs(internal.ravel()[~active_nodes.held]).sum()) / size if len(force) else 0.0
    )
    return force, residual, internal


def _solution(
    guess: InitialGuess,
    forces: ContactForces,
    planes: TangentPlanes,
    pressed: _Pressed,
    nodes: Index,
    loops: int,
    load_error: float,
    converged: bool,
) -> Solution:
    forces = replace(forces, converged=converged)
    residual = Residual(max(load_error, pressed.residual))
    return Solution(
        guess.candidates, forces, planes, pressed.field[nodes], pressed.field, None, loops, residual
    )
