"""Full Newton iteration of the lattice in contact: the reference, and the fallback.

Every step refactorises the tangent stiffness and solves the contact on its own compliance, so
that nothing of the accelerated iteration is shared but the contact conditions.
"""

from dataclasses import replace

import numpy as np

from tkamb.contact.lattice.active_set import ContactForces
from tkamb.contact.lattice.initial_guess import InitialGuess
from tkamb.contact.lattice.linear.compliance import ContactResponse
from tkamb.contact.lattice.linear.operator import prepare_operator
from tkamb.contact.lattice.nonlinear_balance import Residual
from tkamb.contact.lattice.problem import ContactProblem, TangentPlanes
from tkamb.contact.lattice.settings import LatticeSolverSettings
from tkamb.contact.lattice.solver import SlidingNodes, Solution, solve_pass
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, Index, Mask

MOST_STEPS = 30


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
        settings: tolerances; the number of passes is not used.
        field: (n, 3) m, where to start; at rest by default.

    Raises:
        ComputationError: the tangent is not positive definite, or numbers overflow.
    """
    solid, nodes = problem.solid, problem.contact_nodes[guess.candidates]
    points = problem.surface_points[guess.candidates]
    u = np.zeros_like(solid.nodes) if field is None else field
    active, step, last, steps = guess.active, 1.0, np.inf, 0
    sliding = SlidingNodes(problem, points, u[nodes], pose, guess.planes)
    while True:
        steps += 1
        planes = sliding.planes
        u_full, forces = _step(problem, nodes, points, u, planes, load, active)
        u = u + step * (u_full - u)
        active = forces.active
        residual = _residual(problem, nodes, u, forces.force[:, None] * planes.normals)
        gap, ends = sliding.follow(u[nodes], forces), steps == MOST_STEPS
        done = residual.within(settings)
        done = done and gap <= (settings.force_tolerance if ends else settings.gap_tolerance)
        if done or ends:
            forces = replace(forces, converged=done and forces.converged)
            h = solid.residual_force(u)
            h[problem.held.reshape(-1, 3)] = 0.0
            return Solution(
                guess.candidates, forces, planes, u[nodes], u, h, steps,
                max(residual.force, gap), work=residual.work, gap=gap,
            )  # fmt: skip
        step, last = 0.5 if residual.force > 2 * last else 1.0, residual.force


def _residual(problem: ContactProblem, nodes: Index, u: Array, force: Array) -> Residual:
    """Return what is out of balance at u (n, 3) under forces (m, 3) on nodes."""
    outside = -problem.solid.internal_force(u)
    outside[nodes] += force
    outside[problem.held.reshape(-1, 3)] = 0.0
    size = max(float(np.linalg.norm(force)), 1e-300)
    work = max(float(np.vdot(force, u[nodes])), 1e-300)
    residual = float(np.linalg.norm(outside)) / size
    if not np.isfinite(residual):
        raise ComputationError("Newton's iteration left the range of numbers")
    return Residual(residual, abs(float(np.vdot(outside, u))) / work)


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
