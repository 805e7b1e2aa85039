"""Residual forces of the displaced solid, and the nonlinear loads h that make them vanish.

K is the linear stiffness; the loads h correct for the stress that the softened material lacks:

    K u = f + h,    r = f - f_int(u)

f are the contact forces, f_int(u) the internal forces under the nonlinear law. At equilibrium r = 0
and h = K u - f_int(u). Every pass solves K u = f + h and takes h + s r as the next h (modified
Newton), accelerated by Anderson's method (Walker & Ni, SIAM J Numer Anal 49:1715, 2011,
doi:10.1137/10078356X). The softening s is the ratio of secant and tangent stiffness along u, so
that K/s approximates the tangent stiffness.

An element's share of h grows with a power of its strain (4.5 for polyethylene). So passes evaluate
only the `Region` of the largest shares. The other shares and the rounding error of the factor
change little. They are measured with the whole solid (`NonlinearBalance.measure`), and are constant
until the next measurement.
"""

from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.initial_guess import InitialGuess
from tkamb.contact.lattice.problem import ContactProblem, Region
from tkamb.contact.lattice.settings import LatticeSolverSettings
from tkamb.contact.lattice.solid import Solid
from tkamb.geometry.frames import Array, Index, Mask


@dataclass(frozen=True)
class Residual:
    """The measured residuals, which stop the iteration.

    Args:
        force: |r| over the free unknowns, relative to |f|, with r = f - f_int(u).
        work: s |r · u|, relative to f · u, with the softening s = (f_int(u) · u) / (uᵀ K_T u): an
            estimate of the relative error of the approach.
        gap: largest distance of an active node from the femoral surface, or largest penetration
            of another node, relative to the largest displacement of an active node.
        peak: largest relative growth of the largest nodal force if the residual at the candidates
            were added: an estimate of the relative error of the peak.
    """

    force: float
    work: float = 0.0
    gap: float = 0.0
    peak: float = 0.0

    @classmethod
    def of(
        cls,
        r: Array,
        field: Array,
        force: Array,
        displacement: Array,
        candidates: Index,
        softening: float,
    ) -> "Residual":
        """Return force, work and peak of residual nodal forces.

        Args:
            r: N, (n, 3), zero at held unknowns.
            field: u, m, (n, 3).
            force: contact forces on the candidates, N, (m, 3).
            displacement: displacement of the candidates, m, (m, 3).
            candidates: their nodes, (m,).
            softening: s.
        """
        size = max(float(np.linalg.norm(force)), 1e-300)
        work = abs(float(np.vdot(r, field))) / max(float(np.vdot(force, displacement)), 1e-300)
        nodal, error = (np.linalg.norm(each, axis=1) for each in (force, r[candidates]))
        peak = float((nodal + error).max() / max(float(nodal.max()), 1e-300)) - 1.0
        return cls(float(np.linalg.norm(r)) / size, softening * work, peak=peak)

    def within(self, settings: LatticeSolverSettings) -> bool:
        """Return whether all residuals are within their tolerances; NaN is not."""
        in_balance = self.force <= settings.force_tolerance and self.work <= settings.work_tolerance
        smooth = self.gap <= settings.gap_tolerance and self.peak <= settings.peak_tolerance
        return in_balance and smooth

    @property
    def reported(self) -> float:
        """The larger of force and gap."""
        return max(self.force, self.gap)


class LinearBalance:
    """The balance of a linear material. It needs no loads h; passes repeat rays and contact.

    Attributes:
        offset: displacement of the candidates without contact forces, m, (m, 3).
        displacement: total displacement of the candidates, m, (m, 3).
    """

    residual, field, h, half, region, softening = Residual(0.0), None, None, None, None, 1.0

    def __init__(self, offset: Array) -> None:
        self.offset = offset

    def displace(self, force: Array, displacement: Array) -> None:
        """Set the displacement (m, 3), m, to that of the condensed compliance."""
        del force
        self.displacement = displacement

    def measure(self) -> None:
        """Do nothing: the residual of a linear material is zero."""

    advance = measure


class NonlinearBalance:
    """The iteration for the nonlinear loads h of one solution.

    Args:
        guess: response of the candidates; h, region and softening of an earlier solution.

    Attributes:
        displacement: displacement of the candidates, m, (m, 3), from the compliance; after
            `measure` from the factor.
        field: displacement of the region's nodes, after `measure` of all nodes, m, (n, 3).
        residual: force and work of the region, after `measure` of the whole solid.
        h: nonlinear loads of the last pass, N, (n, 3).
        half: L⁻¹ h in elimination order.
        loads: h + r, N, (n, 3).
        softening: s of the last measurement.
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
        if guess.loads is None or guess.half is None:
            self._set_loads(self._constant if guess.loads is None else guess.loads)
        else:
            self.h, self.half = guess.loads, guess.half

    def _set_loads(self, h: Array) -> None:
        """Set h (n, 3), N, on the nodes of the region, and 0 elsewhere."""
        self.h, nodes = np.zeros_like(h), self._region.nodes
        self.h[nodes] = h[nodes]
        self.half = self._problem.operator.start(self.h, self._region.fronts)

    @property
    def offset(self) -> Array:
        """Displacement (m, 3) of the candidates without contact forces, m."""
        return self._response.displacement(self.half) + self._rounding

    def displace(self, force: Array, displacement: Array) -> None:
        """Compute the region's displacement and residual.

        Args:
            force: forces on the candidates, N, (m, 3).
            displacement: candidates' displacement from the condensed compliance, m, (m, 3).
        """
        operator, region, solid = self._problem.operator, self._region, self._problem.solid
        self._force, self.displacement = force, displacement
        # First L⁻¹ (h + f), then K⁻¹ (h + f) in the unknowns of the region's fronts.
        self._x = self.half.copy()
        self._response.push(force, self._x)
        operator.factor.backward(self._x, region.fronts)
        self._measured = False
        if region.whole:
            self.measure()
            return
        self.field = np.zeros_like(self.h)
        self.field[region.nodes] = operator.nodal(self._x, region.nodes)
        shares = solid.nonlinear_residual(self.field, region.elements)
        self.loads = self._constant + solid.scatter.sum(shares, region.elements)
        r = np.zeros_like(self.h)
        r[region.nodes] = (self.loads - self.h)[region.nodes]
        self._set_residual(r)

    def measure(self) -> None:
        """Measure displacement and residual of the whole solid."""
        if self._measured:
            return
        solid, operator = self._problem.solid, self._problem.operator
        if not self._region.whole:
            # The other fronts still lack the backward solve.
            fronts = self._problem.everywhere.fronts.fronts
            others = np.setdiff1d(fronts, self._region.fronts.fronts, assume_unique=True)
            operator.factor.backward(self._x, operator.factor.shared(others))
        self.field = operator.nodal(self._x)
        internal, self._sizes, self.softening = forces_of(solid, self.field)
        r = -internal
        r[self._candidates] += self._force
        self.loads, self._measured = self.h + r, True
        self._set_residual(r)
        # The factor is less precise than the compliance. The difference of their displacements
        # corrects the offset of the next passes.
        measured = self.field[self._candidates]
        self._rounding = self._rounding + measured - self.displacement
        self.displacement = measured

    def _set_residual(self, r: Array) -> None:
        """Set the residual from the residual nodal forces (n, 3), N."""
        for loads in (r, self.loads):
            loads.ravel()[self._problem.held_unknowns] = 0.0
        last, self._size = self.residual, float(np.linalg.norm(self._force))
        new = Residual.of(
            r, self.field, self._force, self.displacement, self._candidates, self.softening
        )
        # The work is small by chance where it changes its sign. So it may not fall by a larger
        # factor than the force.
        fall = min(new.force / max(last.force, 1e-300), 1.0) if np.isfinite(last.force) else 0.0
        self.residual = replace(new, work=max(new.work, fall * last.work if fall else 0.0))

    def advance(self) -> None:
        """Set the next loads, h + s r accelerated."""
        if self._measured:
            self._choose_region()
        nodes = self._region.nodes
        h = self.h[nodes].ravel()
        step = self.softening * (self.loads[nodes].ravel() - h)
        self._differences.append((h + step, step))
        del self._differences[: -self._settings.anderson_depth - 1]
        next_loads = np.zeros_like(self.h)
        next_loads[nodes] = accelerated(self._differences).reshape(-1, 3)
        self._set_loads(next_loads)

    def _choose_region(self) -> None:
        """Choose the region; the other elements' loads are constant from here on."""
        tolerance = self._settings.force_tolerance * self._size
        if self._region.whole or self._beyond(self._region, self.loads - self.h) > tolerance:
            region = self.region
            if self._beyond(region, self.loads) > tolerance:
                region = self._problem.everywhere
            if not (region.whole and self._region.whole):  # earlier iterates have another region
                self._differences = []
            self._region = region
        elements = self._region.elements
        shares = self._problem.solid.nonlinear_residual(self.field, elements)
        in_region = self._problem.solid.scatter.sum(shares, elements)
        self._constant = self.loads - in_region

    @property
    def region(self) -> Region:
        """The elements with the largest shares of h at the measured displacement."""
        if not self._measured:
            return self._region
        settings = self._settings
        allowed = settings.region_tolerance * settings.force_tolerance * self._size
        return Region.of(self._problem, np.flatnonzero(largest_shares(self._sizes, allowed)))

    def _beyond(self, region: Region, force: Array) -> float:
        """Return the norm of forces (n, 3), N, outside of a region."""
        outside = force.copy()
        outside[region.nodes] = 0.0
        return float(np.linalg.norm(outside))


def forces_of(solid: Solid, field: Array) -> tuple[Array, Array, float]:
    """Return f_int(u) (n, 3), N, the norms of the elements' shares of h (k,), N, and s at u."""
    internal, sizes, tangent_work = solid.forces(field)
    work = float(np.vdot(internal, field))
    return internal, sizes, work / max(tangent_work, 1e-3 * abs(work), 1e-300)


def accelerated(iterates: list[tuple[Array, Array]]) -> Array:
    """Return the next x of a fixed-point iteration x = g(x), by Anderson's method.

    The method combines the iterates so that the linearised residual is smallest.

    Args:
        iterates: pairs of g(x) and g(x) - x, (n,) each, the newest last.
    """
    value, residual = iterates[-1]
    if len(iterates) == 1:
        return value
    values, residuals = (np.diff(np.stack(each), axis=0) for each in zip(*iterates, strict=True))
    gram = residuals @ residuals.T
    gram[np.diag_indices(len(gram))] *= 1 + 1e-12
    weights = np.linalg.lstsq(gram, residuals @ residual, rcond=1e-14)[0]
    return np.asarray(value - weights @ values)


def largest_shares(size: Array, allowed: float) -> Mask:
    """Return the elements (c,) of the region: all but the smallest shares of h.

    Args:
        size: norm of each element's share of h, N, (c,).
        allowed: largest root of the sum of squares of the omitted shares, N.
    """
    result = size > allowed / np.sqrt(len(size))  # the others are within the bound in any case
    ordered = np.sort(size[result])
    sums = np.cumsum(ordered**2) + float(np.square(size[~result]).sum())
    omitted = np.searchsorted(sums, allowed**2, side="right")
    result &= size > (ordered[omitted - 1] if omitted else 0.0)
    return result
