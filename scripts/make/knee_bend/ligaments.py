"""The ligament bundles: attachments, stiffness, and strain over the motion.

Femoral attachments are in the femoral frame, tibial attachments in the insert frame (mm). They show
the positions relative to the implant. The frame of the tibia link differs from the insert frame by
a translation.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import knee_pose, transform


@dataclass(frozen=True)
class Bundle:
    """A straight bundle. `strain` at flexion `reference` (deg) gives its slack length."""

    name: str
    femur: tuple[float, float, float]
    tibia: tuple[float, float, float]
    stiffness: float
    """Stiffness, N/mm."""
    strain: float
    reference: float


BUNDLES = (
    Bundle("MCL_anterior", (1.5, 0.5, -42.0), (3.0, -52.0, -31.0), 91.25, 0.02, 0.0),
    Bundle("MCL_oblique", (-1.0, 0.0, -42.0), (-14.0, -6.0, -36.0), 27.86, 0.02, 0.0),
    Bundle("MCL_deep", (1.0, 0.0, -41.0), (-3.0, -3.0, -37.0), 21.07, 0.02, 0.0),
    Bundle("LCL", (-0.5, 0.0, 41.0), (-20.0, -14.0, 41.0), 72.22, 0.02, 0.0),
    Bundle("PCL_anterolateral", (0.5, -5.0, -6.0), (-26.0, -3.0, 0.0), 125.0, 0.07, 120.0),
    Bundle("PCL_posteromedial", (-1.0, -4.0, -7.0), (-26.0, -5.0, -3.0), 60.0, 0.06, 120.0),
)


def lengths(bundle, coordinates):
    """Return the length (f,) mm of a bundle at knee coordinates (f, 6), mm and rad."""
    femur = transform(knee_pose(coordinates), np.array(bundle.femur))
    return np.linalg.norm(femur - np.array(bundle.tibia), axis=1)


def slack_length(bundle, coordinates):
    """Return the slack length (mm) from the strain at the frame nearest to the reference."""
    frame = np.argmin(np.abs(np.degrees(coordinates[:, 5]) - bundle.reference))
    return lengths(bundle, coordinates)[frame] / (1.0 + bundle.strain)


def strains(bundle, coordinates):
    """Return the strain (f,) of a bundle; negative: slack."""
    return lengths(bundle, coordinates) / slack_length(bundle, coordinates) - 1.0
