"""Frictionless contact of an elastic body that is condensed to its candidate nodes.

Find the normal forces lambda (and the approach D) such that, for every candidate,

    gamma = gap + A lambda + D c >= 0,   lambda >= 0,   gamma lambda = 0

Either D or the load -cᵀ lambda is given. A is the compliance along the femoral normals, symmetric
and positive definite, c the y of these normals. Primal-dual active set (Hintermueller, Ito &
Kunisch, SIAM J Optim 13:865, 2002, doi:10.1137/S1052623401383558). Once a set recurs, only the node
with the largest violation changes. The search stops after twice as many sets as candidates.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from tkamb.geometry.frames import Array, Mask


@dataclass(frozen=True, eq=False)
class ContactForces:
    """Solution of the contact problem.

    Args:
        force: lambda, N, (n,), >= 0.
        gap: gamma, m, (n,), >= 0.
        approach: D, m.
        active: mask of the nodes in contact, (n,).
        converged: whether the active set has stopped changing.
    """

    force: Array
    gap: Array
    approach: float
    active: Mask
    sets: int
    converged: bool


def solve_contact(
    compliance: Array,
    gap: Array,
    normal_y: Array,
    load: float | None,
    active: Mask,
    approach: float = 0.0,
) -> ContactForces:
    """Return forces, gaps and approach that fulfil the contact conditions.

    Args:
        compliance: A, m/N, (n, n).
        gap: gaps at zero force and approach, m, (n,).
        normal_y: c, y of the femoral normals, (n,), negative.
        load: force along -y, N; None if the approach is given.
        active: initial guess of the nodes in contact, (n,).
        approach: m, used if the load is None.

    Raises:
        LinAlgError: the compliance of the nodes in contact is singular.
    """
    active, earlier_sets, one_by_one, sets = active.copy(), set[bytes](), False, 0
    while True:
        if load is not None and not active.any():
            active[np.argmin(gap / -normal_y)] = True
        force, approach = _forces_of(compliance, gap, normal_y, load, active, approach)
        opening = gap + compliance @ force + approach * normal_y
        opening[active] = 0.0
        leaving = active & (force < -1e-12 * max(float(np.abs(force).max(initial=0)), 1e-300))
        joining = ~active & (opening < -1e-15)
        converged, sets = not (leaving.any() or joining.any()), sets + 1
        if converged or sets > 2 * len(active):
            return ContactForces(np.maximum(force, 0), opening, approach, active, sets, converged)
        key = active.tobytes()
        one_by_one = one_by_one or key in earlier_sets
        earlier_sets.add(key)
        if not one_by_one:
            active = (active & ~leaving) | joining
        elif leaving.any():
            active[np.argmin(np.where(leaving, force, 0.0))] = False
        else:
            active[np.argmin(np.where(joining, opening, 0.0))] = True


def _forces_of(
    compliance: Array,
    gap: Array,
    normal_y: Array,
    load: float | None,
    active: Mask,
    approach: float,
) -> tuple[Array, float]:
    """Return the forces (n,) and the approach at which the active nodes have no gap."""
    force = np.zeros(len(gap))
    if not active.any():
        return force, approach
    nodes = np.flatnonzero(active)
    right_sides = np.column_stack([-gap[nodes], -normal_y[nodes]])
    *_, solution, info = dposv(compliance[nodes[:, None], nodes], right_sides, lower=True)
    if info:
        raise np.linalg.LinAlgError("the compliance of the nodes in contact is singular")
    at_zero, per_approach = solution.T
    if load is not None:
        approach = (load + normal_y[active] @ at_zero) / -(normal_y[active] @ per_approach)
    force[active] = at_zero + approach * per_approach
    return force, float(approach)
