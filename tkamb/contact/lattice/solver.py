"""Frictionless contact of the lattice: force, approach and material in one iteration.

Every pass fires the rays through the displaced contact nodes, solves the unilateral contact
on the stored compliance of the linear operator (approach included), finds the displacement of
all nodes, and renews the nonlinear residual h, what the material carries less than the linear
one:

    K u = f_contact + h,    h = K u - f_internal(u)

h is accelerated by Anderson's method; its change is the out-of-balance force. An element's
share of h falls with a power of its strain (4.5 for polyethylene), so most of the insert is as
good as linear: passes look at the `Region` where it counts, and at everything once, at the end.
The contact under the h that this last look asks for ends the iteration: what it leaves out of
balance is foreseen from what passes leave of it, not looked at again.
For a linear material h = 0 and the pass is repeated only until the sliding nodes rest.
"""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.active_set import ContactForces, solve_contact
from tkamb.contact.lattice.anderson import AndersonMixer
from tkamb.contact.lattice.initial_guess import NOT_KNOWN, InitialGuess, Left
from tkamb.contact.lattice.linear.compliance import ContactResponse
from tkamb.contact.lattice.problem import ContactProblem, Region, TangentPlanes, tangent_planes
from tkamb.contact.lattice.solids.solid import Noticed
from tkamb.geometry.frames import Array, Index, Mask

DIVERGED = 100.0
"""The iteration is given up when the imbalance is this many times the smallest so far."""
SHARE = 0.1
"""What elements left out may add to the imbalance, relative to the tolerance."""
PASSED_OVER = 0.03
"""And what those may that a bound of their strain passes over, when all are looked at."""
LEFT = 2.5
"""Times what passes left of the imbalance before, the next may leave of it. What is then foreseen
is 1.0 to 7 times what is found (docs/lattice.md)."""
OLDER = 1.1
"""And so many times more with every solution since in which it was not measured."""
KEPT = 0.8
"""Share of what passes left before that counts where the last solution measured less."""
FURTHER = 0.4
"""Of a change of h and of the stiffness that is lost there: what the next pass would add to it."""
SLOW = 0.7
"""When a pass leaves more than this share of the last distance, sliding steps are halved."""
SMALLEST_SHARE = 0.125


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
class Solution:
    """What the iteration found.

    Args:
        candidates: (m,) positions among the contact nodes.
        forces: along the normals, with approach and active set.
        planes: femoral points and normals of the candidates.
        displacement: (m, 3) of the candidates, m.
        field: (n, 3) displacement of all nodes when they were last looked at, or None (linear
            material).
        nonlinear_residual: (n, 3) h, N, that the forces hold with, or None (linear).
        passes: how many.
        residual: out-of-balance force, as foreseen, or distance from the femoral surface, the
            larger one, both relative.
        region: outside of which h is zero, or None.
        seen: all elements were looked at; else `field` is that of the region.
        noticed: elements but which the bound passed over, or None (all).
        half: L⁻¹ h in elimination order, or None.
        left: shares of the imbalance that passes leave.
        balanced: some pass had no force out of balance; active nodes may yet have missed the
            femoral surface.
    """

    candidates: Index
    forces: ContactForces
    planes: TangentPlanes
    displacement: Array
    field: Array | None
    nonlinear_residual: Array | None
    passes: int
    residual: float
    region: Region | None = None
    seen: bool = True
    noticed: Noticed | None = None
    half: Array | None = None
    left: Left = NOT_KNOWN
    balanced: bool = False

    @property
    def converged(self) -> bool:
        """Whether forces, surface and active set all came to rest."""
        return self.forces.converged


def solve(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    guess: InitialGuess,
    tolerance: Tolerance,
) -> Solution:
    """Return the contact at a pose under a load (N), or at approach 0 when load is None."""
    if problem.solid.material.is_linear:
        return _solve_linear(problem, pose, load, guess, tolerance)
    chosen, active, passes, balanced = guess.candidates, guess.active, 0, False
    balance = NonlinearBalance(problem, guess, tolerance.force)
    points = problem.surface_points[chosen]
    first = balance.offset if guess.moved is None else guess.moved
    sliding = SlidingNodes(problem, points, first, pose, guess.planes)
    best: Solution | None = None
    warm = guess.nonlinear_residual is not None
    while True:
        planes = sliding.planes
        forces, moved = solve_pass(guess.response, balance.offset, points, planes, load, active)
        if warm and not forces.active.any():
            # What a heavier contact left behind holds the nodes down: begin without it.
            warm, guess = False, guess.cold
            balance = NonlinearBalance(problem, guess, tolerance.force)
            sliding = SlidingNodes(problem, points, balance.offset, pose, guess.planes)
            continue
        active = forces.active
        missed = sliding.follow(moved, forces)
        residual = max(balance.foreseen, missed)
        done = residual <= tolerance.force
        if not done:
            passes += 1
            balance.respond(forces.force[:, None] * planes.normals)
            if balance.foreseen <= tolerance.force and balance.size > guess.unseen:
                balance.look_everywhere()
            residual = max(balance.residual, missed)
        now = Solution(
            chosen,
            replace(forces, converged=done and forces.converged),
            planes,
            moved,
            balance.field,
            balance.h,
            passes,
            residual,
            balance.region,
            balance.size > guess.unseen,
            balance.noticed,
            balance.half,
            balance.left,
            balanced := balanced or balance.residual <= tolerance.force,
        )
        if done:
            return now
        best = now if best is None or residual < best.residual else best
        last = passes >= tolerance.passes and balance.foreseen > tolerance.force
        if last or passes > tolerance.passes or not residual < DIVERGED * best.residual:
            return replace(_given_up(problem, best, passes), balanced=balanced)
        balance.advance()


def solve_pass(
    response: ContactResponse,
    offset: Array,
    points: Array,
    planes: TangentPlanes,
    load: float | None,
    active: Mask,
) -> tuple[ContactForces, Array]:
    """Solve the contact for given femoral planes; return it and the displacement (m, 3).

    Args:
        response: of the candidates.
        offset: (m, 3) their displacement without contact forces.
        points: (m, 3) undeformed.
        planes: over them.
        load: N, or None for approach 0.
        active: first guess.
    """
    along, pushed = response.along(planes.normals)
    forces = solve_contact(along, planes.gap(points + offset), planes.normal_y, load, active)
    return forces, offset + response.moved(pushed, forces.force)


def _given_up(problem: ContactProblem, best: Solution, passes: int) -> Solution:
    """Return the best pass with the displacements of the whole solid."""
    h = best.nonlinear_residual
    applied = np.zeros_like(problem.solid.nodes) if h is None else h.copy()
    applied[problem.contact_nodes[best.candidates]] += (
        best.forces.force[:, None] * best.planes.normals
    )
    return replace(best, field=problem.operator.solve(applied), passes=passes, noticed=None)


def _solve_linear(
    problem: ContactProblem,
    pose: Array,
    load: float | None,
    guess: InitialGuess,
    tolerance: Tolerance,
) -> Solution:
    """Repeat rays and contact until the sliding nodes rest."""
    points = problem.surface_points[guess.candidates]
    offset = np.zeros_like(points) if guess.offset is None else guess.offset
    active, passes = guess.active, 0
    first = offset if guess.moved is None else guess.moved
    sliding = SlidingNodes(problem, points, first, pose, guess.planes)
    while True:
        passes += 1
        planes = sliding.planes
        forces, moved = solve_pass(guess.response, offset, points, planes, load, active)
        active = forces.active
        missed = sliding.follow(moved, forces)
        done = missed <= tolerance.force
        if done or passes == tolerance.passes:
            forces = replace(forces, converged=done and forces.converged)
            return Solution(guess.candidates, forces, planes, moved, None, None, passes, missed)


class NonlinearBalance:
    """One solution's nonlinear residual h, brought into balance with what it causes.

    A pass looks at the region where h counts; `look_everywhere` at the rest.

    Args:
        problem: solid and operator.
        guess: response of the candidates; h of an earlier solution and its region.
        tolerance: largest imbalance relative to the contact forces.

    Attributes:
        h: (n, 3) N, what the last pass asks for.
        region: outside of which it is zero.
        offset: (m, 3) m, displacement of the candidates without contact forces.
        field: (n, 3) m, displacement of the nodes looked at, 0 elsewhere.
        residual: imbalance of the elements looked at, relative to the contact forces.
        foreseen: imbalance that contact forces under h would leave, relative.
        half: L⁻¹ h in elimination order.
        size: N, norm of the contact forces.
        noticed: elements but which the bound passed over in the last look at all, or None.
    """

    def __init__(self, problem: ContactProblem, guess: InitialGuess, tolerance: float) -> None:
        self._problem, self._response, self._tolerance = problem, guess.response, tolerance
        self.region = problem.everywhere if guess.region is None else guess.region
        self.noticed: Noticed | None = None
        self._earlier, self._left = guess.left, list[float]()
        self.foreseen, self._last = np.inf, np.nan
        self._mixer = AndersonMixer()
        if guess.nonlinear_residual is not None and guess.half is not None:
            self.h = guess.nonlinear_residual
            self._begin(guess.half)
            return
        self.h = np.zeros_like(problem.solid.nodes)
        if guess.nonlinear_residual is not None:
            self.h[self.region.nodes] = guess.nonlinear_residual[self.region.nodes]
        self._begin(problem.operator.start(self.h, self.region.fronts))

    def respond(self, pushed: Array) -> None:
        """Work out displacements and imbalance of the region under contact forces (m, 3), N."""
        operator, region = self._problem.operator, self.region
        self.size = max(float(np.linalg.norm(pushed)), 1e-300)
        self._x = self.half.copy()
        self._response.push(pushed, self._x)
        operator.factor.backward(self._x, region.fronts)
        self.field = np.zeros_like(self.h)
        self.field[region.nodes] = operator.nodal(self._x, region.nodes)
        if region.whole:
            self._look_at_all(None)
        else:
            self._look(region)
        if np.isfinite(self._last):
            self._left.append(self.residual / self._last)
        self._foresee()

    def look_everywhere(self) -> None:
        """Look at the rest of the solid, for the residual and the field of all of it."""
        region, operator = self.region, self._problem.operator
        if self._narrowed:
            return
        factor, every = operator.factor, self._problem.everywhere.fronts.fronts
        rest = np.setdiff1d(every, region.fronts.fronts, assume_unique=True)
        factor.backward(self._x, factor.shared(rest))
        self.field = operator.nodal(self._x)
        self._look_at_all((region.elements, self._shares, self._lost))
        self._foresee()

    def advance(self) -> None:
        """Take the next h."""
        nodes = self.region.nodes
        if self._narrowed:  # another set of unknowns: earlier differences do not apply
            self._mixer = AndersonMixer()
        mixed = self._mixer.next(self._taken[nodes].ravel(), self._expected(nodes).ravel())
        self.h = np.zeros_like(self.h)
        self.h[nodes] = mixed.reshape(-1, 3)
        self._begin(self._problem.operator.start(self.h, self.region.fronts))

    def _expected(self, nodes: Index) -> Array:
        """Return what nodes (m, 3) will ask for when they are given what they now ask for, N.

        Elements that have lost stiffness strain more under what they ask for, and ask for more:
        h at a node goes on by `FURTHER` of its last change and of its elements' lost stiffness.
        """
        scatter, shares = self._problem.solid.scatter, self._shares
        further = FURTHER * scatter.mean(self._lost, shares, self.region.elements)[nodes, None]
        return self.h[nodes] + further * (self.h[nodes] - self._taken[nodes])

    def _begin(self, half: Array) -> None:
        """Take h with L⁻¹ of it."""
        self._taken, self.half, self._narrowed = self.h, half, False
        self.offset = self._response.displacement(half)

    def _foresee(self) -> None:
        """Foresee what a contact under the h asked for leaves of the imbalance."""
        self._last, left = self.residual, self.left
        share = (left.later or left.first) if self._left else left.first
        if share is not None:
            left_over = LEFT * share * self.residual + SHARE * self._tolerance
            self.foreseen = min(left_over, self.residual)
        else:
            self.foreseen = self.residual

    @property
    def left(self) -> Left:
        """Shares that passes left here, or where there were none, a bit more than before."""
        return Left(
            _most(self._left[:1], self._earlier.first), _most(self._left[1:], self._earlier.later)
        )

    def _look(self, region: Region) -> None:
        """Find the imbalance of a region."""
        solid = self._problem.solid
        self._lost = np.empty(len(region.elements))
        self._shares = solid.nonlinear_residual(self.field, region.elements, self._lost)
        self.h = self._summed(self._shares, region.elements)
        self.residual = float(np.linalg.norm(self.h - self._taken)) / self.size

    def _look_at_all(self, known: tuple[Index, Array, Array] | None) -> None:
        """Find the imbalance of all elements, and which count.

        Args:
            known: some elements (k,), their shares (k, 3p) of this field, N, and what they have
                lost of their stiffness (k,); or None.
        """
        solid, everywhere = self._problem.solid, self._problem.everywhere.elements
        allowed = PASSED_OVER * self._tolerance * self.size
        self.noticed = solid.noticeable(self.field, allowed / np.sqrt(len(everywhere)))
        elements = everywhere
        if self.noticed is not None:
            left = np.zeros(len(everywhere), bool)
            left[self.noticed.elements] = True
            if known is not None:
                left[known[0]] = False
            elements = np.flatnonzero(left)
        lost = np.empty(len(elements))
        shares = solid.nonlinear_residual(self.field, elements, lost)
        if self.noticed is not None and known is not None:
            elements, lost = np.concatenate([known[0], elements]), np.concatenate([known[2], lost])
            shares = np.vstack([known[1], shares])
        size = np.sqrt(np.einsum("ij,ij->i", shares, shares))
        counts = elements_that_count(size, SHARE * self._tolerance * self.size)
        which = np.flatnonzero(counts)
        which = which[np.argsort(elements[which])]
        self.region = Region.of(self._problem, elements[which])
        self._shares, self._lost = shares[which], lost[which]
        self.h = self._summed(shares, elements, which)
        asked = self.h + self._summed(shares, elements, np.flatnonzero(~counts))
        self.residual = float(np.linalg.norm(asked - self._taken)) / self.size
        self._narrowed = True

    def _summed(self, forces: Array, elements: Index, which: Index | None = None) -> Array:
        value = self._problem.solid.scatter.sum(forces, elements, which)
        value.ravel()[self._problem.held_unknowns] = 0.0
        return value


def _most(measured: list[float], earlier: float | None) -> float | None:
    """Return the most of what was measured and of what was so before, by now; None: nothing."""
    before = [] if earlier is None else [earlier * (KEPT if measured else OLDER)]
    return max(measured + before, default=None)


def elements_that_count(size: Array, allowed: float) -> Mask:
    """Return which elements (c,) count: all but the smallest, which together are below a bound.

    Args:
        size: (c,) norm of each element's share of h, N.
        allowed: N, root of the sum of squares of those left out.
    """
    surely = size <= allowed / np.sqrt(max(len(size), 1))  # even if all were as large
    others = np.flatnonzero(~surely)
    order = others[np.argsort(size[others])]
    total = (size[surely] ** 2).sum() + np.cumsum(size[order] ** 2)
    counts = np.zeros(len(size), bool)
    counts[order[np.searchsorted(total, allowed**2, side="right") :]] = True
    return counts


class SlidingNodes:
    """Femoral planes over the candidates, renewed as the nodes slide.

    Each pass solves the contact on tangent planes; the rays are then fired from the displaced
    nodes. Where the femoral normal turns quickly (a rim, a coarse triangle) the nodes could
    swing to and fro: the next planes are then taken only part of the way towards them.

    Args:
        problem: solid and femoral component.
        points: (m, 3) undeformed candidates, m.
        moved: (m, 3) their first displacement, m.
        pose: (4, 4) pose_femoral_in_insert.
        planes: over the undeformed candidates.
    """

    def __init__(
        self,
        problem: ContactProblem,
        points: Array,
        moved: Array,
        pose: Array,
        planes: TangentPlanes,
    ) -> None:
        self._problem, self._points, self._pose = problem, points, pose
        self._fired = points + moved
        self._share, self._last = 1.0, np.inf
        self.planes = planes
        if moved.any():
            self.planes = tangent_planes(problem, self._fired, pose, planes)

    def follow(self, moved: Array, forces: ContactForces) -> float:
        """Renew the planes for nodes displaced by moved (m, 3).

        Returns:
            The largest distance of an active node from the femoral surface where it now is
            (overlap of the others counts too), relative to the largest displacement of an
            active node; inf where no node is active, for bodies that overlap touch.
        """
        positions = self._points + moved
        there = tangent_planes(self._problem, positions, self._pose, self.planes)
        gap = there.gap(positions) + forces.approach * there.normal_y
        miss = np.where(forces.active, np.abs(gap), np.maximum(-gap, 0))
        size = float(np.abs(moved[forces.active]).max(initial=0.0))
        missed = float(np.nan_to_num(miss, nan=0.0).max()) / max(size, 1e-300)
        missed = missed if forces.active.any() else np.inf
        if missed > SLOW * self._last:
            self._share = max(self._share / 2, SMALLEST_SHARE)
        self._last = missed
        if self._share == 1.0:
            self._fired, self.planes = positions, there
        else:
            self._fired = self._fired + self._share * (positions - self._fired)
            self.planes = tangent_planes(self._problem, self._fired, self._pose, self.planes)
        return missed
