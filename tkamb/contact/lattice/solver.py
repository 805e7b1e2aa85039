"""Frictionless contact of the lattice: force, approach and material in one iteration.

Every pass fires the rays through the displaced contact nodes, solves the unilateral contact
on the stored compliance of the linear operator (approach included), finds the displacement of
all nodes, and replaces the forces h that the material has lost against the linear one:

    K u = f_contact + h,    h = K u - f_internal(u)

(`tkamb.contact.lattice.lost_balance`). For a linear material h = 0 and the pass is repeated
only until the sliding nodes rest.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.active_set import ContactForces, solve_contact
from tkamb.contact.lattice.lost_balance import LostBalance
from tkamb.contact.lattice.problem import ContactProblem, Footing
from tkamb.contact.lattice.region import Region
from tkamb.contact.lattice.response import ContactResponse
from tkamb.contact.lattice.sliding import SlidingNodes
from tkamb.geometry.frames import Array

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


DIVERGED = 100.0
"""The iteration is given up when the imbalance is this many times the smallest so far."""


@dataclass(frozen=True)
class Tolerance:
    """When the iteration stops.

    Args:
        force: out-of-balance force and change of contact force, relative.
        passes: most passes before giving up.
    """

    force: float = 1e-3
    passes: int = 40


@dataclass(frozen=True, eq=False)
class Start:
    """Where the iteration starts.

    Args:
        candidates: (m,) positions among the contact nodes.
        response: of the candidates to forces on them.
        active: (m,) first guess of the active set.
        foot: femoral planes under the undeformed candidates.
        lost: (n, 3) h, N, of an earlier solution, or None.
        moved: (m, 3) m, displacement of the candidates in an earlier solution, or None.
        reach: m, every node with a smaller vertical gap is a candidate.
        region: outside of which `lost` is zero, or None.
    """

    candidates: Indices
    response: ContactResponse
    active: Mask
    foot: Footing
    lost: Array | None = None
    moved: Array | None = None
    reach: float = np.inf
    region: Region | None = None


@dataclass(frozen=True, eq=False)
class Solution:
    """What the iteration found.

    Args:
        candidates: (m,) positions among the contact nodes.
        forces: along the normals, with approach and active set.
        footing: femoral points and normals of the candidates.
        displacement: (m, 3) of the candidates, m.
        field: (n, 3) displacement of all nodes, or None (linear material).
        lost: (n, 3) h, N, where another pass would start, or None (linear material).
        passes: how many.
        residual: out-of-balance force or distance from the femoral surface, the larger one,
            both relative.
        region: outside of which `lost` is zero, or None.
    """

    candidates: Indices
    forces: ContactForces
    footing: Footing
    displacement: Array
    field: Array | None
    lost: Array | None
    passes: int
    residual: float
    region: Region | None = None

    @property
    def converged(self) -> bool:
        """Whether forces, surface and active set all came to rest."""
        return self.forces.converged


def solve_pass(
    response: ContactResponse,
    offset: Array,
    points: Array,
    foot: Footing,
    load: float | None,
    active: Mask,
) -> tuple[ContactForces, Array]:
    """Solve the contact for given femoral planes; return it and the displacement (m, 3).

    Args:
        response: of the candidates.
        offset: (m, 3) their displacement without contact forces.
        points: (m, 3) undeformed.
        foot: femoral planes.
        load: N, or None for approach 0.
        active: first guess.
    """
    along, pushed = response.along(foot.normals)
    forces = solve_contact(along, foot.gap(points + offset), foot.lean, load, active)
    return forces, offset + response.moved(pushed, forces.force)


def solve(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    start: Start,
    tolerance: Tolerance,
) -> Solution:
    """Return the contact at a pose under a load (N), or at approach 0 when load is None."""
    if problem.solid.material.is_linear:
        return _solve_linear(problem, pose, load, start, tolerance)
    chosen, active, passes = start.candidates, start.active, 0
    balance = LostBalance(problem, start.response, tolerance.force, start.lost, start.region)
    points = problem.surface_points[chosen]
    first = balance.offset if start.moved is None else start.moved
    sliding = SlidingNodes(problem, points, first, pose, start.foot)
    best: Solution | None = None
    while True:
        passes += 1
        foot = sliding.foot
        forces, moved = solve_pass(start.response, balance.offset, points, foot, load, active)
        active = forces.active
        balance.respond(forces.force[:, None] * foot.normals)
        missed = sliding.follow(moved, forces)
        if not active.any() or max(balance.residual, missed) <= tolerance.force:
            balance.look_everywhere()
        residual = max(balance.residual, missed)
        done = not active.any() or residual <= tolerance.force
        forces = replace(forces, converged=done and forces.converged)
        field, lost, region = balance.field, balance.lost, balance.region
        now = Solution(chosen, forces, foot, moved, field, lost, passes, residual, region)
        if done:
            return now
        best = now if best is None or residual < best.residual else best
        if passes == tolerance.passes or not residual < DIVERGED * best.residual:
            return _given_up(problem, best, passes)
        balance.advance()


def _given_up(problem: ContactProblem, best: Solution, passes: int) -> Solution:
    """Return the best pass with the displacements of the whole solid."""
    applied = np.zeros_like(problem.solid.nodes) if best.lost is None else best.lost.copy()
    applied[problem.contact_nodes[best.candidates]] += (
        best.forces.force[:, None] * best.footing.normals
    )
    return replace(best, field=problem.operator.solve(applied), passes=passes)


def _solve_linear(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    start: Start,
    tolerance: Tolerance,
) -> Solution:
    """Repeat rays and contact until the sliding nodes rest."""
    points = problem.surface_points[start.candidates]
    nothing, active, passes = np.zeros_like(points), start.active, 0
    first = nothing if start.moved is None else start.moved
    sliding = SlidingNodes(problem, points, first, pose, start.foot)
    while True:
        passes += 1
        foot = sliding.foot
        forces, moved = solve_pass(start.response, nothing, points, foot, load, active)
        active = forces.active
        missed = sliding.follow(moved, forces)
        done = missed <= tolerance.force
        if done or passes == tolerance.passes:
            forces = replace(forces, converged=done and forces.converged)
            return Solution(start.candidates, forces, foot, moved, None, None, passes, missed)
