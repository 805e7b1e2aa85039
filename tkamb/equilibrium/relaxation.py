"""Muscle forces that a search for equilibrium holds for a while: between the last and the new.

The sharing answers to where the knee rests, and the knee to the sharing. Where a light load
leaves the knee soft, either overshoots the other, and taken in turn they would go round in a
circle. So the forces go only a part omega of the way from those held, f, to those asked for, f',

    f <- f + omega (f' - f),   omega <- -omega d . (d' - d) / |d' - d|²,

d and d' the last two f' - f: Aitken's secant for a vector. At the end f' itself is held.

How the knee yields to the muscles, which decides their arms, is found anew until the forces settle
where the contact's stiffness is a smooth function of the pose, so that the answer does not hang on
where the search began. Else, and where they do not settle (a condyle that rests on a few columns),
in the first passes only: forces that follow each of its jumps never would.

References: Irons & Tuck, Int J Numer Methods Eng 1:275 (1969), doi:10.1002/nme.1620010306;
Küttler & Wall, Comput Mech 43:61 (2008), doi:10.1007/s00466-008-0255-5.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array

if TYPE_CHECKING:
    from tkamb.body.crossing import MuscleShare

AGREED = 1.0
"""N: no muscle's force asked for differs by more from the one held where both agree."""
LEAST, MOST = 0.05, 1.0
"""The limits of omega."""


FRESH, FRESH_IF_SMOOTH = 3, 8
"""In so many passes it is found anew how the knee yields."""


class Relaxation:
    """The muscles' forces over the passes of one search.

    Attributes:
        settled: what was asked for last agrees with what was held, and is held now.
    """

    def __init__(self) -> None:
        self._held: MuscleShare | None = None
        self._last: Array | None = None
        self._part, self.settled = MOST, True
        self._yields: Array | None = None
        self._passes = 0

    def kept(self, found: Callable[[], Array | None], smooth: bool) -> Array | None:
        """Return how the knee yields, from `found` in the first passes.

        Args:
            found: computes it.
            smooth: it is a smooth function of the pose.
        """
        if self._passes < (FRESH_IF_SMOOTH if smooth else FRESH):
            self._yields = found()
        self._passes += 1
        return self._yields

    def mixed(self, asked: "MuscleShare") -> "MuscleShare":
        """Return the forces to hold next.

        Args:
            asked: the sharing where the knee rested under those held before.
        """
        held, self._held, self.settled = self._held, asked, False
        if held is None:
            return asked
        away = asked.force - held.force
        if self._last is not None:
            change = away - self._last
            part = -self._part * float(self._last @ change) / max(float(change @ change), 1e-12)
            self._part = float(np.clip(part, LEAST, MOST))
        self._last = away
        self.settled = bool(np.abs(away).max() < AGREED)
        if not self.settled:
            self._held = replace(
                asked,
                activation=held.activation + self._part * (asked.activation - held.activation),
                force=held.force + self._part * away,
                reserve=held.reserve + self._part * (asked.reserve - held.reserve),
            )
        return self._held
