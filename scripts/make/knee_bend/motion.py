"""The "recorded" motion of the knee. Flexion, axial rotation and contact path are chosen.

The other coordinates are solved. Mediolaterally, the femur is in equilibrium without friction and
under an even load: the two contact points have equal distances from the middle, so that the slopes
of the dishes cancel.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import root

from knee_bend import dimensions as d
from knee_bend.implant import ARTICULATION

KNOTS = np.radians([0.0, 6.0, 12.0, 24.0, 36.0, 60.0, 90.0, 120.0])


@dataclass(frozen=True)
class KneeMotion:
    """Frames of the knee: times (s) and coordinates (f, 6), mm and rad, as in KNEE_COORDINATES."""

    time: np.ndarray
    coordinates: np.ndarray
    contact: np.ndarray
    """Contact points (f, 2, 3) on the insert, medial and lateral."""


def flexion_at(time):
    """Return flexion (rad): constant rate between smooth ramps, with zero rate at both ends."""
    steady = d.FLEXION_END / (d.DURATION_S - d.RAMP_S)
    s = np.clip(np.minimum(time, d.DURATION_S - time) / d.RAMP_S, 0.0, 1.0)
    ramp = steady * d.RAMP_S * (s**6 - 3.0 * s**5 + 2.5 * s**4)
    ramp = ramp + steady * np.clip(np.minimum(time, d.DURATION_S - time) - d.RAMP_S, 0.0, None)
    return np.radians(np.where(time <= d.DURATION_S / 2, ramp, d.FLEXION_END - ramp))


def axial_rotation_at(flexion):
    """Return the external rotation of the femur (rad); its rate decreases with flexion."""
    return np.radians(d.AXIAL_ROTATION_END) * np.sin(
        np.pi / 2 * flexion / np.radians(d.FLEXION_END)
    )


def contact_path_at(flexion):
    """Return the mean AP position (mm) of the two contact points."""
    s = flexion / np.radians(d.FLEXION_END)
    return d.CONTACT_AP_START + (d.CONTACT_AP_END - d.CONTACT_AP_START) * s * (2.0 - s)


def _settled(articulation, flexion):
    """Return AP and ML (mm) at a flexion: mean contact on its path, ML slopes in balance."""
    rotation, wanted = axial_rotation_at(flexion), contact_path_at(flexion)
    wanted += articulation.insert.low_point_ap - d.DISH_LOW_POINT_AP

    def miss(place):
        medial, lateral = articulation.touch(*place, rotation, flexion).points
        inward = medial[2] + lateral[2]
        return [(medial[0] + lateral[0]) / 2.0 - wanted, inward]

    found = root(
        miss,
        [_start(articulation, flexion, wanted), 0.0],
        method="hybr",
        options={"eps": 1e-3, "xtol": 1e-6},
    )
    return [round(float(x), 3) for x in found.x]


def _start(articulation, flexion, wanted):
    """Return the AP (mm) that puts the lowest point of the medial ridge at `wanted`."""
    anterior, superior = articulation.femoral.profile.point(flexion)
    return wanted - (anterior * np.cos(flexion) - superior * np.sin(flexion))


def knee_motion(articulation=ARTICULATION, frames=d.FRAMES):
    """Return the KneeMotion. Its contact path starts at the low point of the dishes."""
    time = np.linspace(0.0, d.DURATION_S, frames)
    flexion = flexion_at(time)
    place_at = CubicSpline(KNOTS, [_settled(articulation, f) for f in KNOTS], bc_type="natural")
    coordinates, contact, guess = [], [], 0.0
    for angle in flexion:
        (ap, ml), rotation = place_at(angle), float(axial_rotation_at(angle))
        found = articulation.touch(ap, ml, rotation, angle, guess)
        guess = found.adduction
        coordinates.append([ap, found.si, ml, rotation, found.adduction, angle])
        contact.append(found.points)
    return KneeMotion(time, np.array(coordinates), np.array(contact))
