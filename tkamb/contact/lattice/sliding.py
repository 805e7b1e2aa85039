"""Contact nodes that slide: rays fired again from where they have gone."""

import numpy as np

from tkamb.contact.lattice.active_set import ContactForces
from tkamb.contact.lattice.problem import ContactProblem, Footing, footing
from tkamb.geometry.frames import Array

SLOW = 0.7
"""When a pass leaves more than this share of the last distance, steps are halved."""
SMALLEST_SHARE = 0.125


class SlidingNodes:
    """Femoral planes under the candidates, renewed as the nodes slide.

    Each pass solves the contact on tangent planes; the rays are then fired from the displaced
    nodes. Where the femoral normal turns quickly (a rim, a coarse triangle) the nodes could
    swing to and fro: the next planes are then taken only part of the way towards them.

    Args:
        problem: solid and femoral component.
        points: (m, 3) undeformed candidates, m.
        moved: (m, 3) their first displacement, m.
        pose: (4, 4) pose_femoral_in_insert.
        foot: planes under the undeformed candidates.
    """

    def __init__(
        self, problem: ContactProblem, points: Array, moved: Array, pose: Array, foot: Footing
    ) -> None:
        self._problem, self._points, self._pose = problem, points, pose
        self._fired = points + moved
        self._share, self._last = 1.0, np.inf
        self.foot = footing(problem, self._fired, pose, foot) if moved.any() else foot

    def follow(self, moved: Array, forces: ContactForces) -> float:
        """Renew the planes for nodes displaced by moved (m, 3).

        Returns:
            The largest distance of an active node from the femoral surface where it now is
            (overlap of the others counts too), relative to the largest displacement of an
            active node.
        """
        if not forces.active.any():
            return 0.0
        positions = self._points + moved
        there = footing(self._problem, positions, self._pose, self.foot)
        gap = there.gap(positions) + forces.approach * there.lean
        miss = np.where(forces.active, np.abs(gap), np.maximum(-gap, 0))
        size = float(np.abs(moved[forces.active]).max())
        missed = float(np.nan_to_num(miss, nan=0.0).max()) / max(size, 1e-300)
        if missed > SLOW * self._last:
            self._share = max(self._share / 2, SMALLEST_SHARE)
        self._last = missed
        if self._share == 1.0:
            self._fired, self.foot = positions, there
        else:
            self._fired = self._fired + self._share * (positions - self._fired)
            self.foot = footing(self._problem, self._fired, self._pose, self.foot)
        return missed
