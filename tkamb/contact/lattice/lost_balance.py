"""The forces that the material has lost, brought into balance with what they cause.

    K u = f + h,    h = K u - f_internal(u)

for contact forces f that change from pass to pass. h is accelerated by Anderson's method; its
change is the out-of-balance force.
"""

import numpy as np

from tkamb.contact.lattice.anderson import AndersonMixer
from tkamb.contact.lattice.problem import ContactProblem
from tkamb.contact.lattice.region import Region, members_that_count
from tkamb.contact.lattice.response import ContactResponse
from tkamb.geometry.frames import Array

SHARE = 0.1
"""What members left out may add to the imbalance, relative to the tolerance."""


class LostBalance:
    """One solution's lost forces, pass by pass.

    A pass looks at the region where lost forces count; `look_everywhere` at the rest.

    Args:
        problem: solid and operator.
        response: of the candidates.
        tolerance: largest imbalance relative to the contact forces.
        lost: (n, 3) h of an earlier solution, N, or None.
        region: outside of which that is taken as zero; everywhere by default.

    Attributes:
        lost: (n, 3) N, the h that the last pass asks for.
        region: outside of which it is zero.
        offset: (m, 3) m, displacement of the candidates without contact forces.
        field: (n, 3) m, displacement of the nodes looked at, 0 elsewhere.
        residual: imbalance of the members looked at, relative to the contact forces.
    """

    def __init__(
        self,
        problem: ContactProblem,
        response: ContactResponse,
        tolerance: float,
        lost: Array | None = None,
        region: Region | None = None,
    ) -> None:
        self._problem, self._response, self._tolerance = problem, response, tolerance
        self.region = Region.everywhere(problem) if region is None else region
        self.lost = np.zeros_like(problem.solid.nodes)
        if lost is not None:
            self.lost[self.region.nodes] = lost[self.region.nodes]
        self._mixer = AndersonMixer()
        self._begin()

    def respond(self, pushed: Array) -> None:
        """Work out displacements and imbalance of the region under contact forces (m, 3), N."""
        operator, region = self._problem.operator, self.region
        self._size = max(float(np.linalg.norm(pushed)), 1e-300)
        self._response.push(pushed, self._x)
        operator.factor.backward(self._x, region.fronts)
        self.field = np.zeros_like(self.lost)
        self.field[region.nodes] = operator.nodal(self._x)[region.nodes]
        self._look(region)

    def look_everywhere(self) -> None:
        """Look at the rest of the solid, for the residual and the field of all of it."""
        region, operator = self.region, self._problem.operator
        if self._narrowed:
            return
        rest = np.setdiff1d(np.arange(len(operator.factor.fronts)), region.fronts)
        operator.factor.backward(self._x, rest)
        self.field = operator.nodal(self._x)
        self._look(Region.everywhere(self._problem))

    def advance(self) -> None:
        """Take the next h."""
        nodes = self.region.nodes
        if self._narrowed:
            self._mixer = AndersonMixer()
        mixed = self._mixer.next(self._taken[nodes].ravel(), self.lost[nodes].ravel())
        self.lost = np.zeros_like(self.lost)
        self.lost[nodes] = mixed.reshape(-1, 3)
        self._begin()

    def _begin(self) -> None:
        """Solve the first half for the lost forces."""
        operator, self._taken, self._narrowed = self._problem.operator, self.lost, False
        self._x = operator.start(self.lost, self.region.fronts)
        self.offset = self._response.displacement(self._x)

    def _look(self, region: Region) -> None:
        """Find the imbalance of a region; of the whole, also which members count."""
        solid = self._problem.solid
        forces = solid.lost(self.field, None if region.whole else region.members)
        value = self._summed(forces, region)
        self.residual = float(np.linalg.norm(value - self._taken)) / self._size
        if region.whole:
            size = np.linalg.norm(forces, axis=1)
            count = members_that_count(size, SHARE * self._tolerance * self._size)
            self.region = Region.of(self._problem, region.members[count])
            value = self._summed(forces[count], self.region)
            self._narrowed = True
        self.lost = value

    def _summed(self, forces: Array, region: Region) -> Array:
        value = self._problem.solid.scatter.sum(forces, region.members)
        value[self._problem.held.reshape(-1, 3)] = 0.0
        return value
