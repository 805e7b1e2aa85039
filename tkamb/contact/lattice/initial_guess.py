"""Where a solution begins: which nodes may be touched, and what a neighbouring one left."""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.linear.compliance import ComplianceCache, ContactResponse
from tkamb.contact.lattice.problem import ContactProblem, LatticeState, Region, TangentPlanes
from tkamb.contact.lattice.settings import LatticeSolverSettings
from tkamb.contact.warm_start import Guess, WarmStart
from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index, Mask

FORCES_ONLY_DISTANCE = 0.1
"""Of a cell: how far a search that needs forces alone may go from the pose at which the whole solid
was measured last. The residual there is measured in `tests/test_lattice_forces_only.py`."""
FORCES_ONLY_GROWTH = 1.1
"""How much the contact forces may have grown there."""
LEVER_ARM = 0.03
"""m, from the femoral axis to the contact: turns a rotation into a distance."""
LARGEST_TURN = 0.5
"""Share of a step that may lead aside if the last change is extrapolated."""
SPARE_DEPTH = 1.6
"""The stored compliance covers nodes down to this many times the depth asked for."""


@dataclass(frozen=True, eq=False)
class LatticeStart(WarmStart):
    """Where a solution ended, and the next one of the same problem may begin.

    Args:
        problem: whose solution it was; it serves no other.
        loads: (n, 3) N, nonlinear loads that its last state asks for; None: linear material.
        moved: (c, 3) m, displacement of the contact nodes that were candidates, else 0.
        depth: m, how far the femoral component went below the lowest contact node.
        region: outside of which h is zero, or None.
        looked: norm of the contact forces, N, and pose when the whole solid was measured last.
        before: where the solution ended that this one began from, or None.
    """

    problem: ContactProblem
    loads: Array | None
    moved: Array
    depth: float
    region: Region | None
    looked: tuple[float, Array]
    before: "LatticeStart | None" = None

    def near(self, pose: Array) -> bool:
        """Return whether the whole solid was measured within `FORCES_ONLY_DISTANCE` of a pose."""
        reach = FORCES_ONLY_DISTANCE * float(self.problem.solid.spacing.min())
        return bool(np.linalg.norm(_way(self.looked[1], pose)) <= reach)

    def extrapolated(self, pose: Array) -> "LatticeStart":
        """Return what is to be expected at a pose: this, or this and its last change once more.

        The change counts as far as the way to the pose goes on along the last one.
        """
        last, h = self.before, self.loads
        if last is None or h is None or last.loads is None:
            return self
        step, way = _way(last.pose, self.pose), _way(self.pose, pose)
        along = float(step @ way) / max(float(step @ step), 1e-300)
        if not np.linalg.norm(way - along * step) <= LARGEST_TURN * np.linalg.norm(way):
            return self
        along = min(max(along, 0.0), 1.0)
        both = self.moved.any(axis=1, keepdims=True) & last.moved.any(axis=1, keepdims=True)
        return replace(
            self,
            loads=_gone_on(h, last.loads, h, along),
            moved=self.moved + along * np.where(both, self.moved - last.moved, 0.0),
        )

    def going_as(self, start: "LatticeStart", end: "LatticeStart", pose: Array) -> "LatticeStart":
        """Return this as if the change from another solution to the one after it had led here.

        `extrapolated` at the pose then expects that change once more.

        Args:
            start: where a like step began elsewhere.
            end: where that ended.
            pose: (4, 4) where the step from here leads.
        """
        h, first, last = self.loads, start.loads, end.loads
        if h is None or first is None or last is None:
            return self
        moved = self.moved - (end.moved - start.moved)
        came = replace(
            self,
            loads=_gone_on(h, first, last, -1.0),
            moved=moved,
            pose=2 * self.pose - pose,
        )
        return replace(self, before=replace(came, before=None))


def lattice_start(state: LatticeState, start: Guess | None) -> LatticeStart | None:
    """Return the start if it is one of this prepared state; an answer alone is none."""
    own = isinstance(start, LatticeStart) and start.problem is state.problem
    return start if own else None  # type: ignore[return-value]


def _gone_on(
    here: Array | None, start: Array | None, end: Array | None, share: float
) -> Array | None:
    """Return what a share of the change from start to end adds up to; None if one is missing."""
    if here is None or start is None or end is None:
        return None
    return _with_change(here.ravel(), start.ravel(), end.ravel(), share).reshape(here.shape)


@compiled
def _with_change(here: Array, start: Array, end: Array, share: float) -> Array:
    """Return here (n,) and a share of the change, in one go."""
    result = np.empty(len(here))
    for i in range(len(here)):
        result[i] = here[i] + share * (end[i] - start[i])
    return result


def _way(start: Array, end: Array) -> Array:
    """Return the way between two poses (12,), m, but along y; rotations times `LEVER_ARM`."""
    change = end[:3] - start[:3]
    change[:, :3] *= LEVER_ARM
    change[1, 3] = 0.0
    return change.ravel()


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
        offset: (m, 3) m, displacement of the candidates of a linear material that no contact
            force made, or None.
        unmeasured: N, norm of the contact forces up to which the region's residual is enough; 0:
            that of the whole solid is measured.
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
    unmeasured: float = 0.0

    @property
    def cold(self) -> "InitialGuess":
        """The same without what an earlier solution left."""
        return InitialGuess(
            self.candidates, self.response, self.active, self.planes, reach=self.reach
        )


def initial_guess(
    cache: ComplianceCache,
    gaps: Array,
    planes: TangentPlanes,
    depth: float,
    at_pose: bool,
    touched: Mask | None,
    warm: LatticeStart | None,
    unmeasured: float = 0.0,
    margin: float = LatticeSolverSettings.candidate_margin,
) -> InitialGuess:
    """Return candidates, their response and a first active set.

    Args:
        cache: where responses come from.
        gaps: (c,) vertical gaps, m.
        planes: over all contact nodes, undeformed.
        depth: m, how deep the femoral component may go below the lowest gap.
        at_pose: the femoral component stays at the pose: candidates overlap it already.
        touched: (c,) nodes in contact in a neighbouring solution, or None.
        warm: where a neighbouring solution ended, or None.
        unmeasured: see `InitialGuess`.
        margin: see `LatticeSolverSettings.candidate_margin`.
    """
    lowest = float(gaps.min())
    reach = lowest + (1 + margin) * depth
    nodes = np.flatnonzero(gaps <= reach)
    spare = np.flatnonzero(gaps <= lowest + SPARE_DEPTH * depth)
    level = 0.0 if at_pose else lowest + 0.6 * depth
    active = gaps[nodes] < level
    if touched is not None and touched[nodes].any():
        active = touched[nodes]
    guess = InitialGuess(nodes, cache.among(nodes, spare), active, planes.part(nodes), reach=reach)
    if warm is None:
        return guess
    return replace(
        guess,
        loads=warm.loads,
        moved=warm.moved[nodes],
        region=warm.region,
        unmeasured=unmeasured,
    )


def guessed_depth(problem: ContactProblem, gaps: Array, areas: Array, load: float) -> float:
    """Return a depth (m) at which an elastic foundation of modulus E would carry the load.

    Args:
        problem: for the material and the thickness under each node.
        gaps: (c,) vertical gaps, m.
        areas: (c,) m².
        load: N.
    """
    stiffness = problem.solid.material.young_modulus * areas
    stiffness = stiffness / np.maximum(problem.surface_points[:, 1], 1e-3)
    order = np.argsort(gaps)
    order = order[np.isfinite(gaps[order])]
    height, k = gaps[order], stiffness[order]
    total, moment = np.cumsum(k), np.cumsum(k * height)
    # What all springs so far carry when the next one is reached.
    last = int(np.searchsorted(total * height - moment, load))
    last = max(min(last, len(order)) - 1, 0)
    return float((load + moment[last]) / total[last] - height[0])
