"""Frictionless contact of the lattice: force, approach and material in one iteration.

Every pass fires the rays through the displaced contact nodes, solves the unilateral contact
on the stored compliance of the linear operator (approach included), finds the displacement of
all nodes, and renews the nonlinear residual h, what the material carries less than the linear
one (`NonlinearBalance`). The contact under the h that the last look at all elements asks for ends
the iteration. For a linear material h = 0 and the pass is repeated only until the sliding nodes
rest.
"""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.active_set import ContactForces, solve_contact
from tkamb.contact.lattice.initial_guess import NOT_KNOWN, InitialGuess, Left
from tkamb.contact.lattice.linear.compliance import ContactResponse
from tkamb.contact.lattice.nonlinear_balance import NonlinearBalance
from tkamb.contact.lattice.problem import ContactProblem, Region, TangentPlanes, tangent_planes
from tkamb.contact.lattice.solids.solid import Noticed
from tkamb.geometry.frames import Array, Index, Mask

DIVERGED = 100.0
"""The iteration is given up when the imbalance is this many times the smallest so far."""
AT_REST = 0.25
"""Of the tolerance: so far may active nodes be from the femoral surface. At a rim, where its normal
turns, a peak is off by up to three times as much."""
SLOW = 0.7
"""When a pass leaves more than this share of the last distance, sliding steps are halved."""
SMALLEST_SHARE = 0.125


@dataclass(frozen=True)
class Tolerance:
    """When the iteration stops.

    Args:
        force: out-of-balance force and change of contact force, relative.
        passes: most passes before giving up.
    """

    force: float = 1e-3
    passes: int = 40

    def at_rest(self, missed: float, last: bool) -> bool:
        """Say whether active nodes are near enough to the femoral surface.

        Args:
            missed: largest distance, relative to what nodes move.
            last: it is the last pass: what comes to rest slowly is held to the whole tolerance.
        """
        return missed <= (self.force if last else AT_REST * self.force)


@dataclass(frozen=True, eq=False)
class Solution:
    """What the iteration found.

    Args:
        candidates: (m,) positions among the contact nodes.
        forces: along the normals, with approach and active set.
        planes: femoral points and normals of the candidates.
        displacement: (m, 3) of the candidates, m.
        field: (n, 3) displacement of all nodes when they were last looked at, or None (linear
            material).
        nonlinear_residual: (n, 3) h, N, that the forces hold with, or None (linear).
        passes: how many.
        residual: out-of-balance force, as foreseen, or distance from the femoral surface, the
            larger one, both relative.
        region: outside of which h is zero, or None.
        seen: all elements were looked at; else `field` is that of the region.
        noticed: elements but which the bound passed over, or None (all).
        half: L⁻¹ h in elimination order, or None.
        left: shares of the imbalance that passes leave.
        balanced: some pass had no force out of balance; active nodes may yet have missed the
            femoral surface.
    """

    candidates: Index
    forces: ContactForces
    planes: TangentPlanes
    displacement: Array
    field: Array | None
    nonlinear_residual: Array | None
    passes: int
    residual: float
    region: Region | None = None
    seen: bool = True
    noticed: Noticed | None = None
    half: Array | None = None
    left: Left = NOT_KNOWN
    balanced: bool = False

    @property
    def converged(self) -> bool:
        """Whether forces, surface and active set all came to rest."""
        return self.forces.converged


def solve(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    guess: InitialGuess,
    tolerance: Tolerance,
) -> Solution:
    """Return the contact at a pose under a load (N), or at approach 0 when load is None."""
    if problem.solid.material.is_linear:
        return _solve_linear(problem, pose, load, guess, tolerance)
    chosen, active, passes, balanced = guess.candidates, guess.active, 0, False
    balance = NonlinearBalance(problem, guess, tolerance.force)
    points = problem.surface_points[chosen]
    first = balance.offset if guess.moved is None else guess.moved
    sliding = SlidingNodes(problem, points, first, pose, guess.planes)
    best: Solution | None = None
    settled: Solution | None = None
    warm, enough = guess.nonlinear_residual is not None, tolerance.force

    def found(residual: float, converged: bool) -> Solution:
        return Solution(
            chosen,
            replace(forces, converged=converged and forces.converged),
            planes,
            moved,
            balance.field,
            balance.h,
            passes,
            residual,
            balance.region,
            balance.size > guess.unseen,
            balance.noticed,
            balance.half,
            balance.left,
            balanced,
        )

    while True:
        planes = sliding.planes
        forces, moved = solve_pass(guess.response, balance.offset, points, planes, load, active)
        if warm and not forces.active.any():
            # What a heavier contact left behind holds the nodes down: begin without it.
            warm, guess = False, guess.cold
            balance = NonlinearBalance(problem, guess, tolerance.force)
            sliding = SlidingNodes(problem, points, balance.offset, pose, guess.planes)
            continue
        active = forces.active
        missed = sliding.follow(moved, forces)
        last = passes == tolerance.passes
        if balance.foreseen <= enough and tolerance.at_rest(missed, last):
            settled = found(max(balance.foreseen, missed), True)
            enough = tolerance.force / balance.weight  # a softened contact goes on to this
            if balance.foreseen <= enough or last:
                return settled
        passes += 1
        balance.respond(forces.force[:, None] * planes.normals)
        if balance.foreseen <= enough and balance.size > guess.unseen:
            balance.look_everywhere()
        balanced = balanced or balance.residual <= tolerance.force
        now = found(max(balance.residual, missed), False)
        best = now if best is None or now.residual < best.residual else best
        spent = passes >= tolerance.passes and balance.foreseen > enough
        if spent or passes > tolerance.passes or not now.residual < DIVERGED * best.residual:
            return settled or replace(_given_up(problem, best, passes), balanced=balanced)
        balance.advance()


def solve_pass(
    response: ContactResponse,
    offset: Array,
    points: Array,
    planes: TangentPlanes,
    load: float | None,
    active: Mask,
) -> tuple[ContactForces, Array]:
    """Solve the contact for given femoral planes; return it and the displacement (m, 3).

    Args:
        response: of the candidates.
        offset: (m, 3) their displacement without contact forces.
        points: (m, 3) undeformed.
        planes: over them.
        load: N, or None for approach 0.
        active: first guess.
    """
    along, pushed = response.along(planes.normals)
    forces = solve_contact(along, planes.gap(points + offset), planes.normal_y, load, active)
    return forces, offset + response.moved(pushed, forces.force)


def _given_up(problem: ContactProblem, best: Solution, passes: int) -> Solution:
    """Return the best pass with the displacements of the whole solid."""
    h = best.nonlinear_residual
    applied = np.zeros_like(problem.solid.nodes) if h is None else h.copy()
    applied[problem.contact_nodes[best.candidates]] += (
        best.forces.force[:, None] * best.planes.normals
    )
    return replace(best, field=problem.operator.solve(applied), passes=passes, noticed=None)


def _solve_linear(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    guess: InitialGuess,
    tolerance: Tolerance,
) -> Solution:
    """Repeat rays and contact until the sliding nodes rest."""
    points = problem.surface_points[guess.candidates]
    offset = np.zeros_like(points) if guess.offset is None else guess.offset
    active, passes = guess.active, 0
    first = offset if guess.moved is None else guess.moved
    sliding = SlidingNodes(problem, points, first, pose, guess.planes)
    while True:
        passes += 1
        planes = sliding.planes
        forces, moved = solve_pass(guess.response, offset, points, planes, load, active)
        active = forces.active
        missed = sliding.follow(moved, forces)
        done = tolerance.at_rest(missed, passes == tolerance.passes)
        if done or passes == tolerance.passes:
            forces = replace(forces, converged=done and forces.converged)
            return Solution(guess.candidates, forces, planes, moved, None, None, passes, missed)


class SlidingNodes:
    """Femoral planes over the candidates, renewed as the nodes slide.

    Each pass solves the contact on tangent planes; the rays are then fired from the displaced
    nodes. Where the femoral normal turns quickly (a rim, a coarse triangle) the nodes could
    swing to and fro: the next planes are then taken only part of the way towards them.

    Args:
        problem: solid and femoral component.
        points: (m, 3) undeformed candidates, m.
        moved: (m, 3) their first displacement, m.
        pose: (4, 4) pose_femoral_in_insert.
        planes: over the undeformed candidates.
    """

    def __init__(
        self,
        problem: ContactProblem,
        points: Array,
        moved: Array,
        pose: Array,
        planes: TangentPlanes,
    ) -> None:
        self._problem, self._points, self._pose = problem, points, pose
        self._fired = points + moved
        self._share, self._last = 1.0, np.inf
        self.planes = planes
        if moved.any():
            self.planes = tangent_planes(problem, self._fired, pose, planes)

    def follow(self, moved: Array, forces: ContactForces) -> float:
        """Renew the planes for nodes displaced by moved (m, 3).

        Returns:
            The largest distance of an active node from the femoral surface where it now is
            (overlap of the others counts too), relative to the largest displacement of an
            active node; inf where no node is active, for bodies that overlap touch.
        """
        positions = self._points + moved
        there = tangent_planes(self._problem, positions, self._pose, self.planes)
        gap = there.gap(positions) + forces.approach * there.normal_y
        miss = np.where(forces.active, np.abs(gap), np.maximum(-gap, 0))
        size = float(np.abs(moved[forces.active]).max(initial=0.0))
        missed = float(np.nan_to_num(miss, nan=0.0).max()) / max(size, 1e-300)
        missed = missed if forces.active.any() else np.inf
        if missed > SLOW * self._last:
            self._share = max(self._share / 2, SMALLEST_SHARE)
        self._last = missed
        if self._share == 1.0:
            self._fired, self.planes = positions, there
        else:
            self._fired = self._fired + self._share * (positions - self._fired)
            self.planes = tangent_planes(self._problem, self._fired, self._pose, self.planes)
        return missed
