"""Recorded envelopes in the sharing of the muscles: as targets, or as bounds."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.run.muscles.static_optimisation import LoadSharing


@dataclass(frozen=True, eq=False)
class EmgGuide:
    """What envelopes e ask of the activations a.

    - "target" adds Σ_i W (a_i - e_i)² to the cost, W the weight;
    - "bounds" holds a_i within e_i ± width, as far as that lies within the bounds of all.

    Args:
        envelope: (f, m) normalised; NaN for muscles without EMG.
        use: which of the two.
        size: W, or the width.
    """

    envelope: Array
    use: Literal["target", "bounds"]
    size: float

    def only(self, k: int) -> "EmgGuide":
        """Return that of frame k alone."""
        return replace(self, envelope=self.envelope[k : k + 1])

    def applied(self, problem: LoadSharing, k: int) -> LoadSharing:
        """Return the problem of frame k with its envelopes in it."""
        finite, expected = np.isfinite(self.envelope[k]), np.nan_to_num(self.envelope[k])
        if self.use == "target":
            spread = np.where(finite, self.size**-0.5, np.inf)
            return replace(problem, expected=expected, spread=spread)
        low, high = (
            np.clip(expected + sign * self.size, problem.lowest, problem.highest)
            for sign in (-1.0, 1.0)
        )
        return replace(
            problem,
            lowest=np.where(finite, low, problem.lowest),
            highest=np.where(finite, high, problem.highest),
        )
