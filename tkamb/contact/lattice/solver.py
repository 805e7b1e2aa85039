"""Frictionless contact of the lattice: force, approach and material in one iteration.

Find the displacement u, the contact forces lambda >= 0 along the femoral normals n and the
approach D with

    f_int(u) = f,                  f = sum of lambda n over the nodes in contact
    gamma lambda = 0, gamma >= 0,  gamma = n · (x - p) + D n_y, the gap of a node at x
    -sum of lambda n_y = load

f_int are the internal forces of the displaced solid under its nonlinear law, p the femoral points.
A pass is a modified Newton step with the factorised linear stiffness K; docs/lattice.md ("Solver")
has its steps.

Passes evaluate only the region of the softened elements. When its residual is within the
tolerances, the whole solid is measured: r from the law of every element, and the gap with new rays
at the displaced nodes. The iteration has converged when

    |r| / |f| <= force_tolerance
    s |r · u| / (f · u) <= work_tolerance,    s = (f_int(u) · u) / (uᵀ K_T u)
    |gamma| / max |u| <= gap_tolerance        for active nodes, and for penetrations of others
    max(|f_i| + |r_i|) / max |f_i| - 1 <= peak_tolerance

and the active set has stopped changing. The second residual estimates the relative error of the
approach, because an error du = e u leaves r = e K_T u. The load and lambda >= 0 hold to rounding in
every pass.

After `max_passes`, an iteration that began with the loads of an earlier solution begins again
without them; any other continues with `solve_by_newton`. This full Newton iteration is also the
reference: every step factorises the tangent stiffness and solves the contact on its compliance. The
two share only the contact conditions.
"""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.active_set import ContactForces, solve_contact
from tkamb.contact.lattice.initial_guess import InitialGuess
from tkamb.contact.lattice.linear.compliance import ContactResponse, displacement_under
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
    """The state at which the iteration stopped, with its measured residual.

    Args:
        candidates: indices of the candidates in the list of contact nodes, (m,).
        displacement: displacement of the candidates, m, (m, 3).
        field: displacement of all nodes, m, (n, 3); None for a linear material.
        loads: h, N, (n, 3), for a warm start; None for a linear material.
        softening: s for a warm start.
        half: L⁻¹ h in elimination order for a warm start, or None.
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
    half: Array | None = None

    @property
    def converged(self) -> bool:
        """Whether the residual is within its tolerances and the active set stopped changing."""
        return self.forces.converged


def solve(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    guess: InitialGuess,
    settings: LatticeSolverSettings,
) -> Solution:
    """Return the contact at a pose under a load, or at approach 0 if the load is None.

    `load` is the force along -y, N; `pose` is pose_femoral_in_insert (4, 4).
    """
    points = problem.surface_points[guess.candidates]
    balance: LinearBalance | NonlinearBalance
    if problem.solid.material.is_linear:
        balance = LinearBalance(np.zeros_like(points) if guess.offset is None else guess.offset)
    else:
        balance = NonlinearBalance(problem, guess, settings)
    displacement = balance.offset if guess.displacement is None else guess.displacement
    sliding = SlidingNodes(problem, points, displacement, pose, guess.planes)
    active, passes = guess.active, 0
    while True:
        planes, passes = sliding.planes, passes + 1
        forces, displacement = solve_pass(
            guess.response, balance.offset, points, planes, load, active
        )
        active = forces.active
        balance.displace(forces.force[:, None] * planes.normals, displacement)
        residual = replace(balance.residual, gap=sliding.follow(displacement, forces))
        last = passes == settings.max_passes or not np.isfinite(residual.force)
        if guess.loads is not None and (last or not active.any()):
            # The nonlinear loads of another contact may keep the nodes out of contact.
            return solve(problem, pose, load, guess.cold, settings)
        if last or residual.within(settings):
            if last or not guess.region_only:
                balance.measure()
            gap = residual.gap
            if balance.displacement is not displacement:
                gap = sliding.gap(balance.displacement, forces)
            residual = replace(balance.residual, gap=gap)
            within = residual.within(settings)
            if last or within:
                forces = replace(forces, converged=within and forces.converged)
                return Solution(
                    guess.candidates, forces, planes, balance.displacement, balance.field,
                    balance.h, passes, residual, balance.region, balance.softening, balance.half,
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
    """Return the contact on given femoral planes, and the candidates' displacement (m, 3), m.

    Args:
        offset: candidates' displacement without contact forces, m, (m, 3).
        points: undeformed candidates, m, (m, 3).
        load: N, or None for approach 0.
        active: first guess of the active set, (m,).
    """
    along, vectors = response.along(planes.normals)
    forces = solve_contact(along, planes.gap(points + offset), planes.normal_y, load, active)
    return forces, offset + displacement_under(vectors, forces.force)


class SlidingNodes:
    """The femoral planes over the candidates, updated as the nodes slide.

    Each pass solves the contact on tangent planes, then new rays through the displaced nodes give
    the next ones. The nodes can oscillate where the femoral normal turns quickly (a rim, a coarse
    triangle); then the rays follow the nodes only part of the way. Points and displacement (m, 3),
    m, are those of the undeformed candidates.
    """

    def __init__(
        self,
        problem: ContactProblem,
        points: Array,
        displacement: Array,
        pose: Array,
        planes: TangentPlanes,
    ) -> None:
        self._problem, self._points, self._pose = problem, points, pose
        self._ray_points, self.planes = points + displacement, planes
        self._share, self._gap = 1.0, np.zeros(len(points))
        if displacement.any():
            self.planes = self._planes_over(self._ray_points)

    def _planes_over(self, positions: Array) -> TangentPlanes:
        return tangent_planes(self._problem, positions, self._pose, self.planes)

    def follow(self, displacement: Array, forces: ContactForces) -> float:
        """Update the planes for a displacement (m, 3), m, and return its `gap`."""
        positions = self._points + displacement
        planes = self._planes_over(positions)
        relative_gap = self._relative_gap(planes, displacement, forces)
        gap = planes.gap(positions) + forces.approach * planes.normal_y
        gap = np.where(forces.active, gap, 0.0)
        # The gaps have changed their sign: the nodes oscillate.
        if float(gap @ self._gap) < -0.5 * float(self._gap @ self._gap):
            self._share /= 2
        self._gap = gap
        self._ray_points = self._ray_points + self._share * (positions - self._ray_points)
        self.planes = planes if self._share == 1.0 else self._planes_over(self._ray_points)
        return relative_gap

    def gap(self, displacement: Array, forces: ContactForces) -> float:
        """Return the largest distance of an active node from the femoral surface, or penetration of
        another one.

        It is relative to the largest displacement of an active node; inf if no node is active.
        """
        planes = self._planes_over(self._points + displacement)
        return self._relative_gap(planes, displacement, forces)

    def _relative_gap(
        self, planes: TangentPlanes, displacement: Array, forces: ContactForces
    ) -> float:
        if not forces.active.any():
            return np.inf
        gap = planes.gap(self._points + displacement) + forces.approach * planes.normal_y
        error = np.where(forces.active, np.abs(gap), np.maximum(-gap, 0))
        size = float(np.abs(displacement[forces.active]).max())
        return float(np.nan_to_num(error, nan=0.0).max()) / max(size, 1e-300)


def solve_by_newton(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    guess: InitialGuess,
    settings: LatticeSolverSettings,
    field: Array | None = None,
) -> Solution:
    """Return the result of `solve` by the full Newton iteration.

    `field` (n, 3), m, is the initial displacement, zero by default. The guess's compliance is not
    used.

    Raises:
        ComputationError: the tangent is not positive definite, or the iteration diverges.
    """
    solid, nodes = problem.solid, problem.contact_nodes[guess.candidates]
    points = problem.surface_points[guess.candidates]
    u = np.zeros_like(solid.nodes) if field is None else field
    active, step, last_force, free = guess.active, 1.0, np.inf, ~problem.held.reshape(-1, 3)
    sliding = SlidingNodes(problem, points, u[nodes], pose, guess.planes)
    within, steps = False, 0
    while steps < settings.max_passes and not within:
        planes, steps = sliding.planes, steps + 1
        u_full, forces = _step(problem, nodes, points, u, planes, load, active)
        u, active = u + step * (u_full - u), forces.active
        gap, force = sliding.follow(u[nodes], forces), forces.force[:, None] * planes.normals
        internal, _, softening = forces_of(solid, u)
        r = -internal
        r[nodes] += force
        residual = replace(Residual.of(free * r, u, force, u[nodes], nodes, softening), gap=gap)
        if not np.isfinite(residual.force):
            raise ComputationError("Newton's iteration diverged: its forces are not finite")
        within = residual.within(settings)
        step, last_force = 0.5 if residual.force > 2 * last_force else 1.0, residual.force
    forces = replace(forces, converged=within and forces.converged)
    h = free * solid.residual_force(u)
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
    solid = problem.solid
    operator = prepare_operator(solid.tangent(u), problem.index, problem.held, nodes)
    without_contact = u - operator.solve(solid.forces(u)[0])
    response = ContactResponse.of(operator.half)
    forces, _ = solve_pass(response, without_contact[nodes], points, planes, load, active)
    contact_force = np.zeros_like(u)
    contact_force[nodes] = forces.force[:, None] * planes.normals
    return without_contact + operator.solve(contact_force), forces
