"""Axisymmetric contact of a rigid sphere with an elastic layer bonded to a rigid base.

An independent reference for Hertz's problem on a block of finite thickness. Surface
displacement under a pressure with Hankel transform P(k), frictionless:

    u(r) = 2 (1 - nu²)/E ∫ L(k t) P(k) J0(k r) dk
    L(w) = (2 κ sinh 2w - 4 w)/(2 κ cosh 2w + 1 + κ² + 4 w²),   κ = 3 - 4 nu

Elliptic integrals give the half-space part (L = 1) in closed form. Quadrature gives the rest.
Reference: Johnson, Contact Mechanics (1985), sections 3.4 and 5.8.
"""

import numpy as np
from scipy.special import ellipe, ellipk, j0, j1


def sphere_on_layer(radius, thickness, load, young, nu, rings=160):
    """Return contact radius, approach, mean radii of the rings, and their pressures (SI)."""
    low, high = 1e-6, 0.5 * thickness + radius * 0.2
    for _ in range(60):
        a = 0.5 * (low + high)
        force, approach, middles, pressure = _indent(radius, thickness, a, young, nu, rings)
        low, high = (a, high) if force < load else (low, a)
    return a, approach, middles, pressure


def _indent(radius, thickness, a, young, nu, rings):
    """Return load, approach and pressures for a given contact radius."""
    t = (np.arange(rings + 1) / rings) * np.pi / 2
    edges = a * np.sin(t)
    middles = a * np.sin((t[1:] + t[:-1]) / 2)
    disk = _disks(middles, edges[1:], thickness, young, nu)
    matrix = disk - np.column_stack([np.zeros(rings), disk[:, :-1]])
    full = np.zeros((rings + 1, rings + 1))
    full[:rings, :rings] = matrix
    full[:rings, rings] = -1.0
    # Near the edge the pressure is proportional to sqrt(1 - (r/a)²). The last two rings obey this.
    s = np.sqrt(1 - (middles[-2:] / a) ** 2)
    full[rings, rings - 2 : rings] = [s[1], -s[0]]
    right = np.append(-(middles**2) / (2 * radius), 0.0)
    solution = np.linalg.solve(full, right)
    pressure = solution[:rings]
    area = np.pi * np.diff(edges**2)
    return float(pressure @ area), float(solution[rings]), middles, pressure


def _disks(at, radii, thickness, young, nu):
    """Return displacements (n, m) at radii `at` (n,) under unit pressure on disks (m,)."""
    r, b = at[:, None], radii[None]
    m = np.minimum(r / b, b / r) ** 2
    inside = 4 * b / np.pi * ellipe(m)
    outside = 4 * r / np.pi * (ellipe(m) - (1 - m) * ellipk(m))
    half_space = np.where(r < b, inside, outside) / 2
    nodes, weights = np.polynomial.legendre.leggauss(200)
    k = (nodes + 1) * 10 / thickness
    w = k * thickness
    kappa = 3 - 4 * nu
    layer = (2 * kappa * np.sinh(2 * w) - 4 * w) / (
        2 * kappa * np.cosh(2 * w) + 1 + kappa**2 + 4 * w**2
    ) - 1
    transform = radii[:, None] * j1(k[None] * radii[:, None]) / k
    correction = j0(k[None] * at[:, None]) @ (layer * weights * 10 / thickness * transform).T
    return 2 * (1 - nu**2) / young * (half_space + correction)
