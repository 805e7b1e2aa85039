"""Contact models on a lattice of cells: the contract's prepare, evaluate and press."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from tkamb.contact.lattice.bbar import BbarHexahedra
from tkamb.contact.lattice.calibrated import CalibratedNetwork
from tkamb.contact.lattice.initial_guess import (
    InitialGuess,
    LatticeStart,
    guessed_depth,
    initial_guess,
    lattice_start,
)
from tkamb.contact.lattice.linear.cache import cached_operator
from tkamb.contact.lattice.linear.compliance import SINGLE, ComplianceCache
from tkamb.contact.lattice.linear.operator import (
    ElasticOperator,
    TooLittleMemoryError,
    check_assembly_memory,
    fixed_unknowns,
    prepare_operator,
)
from tkamb.contact.lattice.meshing.contact_map import contact_map
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.lattice.meshing.quality import whole_lattice
from tkamb.contact.lattice.probe import LatticeProbe
from tkamb.contact.lattice.problem import (
    ContactProblem,
    Direction,
    LatticeState,
    SurfaceFromBelow,
    TangentPlanes,
    undeformed,
)
from tkamb.contact.lattice.report import PressureRule, result_of, unseen_flags
from tkamb.contact.lattice.settings import LATTICE_SOLVER, LatticeSolverSettings
from tkamb.contact.lattice.solid import Solid
from tkamb.contact.lattice.solver import Solution, solve, solve_by_newton
from tkamb.contact.materials import LinearElastic, Material
from tkamb.contact.model import ContactModel, Probe
from tkamb.contact.pair import ContactPair
from tkamb.contact.pressing import check_load, within_insert
from tkamb.contact.result import ContactResult, Guess, WarmStart
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.units import MILLIMETRE

TOUCHING = 1e-13
"""m; bodies that overlap by less carry nothing: 1e-6 N at 1e7 N/m."""
COARSE = 1e-3
"""From this tolerance on the factor is kept in 16 bits: they leave an imbalance of 3e-4."""
REACH = 1.08
"""Candidates must cover this many times the approach that was found."""


@dataclass(frozen=True)
class CellContact(ContactModel):
    """A solid of cells on the lattice's grid under a rigid femoral component.

    Unilateral and frictionless: contact nodes may not pass the femoral surface, which they
    meet along vertical rays, are pressed along its normal and slide on it freely. The
    approach is an unknown of the same iteration. Small strain.

    Args:
        resolution: m, edge of the cells.
        tolerance: the three tolerances of `LatticeSolverSettings` are multiplied by
            tolerance / 1e-3. The relative error of the approach is at most half of `tolerance`.
        pressure_rule: "tributary" (force over the node's own area) or "source" (force over
            total area by number of nodes, Sharma 2008, section 4.5.6).
        newton: solve by full Newton steps (slow; the reference).
        cache: keep prepared operators on disk, see `tkamb.contact.lattice.linear.cache`.
    """

    mobile_bearing: ClassVar[bool] = True

    resolution: float = 1e-3
    tolerance: float = 1e-3
    pressure_rule: PressureRule = "tributary"
    newton: bool = False
    cache: bool = True

    @property
    def settings(self) -> LatticeSolverSettings:
        """What the solver's tolerances are at this model's tolerance."""
        usual = LATTICE_SOLVER
        scale = self.tolerance / COARSE
        return replace(
            usual,
            force_tolerance=scale * usual.force_tolerance,
            work_tolerance=scale * usual.work_tolerance,
            gap_tolerance=scale * usual.gap_tolerance,
        )

    direction: ClassVar[Direction] = "normal"
    """Nodes are pressed along the femoral normal, or vertically."""
    ends_held: ClassVar[bool] = False
    """A mobile bearing's end nodes are held, see `fixed_unknowns`."""

    @abstractmethod
    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the solid on a lattice."""

    def prepare(self, pair: ContactPair) -> LatticeState:
        """Build the grid, factorise its stiffness, store the contact nodes' response."""
        lattice = whole_lattice(pair.insert, self.resolution)
        solid = self.solid(lattice, pair.material)
        held = fixed_unknowns(
            lattice.nodes,
            lattice.bottom_nodes,
            pair.bearing,
            lattice.piece_of_node,
            self.ends_held,
        )
        nodes, surface = contact_map(lattice, pair.insert)
        operator = self._operator(solid, lattice, held, nodes)
        femoral = SurfaceFromBelow(pair.femoral, pair.femoral.rays)
        problem = ContactProblem(
            solid, operator, lattice.index, held, femoral, self.direction, surface.lift
        )
        _warm_up(problem, pair)
        return LatticeState(pair, surface, lattice, problem, ComplianceCache(operator.half))

    def _operator(
        self,
        solid: Solid,
        lattice: Lattice,
        held: Mask,
        nodes: Index,
    ) -> ElasticOperator:
        """Return the operator, from disk if it was made before.

        Raises:
            InputError: it does not fit into the memory that is left.
        """

        coarse = self.tolerance >= COARSE

        def make() -> ElasticOperator:
            try:
                check_assembly_memory(len(lattice.cells))
                index = lattice.index
                return prepare_operator(solid.stiffness, index, held, nodes, SINGLE, coarse)
            except TooLittleMemoryError as short:
                size = f"{self.resolution / MILLIMETRE:g} mm"
                raise InputError(
                    f"cells of {size} do not fit: {short.what}",
                    "contact.resolution_mm",
                    short.advice(self.resolution),
                ) from None

        if not self.cache:
            return make()
        return cached_operator(solid, held, nodes, make, coarse)

    def evaluate(
        self, state: LatticeState, pose: Array, guess: Guess | None = None
    ) -> ContactResult:
        """Return the contact at a pose; see `ContactModel`."""
        return self.evaluate_from(state, pose, guess)[0]

    def press(
        self, state: LatticeState, load: float, pose: Array, guess: Guess | None = None
    ) -> ContactResult:
        """Find the approach that carries `load` (N); see `ContactModel`."""
        return self.press_from(state, load, pose, guess)[0]

    def evaluate_from(
        self,
        state: LatticeState,
        pose: Array,
        start: Guess | None = None,
        forces_only: bool = False,
    ) -> tuple[ContactResult, WarmStart]:
        """Return the contact at a pose, and the start of the next; see `ContactModel`.

        Args:
            state: what `prepare` returned.
            pose: (4, 4) pose_femoral_in_insert.
            start: an earlier result, or the start that came with it.
            forces_only: the elements that did not count at the start are not looked at, areas are
                whole nodes', nothing is flagged. It holds near the start (`LatticeProbe`).
        """
        pose = np.array(pose, float)
        if not np.isfinite(pose).all():
            return _alone(ContactResult.failed(state, pose, "the pose is not finite"))
        gaps, planes = undeformed(state.problem, pose)
        deepest = -float(gaps.min())
        if deepest <= TOUCHING:
            return _alone(ContactResult.of(state, pose, np.zeros(len(gaps)), gaps))
        return self._solved(state, pose, None, (gaps, planes), deepest, start, forces_only)

    def press_from(
        self,
        state: LatticeState,
        load: float,
        pose: Array,
        start: Guess | None = None,
    ) -> tuple[ContactResult, WarmStart]:
        """Return the contact under a load (N), and the start of the next; see `evaluate_from`."""
        check_load(load)
        pose = np.array(pose, float)
        if not np.isfinite(pose).all():
            return _alone(ContactResult.failed(state, pose, "the pose is not finite"))
        gaps, planes = undeformed(state.problem, pose)
        lowest = float(gaps.min())
        if not np.isfinite(lowest):
            missed = "the femoral component does not lie over the insert"
            return _alone(ContactResult.failed(state, pose, missed))
        if load == 0:
            pose = state.pair.pose_at_approach(pose, 0.0)
            gaps, _ = undeformed(state.problem, pose)
            return _alone(ContactResult.of(state, pose, np.zeros(len(gaps)), gaps))
        pose[1, 3] -= lowest
        gaps, planes = gaps - lowest, planes.raised(-lowest)
        own = lattice_start(state, start)
        if own is not None:
            depth = own.depth
        elif start is not None and start.approach > 0:
            depth = start.approach
        else:
            depth = guessed_depth(state.problem, gaps, state.surface.area, load)
        return self._solved(state, pose, load, (gaps, planes), depth, start)

    def probe(self, state: LatticeState, guess: Guess | None = None) -> Probe:
        """Return the probe with stiffness; see `ContactModel`."""
        if self.direction == "vertical":
            return Probe(self, state, guess)
        return LatticeProbe(self, state, guess, self.tolerance)

    def _solved(
        self,
        state: LatticeState,
        pose: Array,
        load: float | None,
        rest: tuple[Array, TangentPlanes],
        depth: float,
        begin: Guess | None,
        region_only: bool = False,
    ) -> tuple[ContactResult, WarmStart]:
        """Solve with growing candidate sets until they cover the approach.

        `rest` is what `undeformed` says at the pose.
        """
        (gaps, planes), settings = rest, self.settings
        start = lattice_start(state, begin)
        forces_only = region_only and start is not None and not self.newton
        for _ in range(settings.max_expansions):
            guess = initial_guess(
                state.compliance, gaps, planes, depth, load is None, start,
                settings.candidate_margin, forces_only,
            )  # fmt: skip
            below = -min(float(gaps.min()), 0.0)
            covered = load is None or len(guess.candidates) == np.isfinite(gaps).sum()
            within = np.inf if covered else (guess.reach - below) / REACH
            solution = self._solution(state.problem, pose, load, guess, settings, within)
            approach = solution.forces.approach
            if approach <= within:
                rule = self.pressure_rule
                result = result_of(state, pose, load, gaps, solution, rule, forces_only)
                if load is not None:
                    sunk = approach + max(-float(gaps.min()), 0.0)
                    result = within_insert(state, result, *unseen_flags(state, result, sunk))
                if not solution.converged:
                    return _alone(result)
                return result, _start_after(state, result, solution, below + approach)
            if solution.converged:  # the repetition with more candidates begins here
                place = WarmStart(state.pair, pose, state.points, np.zeros(len(gaps)), gaps)
                start = _start_after(state, place, solution, below + approach)
            depth = 1.1 * approach
        saturated = "the set of candidate nodes is saturated"
        return _alone(ContactResult.failed(state, pose, saturated))

    def _solution(
        self,
        problem: ContactProblem,
        pose: Array,
        load: float | None,
        guess: InitialGuess,
        settings: LatticeSolverSettings,
        within: float,
    ) -> Solution:
        """Solve by the stored response; by Newton's method when that leaves forces out of balance.

        A femoral surface on which nodes come to no rest stays that to Newton's method, and an
        approach beyond `within`, m, is solved again with more candidates.
        """
        if self.newton:
            return solve_by_newton(problem, pose, load, guess, settings)
        solution = solve(problem, pose, load, guess, settings)
        if (
            solution.converged
            or problem.solid.material.is_linear
            or solution.residual.gap >= solution.residual.force
        ):
            return solution
        if solution.forces.approach > within:
            return solution
        try:
            return solve_by_newton(problem, pose, load, guess, settings, solution.field)
        except ComputationError:
            return solution


@dataclass(frozen=True)
class CalibratedLattice(CellContact):
    """The calibrated lattice: exact in the uniform-strain patch, any Poisson's ratio.

    28 springs per cell weighted by the share of the cells that own them plus a cell volume
    term; nonlinear by one secant shear modulus per cell (J2 deformation theory, elastic
    bulk) from the material's curve, fed with small strain. See docs/lattice.md.
    """

    name: ClassVar[str] = "lattice"
    assumes: ClassVar[str] = (
        "a spring lattice calibrated to E, nu and the stress-strain curve; small strain, "
        "no friction"
    )
    needs: ClassVar[str] = "a closed insert; seconds to prepare, then tenths of a second"

    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the calibrated network."""
        return CalibratedNetwork(lattice.nodes, lattice.cells, lattice.spacing, material)


@dataclass(frozen=True)
class LinearLattice(CellContact):
    """The calibrated lattice with Hooke's law: contact condensed to the surface nodes."""

    name: ClassVar[str] = "lattice-linear"
    assumes: ClassVar[str] = "a spring lattice calibrated to E and nu; linear, no friction"
    needs: ClassVar[str] = "a closed insert; seconds to prepare, then milliseconds"

    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the calibrated network with the material's E and nu alone."""
        linear = replace(material, law=LinearElastic())
        return CalibratedNetwork(lattice.nodes, lattice.cells, lattice.spacing, linear)


@dataclass(frozen=True)
class FiniteElements(CellContact):
    """B-bar hexahedra (mean dilatation), J2 deformation theory at eight Gauss points.

    Grid, active set and pressure rules are those of the lattice; small strain.
    """

    name: ClassVar[str] = "fe"
    assumes: ClassVar[str] = "finite elements (B-bar hexahedra) with J2 deformation theory"
    needs: ClassVar[str] = "a closed insert; seconds to prepare, then tenths of a second"

    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the hexahedra."""
        return BbarHexahedra(lattice.nodes, lattice.cells, lattice.spacing, material)


def _alone(result: ContactResult) -> tuple[ContactResult, WarmStart]:
    """Return an answer that leaves no solution behind, and the start that it gives by itself."""
    return result, WarmStart.after(result)


def _start_after(
    state: LatticeState, place: Guess, solution: Solution, depth: float
) -> LatticeStart:
    """Return where the next solution may begin after one that has converged.

    Args:
        state: prepared contact.
        place: pose, pressure and gap of the solution.
        solution: what the solver found.
        depth: m, how far the femoral component is below the lowest contact node.
    """
    moved = np.zeros_like(state.surface.points)
    moved[solution.candidates] = solution.displacement
    return LatticeStart(
        state.pair, place.pose, state.points, place.pressure, place.gap,
        state.problem, solution.loads, moved, depth, solution.region, solution.softening,
    )  # fmt: skip


def _warm_up(problem: ContactProblem, pair: ContactPair) -> None:
    """Have built now what the first rays and the first look at the cells would build."""
    undeformed(problem, np.eye(4))
    pair.touch_at(np.eye(4))
    if not problem.solid.material.is_linear:
        still = np.zeros_like(problem.solid.nodes)
        problem.solid.nonlinear_residual(still)
        problem.solid.least_principal_strain(still)
