"""How a condyle moves on the insert: slip, sliding and normal velocity.

- slip and its rate, from arcs of successive lowest points (`tkamb.body.slip`);
- the same rate without arcs: the rigid-body velocity of the femur's contact point relative
  to the insert, forwards, less its axial part;
- that velocity along the contact normal. Surfaces that stay in touch have none: what is
  left is by how much the recorded motion violates the contact constraint.
"""

import numpy as np

from tkamb.body.slip import CondyleSlip, sliding_velocity
from tkamb.body.unknowns import CondylePoint
from tkamb.geometry.frames import Array, knee_pose, knee_twist, transform
from tkamb.scene.case import Case
from tkamb.units import MILLIMETRE


def sliding_row(
    case: Case, k: int, side: str, slip: CondyleSlip, contact: CondylePoint | None
) -> dict[str, float]:
    """Return one condyle's columns of slip, sliding and normal velocity at one frame.

    Args:
        case: the case.
        k: frame of the motion.
        side: "medial" or "lateral".
        slip: over all frames of the motion.
        contact: the condyle's contact point there; None if there is none.
    """
    values = {
        "slip_mm": slip.slip[k],
        "slip_velocity_mm_per_s": slip.slip_velocity(case.motion.time)[k],
    }
    if contact is not None:
        values["sliding_velocity_mm_per_s"] = _sliding(case, k, contact.point)
        values["normal_velocity_mm_per_s"] = contact.sliding @ contact.normal
    return {f"{side}_{name}": float(value) / MILLIMETRE for name, value in values.items()}


def _sliding(case: Case, k: int, contact: Array) -> float:
    """Return the forward sliding m/s by rigid-body kinematics, without axial rotation."""
    assert case.femoral is not None
    coordinates = case.motion.coordinates[k]
    velocity, spin = knee_twist(coordinates, case.motion.velocity[k])
    centre = transform(knee_pose(coordinates), case.femoral.bounds.mean(axis=0))
    arm, lever = contact - coordinates[:3], contact[2] - centre[2]
    return float(sliding_velocity(velocity[None], spin[None], arm[None], np.array([lever]))[0])
