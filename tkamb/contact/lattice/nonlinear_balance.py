"""The nonlinear residual h of one solution, brought into balance with what it causes.

    K u = f_contact + h,    h = K u - f_internal(u)

h is accelerated by Anderson's method; its change is the out-of-balance force. An element's
share of h falls with a power of its strain (4.5 for polyethylene), so most of the insert is as
good as linear: passes look at the `Region` where it counts, and at everything once, at the end.
What the contact under the h that this last look asks for leaves out of balance is foreseen from
what passes leave of it, not looked at again.
"""

import numpy as np

from tkamb.contact.lattice.anderson import AndersonMixer
from tkamb.contact.lattice.initial_guess import InitialGuess, Left
from tkamb.contact.lattice.problem import ContactProblem, Region
from tkamb.contact.lattice.solids.solid import Noticed
from tkamb.geometry.frames import Array, Index, Mask

SHARE = 0.1
"""What elements left out may add to the imbalance, relative to the tolerance."""
PASSED_OVER = 0.03
"""And what those may that a bound of their strain passes over, when all are looked at."""
LEFT = 2.5
"""Times what passes left of the imbalance before, the next may leave of it. What is then foreseen
is 1.0 to 8.5 times what is found (docs/lattice.md)."""
OLDER = 1.1
"""And so many times more with every solution since in which it was not measured."""
KEPT = 0.8
"""Share of what passes left before that counts where the last solution measured less."""
FURTHER = 0.4
"""Of a change of h and of the stiffness that is lost there: what the next pass would add to it."""
SOFT = 0.65
"""Share of its stiffness that a contact may have lost, in the mean, before imbalance counts more:
that of knees in daily motions stays below (docs/lattice.md)."""


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
        weight: how much more an imbalance counts, by the stiffness that the contact has lost.
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
        self._mixer, self.weight = AndersonMixer(), 1.0
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
        self._last = self.foreseen = self.residual
        left = self.left
        share = left.first if not self._left or left.later is None else left.later
        if share is not None:
            leaves = LEFT * share * self.residual + SHARE * self._tolerance / self.weight
            self.foreseen = min(leaves, self.residual)

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
        self.weight = weight_of(norms(self._shares), self._lost)
        self.h = self._summed(self._shares, region.elements)
        self.residual = float(np.linalg.norm(self.h - self._taken)) / self.size

    def _look_at_all(self, known: tuple[Index, Array, Array] | None) -> None:
        """Find the imbalance of all elements, and which count.

        Args:
            known: some elements (k,), their shares (k, 3p) of this field, N, and what they have
                lost of their stiffness (k,); or None.
        """
        solid, everywhere = self._problem.solid, self._problem.everywhere.elements
        allowed = PASSED_OVER * self._tolerance * self.size / self.weight
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
        size = norms(shares)
        self.weight = weight_of(size, lost)
        counts = elements_that_count(size, SHARE * self._tolerance * self.size / self.weight)
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


def norms(shares: Array) -> Array:
    """Return the norms (k,) of elements' shares of h (k, 3p), N."""
    return np.sqrt(np.einsum("ij,ij->i", shares, shares))


def weight_of(size: Array, lost: Array) -> float:
    """Return how much more an imbalance counts, 1 or more, where the contact has softened.

    What passes leave is what they find slowly, the softest of it, and the approach follows it by
    the tangent stiffness. The cube of that is measured, not proven (docs/lattice.md).

    Args:
        size: (k,) norms of the elements' shares of h.
        lost: (k,) shares of their tangent stiffness that they have lost.
    """
    mean = float(size @ lost) / max(float(size.sum()), 1e-300)
    return float(max(1.0, (1 - SOFT) / max(1 - mean, 1e-3)) ** 3)


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
