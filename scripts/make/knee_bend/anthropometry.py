"""Segments of a man by de Leva, J Biomech 29:1223 (1996), as shares of mass and length.

Lengths are scaled from de Leva's mean man to the subject's height; centres are measured
from the proximal joint; radii of gyration (sagittal, transverse, longitudinal) are shares of
the segment's length.
"""

from dataclasses import dataclass

from knee_bend import dimensions as d

MEAN_MAN_HEIGHT = 1741.0
SCALE = d.HEIGHT / MEAN_MAN_HEIGHT


@dataclass(frozen=True)
class Segment:
    """A rigid segment: kg, mm, kg m² about its centre of mass."""

    mass: float
    length: float
    centre: float
    inertia_sagittal: float
    """kg m²: moment of inertia about the AP axis."""
    inertia_transverse: float
    """kg m²: moment of inertia about the ML axis (flexion)."""
    inertia_longitudinal: float


def _segment(mass_share, length, centre_share, gyration):
    mass, size = mass_share * d.MASS_KG, length * SCALE
    moments = [mass * (share * size * 1e-3) ** 2 for share in gyration]
    return Segment(mass, size, centre_share * size, *moments)


THIGH = _segment(0.1416, 422.2, 0.4095, (0.329, 0.329, 0.149))
SHANK = _segment(0.0433, 440.3, 0.4395, (0.251, 0.246, 0.102))
FOOT_MASS = 0.0137 * d.MASS_KG

HAT_MASS = d.MASS_KG - 2.0 * (THIGH.mass + SHANK.mass + FOOT_MASS)
HAT_CENTRE = 350.0 * SCALE
"""mm: centre of mass of head, arms (at the chest) and trunk above the hips, by de Leva."""
HAT_INERTIA = HAT_MASS * 0.255**2
"""kg m²: inertia of head, arms and trunk about their centre; radius of gyration 255 mm."""
