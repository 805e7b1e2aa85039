"""Muscle forces that a search for equilibrium holds for a while: between the last and the new.

The sharing answers to where the knee rests, and the knee to the sharing. Where a light load
leaves the knee soft, either overshoots the other, and taken in turn they would go round in a
circle. So the forces go only a part omega of the way from those held, f, to those asked for, f',

    f <- f + omega (f' - f),   omega <- -omega d . (d' - d) / |d' - d|²,

d and d' the last two f' - f: Aitken's secant for a vector. At the end f' itself is held.

How the knee yields to the muscles decides their arms, and hangs itself on where the knee rests. It
is taken as found in the first passes; then it goes only half of the way to what is found, and a
quarter, so that it comes to rest where the contact's stiffness changes fast with the pose. Where
even that goes on and on (a condyle about to lift, whose pose jumps), it is kept at last. `doubt`
says what of it is left open.

References: Irons & Tuck, Int J Numer Methods Eng 1:275 (1969), doi:10.1002/nme.1620010306;
Küttler & Wall, Comput Mech 43:61 (2008), doi:10.1007/s00466-008-0255-5.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.knee.equilibrium.released_forces import RELEASED_FORCE

if TYPE_CHECKING:
    from tkamb.knee.crossing import MuscleShare


@dataclass(frozen=True)
class MuscleIterationSettings:
    """The iteration between muscle forces and knee equilibrium."""

    muscle_force_tolerance: float = 1.0
    """N: largest difference, over the muscles, of the force that is needed from the force that
    is applied, at which the iteration has converged."""


MUSCLE_ITERATION = MuscleIterationSettings()

LEAST, MOST = 0.05, 1.0
"""The limits of omega."""


STEPS = ((4, 1.0), (8, 0.5), (16, 0.25))
"""Until so many passes are made, how the knee yields goes that part of the way to what is found."""
TURNS = np.array(
    [1.0, 1.0, 1.0, RELEASED_FORCE.lever_arm, RELEASED_FORCE.lever_arm, RELEASED_FORCE.lever_arm]
)
"""Makes answers to forces and to moments comparable."""


class Relaxation:
    """The muscles' forces over the passes of one search.

    Attributes:
        settled: what was asked for last agrees with what was held, and is held now.
        doubt: share by which the knee yields otherwise, as last found, than it is taken to; 0:
            it is as found.
    """

    def __init__(self) -> None:
        self._held: MuscleShare | None = None
        self._last: Array | None = None
        self._part, self.settled = MOST, True
        self._yields: Array | None = None
        self._passes, self.doubt = 0, 0.0

    def yielding(self, measured: Array | None) -> Array | None:
        """Return how the knee is taken to yield.

        Args:
            measured: how it does where it rests, see `ReleasedForces.tension_per_wrench`.
        """
        self._passes, self.doubt = self._passes + 1, 0.0
        last, self._yields = self._yields, measured
        step = next((part for until, part in STEPS if self._passes <= until), 0.0)
        if last is None or measured is None or step == 1.0:
            return measured
        relaxed = last + step * (measured - last)
        away, size = (float(np.linalg.norm(part * TURNS)) for part in (measured - relaxed, relaxed))
        if away > 0.0:
            self.doubt = away / size if size > 0.0 else np.inf
        self._yields = relaxed
        return relaxed

    def mixed(self, required: "MuscleShare") -> "MuscleShare":
        """Return the forces to hold next.

        Args:
            required: the sharing where the knee rested under those held before.
        """
        applied, self._held, self.settled = self._held, required, False
        if applied is None:
            return required
        away = required.force - applied.force
        if self._last is not None:
            change = away - self._last
            part = -self._part * float(self._last @ change) / max(float(change @ change), 1e-12)
            self._part = float(np.clip(part, LEAST, MOST))
        self._last = away
        self.settled = bool(np.abs(away).max() < MUSCLE_ITERATION.muscle_force_tolerance)
        if not self.settled:
            self._held = replace(
                required,
                activation=applied.activation
                + self._part * (required.activation - applied.activation),
                force=applied.force + self._part * away,
                reserve=applied.reserve + self._part * (required.reserve - applied.reserve),
            )
        return self._held
