"""The initial guess of a press: candidate nodes, and the state of an earlier solution."""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.linear.compliance import ComplianceCache, ContactResponse
from tkamb.contact.lattice.problem import ContactProblem, LatticeState, Region, TangentPlanes
from tkamb.contact.lattice.settings import LATTICE_SOLVER
from tkamb.contact.result import Guess, WarmStart
from tkamb.geometry.frames import Array, Index, Mask


@dataclass(frozen=True, eq=False)
class LatticeStart(WarmStart):
    """The end of a solution, at which the next solution of the same problem may begin.

    Args:
        problem: the problem that was solved. The start is used for no other problem.
        loads: (n, 3) N, nonlinear loads h + r of the last state; None for a linear material.
        moved: (c, 3) m, displacement of the candidates; 0 at the other contact nodes.
        depth: m, distance of the femoral component below the lowest contact node.
        region: elements outside of which h is zero, or None.
        softening: s, see `Residual`.
    """

    problem: ContactProblem
    loads: Array | None
    moved: Array
    depth: float
    region: Region | None
    softening: float = 1.0


def lattice_start(state: LatticeState, start: Guess | None) -> LatticeStart | None:
    """Return the start if it belongs to this prepared state, else None."""
    own = isinstance(start, LatticeStart) and start.problem is state.problem
    return start if own else None  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class InitialGuess:
    """The state at which the iteration starts.

    Args:
        candidates: (m,) nodes that may come into contact, as positions among the contact nodes.
        response: displacements of the candidates under forces on them.
        active: (m,) first guess of the active set.
        planes: femoral planes over the undeformed candidates.
        loads: (n, 3) N, nonlinear loads h of an earlier solution, or None.
        moved: (m, 3) m, displacement of the candidates in an earlier solution, or None.
        reach: m; every node with a smaller vertical gap is a candidate.
        region: elements outside of which h is zero, or None.
        offset: (m, 3) m, displacement of the candidates without contact forces, or None. For a
            linear material that has crept.
        softening: s of an earlier solution, see `Residual`.
        region_only: whether the residual of the region alone stops the iteration.
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
        """The same guess without the state of an earlier solution."""
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
        cache: compliance of the contact nodes.
        gaps: (c,) m, vertical gaps.
        planes: femoral planes over all contact nodes, undeformed.
        depth: m, expected distance of the femoral component below the lowest gap.
        at_pose: whether the femoral component stays at the pose and overlaps the candidates.
        start: end of an earlier solution, or None.
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
        problem: solid; its modulus and the thickness under each node are used.
        gaps: (c,) m, vertical gaps.
        areas: (c,) m², area of each contact node.
        load: N.
    """
    order = np.argsort(gaps)
    order = order[np.isfinite(gaps[order])]
    thickness = np.maximum(problem.surface_points[order, 1], 1e-3)
    height, k = gaps[order], problem.solid.material.young_modulus * areas[order] / thickness
    total, moment = np.cumsum(k), np.cumsum(k * height)
    # Force of the springs with smaller gaps when the next spring comes into contact.
    last = int(np.searchsorted(total * height - moment, load))
    last = max(min(last, len(order)) - 1, 0)
    return float((load + moment[last]) / total[last] - height[0])
