"""Residual forces of the displaced solid, and the loads that take them away.

The solid is linear but for loads h that stand for what its material carries less:

    K u = f + h,    r = f - f_int(u)

K is the factorised linear stiffness, f the contact forces, f_int the forces of the displaced
solid under its nonlinear law. At equilibrium r = 0 and h = K u - f_int(u). Every pass solves
K u = f + h and takes h + r as the next h (modified Newton), accelerated by Anderson's method
(Walker & Ni, SIAM J Numer Anal 49:1715, 2011, doi:10.1137/10078356X).

An element's share of h falls with a power of its strain (4.5 for polyethylene). So passes work on
the `Region` of the elements that count. What the rest asks for, and what the rounding of the
factor leaves, changes little from pass to pass: it is measured with the whole solid
(`NonlinearBalance.measure`) and then held constant.
"""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.initial_guess import InitialGuess
from tkamb.contact.lattice.problem import ContactProblem, Region
from tkamb.contact.lattice.settings import LatticeSolverSettings
from tkamb.contact.lattice.solid import Solid
from tkamb.geometry.frames import Array, Mask


@dataclass(frozen=True)
class Residual:
    """What is measured of a state, and stops the iteration.

    Args:
        force: |f - f_int(u)| over the free unknowns, relative to |f|.
        work: |(f - f_int(u)) · u|, relative to f · u, times the softening
            s = (f_int(u) · u) / (uᵀ K_T u): an estimate of the relative error of the approach.
        gap: largest distance of an active node from the femoral surface (overlap of the others),
            relative to the largest displacement of an active node.
    """

    force: float
    work: float = 0.0
    gap: float = 0.0

    @classmethod
    def of(
        cls, outside: Array, field: Array, force: Array, moved: Array, softening: float
    ) -> "Residual":
        """Return the residual of forces outside of balance.

        Args:
            outside: f - f_int(u) (n, 3), N, zero where held.
            field: (n, 3) u, m.
            force: (m, 3) contact forces, N.
            moved: (m, 3) displacement of their nodes, m.
            softening: s.
        """
        size = max(float(np.linalg.norm(force)), 1e-300)
        work = abs(float(np.vdot(outside, field))) / max(float(np.vdot(force, moved)), 1e-300)
        return cls(float(np.linalg.norm(outside)) / size, softening * work)

    def within(self, settings: LatticeSolverSettings) -> bool:
        """Return whether all are within their tolerances; NaN is not."""
        balanced = self.force <= settings.force_tolerance and self.work <= settings.work_tolerance
        return balanced and self.gap <= settings.gap_tolerance

    @property
    def reported(self) -> float:
        """The larger one of force and gap."""
        return max(self.force, self.gap)


class LinearBalance:
    """Hooke's law needs no loads h: only rays and contact are repeated.

    Attributes:
        offset: (m, 3) m, displacement of the candidates that no contact force made.
        moved: (m, 3) m, theirs in all.
    """

    residual, field, loads, region, softening = Residual(0.0), None, None, None, 1.0

    def __init__(self, offset: Array) -> None:
        self.offset = offset

    def displace(self, force: Array, moved: Array) -> None:
        """Take the displacement (m, 3) of the condensed compliance."""
        del force
        self.moved = moved

    def measure(self) -> None:
        """There is nothing more to measure."""

    advance = measure


class NonlinearBalance:
    """The loads h of one solution, brought into balance with the displacement they cause.

    Args:
        problem: solid and operator.
        guess: response of the candidates; h of an earlier solution and its region.
        settings: tolerances.

    Attributes:
        moved: (m, 3) m, displacement of the candidates: by the compliance, then as measured.
        field: (n, 3) m, displacement of the region's nodes; of all after `measure`.
        residual: force and work of the region; of the whole solid after `measure`.
        loads: (n, 3) N, h + r after `measure`: where a next solution may begin.
    """

    def __init__(
        self, problem: ContactProblem, guess: InitialGuess, settings: LatticeSolverSettings
    ) -> None:
        self._problem, self._response, self._settings = problem, guess.response, settings
        self._candidates = problem.contact_nodes[guess.candidates]
        self._region = guess.region or problem.everywhere
        self._constant = np.zeros_like(problem.solid.nodes)
        self._rounding = np.zeros((len(guess.candidates), 3))
        self._differences: list[tuple[Array, Array]] = []
        self.softening, self.residual = guess.softening, Residual(np.inf, np.inf)
        self._take(self._constant if guess.loads is None else guess.loads)

    def _take(self, h: Array) -> None:
        """Take loads (n, 3), N; on other nodes than the region's they are zero."""
        self._h, nodes = np.zeros_like(h), self._region.nodes
        self._h[nodes] = h[nodes]
        self._half = self._problem.operator.start(self._h, self._region.fronts)

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
        operator, region, solid = self._problem.operator, self._region, self._problem.solid
        self._force, self.moved = force, moved
        self._x = self._half.copy()
        self._response.push(force, self._x)
        operator.factor.backward(self._x, region.fronts)
        self._measured = False
        if region.whole:
            self.measure()
            return
        self.field = np.zeros_like(self._h)
        self.field[region.nodes] = operator.nodal(self._x, region.nodes)
        shares = solid.nonlinear_residual(self.field, region.elements)
        self.loads = self._constant + solid.scatter.sum(shares, region.elements)
        outside = np.zeros_like(self._h)
        outside[region.nodes] = (self.loads - self._h)[region.nodes]
        self._found(outside)

    def measure(self) -> None:
        """Measure displacement and residual of the whole solid, by the law of every element."""
        if self._measured:
            return
        solid, operator = self._problem.solid, self._problem.operator
        if not self._region.whole:
            every = self._problem.everywhere.fronts.fronts
            rest = np.setdiff1d(every, self._region.fronts.fronts, assume_unique=True)
            operator.factor.backward(self._x, operator.factor.shared(rest))
        self.field = operator.nodal(self._x)
        internal, self._shares, self.softening = forces_of(solid, self.field)
        outside = -internal
        outside[self._candidates] += self._force
        self.loads, self._measured = self._h + outside, True
        self._found(outside)
        # The factor is kept with less precision than the compliance.
        measured = self.field[self._candidates]
        self._rounding, self.moved = self._rounding + measured - self.moved, measured

    def _found(self, outside: Array) -> None:
        """Note the residual (n, 3), N, relative to the contact forces and their work."""
        for loads in (outside, self.loads):
            loads.ravel()[self._problem.held_unknowns] = 0.0
        last, self._size = self.residual, float(np.linalg.norm(self._force))
        new = Residual.of(outside, self.field, self._force, self.moved, self.softening)
        # The work changes its sign from time to time: it has not fallen more than the force.
        fall = min(new.force / max(last.force, 1e-300), 1.0) if np.isfinite(last.force) else 0.0
        self.residual = replace(new, work=max(new.work, fall * last.work if fall else 0.0))

    def advance(self) -> None:
        """Take the next loads h: h + s r, accelerated."""
        if self._measured:
            self._choose_region()
        nodes = self._region.nodes
        h = self._h[nodes].ravel()
        step = self.softening * (self.loads[nodes].ravel() - h)
        self._differences.append((h + step, step))
        del self._differences[: -self._settings.anderson_depth - 1]
        following = np.zeros_like(self._h)
        following[nodes] = accelerated(self._differences).reshape(-1, 3)
        self._take(following)

    def _choose_region(self) -> None:
        """Choose the elements that count, and hold constant what the others ask for."""
        most = self._settings.force_tolerance * self._size
        if self._region.whole or self._beyond(self._region, self.loads - self._h) > most:
            region = self.region
            if self._beyond(region, self.loads) > most:
                region = self._problem.everywhere
            if not (region.whole and self._region.whole):  # earlier iterates do not apply
                self._differences = []
            self._region = region
        elements = self._region.elements
        known = self._problem.solid.scatter.sum(self._shares[elements], elements)
        self._constant = self.loads - known

    @property
    def region(self) -> Region:
        """The elements that count at the displacement that was measured."""
        if not self._measured:
            return self._region
        settings, shares = self._settings, self._shares
        allowed = settings.region_tolerance * settings.force_tolerance * self._size
        size = np.sqrt(np.einsum("ij,ij->i", shares, shares))
        return Region.of(self._problem, np.flatnonzero(elements_that_count(size, allowed)))

    def _beyond(self, region: Region, force: Array) -> float:
        """Return the norm of forces (n, 3) on nodes outside of a region, N."""
        outside = force.copy()
        outside[region.nodes] = 0.0
        return float(np.linalg.norm(outside))


def forces_of(solid: Solid, field: Array) -> tuple[Array, Array, float]:
    """Return f_int(u) (n, 3), each element's share of h (k, 3p), N, and the softening s at u."""
    internal, shares, tangent_work = solid.forces(field)
    work = float(np.vdot(internal, field))
    return internal, shares, work / max(tangent_work, 1e-3 * abs(work), 1e-300)


def accelerated(iterates: list[tuple[Array, Array]]) -> Array:
    """Return the next x of a fixed-point iteration x = g(x), by Anderson's method.

    The combination of the last iterates whose linearised residual is smallest.

    Args:
        iterates: g(x) and g(x) - x, (n,), the last one last.
    """
    value, residual = iterates[-1]
    if len(iterates) == 1:
        return value
    values, residuals = (np.diff(np.stack(each), axis=0) for each in zip(*iterates, strict=True))
    gram = residuals @ residuals.T
    gram[np.diag_indices(len(gram))] *= 1 + 1e-12
    weights = np.linalg.lstsq(gram, residuals @ residual, rcond=1e-14)[0]
    return np.asarray(value - weights @ values)


def elements_that_count(size: Array, allowed: float) -> Mask:
    """Return which elements (c,) count: all but the smallest, which together are below a bound.

    Args:
        size: (c,) norm of each element's share of h, N.
        allowed: N, root of the sum of squares of those left out.
    """
    order = np.argsort(size)
    counts = np.zeros(len(size), bool)
    left_out = np.searchsorted(np.cumsum(size[order] ** 2), allowed**2, side="right")
    counts[order[left_out:]] = True
    return counts
