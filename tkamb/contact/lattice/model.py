"""Contact models on a lattice of cells."""

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
from tkamb.contact.pressing import beside_words, check_load, within_insert
from tkamb.contact.result import ContactResult, Guess, WarmStart
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.units import MILLIMETRE

LEAST_OVERLAP = 1e-13
"""m: smaller overlaps count as no contact. With 1e7 N/m their force is below 1e-6 N."""
COARSE = 1e-3
"""1: from this `tolerance` on the factor is stored in 16-bit integers.
`LatticeSolverSettings.force_tolerance` states their rounding residual."""
COVERED_APPROACH = 1.08
"""1: least ratio of the depth covered by the candidates and the approach."""


@dataclass(frozen=True)
class CellContact(ContactModel):
    """A solid of cells on the lattice's grid under a rigid femoral component.

    The contact is frictionless, at small strain. Vertical rays measure the gaps; contact forces act
    along the femoral normal. The approach is an unknown of the same iteration.

    Args:
        resolution: edge of the cells, m.
        tolerance: the four tolerances of `LatticeSolverSettings` are multiplied by
            tolerance / 1e-3. The relative error of the approach is at most half of `tolerance`.
        pressure_rule: "tributary" (a node's force over its tributary area) or "source" (force over
            the mean area of the nodes in contact, Sharma 2008, section 4.5.6).
        newton: whether to use full Newton steps (slow; the reference).
        cache: whether to store prepared operators, see `tkamb.contact.lattice.linear.cache`.
    """

    mobile_bearing: ClassVar[bool] = True

    resolution: float = 1e-3
    tolerance: float = 1e-3
    pressure_rule: PressureRule = "tributary"
    newton: bool = False
    cache: bool = True

    @property
    def settings(self) -> LatticeSolverSettings:
        """The solver's settings at this model's tolerance."""
        defaults = LATTICE_SOLVER
        scale = self.tolerance / COARSE
        return replace(
            defaults,
            force_tolerance=scale * defaults.force_tolerance,
            work_tolerance=scale * defaults.work_tolerance,
            gap_tolerance=scale * defaults.gap_tolerance,
            peak_tolerance=scale * defaults.peak_tolerance,
        )

    direction: ClassVar[Direction] = "normal"
    """Direction of the contact forces: along the femoral normal, or vertical."""
    ends_held: ClassVar[bool] = False
    """Whether a mobile bearing's end nodes are held, see `fixed_unknowns`."""

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
        """Return the operator, stored or new.

        Raises:
            InputError: it does not fit into the available memory.
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
        """Return the contact at a pose, and a warm start; see `ContactModel`.

        Args:
            forces_only: whether only the forces are needed. Then only the region of the warm start
                is evaluated, a contact area is the sum of the tributary areas of the loaded nodes,
                and nothing is flagged. This is accurate near the pose of the warm start
                (`LatticeProbe`).
        """
        pose = np.array(pose, float)
        if not np.isfinite(pose).all():
            return _with_start(ContactResult.out_of_range(state, pose, "the pose is not finite"))
        gaps, planes = undeformed(state.problem, pose)
        overlap = -float(gaps.min())
        if overlap <= LEAST_OVERLAP:
            return _with_start(ContactResult.of(state, pose, np.zeros(len(gaps)), gaps))
        return self._solved(state, pose, None, (gaps, planes), overlap, start, forces_only)

    def press_from(
        self,
        state: LatticeState,
        load: float,
        pose: Array,
        start: Guess | None = None,
        forces_only: bool = False,
    ) -> tuple[ContactResult, WarmStart]:
        """Return the contact under a load (N) and a warm start; see `evaluate_from`."""
        check_load(load)
        pose = np.array(pose, float)
        if not np.isfinite(pose).all():
            return _with_start(ContactResult.out_of_range(state, pose, "the pose is not finite"))
        gaps, planes = undeformed(state.problem, pose)
        lowest = float(gaps.min())
        if not np.isfinite(lowest):
            return _with_start(
                ContactResult.out_of_range(state, pose, beside_words(state.pair, pose))
            )
        if load == 0:
            pose = state.pair.pose_at_approach(pose, 0.0)
            gaps, _ = undeformed(state.problem, pose)
            return _with_start(ContactResult.of(state, pose, np.zeros(len(gaps)), gaps))
        pose[1, 3] -= lowest
        gaps, planes = gaps - lowest, planes.raised(-lowest)
        warm = lattice_start(state, start)
        if warm is not None:
            depth = warm.depth
        elif start is not None and start.approach > 0:
            depth = start.approach
        else:
            depth = guessed_depth(state.problem, gaps, state.surface.area, load)
        return self._solved(state, pose, load, (gaps, planes), depth, start, forces_only)

    def probe(self, state: LatticeState, guess: Guess | None = None) -> Probe:
        """Return a probe that also gives the stiffness; see `ContactModel`."""
        if self.direction == "vertical":
            return Probe(self, state, guess)
        return LatticeProbe(self, state, guess, self.tolerance)

    def _solved(
        self,
        state: LatticeState,
        pose: Array,
        load: float | None,
        gaps_and_planes: tuple[Array, TangentPlanes],
        depth: float,
        guess_or_start: Guess | None,
        region_only: bool = False,
    ) -> tuple[ContactResult, WarmStart]:
        """Solve with growing candidate sets until they cover the approach.

        `gaps_and_planes` is `undeformed` at the pose, `depth` the expected approach, m.
        """
        (gaps, planes), settings = gaps_and_planes, self.settings
        before = lattice_start(state, guess_or_start)
        start = None if before is None else before.extrapolated(pose)
        forces_only = region_only and start is not None and not self.newton
        for _ in range(settings.max_expansions):
            guess = initial_guess(
                state.compliance, gaps, planes, depth, load is None, start,
                settings.candidate_margin, forces_only,
            )  # fmt: skip
            overlap = -min(float(gaps.min()), 0.0)
            complete = load is None or len(guess.candidates) == np.isfinite(gaps).sum()
            covered = np.inf if complete else (guess.reach - overlap) / COVERED_APPROACH
            solution = self._solution(state.problem, pose, load, guess, settings, covered)
            approach = solution.forces.approach
            if approach <= covered:
                rule = self.pressure_rule
                result = result_of(state, pose, load, gaps, solution, rule, forces_only)
                if load is not None and not forces_only:
                    below_first = approach + max(-float(gaps.min()), 0.0)
                    flags = unseen_flags(state, result, below_first)
                    result = within_insert(state, result, *flags)
                if not solution.converged:
                    return _with_start(result)
                return result, _start_after(state, result, solution, overlap + approach, before)
            if solution.converged:  # the solution with more candidates begins at this state
                at_pose = WarmStart(state.pair, pose, state.points, np.zeros(len(gaps)), gaps)
                start = _start_after(state, at_pose, solution, overlap + approach, None)
            depth = 1.1 * approach
        saturated = "the set of candidate nodes is saturated"
        return _with_start(ContactResult.out_of_range(state, pose, saturated))

    def _solution(
        self,
        problem: ContactProblem,
        pose: Array,
        load: float | None,
        guess: InitialGuess,
        settings: LatticeSolverSettings,
        covered: float,
    ) -> Solution:
        """Solve with the stored factor, and by Newton's method if this does not converge.

        It is not tried if the gap residual is at least the force residual: the nodes oscillate on
        the femoral surface, also with Newton's method. Nor is it tried if the approach is larger
        than `covered`, m, because the caller then adds candidates.
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
        if solution.forces.approach > covered:
            return solution
        try:
            return solve_by_newton(problem, pose, load, guess, settings, solution.field)
        except ComputationError:
            return solution


@dataclass(frozen=True)
class CalibratedLattice(CellContact):
    """The calibrated lattice. It passes the patch test, for any Poisson's ratio.

    A cell has 28 springs, which it shares with its neighbours, and a volume term. The material's
    curve gives one secant shear modulus per cell (J2 deformation theory, elastic bulk, small
    strain). See docs/lattice.md.
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
    """The calibrated lattice with Hooke's law."""

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

    Grid, contact and pressure rules are those of the lattice. Small strain.
    """

    name: ClassVar[str] = "fe"
    assumes: ClassVar[str] = "finite elements (B-bar hexahedra) with J2 deformation theory"
    needs: ClassVar[str] = "a closed insert; seconds to prepare, then tenths of a second"

    def solid(self, lattice: Lattice, material: Material) -> Solid:
        """Return the hexahedra."""
        return BbarHexahedra(lattice.nodes, lattice.cells, lattice.spacing, material)


def _with_start(result: ContactResult) -> tuple[ContactResult, WarmStart]:
    """Return a result, and a warm start without a lattice solution."""
    return result, WarmStart.after(result)


def _start_after(
    state: LatticeState,
    contact: Guess,
    solution: Solution,
    depth: float,
    before: LatticeStart | None,
) -> LatticeStart:
    """Return the warm start of a converged solution.

    Args:
        contact: pose, pressure and gap of the solution.
        depth: travel of the femoral component since it touched the first contact node, m.
    """
    if before is not None:
        before = replace(before, before=None)
    displacement = np.zeros_like(state.surface.points)
    displacement[solution.candidates] = solution.displacement
    return LatticeStart(
        state.pair, contact.pose, state.points, contact.pressure, contact.gap,
        state.problem, solution.loads, displacement, depth, solution.region, solution.softening,
        solution.half, before,
    )  # fmt: skip


def _warm_up(problem: ContactProblem, pair: ContactPair) -> None:
    """Build what the first evaluation would: ray trees and compiled loops."""
    undeformed(problem, np.eye(4))
    pair.touch_at(np.eye(4))
    if not problem.solid.material.is_linear:
        zero = np.zeros_like(problem.solid.nodes)
        problem.solid.nonlinear_residual(zero)
        problem.solid.least_principal_strain(zero)
