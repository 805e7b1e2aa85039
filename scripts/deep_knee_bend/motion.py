"""The recorded motion of the knee: flexion, rotation and contact path chosen, the rest solved.

The femur lies where an evenly loaded frictionless femur would lie mediolaterally: the two
contact points are as far from the middle as each other, so the dishes' slopes cancel.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import root

from deep_knee_bend import dimensions as d
from deep_knee_bend.implant import ARTICULATION

KNOTS = np.radians([0.0, 6.0, 12.0, 24.0, 36.0, 60.0, 90.0, 120.0])


@dataclass(frozen=True)
class KneeMotion:
    """Frames of the knee: s, mm and rad; coordinates (f, 6) in KNEE_COORDINATES' order."""

    time: np.ndarray
    coordinates: np.ndarray
    contact: np.ndarray
    """Contact points (f, 2, 3) on the insert, medial and lateral."""


def flexion_at(time):
    """Flexion (rad): constant rate between two smooth ramps, at rest at both ends."""
    steady = d.FLEXION_END / (d.DURATION_S - d.RAMP_S)
    s = np.clip(np.minimum(time, d.DURATION_S - time) / d.RAMP_S, 0.0, 1.0)
    ramp = steady * d.RAMP_S * (s**6 - 3.0 * s**5 + 2.5 * s**4)
    ramp = ramp + steady * np.clip(np.minimum(time, d.DURATION_S - time) - d.RAMP_S, 0.0, None)
    return np.radians(np.where(time <= d.DURATION_S / 2, ramp, d.FLEXION_END - ramp))


def axial_rotation_at(flexion):
    """External rotation of the femur (rad): quick at first, flattening towards the end."""
    return np.radians(d.AXIAL_ROTATION_END) * np.sin(
        np.pi / 2 * flexion / np.radians(d.FLEXION_END)
    )


def contact_path_at(flexion):
    """Mean AP position (mm) of the two contact points."""
    s = flexion / np.radians(d.FLEXION_END)
    return d.CONTACT_AP_START + (d.CONTACT_AP_END - d.CONTACT_AP_START) * s * (2.0 - s)


def _settled(articulation, flexion):
    """AP and ML (mm) at a flexion: mean contact on its path, ML slopes under it balanced."""
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
    """AP place (mm) at which the medial ridge's lowest point is where contact is wanted."""
    anterior, superior = articulation.femoral.profile.point(flexion)
    return wanted - (anterior * np.cos(flexion) - superior * np.sin(flexion))


def knee_motion(articulation=ARTICULATION, frames=d.FRAMES):
    """Return the KneeMotion of all frames; the contact path starts at the dishes' low point."""
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
