"""A rigid sphere on an elastic layer bonded to a rigid base: the exact axisymmetric contact.

Surface displacement under a pressure with Hankel transform P(k), frictionless:

    u(r) = 2 (1 - nu²)/E ∫ L(k t) P(k) J0(k r) dk
    L(w) = (2 κ sinh 2w - 4 w)/(2 κ cosh 2w + 1 + κ² + 4 w²),   κ = 3 - 4 nu

The half-space part (L = 1) is closed by elliptic integrals, the rest by quadrature.
Reference: Johnson, Contact Mechanics (1985), sections 3.4 and 5.8.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ellipe, ellipk, j0, j1

from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class ElasticLayerSettings:
    """The numerical solution of a layer under a sphere."""

    rings: int = 160
    """Rings of constant pressure under the sphere. Chosen: twice as many change the result by less
    than is compared."""
    half_space_wave_number: float = 60.0
    """Wave number times thickness beyond which the layer is a half space. Chosen: the difference is
    below rounding."""


ELASTIC_LAYER = ElasticLayerSettings()


@dataclass(frozen=True, eq=False)
class LayerContact:
    """The contact.

    Args:
        contact_radius: m.
        approach: m.
        radii: (n,) m, middles of the rings.
        pressure: (n,) Pa.
    """

    contact_radius: float
    approach: float
    radii: Array
    pressure: Array


def sphere_on_layer(
    radius: float, thickness: float, load: float, young_modulus: float, poisson_ratio: float
) -> LayerContact:
    """Return the contact of a sphere (paraboloid) that carries a load.

    Args:
        radius: m, of the sphere.
        thickness: m, of the layer.
        load: N.
        young_modulus: Pa, of the layer.
        poisson_ratio: of the layer.
    """
    low, high = 1e-6, 0.5 * thickness + 0.2 * radius
    for _ in range(60):
        middle = 0.5 * (low + high)
        result, force = _indented(radius, thickness, middle, young_modulus, poisson_ratio)
        low, high = (middle, high) if force < load else (low, middle)
    return result


def _indented(
    radius: float, thickness: float, contact: float, young: float, nu: float
) -> tuple[LayerContact, float]:
    """Return the contact of a given radius and its load (N)."""
    angle = np.linspace(0.0, np.pi / 2, ELASTIC_LAYER.rings + 1)
    edges, middles = contact * np.sin(angle), contact * np.sin((angle[1:] + angle[:-1]) / 2)
    disk = _disks(middles, edges[1:], thickness, young, nu)
    full = np.zeros((ELASTIC_LAYER.rings + 1, ELASTIC_LAYER.rings + 1))
    full[: ELASTIC_LAYER.rings, : ELASTIC_LAYER.rings] = disk - np.column_stack(
        [np.zeros(ELASTIC_LAYER.rings), disk[:, :-1]]
    )
    full[: ELASTIC_LAYER.rings, ELASTIC_LAYER.rings] = -1.0
    root = np.sqrt(1 - (middles[-2:] / contact) ** 2)
    full[ELASTIC_LAYER.rings, ELASTIC_LAYER.rings - 2 : ELASTIC_LAYER.rings] = [root[1], -root[0]]
    solution = np.linalg.solve(full, np.append(-(middles**2) / (2 * radius), 0.0))
    pressure = solution[: ELASTIC_LAYER.rings]
    force = float(pressure @ (np.pi * np.diff(edges**2)))
    return LayerContact(contact, float(solution[ELASTIC_LAYER.rings]), middles, pressure), force


def _disks(at: Array, radii: Array, thickness: float, young: float, nu: float) -> Array:
    """Return the displacement (n, m) at radii `at` (n,) under unit pressure on disks (m,)."""
    r, b = at[:, None], radii[None]
    share = np.minimum(r / b, b / r) ** 2
    inside = 4 * b / np.pi * ellipe(share)
    outside = 4 * r / np.pi * (ellipe(share) - (1 - share) * ellipk(share))
    half_space = np.where(r < b, inside, outside) / 2
    nodes, weights = np.polynomial.legendre.leggauss(400)
    w = (nodes + 1) * ELASTIC_LAYER.half_space_wave_number / 2
    k, kappa = w / thickness, 3 - 4 * nu
    layer = (2 * kappa * np.sinh(2 * w) - 4 * w) / (
        2 * kappa * np.cosh(2 * w) + 1 + kappa**2 + 4 * w**2
    ) - 1
    transform = radii[:, None] * j1(k[None] * radii[:, None]) / k
    step = layer * weights * ELASTIC_LAYER.half_space_wave_number / 2 / thickness
    rest = j0(k[None] * at[:, None]) @ (step * transform).T
    return 2 * (1 - nu**2) / young * (half_space + rest)
