"""Muscle forces and compliance over the passes of a search for released coordinates.

The muscle forces depend on the knee's equilibrium, and this on the muscle forces. Under a light
load the knee is compliant, and a plain iteration would oscillate. Each pass therefore changes the
applied forces f by a share omega of the difference from the required forces f',

    f <- f + omega (f' - f),   omega <- -omega d . (d' - d) / |d' - d|²,

where d and d' are the last two differences f' - f (Aitken's secant for a vector).

The moment arms of the muscles depend on the compliance, and this on the equilibrium. The first
passes use the measured compliance. Later ones change it by half of its difference from the measured
one, then by a quarter. It thus converges even if the contact's stiffness changes fast with the
pose. After these it stays constant, and `compliance_error` is the remaining relative difference.

References: Irons & Tuck, Int J Numer Methods Eng 1:275 (1969), doi:10.1002/nme.1620010306;
Küttler & Wall, Comput Mech 43:61 (2008), doi:10.1007/s00466-008-0255-5.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.knee.released_forces import LEVER_ARM

if TYPE_CHECKING:
    from tkamb.knee.crossing import MuscleShare

# N: largest difference of a muscle's required force from its applied force at which the iteration
# has converged. A thousandth of a usual muscle force.
MUSCLE_FORCE_TOLERANCE = 1.0


LEAST, MOST = 0.05, 1.0
"""Smallest and largest omega."""


STEPS = ((4, 1.0), (8, 0.5), (16, 0.25))
"""Pairs (number of passes, share): up to this pass the compliance changes by this share of the
difference from the measured compliance."""
TURNS = np.array([1.0, 1.0, 1.0, LEVER_ARM, LEVER_ARM, LEVER_ARM])
"""1 and m: factors that make the compliances to forces and moments comparable."""


class Relaxation:
    """The muscles' forces over the passes of one search.

    Attributes:
        converged: whether the applied forces have converged.
        compliance_error: relative difference of the measured compliance from the compliance in use.
    """

    def __init__(self) -> None:
        self._applied: MuscleShare | None = None
        self._last_difference: Array | None = None
        self._factor, self.converged = MOST, True
        self._compliance: Array | None = None
        self._passes, self.compliance_error = 0, 0.0

    def compliance(self, measured: Array | None) -> Array | None:
        """Return the compliance of the knee, 1 and 1/m, for the next pass.

        Args:
            measured: compliance at the last equilibrium, from `ReleasedForces.tension_per_wrench`,
                shape (6,); None: unknown.
        """
        self._passes, self.compliance_error = self._passes + 1, 0.0
        last_compliance, self._compliance = self._compliance, measured
        step = next((part for until, part in STEPS if self._passes <= until), 0.0)
        if last_compliance is None or measured is None or step == 1.0:
            return measured
        relaxed = last_compliance + step * (measured - last_compliance)
        difference, size = (
            float(np.linalg.norm(part * TURNS)) for part in (measured - relaxed, relaxed)
        )
        if difference > 0.0:
            self.compliance_error = difference / size if size > 0.0 else np.inf
        self._compliance = relaxed
        return relaxed

    def relaxed_forces(self, required: "MuscleShare") -> "MuscleShare":
        """Return the forces of the next pass, by those required at the last equilibrium."""
        applied, self._applied, self.converged = self._applied, required, False
        if applied is None:
            return required
        difference = required.force - applied.force
        if self._last_difference is not None:
            change = difference - self._last_difference
            factor = (
                -self._factor
                * float(self._last_difference @ change)
                / max(float(change @ change), 1e-12)
            )
            self._factor = float(np.clip(factor, LEAST, MOST))
        self._last_difference = difference
        self.converged = bool(np.abs(difference).max() < MUSCLE_FORCE_TOLERANCE)
        if not self.converged:
            self._applied = replace(
                required,
                activation=applied.activation
                + self._factor * (required.activation - applied.activation),
                force=applied.force + self._factor * difference,
                reserve=applied.reserve + self._factor * (required.reserve - applied.reserve),
            )
        return self._applied
