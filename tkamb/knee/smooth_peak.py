"""A smooth peak pressure of each condyle, for costs and gradients.

The peak pressure jumps between map points, so it has no derivative. The mean of order n over a
fixed area A0,

    P = (sum_i A_i p_i^n / A0)^(1/n),    dP = sum_i (A_i/A0) (p_i/P)^(n-1) dp_i,

of the pressures p_i at the map points with the areas A_i tends to the peak as n grows, and is
smooth where columns come into contact. The foundations and the lattices whose contact forces lie
along the femoral normal have exact derivatives dp_i, other models central differences.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from tkamb.contact.model import LoadedPoints, ProbedContact
from tkamb.contact.result import medial_points
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array
from tkamb.knee.contact import CONTACT_DIFFERENCE, KneeContact, differences

# 1: order n of the mean. Chosen because a paraboloid of pressure over 1 cm² then has 0.76 of its
# peak, and a larger order weighs single columns.
ORDER = 8
# m²: area A0. Chosen as the usual area of contact of a condyle.
AREA = 1e-4


def smooth_peaks(
    contact: KneeContact, probe: Any, probed: ProbedContact, femur_pose: Array
) -> Array:
    """Return the smooth peak pressures (2,), Pa, of medial and lateral condyle.

    `probed` is the contact of the probe at the pose (4, 4) of the femoral component.

    Raises:
        ComputationError: the contact model is out of its range.
    """
    if hasattr(probe, "loaded_points"):
        return _means(probe.loaded_points(femur_pose, probed, slopes=False))[0]
    return _means(_evaluated(contact, femur_pose))[0]


def smooth_peak_slopes(
    contact: KneeContact, probe: Any, probed: ProbedContact, femur_pose: Array
) -> Array:
    """Return the derivative (2, 6) of `smooth_peaks` by a displacement of the femur.

    The arguments are those of `smooth_peaks`.

    Raises:
        ComputationError: the contact model is out of its range.
        InputError: the forces of the contact model jump from facet to facet.
    """
    contact.check_differentiable()
    if hasattr(probe, "loaded_points"):
        return _means(probe.loaded_points(femur_pose, probed, slopes=True))[1]
    settings = CONTACT_DIFFERENCE
    if not hasattr(contact.model, "tolerance"):
        settings = replace(settings, step=settings.exact_step)
    return differences(lambda pose: _means(_evaluated(contact, pose))[0], femur_pose, settings)


def _evaluated(contact: KneeContact, femur_pose: Array) -> LoadedPoints:
    result = contact.model.evaluate(contact.state, femur_pose)
    if result.failed:
        raise ComputationError(result.reason, "contact")
    medial = medial_points(result.points, femur_pose, contact.pair.split)
    return LoadedPoints(result.pressure, result.area, medial, None)


def _means(points: LoadedPoints) -> tuple[Array, Array]:
    """Return means (2,) of order `ORDER`, Pa, and derivative (2, 6), zero if unknown."""
    means, slopes = np.zeros(2), np.zeros((2, 6))
    for k, side in enumerate((points.medial, ~points.medial)):
        pressure, share = points.pressure[side], points.area[side] / AREA
        largest = float(pressure.max(initial=0.0))
        if largest == 0.0:
            continue
        means[k] = largest * (share @ (pressure / largest) ** ORDER) ** (1.0 / ORDER)
        if points.slope is not None:
            slopes[k] = (share * (pressure / means[k]) ** (ORDER - 1)) @ points.slope[side]
    return means, slopes
