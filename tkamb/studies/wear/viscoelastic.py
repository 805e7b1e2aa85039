"""Linear viscoelastic polyethylene: a Prony series."""

import math
from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class PronySeries:
    """Relaxation of a modulus, relative to its instantaneous value.

        M(t)/M_0 = 1 - sum g_i + sum g_i exp(-t/tau_i)

    Args:
        fractions: g_i, positive, below 1 together.
        times: tau_i, s.
    """

    fractions: tuple[float, ...]
    times: tuple[float, ...]

    def __post_init__(self) -> None:
        shares = all(math.isfinite(g) and g > 0 for g in self.fractions)
        if not shares or sum(self.fractions) >= 1 or len(self.fractions) != len(self.times):
            raise InputError(
                f"fractions {self.fractions} and times {self.times} are no Prony series",
                "viscoelastic",
                "as many positive fractions, below 1 together, as times",
            )
        if not all(math.isfinite(tau) and tau > 0 for tau in self.times):
            raise InputError(f"times {self.times}", "viscoelastic", "give seconds above 0")

    @property
    def equilibrium(self) -> float:
        """M(infinity)/M_0."""
        return 1.0 - sum(self.fractions)

    def relaxation(self, time: float) -> float:
        """Return M(t)/M_0 at a time (s)."""
        pairs = zip(self.fractions, self.times, strict=True)
        return self.equilibrium + sum(g * math.exp(-time / tau) for g, tau in pairs)

    def response(self, step: float) -> tuple[float, Array, Array]:
        """Return how the stress follows from the strain over a step of `step` s.

        With the strain linear in time over the step the hereditary integral is exact:

            q_i' = a_i q_i + b_i (eps' - eps),    sigma'/M_0 = equilibrium eps' + sum q_i'

        Returns:
            Slope d sigma'/d eps' relative to M_0, factors a (i,) and b (i,).
        """
        ratio = step / np.array(self.times)
        decay = np.exp(-ratio)
        weights = np.array(self.fractions) * -np.expm1(-ratio) / ratio
        return self.equilibrium + float(weights.sum()), decay, weights

    def stress(self, time: Array, strain: Array) -> Array:
        """Return the stress relative to M_0 (f, ...) of strains (f, ...), linear between times.

        The strain jumps from nothing to its first value at the first time.

        Args:
            time: (f,) s, rising.
            strain: (f, ...).
        """
        strain = np.asarray(strain, float)
        memory = np.multiply.outer(np.array(self.fractions), strain[0])
        result = [self.equilibrium * strain[0] + memory.sum(axis=0)]
        for step, before, after in zip(np.diff(time), strain[:-1], strain[1:], strict=True):
            _, decay, weights = self.response(float(step))
            memory = (memory.T * decay).T + np.multiply.outer(weights, after - before)
            result.append(self.equilibrium * after + memory.sum(axis=0))
        return np.array(result)
