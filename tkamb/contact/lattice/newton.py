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
from tkamb.contact.lattice.nonlinear_balance import Residual, forces_of
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
    active, step, before, free = guess.active, 1.0, np.inf, ~problem.held.reshape(-1, 3)
    sliding = SlidingNodes(problem, points, u[nodes], pose, guess.planes)
    for steps in range(1, MOST_STEPS + 1):
        planes, last = sliding.planes, steps == MOST_STEPS
        u_full, forces = _step(problem, nodes, points, u, planes, load, active)
        u, active = u + step * (u_full - u), forces.active
        gap, force = sliding.follow(u[nodes], forces), forces.force[:, None] * planes.normals
        internal, shares, softening = forces_of(solid, u)
        outside = -internal
        outside[nodes] += force
        residual = replace(Residual.of(free * outside, u, force, u[nodes], softening), gap=gap)
        if not np.isfinite(residual.force):
            raise ComputationError("Newton's iteration left the range of numbers")
        within = residual.within(settings, last)
        if within or last:
            break
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
