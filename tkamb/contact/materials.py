"""The material of the insert: one-dimensional stress-strain laws and Poisson's ratio.

The laws relate true (Cauchy) stress to true (logarithmic) strain, like the measured polyethylene
data, with one curve for tension and compression, loading and unloading, without hysteresis or
permanent set. A small-strain model uses its engineering strain in the law; the two strains differ
by 5 % at 10 % strain.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from tkamb.errors import InputError, names_near
from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array
from tkamb.units import MEGAPASCAL

MOST_STEPS = 60
"""Largest number of Newton steps for one strain; most strains need five."""
ROUNDING = 2e-16
"""1: relative size of a Newton step below which the solution has converged."""


class StressStrainLaw(Protocol):
    """A stress-strain law; its slope at the origin is Young's modulus, Pa."""

    def stress(self, strain: Array, young_modulus: float) -> Array:
        """Return stress, Pa."""

    def tangent(self, strain: Array, young_modulus: float) -> Array:
        """Return d stress / d strain, Pa."""


@dataclass(frozen=True)
class LinearElastic:
    """Hooke's law: sigma = E eps, at any strain."""

    def stress(self, strain: Array, young_modulus: float) -> Array:
        """Return stress, Pa."""
        return young_modulus * strain

    def tangent(self, strain: Array, young_modulus: float) -> Array:
        """Return the constant tangent, Pa."""
        return np.full_like(strain, young_modulus)


@dataclass(frozen=True)
class RambergOsgood:
    """The law of Ramberg and Osgood: eps = sigma/E + alpha (|sigma|/sigma0)^(n-1) sigma/E.

    Newton's method solves u + alpha u^n = E |eps| / sigma0 for u = |sigma|/sigma0 to machine
    precision, for every strain up to 1000; NaN gives NaN. Beyond the measured strain it is an
    extrapolation, without a singularity at -100 %.

    Args:
        alpha: yield offset, >= 0.
        reference_stress: sigma0, Pa.
        exponent: n, >= 1.

    Reference: Ramberg & Osgood, NACA Technical Note 902 (1943).
    """

    alpha: float
    reference_stress: float
    exponent: float

    def __post_init__(self) -> None:
        if not (self.alpha >= 0 and self.reference_stress > 0 and self.exponent >= 1):
            raise InputError(
                f"alpha={self.alpha}, reference_stress={self.reference_stress}, "
                f"exponent={self.exponent} is no Ramberg-Osgood law",
                "material",
                "alpha >= 0, reference_stress > 0 and exponent >= 1 are needed",
            )

    def stress(self, strain: Array, young_modulus: float) -> Array:
        """Return stress, Pa."""
        return np.sign(strain) * self.reference_stress * self._ratio(strain, young_modulus)

    def tangent(self, strain: Array, young_modulus: float) -> Array:
        """Return d sigma / d eps = E / (1 + alpha n u^(n-1)), Pa."""
        ratio = self._ratio(strain, young_modulus)
        softening = self.alpha * self.exponent * ratio ** (self.exponent - 1)
        return young_modulus / (1 + softening)

    def _ratio(self, strain: Array, young_modulus: float) -> Array:
        elastic = np.abs(strain) * (young_modulus / self.reference_stress)
        if self.alpha == 0:
            return elastic
        ratio = np.empty(elastic.size)
        _solve_ratio(elastic.ravel(), float(self.alpha), float(self.exponent), ratio)
        return ratio.reshape(elastic.shape)


@compiled_as_written
def _solve_ratio(elastic: Array, alpha: float, exponent: float, ratio: Array) -> None:
    """Write the solutions u (n,) of u + alpha u^n = elastic (n,) >= 0."""
    for k in range(len(elastic)):
        # The solution with the elastic or the plastic term alone is an upper bound of u. Newton's
        # method falls monotonically from the smaller bound, because the function is convex.
        u, plastic = elastic[k], (elastic[k] / alpha) ** (1.0 / exponent)
        if plastic < u:
            u = plastic
        for _ in range(MOST_STEPS):
            power = alpha * u ** (exponent - 1.0)
            step = (u + power * u - elastic[k]) / (1.0 + exponent * power)
            u -= step
            if u < 0.0:
                u = 0.0
            if not abs(step) > ROUNDING * u:  # also where it is NaN
                break
        ratio[k] = u


@dataclass(frozen=True)
class TabulatedLaw:
    """A measured true stress-strain curve, interpolated by a monotone cubic (PCHIP).

    The table is mirrored through the origin and scaled so that its slope there is the given Young's
    modulus. Beyond the last point the curve is straight, with the slope of the last chord.

    Args:
        strain: strains, increasing from 0.
        values: stresses at these strains, Pa, not falling, from 0.
    """

    strain: tuple[float, ...]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        strain, values = np.asarray(self.strain, float), np.asarray(self.values, float)
        sound = (
            strain.ndim == 1
            and strain.shape == values.shape
            and len(strain) >= 2
            and np.isfinite([strain, values]).all()
            and strain[0] == values[0] == 0
            and (np.diff(strain) > 0).all()
            and (np.diff(values) >= 0).all()
            and values[1] > 0
        )
        if not sound:
            raise InputError(
                "is no stress-strain table",
                "material",
                "give two equally long finite columns from (0, 0), strain increasing, "
                "stress not falling",
            )

    @cached_property
    def _curve(self) -> PchipInterpolator:
        """The mirrored table, extended by one step of the last chord."""
        strain, values = np.asarray(self.strain, float), np.asarray(self.values, float)
        # The extra point continues the last chord. Without it PCHIP's end condition would change
        # the slope at the table's last point.
        strain = np.append(strain, 2 * strain[-1] - strain[-2])
        values = np.append(values, 2 * values[-1] - values[-2])
        # The mirror image makes tension equal to compression and removes the end condition at zero.
        # PCHIP is monotone: the stress does not fall between points.
        return PchipInterpolator(
            np.concatenate([-strain[:0:-1], strain]), np.concatenate([-values[:0:-1], values])
        )

    @cached_property
    def _slope(self) -> PchipInterpolator:
        return self._curve.derivative()

    @cached_property
    def young_modulus(self) -> float:
        """Slope of the table at the origin, Pa."""
        return float(self._slope(0.0))

    def stress(self, strain: Array, young_modulus: float) -> Array:
        """Return stress, Pa."""
        inside = np.clip(strain, -self.strain[-1], self.strain[-1])
        # Beyond the table the curve continues with its last slope.
        beyond = (strain - inside) * self._slope(self.strain[-1])
        return (self._curve(inside) + beyond) * (young_modulus / self.young_modulus)

    def tangent(self, strain: Array, young_modulus: float) -> Array:
        """Return d stress / d strain, Pa."""
        inside = np.clip(strain, -self.strain[-1], self.strain[-1])
        return self._slope(inside) * (young_modulus / self.young_modulus)


@dataclass(frozen=True)
class Material:
    """An isotropic material with a one-dimensional stress-strain law.

    Args:
        young_modulus: E, Pa, the slope at the origin.
        poisson_ratio: nu, -1 < nu < 0.5.
        sources: origin of the numbers; not compared between materials.

    Raises:
        InputError: E not positive and finite, or nu out of range.
    """

    name: str
    young_modulus: float
    poisson_ratio: float
    law: StressStrainLaw = LinearElastic()
    sources: tuple[str, ...] = field(default=(), repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0 < self.young_modulus < np.inf:
            raise InputError(
                f"Young's modulus {self.young_modulus} Pa", f"material '{self.name}'", "give > 0"
            )
        if not -1 < self.poisson_ratio < 0.5:
            raise InputError(
                f"Poisson's ratio {self.poisson_ratio}",
                f"material '{self.name}'",
                "give a value between -1 and 0.5",
            )

    @property
    def is_linear(self) -> bool:
        """Whether stress is proportional to strain."""
        # A subclass may have other stresses.
        return type(self.law) is LinearElastic

    @property
    def shear_modulus(self) -> float:
        """G = E / (2 (1 + nu)), Pa, at the origin."""
        return self.young_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def bulk_modulus(self) -> float:
        """K = E / (3 (1 - 2 nu)), Pa, at the origin."""
        return self.young_modulus / (3 * (1 - 2 * self.poisson_ratio))

    @property
    def confined_modulus(self) -> float:
        """M = E (1 - nu) / ((1 + nu)(1 - 2 nu)), Pa, at the origin; without lateral strain."""
        nu = self.poisson_ratio
        return self.young_modulus * (1 - nu) / ((1 + nu) * (1 - 2 * nu))

    def stress(self, strain: ArrayLike) -> Array:
        """Return the stress (Pa) at strains of any shape; both are positive in tension."""
        return self.law.stress(np.asarray(strain, float), self.young_modulus)

    def tangent(self, strain: ArrayLike) -> Array:
        """Return d stress / d strain (Pa) at strains of any shape."""
        return self.law.tangent(np.asarray(strain, float), self.young_modulus)

    def secant(self, strain: ArrayLike) -> Array:
        """Return stress / strain (Pa) at strains of any shape; E where the strain is 0."""
        strain = np.asarray(strain, float)
        zero = strain == 0
        ratio = self.stress(strain) / np.where(zero, 1.0, strain)
        return np.where(zero, self.young_modulus, ratio)


_POLYETHYLENE = {
    "young_modulus": 561.5 * MEGAPASCAL,
    "poisson_ratio": 0.45,
    "alpha": 0.0389,
    "reference_stress": 8.4194 * MEGAPASCAL,
    "exponent": 4.5485,
}
_SOURCES = (
    "Sharma (2008), section 5.2: Ramberg-Osgood fit to the true stress-strain data of UHMWPE in "
    "Halloran et al., J Biomech 38:323 (2005), doi:10.1016/j.jbiomech.2004.02.046",
)

MATERIALS = {
    "polyethylene": "Ramberg-Osgood fit to true stress-strain of UHMWPE, E 561.5 MPa, nu 0.45",
    "polyethylene-linear": "linear elastic, E 561.5 MPa, nu 0.45",
}
"""Names of the built-in materials, and their descriptions."""


def material(name: str, **overrides: float) -> Material:
    """Return the built-in material of a name.

    `overrides` are other values of young_modulus (Pa), poisson_ratio; for "polyethylene" also
    alpha, reference_stress (Pa), exponent.

    Raises:
        InputError: unknown name or override, or a value out of range.
    """
    if name not in MATERIALS:
        raise InputError(f"no material '{name}'", hint=names_near(name, MATERIALS))
    linear = name == "polyethylene-linear"
    allowed = ("young_modulus", "poisson_ratio") if linear else tuple(_POLYETHYLENE)
    for key in overrides:
        if key not in allowed:
            raise InputError(
                f"material '{name}' has no '{key}'", hint=f"it has: {', '.join(allowed)}"
            )
    values = {**_POLYETHYLENE, **overrides}
    law: StressStrainLaw = LinearElastic()
    if not linear:
        law = RambergOsgood(values["alpha"], values["reference_stress"], values["exponent"])
    return Material(name, values["young_modulus"], values["poisson_ratio"], law, _SOURCES)


def tabulated_material(
    name: str, strain: ArrayLike, stress: ArrayLike, poisson_ratio: float
) -> Material:
    """Return a material from a true stress-strain table; see `TabulatedLaw`.

    `strain` and `stress` (Pa) have the shape (n,); `name` is for messages.

    Raises:
        InputError: the table does not rise from (0, 0).
    """
    law = TabulatedLaw(
        tuple(np.asarray(strain, float).ravel().tolist()),
        tuple(np.asarray(stress, float).ravel().tolist()),
    )
    return Material(name, law.young_modulus, poisson_ratio, law)
