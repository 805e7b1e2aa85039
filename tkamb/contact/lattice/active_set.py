"""Unilateral frictionless contact of a condensed elastic body: a dense active set.

Find pressures and approach with, for every candidate node,

    gamma = gap + A lambda + D c >= 0,   lambda >= 0,   gamma lambda = 0

and, when the load is given, -cᵀ lambda = load; when it is not, D is given. A is the symmetric
positive definite compliance along the normals, c the normals' y. Primal-dual active set
(Hintermueller, Ito & Kunisch, SIAM J Optim 13:865, 2002, doi:10.1137/S1052623401383558). Once a
set comes a second time, only the worst node changes. The search ends without having converged
after twice as many sets as there are candidates.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from tkamb.geometry.frames import Array, Mask


@dataclass(frozen=True, eq=False)
class ContactForces:
    """What the active set found.

    Args:
        force: (n,) N along the normals, >= 0.
        gap: (n,) m along the normals, >= 0.
        approach: m, D.
        active: (n,) nodes in contact.
        sets: how many sets were solved.
        converged: whether the set stopped changing.
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
    """Solve the complementarity problem.

    Args:
        compliance: A (n, n), m/N.
        gap: (n,) m at zero force and approach.
        normal_y: c (n,), y of the femoral normals, negative.
        load: N along -y, or None when the approach is given.
        active: (n,) first guess of the nodes in contact.
        approach: m, used when the load is None.
    """
    active, seen, careful, done, sets = active.copy(), set[bytes](), False, False, 0
    while True:
        if load is not None and not active.any():
            active[np.argmin(gap / -normal_y)] = True
        force, depth = _forces_of(compliance, gap, normal_y, load, active, approach)
        opening = gap + compliance @ force + depth * normal_y
        opening[active] = 0.0
        leave = active & (force < -1e-12 * max(float(np.abs(force).max(initial=0)), 1e-300))
        join = ~active & (opening < -1e-15)
        done, sets = not (leave.any() or join.any()), sets + 1
        if done or sets > 2 * len(active):
            return ContactForces(np.maximum(force, 0), opening, depth, active, sets, done)
        key = active.tobytes()
        careful = careful or key in seen
        seen.add(key)
        if not careful:
            active = (active & ~leave) | join
        elif leave.any():
            active[np.argmin(np.where(leave, force, 0.0))] = False
        else:
            active[np.argmin(np.where(join, opening, 0.0))] = True


def _forces_of(
    compliance: Array,
    gap: Array,
    normal_y: Array,
    load: float | None,
    active: Mask,
    approach: float,
) -> tuple[Array, float]:
    """Return forces (n,) and approach that close the gap of the active nodes."""
    force = np.zeros(len(gap))
    if not active.any():
        return force, approach
    chosen = np.flatnonzero(active)
    right = np.column_stack([-gap[chosen], -normal_y[chosen]])
    *_, solved, failed = dposv(compliance[chosen[:, None], chosen], right, lower=True)
    if failed:
        raise np.linalg.LinAlgError("the compliance of the nodes in contact is singular")
    closing, per_depth = solved.T
    if load is not None:
        approach = (load + normal_y[active] @ closing) / -(normal_y[active] @ per_depth)
    force[active] = closing + approach * per_depth
    return force, float(approach)
