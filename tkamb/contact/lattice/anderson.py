"""Anderson acceleration of a fixed-point iteration.

Reference: Walker & Ni, SIAM J Numer Anal 49:1715 (2011), doi:10.1137/10078356X.
"""

import numpy as np

from tkamb.geometry.frames import Array


class AndersonMixer:
    """Proposes the next iterate of x = g(x) from the last few.

    Args:
        depth: how many differences are kept.
    """

    def __init__(self, depth: int = 6) -> None:
        self._depth = depth
        self._last: tuple[Array, Array] | None = None
        self._values: list[Array] = []
        self._residuals: list[Array] = []

    def next(self, x: Array, value: Array) -> Array:
        """Return the next x, given value = g(x)."""
        residual = value - x
        if self._last is not None:
            self._values.append(value - self._last[0])
            self._residuals.append(residual - self._last[1])
            del self._values[: -self._depth], self._residuals[: -self._depth]
        self._last = (value, residual)
        if not self._residuals:
            return value
        differences = np.stack(self._residuals)
        gram = differences @ differences.T
        gram[np.diag_indices(len(gram))] *= 1 + 1e-12
        weights = np.linalg.lstsq(gram, differences @ residual, rcond=1e-14)[0]
        return value - weights @ np.stack(self._values)
