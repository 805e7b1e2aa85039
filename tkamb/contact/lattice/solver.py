"""Frictionless contact of the lattice: force, approach and material in one iteration.

Find the displacement u, the contact forces lambda >= 0 along the femoral normals n and the
approach D with

    f_int(u) = f,                  f = sum of lambda n over the nodes in contact
    gamma lambda = 0, gamma >= 0,  gamma = n · (x - p) + D n_y, the gap of a node at x
    -sum of lambda n_y = load

f_int are the forces of the displaced solid under its nonlinear law, p the femoral points. One
pass of the iteration is a modified Newton step with the factorised linear stiffness K:

1. Femoral points and normals: vertical rays through the displaced nodes.
2. Contact: a primal-dual active set on the condensed compliance of the candidate nodes, K⁻¹ at
   those nodes, with the displacement K⁻¹ h of the nonlinear loads h as offset (`active_set.py`).
3. Displacement: K u = f + h. Residual: r = f - f_int(u) (`nonlinear_balance.py`).
4. Next loads: h + s r, accelerated by Anderson's method. The softening s is the ratio of secant
   and tangent stiffness along u, so that K/s stands for the tangent stiffness.

Passes evaluate the region of the elements that have softened. When the residual there is within
the tolerances, the residual of the whole solid is measured at u: r from the law of every element,
without any factor; the gap at the displaced nodes, with new rays. The iteration has converged when

    |r| / |f| <= force_tolerance
    s |r · u| / (f · u) <= work_tolerance,    s = (f_int(u) · u) / (uᵀ K_T u)
    |gamma| / max |u| <= gap_tolerance        for active nodes, and for the overlap of the others

and the active set has stopped changing. The result reports these residuals. The work of the
residual estimates the relative error of the approach: an error du = e u leaves r = e K_T u. The
load and lambda >= 0 hold to rounding in every pass.

After `max_passes` the iteration stops. If it began with the loads h of an earlier solution, it
begins again without them. If it does not converge either, `solve_by_newton` continues. That full
Newton iteration is the reference, too: every step factorises the tangent stiffness and solves the
contact on its own compliance. Both share the contact conditions alone.
"""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.active_set import ContactForces, solve_contact
from tkamb.contact.lattice.initial_guess import InitialGuess
from tkamb.contact.lattice.linear.compliance import ContactResponse
from tkamb.contact.lattice.linear.operator import prepare_operator
from tkamb.contact.lattice.nonlinear_balance import (
    LinearBalance,
    NonlinearBalance,
    Residual,
    forces_of,
)
from tkamb.contact.lattice.problem import ContactProblem, Region, TangentPlanes, tangent_planes
from tkamb.contact.lattice.settings import LatticeSolverSettings
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, Index, Mask


@dataclass(frozen=True, eq=False)
class Solution:
    """The state at which the iteration stopped, and what was measured there.

    Args:
        candidates: (m,) positions among the contact nodes.
        forces: along the normals, with approach and active set.
        planes: femoral points and normals of the candidates.
        displacement: (m, 3) of the candidates, m.
        field: (n, 3) displacement of all nodes, or None (linear material).
        loads: (n, 3) N, h + r: where a next solution may begin; None (linear material).
        passes: how many.
        residual: of the whole solid.
        region: the elements with which a next solution may begin, or None.
        softening: s, with which a next solution may begin.
    """

    candidates: Index
    forces: ContactForces
    planes: TangentPlanes
    displacement: Array
    field: Array | None
    loads: Array | None
    passes: int
    residual: Residual
    region: Region | None = None
    softening: float = 1.0

    @property
    def converged(self) -> bool:
        """Whether residual and active set are within their tolerances."""
        return self.forces.converged


def solve(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    guess: InitialGuess,
    settings: LatticeSolverSettings,
) -> Solution:
    """Return the contact at a pose under a load (N), or at approach 0 when load is None."""
    points = problem.surface_points[guess.candidates]
    balance: LinearBalance | NonlinearBalance
    if problem.solid.material.is_linear:
        balance = LinearBalance(np.zeros_like(points) if guess.offset is None else guess.offset)
    else:
        balance = NonlinearBalance(problem, guess, settings)
    moved = balance.offset if guess.moved is None else guess.moved
    sliding = SlidingNodes(problem, points, moved, pose, guess.planes)
    active, passes = guess.active, 0
    while True:
        planes, passes = sliding.planes, passes + 1
        forces, moved = solve_pass(guess.response, balance.offset, points, planes, load, active)
        active = forces.active
        balance.displace(forces.force[:, None] * planes.normals, moved)
        residual = replace(balance.residual, gap=sliding.follow(moved, forces))
        last = passes == settings.max_passes or not np.isfinite(residual.force)
        if guess.loads is not None and (last or not active.any()):
            # The loads of another contact may hold the nodes down: begin without them.
            return solve(problem, pose, load, guess.cold, settings)
        if last or residual.within(settings):
            if last or not guess.region_only:
                balance.measure()
            gap = sliding.gap(balance.moved, forces) if balance.moved is not moved else residual.gap
            residual = replace(balance.residual, gap=gap)
            within = residual.within(settings)
            if last or within:
                forces = replace(forces, converged=within and forces.converged)
                return Solution(
                    guess.candidates, forces, planes, balance.moved, balance.field,
                    balance.loads, passes, residual, balance.region, balance.softening,
                )  # fmt: skip
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
        self._fired, self.planes = points + moved, planes
        self._share, self._gap = 1.0, np.zeros(len(points))
        if moved.any():
            self.planes = self._at(self._fired)

    def _at(self, positions: Array) -> TangentPlanes:
        return tangent_planes(self._problem, positions, self._pose, self.planes)

    def follow(self, moved: Array, forces: ContactForces) -> float:
        """Renew the planes for nodes displaced by moved (m, 3); return what `gap` does."""
        positions = self._points + moved
        there = self._at(positions)
        missed = self._relative_gap(there, moved, forces)
        gap = there.gap(positions) + forces.approach * there.normal_y
        gap = np.where(forces.active, gap, 0.0)
        if float(gap @ self._gap) < -0.5 * float(self._gap @ self._gap):
            self._share /= 2
        self._gap = gap
        self._fired = self._fired + self._share * (positions - self._fired)
        self.planes = there if self._share == 1.0 else self._at(self._fired)
        return missed

    def gap(self, moved: Array, forces: ContactForces) -> float:
        """Return the largest distance of an active node from the femoral surface where it is.

        Overlap of the others counts too. It is relative to the largest displacement of an active
        node; inf where no node is active, for bodies that overlap touch.
        """
        return self._relative_gap(self._at(self._points + moved), moved, forces)

    def _relative_gap(self, there: TangentPlanes, moved: Array, forces: ContactForces) -> float:
        if not forces.active.any():
            return np.inf
        gap = there.gap(self._points + moved) + forces.approach * there.normal_y
        miss = np.where(forces.active, np.abs(gap), np.maximum(-gap, 0))
        size = float(np.abs(moved[forces.active]).max())
        return float(np.nan_to_num(miss, nan=0.0).max()) / max(size, 1e-300)


def solve_by_newton(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    guess: InitialGuess,
    settings: LatticeSolverSettings,
    field: Array | None = None,
) -> Solution:
    """Return the contact at a pose under a load (N), or at approach 0 when load is None.

    Args:
        problem: solid, boundary and femoral component.
        pose: (4, 4) pose_femoral_in_insert.
        load: N along -y, or None.
        guess: candidates and first active set; its compliance is not used.
        settings: tolerances and largest number of steps.
        field: (n, 3) m, where to start; at rest by default.

    Raises:
        ComputationError: the tangent is not positive definite, or numbers overflow.
    """
    solid, nodes = problem.solid, problem.contact_nodes[guess.candidates]
    points = problem.surface_points[guess.candidates]
    u = np.zeros_like(solid.nodes) if field is None else field
    active, step, before, free = guess.active, 1.0, np.inf, ~problem.held.reshape(-1, 3)
    sliding = SlidingNodes(problem, points, u[nodes], pose, guess.planes)
    within, steps = False, 0
    while steps < settings.max_passes and not within:
        planes, steps = sliding.planes, steps + 1
        u_full, forces = _step(problem, nodes, points, u, planes, load, active)
        u, active = u + step * (u_full - u), forces.active
        gap, force = sliding.follow(u[nodes], forces), forces.force[:, None] * planes.normals
        internal, shares, softening = forces_of(solid, u)
        outside = -internal
        outside[nodes] += force
        residual = replace(Residual.of(free * outside, u, force, u[nodes], softening), gap=gap)
        if not np.isfinite(residual.force):
            raise ComputationError("Newton's iteration left the range of numbers")
        within = residual.within(settings)
        step, before = 0.5 if residual.force > 2 * before else 1.0, residual.force
    forces = replace(forces, converged=within and forces.converged)
    h = free * solid.scatter.sum(shares)
    return Solution(guess.candidates, forces, planes, u[nodes], u, h, steps, residual)


def _step(
    problem: ContactProblem,
    nodes: Index,
    points: Array,
    u: Array,
    planes: TangentPlanes,
    load: float | None,
    active: Mask,
) -> tuple[Array, ContactForces]:
    """Return the displacement (n, 3) and contact forces of one linearised step."""
    solid = problem.solid
    operator = prepare_operator(solid.tangent(u), problem.index, problem.held, nodes)
    relaxed = u - operator.solve(solid.internal_force(u))
    response = ContactResponse.of(operator.half)
    forces, _ = solve_pass(response, relaxed[nodes], points, planes, load, active)
    pushed = np.zeros_like(u)
    pushed[nodes] = forces.force[:, None] * planes.normals
    return relaxed + operator.solve(pushed), forces
