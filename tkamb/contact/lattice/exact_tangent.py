"""The exact tangent of a lattice's contact: the derivative of its converged nodal forces.

H(x, z) is the height of the femoral surface above the insert, and n(x, z) its normal there. An
active node at the position X + u carries the force f = lambda n, and lies on the surface. A small
femoral displacement w(x) = t + r cross x changes

    du = C df,    df = n dlambda + lambda dn,
    m . (du - w) = 0,    m = (-H_x, 1, -H_z),
    dn = r cross n + G (du - w),    G = (n_x, 0, n_z).

C is the compliance of the tangent stiffness K_T at the converged displacement, of all cells, on the
active nodes. With A = 1 - C lambda G, S = A⁻¹ C and b = lambda (r cross n - G w), dlambda solves

    mᵀ S n dlambda = mᵀ (w - S b).

The active set is constant: where a node comes into contact, the derivative is one-sided. The
derivatives of H and n along the surface are central differences of its curved patches.

`tkamb.contact.lattice.probe` has a faster approximation: C of the linear material, and nodes that
move along the normal alone.
"""

import numpy as np

from tkamb.contact.lattice.initial_guess import LatticeStart
from tkamb.contact.lattice.linear.compliance import ContactResponse
from tkamb.contact.lattice.linear.operator import prepare_operator
from tkamb.contact.lattice.problem import ContactProblem, LatticeState
from tkamb.contact.result import ContactResult
from tkamb.geometry.frames import Array, Index

SURFACE_STEP = 1e-7
"""m: step of the central differences of the femoral surface. Chosen because it is far below the
size of a facet, and rounding errors of the rays, about 1e-15 m, are 1e-8 of it."""


def exact_force_changes(
    state: LatticeState, result: ContactResult, start: LatticeStart, nodes: Index
) -> Array:
    """Return the derivative (m, 3, 6) of nodal forces by a displacement of the femur.

    Args:
        state: prepared contact.
        result: contact that has converged.
        start: its warm start.
        nodes: loaded contact nodes, shape (m,).

    Returns:
        Columns 0 to 2: N per m of translation of the femoral point at the insert's origin.
        Columns 3 to 5: N per rad of rotation about this point.
    """
    problem, count = state.problem, len(nodes)
    force = result.nodal_force[nodes]
    size = np.linalg.norm(force, axis=1)
    normals = force / size[:, None]
    positions = problem.surface_points[nodes] + start.displacement[nodes]
    slope, turn = _surface_derivatives(problem, positions, result.pose)
    femoral = np.zeros((count, 3, 6))  # w
    femoral[:, :, :3] = np.eye(3)
    femoral[:, :, 3:] = np.cross(np.eye(3)[None], positions[:, None, :]).transpose(0, 2, 1)
    turned = -turn @ femoral
    turned[:, :, 3:] += np.cross(np.eye(3)[None], normals[:, None, :]).transpose(0, 2, 1)
    turned *= size[:, None, None]  # b
    compliance = _compliance(state, result, start, nodes)
    following = np.einsum(
        "kja,jab->kjb", compliance.reshape(-1, count, 3), size[:, None, None] * turn
    ).reshape(3 * count, -1)  # C lambda G
    right = np.hstack([_by_node(compliance, normals), compliance @ turned.reshape(3 * count, 6)])
    solved = np.linalg.solve(np.eye(3 * count) - following, right)
    by_size, by_turning = solved[:, :count].reshape(count, 3, -1), solved[:, count:]
    along = np.einsum("ia,iaj->ij", slope, by_size)
    wanted = np.einsum("ia,iak->ik", slope, femoral - by_turning.reshape(count, 3, 6))
    growth = np.linalg.solve(along, wanted)
    moved = by_size.reshape(3 * count, -1) @ growth + by_turning
    followed = size[:, None, None] * (turn @ moved.reshape(count, 3, 6))
    return np.asarray(normals[:, :, None] * growth[:, None, :] + turned + followed)


def _by_node(compliance: Array, vectors: Array) -> Array:
    """Return the displacements (3m, m) under a force along one vector (m, 3) at each node."""
    count = len(vectors)
    return np.asarray(np.einsum("kjb,jb->kj", compliance.reshape(-1, count, 3), vectors))


def _surface_derivatives(
    problem: ContactProblem, positions: Array, pose: Array
) -> tuple[Array, Array]:
    """Return m (n, 3) and G (n, 3, 3) of the femoral surface over positions (n, 3).

    Where the femoral surface ends within the step, the surface is taken as its tangent plane.
    """
    slope, turn = np.zeros_like(positions), np.zeros((len(positions), 3, 3))
    slope[:, 1] = 1.0
    normals = problem.femoral.over(positions, pose)[1]
    for axis in (0, 2):
        step = SURFACE_STEP * np.eye(3)[axis]
        ahead, behind = (problem.femoral.over(positions + s, pose) for s in (step, -step))
        rise = (ahead[0][:, 1] - behind[0][:, 1]) / (2.0 * SURFACE_STEP)
        change = (ahead[1] - behind[1]) / (2.0 * SURFACE_STEP)
        ends = ~np.isfinite(rise)
        slope[:, axis] = np.where(ends, normals[:, axis] / normals[:, 1], -rise)
        turn[:, :, axis] = np.where(ends[:, None], 0.0, change)
    return slope, turn


def _compliance(
    state: LatticeState, result: ContactResult, start: LatticeStart, nodes: Index
) -> Array:
    """Return the compliance (3m, 3m), m/N, of the tangent stiffness, ordered by node."""
    problem = state.problem
    if problem.solid.material.is_linear:
        response = state.compliance.among(nodes)
    else:
        load = np.zeros_like(problem.solid.nodes)
        load[problem.contact_nodes] = result.nodal_force
        if start.loads is not None:
            load = load + start.loads
        tangent = problem.solid.tangent(problem.operator.solve(load))
        among = problem.contact_nodes[nodes]
        operator = prepare_operator(tangent, problem.index, problem.held, among)
        response = ContactResponse.of(operator.half)
    size = 3 * len(nodes)
    return response.compliance.astype(np.float64).transpose(1, 0, 3, 2).reshape(size, size)
