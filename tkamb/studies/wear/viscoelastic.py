"""Linear viscoelastic polyethylene: a Prony series, and a bed of columns that obey it."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from tkamb.contact.foundation import FOUNDATION
from tkamb.contact.samples import SurfaceSamples, gaps_along_normals
from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface


@dataclass(frozen=True)
class ViscoelasticBedSettings:
    """The press into a viscoelastic bed."""

    max_approach: float = 5e-3
    """m: largest approach in one step. Chosen: half a usual insert's thickness."""
    approach_tolerance: float = 1e-9
    """m; tolerance of the approach that carries a load. Chosen: far below what changes a force."""


VISCOELASTIC_BED = ViscoelasticBedSettings()


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


class ViscoelasticBed:
    """Columns of springs and dampers under a rigid femoral component, step by step.

    Each column of the bed (`tkamb.contact.samples`) has the linear foundation's pressure p = M d/h
    with M relaxing as a Prony series. A column that the femur leaves carries nothing and creeps
    back: its strain is then the one at which its stress is zero. The load acts along -y.

    Limits: as the linear elastic foundation; one modulus, relaxing in volume and shape alike.

    Args:
        bed: the sampled articular surface.
        femoral: the femoral component, in its own frame.
        modulus: M_0, Pa, instantaneous and confined.
        series: its relaxation.
    """

    def __init__(
        self, bed: SurfaceSamples, femoral: Surface, modulus: float, series: PronySeries
    ) -> None:
        self._bed, self._femoral, self._modulus, self._series = bed, femoral, modulus, series
        self._strain = np.zeros(len(bed.points))
        self._memory = np.zeros((len(series.times), len(bed.points)))

    def press(self, load: float, pose: Array, step: float) -> Array:
        """Go on by `step` s to a load (N) at a pose whose y is free; return the pressure (n,) Pa.

        Raises:
            InputError: the load cannot be carried within
                `VISCOELASTIC_BED.max_approach` of the pose's y.
        """

        def missing(fall: float) -> float:
            result = self._pressed(pose, fall, step)[1]
            return float((result * self._bed.area) @ self._bed.normals[:, 1]) - load

        if (
            missing(-VISCOELASTIC_BED.max_approach) > 0
            or missing(VISCOELASTIC_BED.max_approach) < 0
        ):
            raise InputError(f"a load of {load:g} N cannot be reached", "viscoelastic")
        fall = brentq(
            missing,
            -VISCOELASTIC_BED.max_approach,
            VISCOELASTIC_BED.max_approach,
            xtol=VISCOELASTIC_BED.approach_tolerance,
        )
        strain, pressure = self._pressed(pose, fall, step)
        _, decay, weights = self._series.response(step)
        self._memory = decay[:, None] * self._memory + weights[:, None] * (strain - self._strain)
        self._strain = strain
        return pressure

    def _pressed(self, pose: Array, fall: float, step: float) -> tuple[Array, Array]:
        """Return strains and pressures (n,) with the femur `fall` below its pose."""
        pressed_pose = np.array(pose, float)
        pressed_pose[1, 3] -= fall
        gap = gaps_along_normals(self._bed, self._femoral, pressed_pose)
        asked = -gap / np.maximum(self._bed.thickness, FOUNDATION.least_thickness)
        slope, decay, weights = self._series.response(step)
        relaxed = decay @ self._memory - weights.sum() * self._strain
        free = -relaxed / slope  # strain at which the stress is zero
        strain = np.maximum(asked, free)
        return strain, self._modulus * np.maximum(slope * strain + relaxed, 0.0)
