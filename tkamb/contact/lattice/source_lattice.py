"""The lattice of Sharma (2008) and its own loops, kept for comparison (`lattice-source`).

Sharma (2008), section 4.5.5. Nodes in contact get the vertical displacement that brings them
onto the femoral component, and slide freely in x and z. All other nodes must carry no force.

Linear: a unit dummy displacement of the nodes in contact gives the slope of the reaction, so
that one correction of D reaches the load while the set stays. Nonlinear: at fixed D the free
unknowns are iterated to zero force with the tangent springs, then D_new = D
(F_load/F_reaction)^(1/m). Sharma (2008) has m = 1. That oscillates without end where the reaction
grows with the square of D or faster, as it does while nodes come into contact. From the second D
on, m is therefore the exponent between the last two.
Sharma (2008) leaves open what happens to nodes that would be pulled. Here they are released, and
nodes that the femoral component would penetrate are added.

No step factorises a matrix. Which nodes are in contact changes from loop to loop, and so does the
matrix of the free unknowns. With K = L Lᵀ, the factor of the undeformed insert, and Z = L⁻¹ E, the
response of the held unknowns (E picks them) that `prepare` stores,

    P = L⁻ᵀ (1 − Z (ZᵀZ)⁻¹ Zᵀ) L⁻¹

is the inverse of K on the free unknowns. A prescribed displacement d of the held unknowns moves
the lattice by L⁻ᵀ Z (ZᵀZ)⁻¹ d. The springs' tangent differs from K in the few springs that have
softened. The conjugate gradient method, preconditioned by P, solves with it in a few iterations
(Saad 2003, section 9.2). Rounding of the stored factor changes only the number of iterations.
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


@dataclass(frozen=True)
class LoopSettings:
    """How Sharma's loops begin and end (`lattice-source` with the option loops = "source").

    The tolerances that they share with the other solvers are in `LatticeSolverSettings`.
    """

    max_loops: int = 60
    """Largest number of changes of the contact set or of D; then the press has not converged.
    Smaller: more presses end so. Larger: a press that cannot converge takes longer."""
    max_steps: int = 30
    """Largest number of tangent steps at one D; the next loop goes on from there. Smaller: loops
    are cheaper, but there may be more of them. Larger: the residual at one D is brought further
    down."""
    first_depth: float = 0.8
    """1: first D, as a share of the depth that the candidates cover. Candidates reach a quarter
    deeper than the depth that is expected: 1 / 1.25."""
    load: float = 0.1
    """1: largest relative error of the load, as a share of the solver's `force_tolerance`. Smaller:
    more loops. Larger: fewer; an error of the whole tolerance changes the forces by as much."""
    balance: float = 0.01
    """1: the tangent steps at one D end when the residual of the free nodes is below this share of
    the relative error of the load (or of the solver's `force_tolerance`, if that is larger).
    Smaller: more tangent steps in each loop. Larger: fewer, but D is corrected by a less accurate
    reaction."""
    smallest_step: float = 0.05
    """1: a tangent step that raises the residual is halved, down to about this share."""


LOOP = LoopSettings()


@dataclass(frozen=True)
class SourceLattice(CellContact):
    """26-neighbour springs of one stiffness k = E·C; see `tkamb.contact.lattice.source`.

    Contact is vertical as in Sharma (2008): nodes are pressed along y and slide freely in x and
    z, so that no horizontal force arises. Kept for comparison: with free sides it is too
    stiff (12 % on a cube of 12 cells), and its Poisson's ratio is 0.35 whatever the material.

    Args:
        law: "nonlinear" (the material's curve on every spring) or "linear".
        loops: "stored" (one iteration on the stored response) or "source" (Sharma's own
            displacement-driven loops; the same answer, slower).
        pressure_rule: "source" by default.
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
        within: float,
    ) -> Solution:
        if self.loops == "source":
            return solve_by_loops(problem, pose, load, guess, settings)
        return super()._solution(problem, pose, load, guess, settings, within)


@dataclass(frozen=True, eq=False)
class _Pressed:
    """Vertical forces (m,) on all candidates and displacements (n, 3) at one D."""

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
    """Return the contact at a pose under a load (N), or at approach 0 when load is None.

    `guess` gives candidates and how deep they reach; for the others see `solver.solve`. The
    problem's `direction` is "vertical".
    """
    nodes = problem.contact_nodes[guess.candidates]
    points = problem.surface_points[guess.candidates]
    response = CandidateResponse(problem, guess.candidates)
    sliding = SlidingNodes(problem, points, np.zeros_like(points), pose, guess.planes)
    depth = 0.0 if load is None else settings.first_depth * float(guess.reach)
    field, loops, missed = np.zeros_like(problem.solid.nodes), 0, 1.0
    active, history = sliding.planes.gap(points) < depth, []
    while True:
        loops += 1
        planes = sliding.planes
        target = settings.balance * max(solver.force_tolerance, missed)
        pressed = _press(response, points, planes, active, depth, field, target, settings)
        field, displacement = pressed.field, pressed.field[nodes]
        reaction = float(pressed.force.sum())
        missed = 0.0 if load is None else abs(reaction - load) / load
        changed = _next_active(points + displacement, planes, active, pressed.force, depth)
        opening = np.where(active, 0.0, planes.gap(points + displacement) - depth)
        force = np.where(active, np.maximum(pressed.force, 0), 0.0)
        forces = ContactForces(force, opening, depth, active, loops, True)
        last = loops == settings.max_loops
        settled = sliding.follow(displacement, forces) <= solver.gap_tolerance
        still = bool((changed == active).all())
        load_reached = missed <= settings.load * solver.force_tolerance
        converged = (
            still and settled and load_reached and pressed.residual <= solver.force_tolerance
        )
        if converged or last:
            return _solution(guess, forces, planes, pressed, nodes, loops, missed, converged)
        if load is not None and still:
            history.append((depth, reaction))
            depth = _next_depth(problem, history, load, pressed.slope)
            changed = changed | (sliding.planes.gap(points + displacement) < depth) & ~active
        if not load_reached or not (changed == active).all():
            # Another set or depth moves the nodes again; that is no oscillation.
            sliding = SlidingNodes(problem, points, displacement, pose, planes)
        active = changed


def _next_depth(
    problem: ContactProblem, history: list[tuple[float, float]], load: float, slope: float
) -> float:
    """Return D by the dummy displacement's slope (linear) or by the secant (nonlinear)."""
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
    """Return the set without the nodes that are pulled, plus those that would be penetrated."""
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
    """Prescribe the active nodes' vertical displacement and bring the other nodes to zero force.

    The first step spreads the change with the undeformed stiffness, as in Sharma (2008); then
    tangent steps, halved while they would raise the unbalanced force, until that is below
    `target` times the contact force.
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
    everywhere = np.zeros(len(active))
    everywhere[active] = force
    return _Pressed(
        everywhere, u, active_nodes.slope if solid.material.is_linear else np.nan, residual
    )


def _balance(solid: SourceNetwork, u: Array, active_nodes: HeldNodes) -> tuple[Array, float, Array]:
    """Return the forces on the active nodes, the relative residual and the internal forces."""
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
    missed: float,
    converged: bool,
) -> Solution:
    ended = ContactForces(
        forces.force, forces.gap, forces.approach, forces.active, forces.sets, converged
    )
    residual = Residual(max(missed, pressed.residual))
    return Solution(
        guess.candidates, ended, planes, pressed.field[nodes], pressed.field, None, loops, residual
    )
