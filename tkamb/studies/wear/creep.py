"""Creep of polyethylene under a repeated load: the logarithmic law of time."""

import math
from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.units import MEGAPASCAL

MINUTE = 60.0


@dataclass(frozen=True)
class LogarithmicCreep:
    """Creep strain proportional to pressure, and to the logarithm of time under it.

        strain(t) = p (c + b log10(t / t_ref)),        depth = strain times thickness

    p the time-mean pressure of the cycle. Before the time at which the bracket is zero the
    strain is zero. Where the pressure changes from block to block, each block adds the strain of
    the law between its own two times (time hardening).

    Args:
        compliance_per_MPa: c, strain per MPa at the reference time.
        per_decade_per_MPa: b, strain per MPa and tenfold time.
        reference_min: t_ref, minutes.
    """

    compliance_per_MPa: float
    per_decade_per_MPa: float
    reference_min: float

    def __post_init__(self) -> None:
        for key, lowest in (("compliance_per_MPa", 0.0), ("per_decade_per_MPa", 0.0)):
            value = getattr(self, key)
            if not (math.isfinite(value) and lowest <= value < 1.0):
                raise InputError(f"cannot be {value}", f"[creep] {key}", "give 0 to 1 per MPa")
        if not (math.isfinite(self.reference_min) and self.reference_min > 0):
            raise InputError(
                f"cannot be {self.reference_min}", "[creep] reference_min", "give minutes above 0"
            )

    def times(self, factor: float) -> "LogarithmicCreep":
        """Return the law with both constants times a factor."""
        compliance, per_decade = self.compliance_per_MPa, self.per_decade_per_MPa
        return LogarithmicCreep(compliance * factor, per_decade * factor, self.reference_min)

    def strain_per_pascal(self, time: float) -> float:
        """Return the strain per Pa of constant pressure after `time` (s)."""
        if time <= 0:
            return 0.0
        decades = math.log10(time / (self.reference_min * MINUTE))
        rise = self.compliance_per_MPa + self.per_decade_per_MPa * decades
        return max(rise, 0.0) / MEGAPASCAL

    def depth(self, pressure: Array, thickness: Array, begin: float, end: float) -> Array:
        """Return the depth (n,) m that creep adds between two times (s).

        Args:
            pressure: (n,) Pa, mean over time.
            thickness: (n,) m, of the insert under each point, along its normal.
            begin: s since the first load.
            end: s since the first load.
        """
        rise = self.strain_per_pascal(end) - self.strain_per_pascal(begin)
        return np.asarray(rise * pressure * thickness)
