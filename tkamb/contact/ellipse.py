"""Hertz's solution for a point contact with an elliptical patch, with exact integrals."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipkm1, elliprd


@dataclass(frozen=True)
class EllipseSettings:
    """Hertz's contact ellipse."""

    smallest_axis_ratio: float = 1e-6
    """1: smallest ratio of the semi-axes that is solved for. Chosen: below it the contact is a line
    contact, and elliptic integrals lose their digits."""


ELLIPSE = EllipseSettings()


@dataclass(frozen=True)
class ContactEllipse:
    """The patch and what it carries.

    Args:
        long_axis: a, m, semi-axis along the smaller relative curvature.
        short_axis: b, m.
        peak_pressure: p0, Pa; p = p0 sqrt(1 - (u/a)² - (v/b)²).
        force: N, 2/3 pi a b p0.
    """

    long_axis: float
    short_axis: float
    peak_pressure: float
    force: float


def contact_ellipse(
    flat: float, steep: float, approach: float, plane_modulus: float
) -> ContactEllipse:
    """Return the patch of two bodies that approach each other, gap A u² + B v² at touch.

    With k = b/a, e² = 1 - k² and complete elliptic integrals K(e), E(e) (Johnson, Contact
    Mechanics, 1985, equations 4.24-4.32, doi:10.1017/CBO9781139171731):

        A = p0/E* b/(e² a²) [K - E]
        B = p0/E* b/(e² a²) [E/k² - K]
        delta = p0/E* b K

    [K - E]/e² and [E/k² - K]/e² are Carlson's R_D(0, k², 1)/3 and R_D(0, 1, k²)/3, which
    stay exact at k = 1. B/A fixes k; the rest follows.

    Args:
        flat: A, 1/m, positive; half the smaller relative curvature.
        steep: B >= A, 1/m.
        approach: delta, m, positive, of distant points along the normal.
        plane_modulus: E* = E/(1 - nu²), Pa (the other body rigid).
    """
    # The axis ratio follows from the curvatures alone; size and pressure then from the approach.
    ratio = _axis_ratio(steep / flat)
    # Complete elliptic integral K(1 - ratio²); `ellipkm1` keeps its digits for slender ellipses,
    # where K diverges.
    first = float(ellipkm1(ratio**2))
    long_axis = np.sqrt(approach * float(elliprd(0.0, ratio**2, 1.0)) / (3 * first * flat))
    short_axis = ratio * long_axis
    peak = plane_modulus * approach / (short_axis * first)
    # Volume of a semi-ellipsoid of height p0 over the ellipse.
    force = 2 / 3 * np.pi * long_axis * short_axis * peak
    return ContactEllipse(float(long_axis), float(short_axis), float(peak), float(force))


def _axis_ratio(curvature_ratio: float) -> float:
    """Return k = b/a for B/A >= 1."""

    def excess(log_ratio: float) -> float:
        square = np.exp(2 * log_ratio)
        both = elliprd(0.0, 1.0, square) / elliprd(0.0, square, 1.0)
        return float(np.log(both) - np.log(curvature_ratio))

    # Equal curvatures give a circle; rounding may put the root at a positive logarithm.
    if curvature_ratio <= 1.0 or excess(0.0) >= 0:
        return 1.0
    return float(np.exp(brentq(excess, np.log(ELLIPSE.smallest_axis_ratio), 0.0, xtol=1e-15)))
