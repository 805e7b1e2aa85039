"""Where a solution begins: which nodes may be touched, and what an earlier one left."""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.linear.compliance import ComplianceCache, ContactResponse
from tkamb.contact.lattice.problem import ContactProblem, LatticeState, Region, TangentPlanes
from tkamb.contact.lattice.settings import LATTICE_SOLVER
from tkamb.contact.result import Guess, WarmStart
from tkamb.geometry.frames import Array, Index, Mask


@dataclass(frozen=True, eq=False)
class LatticeStart(WarmStart):
    """Where a solution ended, and the next one of the same problem may begin.

    Args:
        problem: whose solution it was; it serves no other.
        loads: (n, 3) N, nonlinear loads that its last state asks for; None: linear material.
        moved: (c, 3) m, displacement of the contact nodes that were candidates, else 0.
        depth: m, how far the femoral component went below the lowest contact node.
        region: outside of which h is zero, or None.
        softening: s, see `Residual`.
    """

    problem: ContactProblem
    loads: Array | None
    moved: Array
    depth: float
    region: Region | None
    softening: float = 1.0


def lattice_start(state: LatticeState, start: Guess | None) -> LatticeStart | None:
    """Return the start if it is one of this prepared state; an answer alone is none."""
    own = isinstance(start, LatticeStart) and start.problem is state.problem
    return start if own else None  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class InitialGuess:
    """Where the iteration starts.

    Args:
        candidates: (m,) positions among the contact nodes.
        response: of the candidates to forces on them.
        active: (m,) first guess of the active set.
        planes: femoral planes over the undeformed candidates.
        loads: (n, 3) h, N, of an earlier solution, or None.
        moved: (m, 3) m, displacement of the candidates in an earlier solution, or None.
        reach: m, every node with a smaller vertical gap is a candidate.
        region: outside of which h is zero, or None.
        softening: s of an earlier solution, see `Residual`.
        offset: (m, 3) m, displacement of the candidates of a linear material that no contact
            force made, or None.
        region_only: the residual of the region is enough, that of the whole solid is not measured.
    """

    candidates: Index
    response: ContactResponse
    active: Mask
    planes: TangentPlanes
    loads: Array | None = None
    moved: Array | None = None
    reach: float = np.inf
    region: Region | None = None
    offset: Array | None = None
    softening: float = 1.0
    region_only: bool = False

    @property
    def cold(self) -> "InitialGuess":
        """The same without what an earlier solution left."""
        return replace(self, loads=None, moved=None, region=None, softening=1.0, region_only=False)


def initial_guess(
    cache: ComplianceCache,
    gaps: Array,
    planes: TangentPlanes,
    depth: float,
    at_pose: bool,
    start: LatticeStart | None = None,
    margin: float = LATTICE_SOLVER.candidate_margin,
    region_only: bool = False,
) -> InitialGuess:
    """Return candidates, their response and a first active set.

    Args:
        cache: where responses come from.
        gaps: (c,) vertical gaps, m.
        planes: over all contact nodes, undeformed.
        depth: m, how deep the femoral component may go below the lowest gap.
        at_pose: the femoral component stays at the pose: candidates overlap it already.
        start: where an earlier solution ended, or None.
        margin: see `LatticeSolverSettings.candidate_margin`.
        region_only: see `InitialGuess`.
    """
    lowest = float(gaps.min())
    reach = lowest + (1 + margin) * depth
    nodes = np.flatnonzero(gaps <= reach)
    active = gaps[nodes] < (0.0 if at_pose else lowest + 0.6 * depth)
    guess = InitialGuess(nodes, cache.among(nodes), active, planes.part(nodes), reach=reach)
    if start is None:
        return guess
    return replace(
        guess, loads=start.loads, moved=start.moved[nodes], region=start.region,
        region_only=region_only, softening=start.softening,
    )  # fmt: skip


def guessed_depth(problem: ContactProblem, gaps: Array, areas: Array, load: float) -> float:
    """Return a depth (m) at which an elastic foundation of modulus E would carry the load.

    Args:
        problem: for the material and the thickness under each node.
        gaps: (c,) vertical gaps, m.
        areas: (c,) m².
        load: N.
    """
    order = np.argsort(gaps)
    order = order[np.isfinite(gaps[order])]
    thickness = np.maximum(problem.surface_points[order, 1], 1e-3)
    height, k = gaps[order], problem.solid.material.young_modulus * areas[order] / thickness
    total, moment = np.cumsum(k), np.cumsum(k * height)
    # What all springs so far carry when the next one is reached.
    last = int(np.searchsorted(total * height - moment, load))
    last = max(min(last, len(order)) - 1, 0)
    return float((load + moment[last]) / total[last] - height[0])
