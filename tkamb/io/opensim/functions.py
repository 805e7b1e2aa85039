"""OpenSim's functions of one variable, with their first and second derivatives.

Every function takes an array of any shape and returns an array of the same shape.

Reference: Forsythe, Malcolm & Moler, Computer Methods for Mathematical Computations (1977),
chapter 4, for the spline's end conditions.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import PPoly, make_interp_spline

from tkamb.geometry.frames import Array


class Function(Protocol):
    """A function of one variable with its first two derivatives."""

    def __call__(self, x: Array) -> Array:
        """Return the values at x."""
        ...

    def slope(self, x: Array) -> Array:
        """Return the first derivatives at x."""
        ...

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives at x."""
        ...


@dataclass(frozen=True)
class Linear:
    """f(x) = gradient x + offset; a constant has gradient 0."""

    gradient: float
    offset: float

    def __call__(self, x: Array) -> Array:
        """Return the values at x."""
        return self.gradient * x + self.offset

    def slope(self, x: Array) -> Array:
        """Return the first derivatives at x."""
        return np.full_like(x, self.gradient)

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives at x."""
        return np.zeros_like(x)


@dataclass(frozen=True, eq=False)
class Polynomial:
    """f(x) = c_0 xⁿ + … + c_n.

    Args:
        coefficients: (n+1,), beginning with the coefficient of the highest power.
    """

    coefficients: Array

    def __call__(self, x: Array) -> Array:
        """Return the values at x."""
        return np.asarray(np.polyval(self.coefficients, x), float)

    def slope(self, x: Array) -> Array:
        """Return the first derivatives at x."""
        return np.asarray(np.polyval(np.polyder(self.coefficients), x))

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives at x."""
        return np.asarray(np.polyval(np.polyder(self.coefficients, 2), x))


class Piecewise:
    """A piecewise polynomial with linear extrapolation beyond its ends."""

    def __init__(self, pieces: PPoly) -> None:
        self._value, self._slope = pieces, pieces.derivative()
        self._curvature = pieces.derivative(2)
        self.first, self.last = float(pieces.x[0]), float(pieces.x[-1])

    def __call__(self, x: Array) -> Array:
        """Return the values at x."""
        inside = np.clip(x, self.first, self.last)
        return self._value(inside) + self._slope(inside) * (x - inside)

    def slope(self, x: Array) -> Array:
        """Return the first derivatives at x."""
        return self._slope(np.clip(x, self.first, self.last))

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives at x; zero beyond the ends."""
        return np.where((x < self.first) | (x > self.last), 0.0, self._curvature(x))


@dataclass(frozen=True)
class Scaled:
    """f(x) = factor · inner(x): OpenSim's MultiplierFunction."""

    inner: Function
    factor: float

    def __call__(self, x: Array) -> Array:
        """Return the values at x."""
        return self.factor * self.inner(x)

    def slope(self, x: Array) -> Array:
        """Return the first derivatives at x."""
        return self.factor * self.inner.slope(x)

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives at x."""
        return self.factor * self.inner.curvature(x)


def piecewise_linear(x: Array, y: Array) -> Piecewise:
    """Return the polyline through n >= 2 points x, y of shape (n,) with increasing x."""
    return Piecewise(PPoly(np.stack([np.diff(y) / np.diff(x), y[:-1]]), x))


def simm_spline(x: Array, y: Array) -> Piecewise:
    """Return SIMM's cubic spline through n >= 2 points x, y of shape (n,) with increasing x.

    The third derivative in the first interval is that of the cubic through the first four points.
    The last interval uses the last four points. With three points the third derivative is zero;
    with two points the spline is a straight line. The spline is not a natural spline.
    """
    if len(x) == 2:
        return piecewise_linear(x, y)
    ends = (0.0, 0.0)
    if len(x) > 3:
        ends = (6.0 * _third_difference(x[:4], y[:4]), 6.0 * _third_difference(x[-4:], y[-4:]))
    conditions = [(3, ends[0])], [(3, ends[1])]
    return Piecewise(PPoly.from_spline(make_interp_spline(x, y, k=3, bc_type=conditions)))


def _third_difference(x: Array, y: Array) -> float:
    """Return the third divided difference of four points, f'''/6 of the cubic through them."""
    for order in (1, 2, 3):
        y = np.diff(y) / (x[order:] - x[:-order])
    return float(y[0])
