"""Segment inertias of de Leva, for links whose URDF gives none.

Reference: de Leva, J Biomech 29:1223 (1996), doi:10.1016/0021-9290(95)00178-6. Shank from
the knee to the ankle joint centre.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tkamb.geometry.frames import Array

Sex = Literal["male", "female"]
Segment = Literal["thigh", "shank", "foot"]


@dataclass(frozen=True)
class SegmentFractions:
    """Fractions of body mass and of segment length.

    Args:
        mass: of body mass.
        centre: from the proximal end, of segment length.
        radii: of gyration about the sagittal (AP), transverse (ML) and longitudinal axis.
    """

    mass: float
    centre: float
    radii: tuple[float, float, float]


DE_LEVA: dict[Sex, dict[Segment, SegmentFractions]] = {
    "male": {
        "thigh": SegmentFractions(0.1416, 0.4095, (0.329, 0.329, 0.149)),
        "shank": SegmentFractions(0.0433, 0.4395, (0.251, 0.246, 0.102)),
        "foot": SegmentFractions(0.0137, 0.0, (0.0, 0.0, 0.0)),
    },
    "female": {
        "thigh": SegmentFractions(0.1478, 0.3612, (0.369, 0.364, 0.162)),
        "shank": SegmentFractions(0.0481, 0.4352, (0.267, 0.263, 0.092)),
        "foot": SegmentFractions(0.0129, 0.0, (0.0, 0.0, 0.0)),
    },
}
"""De Leva's fractions. The foot is a point mass at the ankle: it is light and hardly moves."""


@dataclass(frozen=True, eq=False)
class RigidInertia:
    """Mass (kg), centre (3,) m and inertia (3, 3) kg·m² about the centre, in one frame."""

    mass: float
    centre: Array
    tensor: Array


def segment_inertia(
    segment: Segment, sex: Sex, body_mass: float, proximal: Array, distal: Array
) -> RigidInertia:
    """Return the inertia of a segment between two joint centres (3,), in their frame.

    The longitudinal axis joins the centres; the two other radii of gyration belong to the
    AP and ML axes nearest to x and z of the frame.
    """
    fractions = DE_LEVA[sex][segment]
    mass = fractions.mass * body_mass
    along = proximal - distal
    length = float(np.linalg.norm(along))
    superior = along / length
    anterior = np.array([1.0, 0.0, 0.0]) - superior[0] * superior
    anterior /= np.linalg.norm(anterior)
    axes = np.stack([anterior, superior, np.cross(anterior, superior)], axis=1)
    sagittal, transverse, longitudinal = fractions.radii
    principal = mass * (length * np.array([sagittal, longitudinal, transverse])) ** 2
    return RigidInertia(
        mass, proximal - fractions.centre * along, axes @ np.diag(principal) @ axes.T
    )


def combined(first: RigidInertia, second: RigidInertia) -> RigidInertia:
    """Return two bodies joined rigidly (parallel-axis theorem)."""
    mass = first.mass + second.mass
    centre = (first.mass * first.centre + second.mass * second.centre) / mass
    tensor = np.zeros((3, 3))
    for part in (first, second):
        arm = part.centre - centre
        tensor += part.tensor + part.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return RigidInertia(mass, centre, tensor)
