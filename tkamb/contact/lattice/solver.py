"""Frictionless contact of the lattice: force, approach and material in one iteration.

Every pass fires the rays through the displaced contact nodes, solves the unilateral contact
on the stored compliance of the linear operator (approach included), finds the displacement of
all nodes, and replaces the forces h that the material has lost against the linear one:

    K u = f_contact + h,    h = K u - f_internal(u)

h is accelerated by Anderson's method; its change is the out-of-balance force. For a linear
material h = 0 and the pass is repeated only until the sliding nodes rest.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.active_set import ContactForces, solve_contact
from tkamb.contact.lattice.anderson import AndersonMixer
from tkamb.contact.lattice.problem import ContactProblem, Footing
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
        compliance: (3m, 3m) m/N among them.
        active: (m,) first guess of the active set.
        lost: (n, 3) h, N, of an earlier solution, or None.
        moved: (m, 3) m, displacement of the candidates in an earlier solution, or None.
        reach: m, every node with a smaller vertical gap is a candidate.
    """

    candidates: Indices
    compliance: Array
    active: Mask
    lost: Array | None = None
    moved: Array | None = None
    reach: float = np.inf


@dataclass(frozen=True, eq=False)
class Solution:
    """What the iteration found.

    Args:
        candidates: (m,) positions among the contact nodes.
        forces: along the normals, with approach and active set.
        footing: femoral points and normals of the candidates.
        displacement: (m, 3) of the candidates, m.
        field: (n, 3) displacement of all nodes, or None (linear material).
        lost: (n, 3) h, N, or None (linear material).
        passes: how many.
        residual: out-of-balance force or distance from the femoral surface, the larger one,
            both relative.
    """

    candidates: Indices
    forces: ContactForces
    footing: Footing
    displacement: Array
    field: Array | None
    lost: Array | None
    passes: int
    residual: float

    @property
    def converged(self) -> bool:
        """Whether forces, surface and active set all came to rest."""
        return self.forces.converged


def solve_pass(
    compliance: Array,
    offset: Array,
    points: Array,
    foot: Footing,
    load: float | None,
    active: Mask,
) -> tuple[ContactForces, Array]:
    """Solve the contact for given femoral planes; return it and the displacement (m, 3).

    Args:
        compliance: (3m, 3m) of the candidates.
        offset: (m, 3) their displacement without contact forces.
        points: (m, 3) undeformed.
        foot: femoral planes.
        load: N, or None for approach 0.
        active: first guess.
    """
    normals, count = foot.normals, len(points)
    blocks = compliance.reshape(count, 3, count, 3)
    half = np.einsum("iajb,jb->iaj", blocks, normals, optimize=True)
    along = np.einsum("iaj,ia->ij", half, normals)
    forces = solve_contact(along, foot.gap(points + offset), foot.lean, load, active)
    return forces, offset + half @ forces.force


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
    operator, chosen = problem.operator, start.candidates
    points = problem.surface_points[chosen]
    lost = np.zeros_like(problem.solid.nodes) if start.lost is None else start.lost
    mixer, active, passes = AndersonMixer(), start.active, 0
    begun = operator.start(lost)
    offset = operator.half.project(begun).reshape(-1, 3)[chosen]
    first = offset if start.moved is None else start.moved
    sliding = SlidingNodes(problem, points, first, pose)
    best: Solution | None = None
    while True:
        passes += 1
        foot = sliding.foot
        forces, moved = solve_pass(start.compliance, offset, points, foot, load, active)
        active = forces.active
        field, value, residual = _respond(problem, begun, chosen, forces, foot, lost)
        missed = sliding.follow(moved, forces)
        done = not active.any() or max(residual, missed) <= tolerance.force
        forces = replace(forces, converged=done and forces.converged)
        now = Solution(chosen, forces, foot, moved, field, lost, passes, max(residual, missed))
        best = now if best is None or now.residual < best.residual else best
        if done:
            return now
        if passes == tolerance.passes or not now.residual < DIVERGED * best.residual:
            return replace(best, passes=passes)
        lost = mixer.next(lost.ravel(), value.ravel()).reshape(-1, 3)
        begun = operator.start(lost)
        offset = operator.half.project(begun).reshape(-1, 3)[chosen]


def _respond(
    problem: ContactProblem,
    begun: Array,
    chosen: Indices,
    forces: ContactForces,
    foot: Footing,
    lost: Array,
) -> tuple[Array, Array, float]:
    """Return all displacements (n, 3), the h they ask for and the relative imbalance.

    Args:
        problem: solid and operator.
        begun: L⁻¹ h, becomes L⁻¹ (h + contact forces).
        chosen: candidates.
        forces: on them.
        foot: femoral planes.
        lost: (n, 3) the h that went in, N.
    """
    pushed = np.zeros((len(problem.contact_nodes), 3))
    pushed[chosen] = forces.force[:, None] * foot.normals
    problem.operator.half.apply(pushed.ravel(), begun)
    field = problem.operator.finish(begun)
    value = problem.solid.correction(field)
    value[problem.held.reshape(-1, 3)] = 0.0
    size = max(float(np.linalg.norm(pushed)), 1e-300)
    return field, value, float(np.linalg.norm(value - lost)) / size


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
    sliding = SlidingNodes(problem, points, first, pose)
    while True:
        passes += 1
        foot = sliding.foot
        forces, moved = solve_pass(start.compliance, nothing, points, foot, load, active)
        active = forces.active
        missed = sliding.follow(moved, forces)
        done = missed <= tolerance.force
        if done or passes == tolerance.passes:
            forces = replace(forces, converged=done and forces.converged)
            return Solution(start.candidates, forces, foot, moved, None, None, passes, missed)
