"""A smooth peak pressure of each condyle, for costs and gradients.

The peak pressure jumps between map points, so it has no derivative. The mean of order n over a
fixed area A0,

    P = (sum_i A_i p_i^n / A0)^(1/n),

of the pressures p_i at the map points with the areas A_i tends to the peak as n grows. Columns that
come into contact do not disturb it, because p^n is smooth there.
"""

from dataclasses import replace

import numpy as np

from tkamb.contact.result import medial_points
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array
from tkamb.knee.contact import CONTACT_DIFFERENCE, KneeContact, differences

# 1: order n of the mean. Chosen because a paraboloid of pressure over 1 cm² then has 0.76 of its
# peak, and a larger order weighs single columns.
ORDER = 8
# m²: area A0. Chosen as the usual area of contact of a condyle.
AREA = 1e-4


def smooth_peaks(contact: KneeContact, femur_pose: Array) -> Array:
    """Return the smooth peak pressures (2,), Pa, of medial and lateral condyle at a pose (4, 4).

    Raises:
        ComputationError: the contact model is out of its range.
    """
    result = contact.model.evaluate(contact.state, femur_pose)
    if result.failed:
        raise ComputationError(result.reason, "contact")
    medial = medial_points(result.points, femur_pose, contact.pair.split)
    largest = max(float(result.pressure.max()), 1.0)
    share = result.area / AREA * (result.pressure / largest) ** ORDER
    sums = np.array([share[medial].sum(), share[~medial].sum()])
    return np.asarray(largest * sums ** (1.0 / ORDER))


def smooth_peak_slopes(contact: KneeContact, femur_pose: Array) -> Array:
    """Return the derivative (2, 6) of `smooth_peaks` by a displacement, by central differences."""
    contact.check_differentiable()
    settings = CONTACT_DIFFERENCE
    if not hasattr(contact.model, "tolerance"):
        settings = replace(settings, step=settings.exact_step)
    return differences(lambda pose: smooth_peaks(contact, pose), femur_pose, settings)
