"""Full Newton iteration of the lattice in contact: the reference, and the fallback.

Every step refactorises the tangent stiffness and solves the contact on its own compliance, so
that nothing of the accelerated iteration is shared but the contact conditions.
"""

from dataclasses import replace

import numpy as np

from tkamb.contact.lattice.operator import prepare_operator
from tkamb.contact.lattice.problem import ContactProblem, footing
from tkamb.contact.lattice.solver import Solution, Start, Tolerance, solve_pass, violation
from tkamb.geometry.frames import Array

MOST_STEPS = 30


def solve_by_newton(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    start: Start,
    tolerance: Tolerance,
    field: Array | None = None,
) -> Solution:
    """Return the contact at a pose under a load (N), or at approach 0 when load is None.

    Args:
        problem: solid, boundary and femoral component.
        pose: (4, 4) pose_femoral_in_insert.
        load: N along -y, or None.
        start: candidates and first active set; its compliance is not used.
        tolerance: of force and femoral surface; its number of passes is not used.
        field: (n, 3) m, where to start; at rest by default.
    """
    solid, free = problem.solid, ~problem.held
    nodes = problem.contact_nodes[start.candidates]
    points = solid.nodes[nodes]
    u = np.zeros_like(solid.nodes) if field is None else field
    active, foot, step, last = start.active, None, 1.0, np.inf
    for count in range(1, MOST_STEPS + 1):
        operator = prepare_operator(solid.tangent(u), problem.index, problem.held, nodes)
        relaxed = u - operator.solve(solid.internal_force(u))
        unknowns = np.arange(3 * len(nodes))
        foot = footing(problem, points + u[nodes], pose, foot)
        forces, _ = solve_pass(
            operator.half.compliance(unknowns), relaxed[nodes], points, foot, load, active
        )
        pushed = np.zeros_like(u)
        pushed[nodes] = forces.force[:, None] * foot.normals
        u = u + step * (relaxed + operator.solve(pushed) - u)
        active = forces.active
        size = max(float(np.linalg.norm(pushed)), 1e-300)
        balance = (solid.internal_force(u) - pushed).ravel()[free]
        residual = float(np.linalg.norm(balance)) / size
        foot_now = footing(problem, points + u[nodes], pose, foot)
        missed = violation(points, u[nodes], foot_now, forces)
        if not active.any() or max(residual, missed) <= tolerance.force:
            break
        step = 0.5 if residual > 2 * last else 1.0
        last = residual
    else:
        forces = replace(forces, converged=False)
    lost = solid.correction(u)
    return Solution(
        start.candidates, forces, foot, u[nodes], u, lost, count, residual, forces.converged
    )
