"""The exact tangent of a lattice's contact: the derivative of its converged nodal forces.

H(x, z) is the height of the femoral surface above the insert, and n(x, z) its normal. An active
node at X + u lies on the surface and carries the force f = lambda n. A small femoral displacement
changes H and n at a constant (x, z) by dH and dn, so that

    du = C df,    df = n dlambda + lambda (dn + G du),    m . du = dH,
    m = (-H_x, 1, -H_z),    G = (n_x, 0, n_z).

C is the compliance, on the active nodes, of the tangent stiffness K_T of all cells at the converged
displacement. With S = (1 - C lambda G)⁻¹ C, dlambda solves

    mᵀ S n dlambda = dH - mᵀ S lambda dn.

The active set is constant: where a node comes into contact, the derivative is one-sided. For a
translation w, dH = m . w and dn = -G w; else dH and dn are central differences of the surface.

`tkamb.contact.lattice.probe` has a faster approximation.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.contact.lattice.initial_guess import LEVER_ARM, LatticeStart
from tkamb.contact.lattice.linear.compliance import ContactResponse
from tkamb.contact.lattice.linear.operator import prepare_operator
from tkamb.contact.lattice.problem import ContactProblem, LatticeState
from tkamb.contact.result import ContactResult
from tkamb.geometry.frames import Array, Index, displaced

SURFACE_STEP = 1e-7
"""m: step of the central differences of the femoral surface; a rotation's step is this over
`LEVER_ARM`. It is far below the size of a facet, and rounding
errors of the rays, about 1e-15 m, are 1e-8 of it."""


def exact_force_changes(
    state: LatticeState, result: ContactResult, start: LatticeStart, nodes: Index
) -> Array:
    """Return the derivative (m, 3, 6) of nodal forces by a displacement of the femur.

    `nodes` (m,) are loaded contact nodes of a converged result; `start` is its warm start. Columns
    0 to 2 are N per m of translation of the femoral point at the insert's origin, 3 to 5 N per rad
    of rotation about it.
    """
    problem, count = state.problem, len(nodes)
    force = result.nodal_force[nodes]
    size = np.linalg.norm(force, axis=1)
    normals = force / size[:, None]
    positions = problem.surface_points[nodes] + start.displacement[nodes]
    surface = _surface_derivatives(problem, positions, result.pose)
    turned = size[:, None, None] * surface.normal  # lambda dn
    compliance = _compliance(state, result, start, nodes)
    following = np.einsum(
        "kja,jab->kjb", compliance.reshape(-1, count, 3), size[:, None, None] * surface.turn
    ).reshape(3 * count, -1)  # C lambda G
    right = np.hstack([_by_node(compliance, normals), compliance @ turned.reshape(3 * count, 6)])
    solved = np.linalg.solve(np.eye(3 * count) - following, right)
    by_size, by_turning = solved[:, :count].reshape(count, 3, -1), solved[:, count:]
    along = np.einsum("ia,iaj->ij", surface.slope, by_size)
    wanted = surface.rise - np.einsum("ia,iak->ik", surface.slope, by_turning.reshape(count, 3, 6))
    growth = np.linalg.solve(along, wanted)
    moved = by_size.reshape(3 * count, -1) @ growth + by_turning
    followed = size[:, None, None] * (surface.turn @ moved.reshape(count, 3, 6))
    return np.asarray(normals[:, :, None] * growth[:, None, :] + turned + followed)


def _by_node(compliance: Array, vectors: Array) -> Array:
    count = len(vectors)
    return np.asarray(np.einsum("kjb,jb->kj", compliance.reshape(-1, count, 3), vectors))


@dataclass(frozen=True, eq=False)
class SurfaceDerivatives:
    """Derivatives of the femoral surface over n positions.

    Args:
        slope: m, (n, 3).
        turn: G, 1/m, (n, 3, 3).
        rise: dH by a displacement of the femur, (n, 6), as dn, (n, 3, 6), in `normal`.
    """

    slope: Array
    turn: Array
    rise: Array
    normal: Array


def _surface_derivatives(
    problem: ContactProblem, positions: Array, pose: Array
) -> SurfaceDerivatives:
    """Return the derivatives over positions (n, 3).

    Where the surface ends within the step, it is taken as its rigid tangent plane.
    """
    count, over = len(positions), problem.femoral.over
    place, outward = over(positions, pose)
    slope, turn = np.zeros((count, 3)), np.zeros((count, 3, 3))
    slope[:, 1] = 1.0
    for axis in (0, 2):
        step = SURFACE_STEP * np.eye(3)[axis]
        rise, change = _central(over(positions + step, pose), over(positions - step, pose))
        ends = ~np.isfinite(rise)
        slope[:, axis] = np.where(ends, outward[:, axis] / outward[:, 1], -rise)
        turn[:, :, axis] = np.where(ends[:, None], 0.0, change)
    rises, normals = np.zeros((count, 6)), np.zeros((count, 3, 6))
    rises[:, :3], normals[:, :, :3] = slope, -turn
    for axis in range(3):
        step = SURFACE_STEP / LEVER_ARM * np.eye(6)[3 + axis]
        rise, change = _central(
            *(over(positions, displaced(pose, sign * step)) for sign in (1.0, -1.0))
        )
        rise, change = LEVER_ARM * rise, LEVER_ARM * change
        rigid = np.cross(np.eye(3)[axis], place)
        ends = ~np.isfinite(rise)
        rises[:, 3 + axis] = np.where(ends, np.einsum("ia,ia->i", slope, rigid), rise)
        turned = np.cross(np.eye(3)[axis], outward) - np.einsum("iab,ib->ia", turn, rigid)
        normals[:, :, 3 + axis] = np.where(ends[:, None], turned, change)
    return SurfaceDerivatives(slope, turn, rises, normals)


def _central(ahead: tuple[Array, Array], behind: tuple[Array, Array]) -> tuple[Array, Array]:
    rise = (ahead[0][:, 1] - behind[0][:, 1]) / (2.0 * SURFACE_STEP)
    return rise, (ahead[1] - behind[1]) / (2.0 * SURFACE_STEP)


def _compliance(
    state: LatticeState, result: ContactResult, start: LatticeStart, nodes: Index
) -> Array:
    """Return the tangent stiffness' compliance (3m, 3m), m/N, by node."""
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
