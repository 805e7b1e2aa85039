"""The initial guess of the contact solver: candidate nodes and the state of a warm start."""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.linear.compliance import ComplianceCache, ContactResponse
from tkamb.contact.lattice.problem import ContactProblem, LatticeState, Region, TangentPlanes
from tkamb.contact.lattice.settings import LATTICE_SOLVER
from tkamb.contact.result import Guess, WarmStart
from tkamb.geometry.frames import Array, Index, Mask

LEVER_ARM = 0.03
"""m: distance from the femoral axis to the contact. It converts a rotation to a distance."""
LARGEST_SHARE = 1.0
"""1: largest share of the last change by which a state is extrapolated. Larger: not studied."""
LARGEST_TURN = 0.5
"""1: largest part of a step across the last one, as a share of the step, with an extrapolation."""


@dataclass(frozen=True, eq=False)
class LatticeStart(WarmStart):
    """Warm start: the state of a converged solution of the same problem.

    Args:
        problem: the problem that was solved. Other problems ignore the warm start.
        loads: nonlinear loads h (`nonlinear_balance.py`), N, shape (n, 3), the first h of the next
            solution; None for a linear material.
        displacement: displacement of the contact nodes, m, shape (c, 3); 0 except at candidates.
        depth: travel of the femoral component since it touched the first contact node, m.
        region: elements outside of which h is zero, or None.
        softening: s, see `Residual`.
        half: L⁻¹ h in elimination order, or None.
        before: warm start of the solution that led to this one, without its own `before`; or None.
    """

    problem: ContactProblem
    loads: Array | None
    displacement: Array
    depth: float
    region: Region | None
    softening: float = 1.0
    half: Array | None = None
    before: "LatticeStart | None" = None

    def extrapolated(self, pose: Array) -> "LatticeStart":
        """Return this state plus its last change, if the step to a pose continues the last step.

        Args:
            pose: pose_femoral_in_insert, shape (4, 4); its height has no influence.
        """
        last = self.before
        if last is None:
            return self
        change, step = step_between(last.pose, self.pose), step_between(self.pose, pose)
        share = min(float(change @ step) / max(float(change @ change), 1e-300), LARGEST_SHARE)
        across = np.linalg.norm(step - share * change)
        if share <= 0 or across > LARGEST_TURN * np.linalg.norm(step):
            return self
        return self.plus(last, self, share)

    def plus(
        self, first: "LatticeStart", second: "LatticeStart", share: float = 1.0
    ) -> "LatticeStart":
        """Return this state plus a share of the change from a first to a second state."""
        both = (self.displacement != 0) & (first.displacement != 0) & (second.displacement != 0)
        moved = np.where(both, second.displacement - first.displacement, 0.0)
        loads = _plus(self.loads, first.loads, second.loads, share)
        half = _plus(self.half, first.half, second.half, share)
        displacement = self.displacement + share * moved
        return replace(self, loads=loads, half=half, displacement=displacement)


def _plus(
    value: Array | None, first: Array | None, second: Array | None, share: float
) -> Array | None:
    """Return a value plus a share of a change; None if one of them is unknown."""
    if value is None or first is None or second is None:
        return None
    return value + share * (second - first)


def step_between(start: Array, end: Array) -> Array:
    """Return the step between two poses without its height, m, shape (12,)."""
    step = (end - start)[:3] * [LEVER_ARM, LEVER_ARM, LEVER_ARM, 1.0]
    step[1, 3] = 0.0
    return np.asarray(step.ravel())


def lattice_start(state: LatticeState, start: Guess | None) -> LatticeStart | None:
    """Return the warm start if it belongs to this prepared state, else None."""
    matches = isinstance(start, LatticeStart) and start.problem is state.problem
    return start if matches else None  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class InitialGuess:
    """The state at which the iteration begins.

    Args:
        candidates: positions of the candidates among the contact nodes, shape (m,).
        response: displacements of the candidates under forces on them.
        active: first guess of the active set, shape (m,).
        planes: femoral planes over the undeformed candidates.
        loads: nonlinear loads h of an earlier solution, N, shape (n, 3), or None.
        displacement: candidates' displacement in an earlier solution, m, shape (m, 3), or None.
        reach: vertical gap below which every node is a candidate, m.
        region: elements outside of which h is zero, or None.
        offset: creep displacement of the candidates of a linear material, m, shape (m, 3), or
            None.
        softening: s of an earlier solution, see `Residual`.
        half: L⁻¹ h of an earlier solution in elimination order, or None.
        region_only: whether the iteration stops by the residual of the region alone.
    """

    candidates: Index
    response: ContactResponse
    active: Mask
    planes: TangentPlanes
    loads: Array | None = None
    displacement: Array | None = None
    reach: float = np.inf
    region: Region | None = None
    offset: Array | None = None
    softening: float = 1.0
    half: Array | None = None
    region_only: bool = False

    @property
    def cold(self) -> "InitialGuess":
        """The same guess without the state of an earlier solution."""
        return replace(
            self,
            loads=None,
            displacement=None,
            region=None,
            softening=1.0,
            half=None,
            region_only=False,
        )


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
    """Return the candidates, their response and a first active set.

    Args:
        cache: compliance of the contact nodes.
        gaps: vertical gaps, m, shape (c,).
        planes: femoral planes over all undeformed contact nodes.
        depth: expected approach beyond the smallest gap, m.
        at_pose: whether the pose is given, not the load: the bodies then overlap.
        start: warm start, or None.
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
        guess, loads=start.loads, displacement=start.displacement[nodes], region=start.region,
        region_only=region_only, softening=start.softening, half=start.half,
    )  # fmt: skip


def guessed_depth(problem: ContactProblem, gaps: Array, areas: Array, load: float) -> float:
    """Return the approach, m, at which an elastic foundation of modulus E carries the load.

    Args:
        problem: gives E and the thickness under each node.
        gaps: vertical gaps, m, shape (c,).
        areas: tributary areas, m², shape (c,).
        load: N.
    """
    order = np.argsort(gaps)
    order = order[np.isfinite(gaps[order])]
    thickness = np.maximum(problem.surface_points[order, 1], 1e-3)
    height, k = gaps[order], problem.solid.material.young_modulus * areas[order] / thickness
    total, moment = np.cumsum(k), np.cumsum(k * height)
    # total * height - moment is the force of the foundation when each spring comes into contact.
    last = int(np.searchsorted(total * height - moment, load))
    last = max(min(last, len(order)) - 1, 0)
    return float((load + moment[last]) / total[last] - height[0])
