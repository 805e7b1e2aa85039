"""Residual forces of the displaced solid, and the loads that take them away.

The solid is linear but for loads h that stand for what its material carries less:

    K u = f + h,    r = f - f_int(u)

K is the factorised linear stiffness, f the contact forces, f_int the forces of the displaced
solid under its nonlinear law. At equilibrium r = 0 and h = K u - f_int(u). Every pass solves
K u = f + h and takes h + r as the next h (modified Newton), accelerated by Anderson's method.

An element's share of h falls with a power of its strain (4.5 for polyethylene). So passes work on
the `Region` of the elements that count. What the rest asks for, and what the rounding of the
factor leaves, changes little from pass to pass: it is measured with the whole solid
(`NonlinearBalance.measure`) and then held constant.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.contact.lattice.anderson import AndersonMixer
from tkamb.contact.lattice.initial_guess import InitialGuess
from tkamb.contact.lattice.problem import ContactProblem, Region
from tkamb.contact.lattice.settings import LatticeSolverSettings
from tkamb.geometry.frames import Array, Mask

NEAR = 0.05
"""Relative residual from which on a region is chosen: a contact far off still grows."""
OUTSIDE = 0.8
"""Share of the force tolerance that may stay outside of the region: the rounding of the factor."""


@dataclass(frozen=True)
class Residual:
    """What the displaced solid leaves out of balance.

    Args:
        force: |f - f_int(u)| over the free unknowns, relative to |f|.
        work: |(f - f_int(u)) · u|, relative to f · u, times the softening
            s = (f_int(u) · u) / (uᵀ K_T u): an estimate of the relative error of the approach.
    """

    force: float
    work: float

    def within(self, settings: LatticeSolverSettings) -> bool:
        """Say whether both are within their tolerances; NaN is not."""
        return self.force <= settings.force_tolerance and self.work <= settings.work_tolerance


class NonlinearBalance:
    """The loads h of one solution, brought into balance with the displacement they cause.

    Args:
        problem: solid and operator.
        guess: response of the candidates; h of an earlier solution and its region.
        settings: tolerances.

    Attributes:
        h: (n, 3) N, the loads taken.
        region: elements on which passes work; h is zero on other nodes.
        field: (n, 3) m, displacement of the region's nodes; of all after `measure`.
        residual: of the region; of the whole solid after `measure`.
        measured: the residual is that of the whole solid.
    """

    def __init__(
        self, problem: ContactProblem, guess: InitialGuess, settings: LatticeSolverSettings
    ) -> None:
        self._problem, self._response, self._settings = problem, guess.response, settings
        self._candidates = problem.contact_nodes[guess.candidates]
        self.region = problem.everywhere if guess.region is None else guess.region
        self._constant = np.zeros_like(problem.solid.nodes)
        self._rounding = np.zeros((len(guess.candidates), 3))
        self._mixer, self._softening = AndersonMixer(settings.anderson_depth), 1.0
        self.h = np.zeros_like(problem.solid.nodes)
        if guess.loads is not None:
            self.h[self.region.nodes] = guess.loads[self.region.nodes]
        self.residual = Residual(np.inf, np.inf)
        self._begin()

    def _begin(self) -> None:
        self._half = self._problem.operator.start(self.h, self.region.fronts)

    @property
    def offset(self) -> Array:
        """Displacement (m, 3) of the candidates without contact forces, m."""
        return self._response.displacement(self._half) + self._rounding

    def displace(self, force: Array, moved: Array) -> None:
        """Find the region's displacement and residual under contact forces.

        Args:
            force: (m, 3) N, on the candidates.
            moved: (m, 3) m, their displacement by the condensed compliance.
        """
        operator, region, solid = self._problem.operator, self.region, self._problem.solid
        self._force, self._moved = force, moved
        self._x = self._half.copy()
        self._response.push(force, self._x)
        operator.factor.backward(self._x, region.fronts)
        self.measured = False
        if region.whole:
            self._measure()
            return
        self.field = np.zeros_like(self.h)
        self.field[region.nodes] = operator.nodal(self._x, region.nodes)
        shares = solid.nonlinear_residual(self.field, region.elements)
        self._asked = self._constant + solid.scatter.sum(shares, region.elements)
        outside = np.zeros_like(self.h)
        outside[region.nodes] = (self._asked - self.h)[region.nodes]
        self.residual = self._residual(outside)

    def measure(self) -> None:
        """Measure the residual of the whole solid, and its displacement."""
        if self.measured:
            return
        factor, every = self._problem.operator.factor, self._problem.everywhere.fronts.fronts
        rest = np.setdiff1d(every, self.region.fronts.fronts, assume_unique=True)
        factor.backward(self._x, factor.shared(rest))
        self._measure()

    def _measure(self) -> None:
        solid = self._problem.solid
        self.field = self._problem.operator.nodal(self._x)
        internal, self._shares, tangent_work = solid.forces(self.field)
        work = float(np.vdot(internal, self.field))
        self._softening = work / max(tangent_work, 1e-3 * abs(work), 1e-300)
        outside = -internal
        outside[self._candidates] += self._force
        self._asked = self.h + outside
        self.residual = self._residual(outside)
        self.measured = True
        # The factor is kept with less precision than the compliance.
        self._rounding = self._rounding + self.field[self._candidates] - self._moved

    def _residual(self, outside: Array) -> Residual:
        """Return the residual (n, 3) relative to the contact forces and their work."""
        outside.ravel()[self._problem.held_unknowns] = 0.0
        self._size = max(float(np.linalg.norm(self._force)), 1e-300)
        force = float(np.linalg.norm(outside)) / self._size
        work = abs(float(np.vdot(outside, self.field)))
        work *= self._softening / max(float(np.vdot(self._force, self._moved)), 1e-300)
        # The work changes its sign from time to time: it has not fallen more than the force.
        last = self.residual
        if np.isfinite(last.force):
            work = max(work, min(force / max(last.force, 1e-300), 1.0) * last.work)
        return Residual(force, work)

    def advance(self) -> None:
        """Take the next loads h."""
        self._asked.ravel()[self._problem.held_unknowns] = 0.0
        if self.measured:
            self._choose_region()
        nodes = self.region.nodes
        mixed = self._mixer.next(self.h[nodes].ravel(), self._asked[nodes].ravel())
        self.h = np.zeros_like(self.h)
        self.h[nodes] = mixed.reshape(-1, 3)
        self._begin()

    def _choose_region(self) -> None:
        """Choose the elements that count, and hold constant what the others ask for."""
        most = OUTSIDE * self._settings.force_tolerance * self._size
        if self.region.whole or self._beyond(self.region, self._asked - self.h) > most:
            region = self._counting()
            if self.residual.force > NEAR or self._beyond(region, self._asked) > most:
                region = self._problem.everywhere
            if not (region.whole and self.region.whole):  # earlier differences do not apply
                self._mixer = AndersonMixer(self._settings.anderson_depth)
            self.region = region
        elements = self.region.elements
        known = self._problem.solid.scatter.sum(self._shares[elements], elements)
        self._constant = self._asked - known

    def _counting(self) -> Region:
        """Return the region of the elements that count at the displacement that was measured."""
        settings, shares = self._settings, self._shares
        allowed = settings.region_tolerance * settings.force_tolerance * self._size
        size = np.sqrt(np.einsum("ij,ij->i", shares, shares))
        return Region.of(self._problem, np.flatnonzero(elements_that_count(size, allowed)))

    def next_start(self) -> tuple[Array, Region]:
        """Return the loads (n, 3), N, and the region with which a next solution may begin."""
        self._asked.ravel()[self._problem.held_unknowns] = 0.0
        return self._asked, self._counting() if self.measured else self.region

    def _beyond(self, region: Region, force: Array) -> float:
        """Return the norm of forces (n, 3) on nodes outside of a region, N."""
        outside = force.copy()
        outside[region.nodes] = 0.0
        return float(np.linalg.norm(outside))


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
