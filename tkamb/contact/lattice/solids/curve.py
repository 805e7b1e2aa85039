"""The material's one-dimensional law as a secant shear modulus.

J2 deformation theory with an elastic bulk: under uniaxial stress sigma the strain is
eps = e + sigma/(9 K), with e the equivalent deviatoric strain and K the bulk modulus, so that

    q(e) = sigma(eps),   e = eps - sigma(eps)/(9 K),   3 mu_s = q(e)/e

reproduces sigma(eps) exactly. e grows with eps, because the tangent never exceeds E and
E/(9 K) = (1 - 2 nu)/3 < 1. Strains are engineering strains of the undeformed shape.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from tkamb.contact.materials import Material
from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class StressCurveSettings:
    """A measured stress-strain curve."""

    least_strain: float = 1e-9
    """1: below this strain the secant modulus is that at this strain. Chosen: above zero, where
    stress over strain is 0/0."""


STRESS_CURVE = StressCurveSettings()

_STRAINS = np.concatenate([[0.0], np.geomspace(1e-7, 20.0, 6000)])


@dataclass(frozen=True, eq=False)
class ShearCurve:
    """Equivalent stress over equivalent deviatoric strain.

    Args:
        shear_modulus: mu at zero strain, Pa.
        spline: q(e), Pa, or None for a linear material.
    """

    shear_modulus: float
    spline: CubicHermiteSpline | None

    @classmethod
    def of(cls, material: Material) -> "ShearCurve":
        """Return the curve of a material, sampled finely with exact slopes."""
        if material.is_linear:
            return cls(material.shear_modulus, None)
        stress, tangent = material.stress(_STRAINS), material.tangent(_STRAINS)
        nine_bulk = 9 * material.bulk_modulus
        # Uniaxial strain minus its volumetric part leaves the equivalent deviatoric strain: e = eps
        # - s / (9 K).
        strain = _STRAINS - stress / nine_bulk
        # Chain rule: ds/de from ds/deps.
        spline = CubicHermiteSpline(strain, stress, tangent / (1 - tangent / nine_bulk))
        return cls(material.shear_modulus, spline)

    def modulus(self, equivalent: Array) -> Array:
        """Return the secant shear modulus mu_s, Pa, at equivalent strains e >= 0."""
        if self.spline is None:
            return np.full_like(equivalent, self.shear_modulus)
        floored = np.clip(equivalent, STRESS_CURVE.least_strain, self.spline.x[-1])
        return self.spline(floored) / (3 * floored)

    def softening(self, equivalent: Array) -> Array:
        """Return (d mu_s / d e) / e, Pa, at equivalent strains e >= 0: never positive."""
        if self.spline is None:
            return np.zeros_like(equivalent)
        floored = np.clip(equivalent, STRESS_CURVE.least_strain, self.spline.x[-1])
        slope = self.spline(floored, 1) / 3 - self.modulus(floored)
        # Below this strain the curve is elastic and the quotient is rounding.
        return np.where(equivalent < 1e-7, 0.0, slope / floored**2)
