"""The patella's motion in the femur's sagittal plane.

The dome touches the groove, and the patellar ligament has a constant length. The dome's centre
moves on the curve at a distance of one dome radius from the groove's floor, so that the gap is
zero. The frictionless contact force passes through the dome's centre. Therefore the massless
patella is in equilibrium when the moments of quadriceps and patellar ligament about this centre
and their forces along the groove cancel.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq

from knee_bend import button
from knee_bend import dimensions as d
from knee_bend.implant import FEMORAL
from tkamb.geometry.frames import inverse, knee_pose, transform
from tkamb.geometry.polygons import sagittal_outline
from tkamb.geometry.surface import Surface
from tkamb.knee.wrapping import taut_path
from tkamb.studies.designs.femoral import normal as normal_at

STEP = 1e-6
BETA_RANGE = (-0.3, 0.4)


@dataclass(frozen=True)
class PatellaPose:
    """Pose of the patella in the femoral frame (mm, rad), force ratios, and contact angle (rad)."""

    ap: float
    si: float
    rotation: float
    ligament_ratio: float
    contact_ratio: float
    contact_phi: float
    dome_angle: float
    quadriceps_wrap: float


def groove_frame(phi):
    """Return point (2,) mm and outward unit normal (2,) of the groove's floor at `phi`."""
    tangent = FEMORAL.groove(phi + STEP) - FEMORAL.groove(phi - STEP)
    normal = np.array([tangent[1], -tangent[0]]) / np.linalg.norm(tangent)
    return FEMORAL.groove(phi), normal * np.sign(normal @ normal_at(phi))


@lru_cache(maxsize=1)
def outline():
    """Return the outline (n, 2) mm of the component that the quadriceps wraps."""
    vertices, faces = FEMORAL.mesh()
    stations = np.linspace(-d.QUADRICEPS_WIDTH_HALF, d.QUADRICEPS_WIDTH_HALF, 7)
    return sagittal_outline(
        [Surface(vertices, faces)], stations, d.QUADRICEPS_HALF_THICKNESS, d.QUADRICEPS_ORIGIN[1]
    )


def _rotated(angle, point):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])


ARM = np.array(d.INFERIOR_POLE[:2]) - button.DOME_CENTRE
"""Vector from the dome's centre to the inferior pole, in the patellar frame."""


def _dome_centre(phi):
    point, normal = groove_frame(phi)
    return point + d.DOME_RADIUS * normal


def _contact(beta, tuberosity):
    """Return the contact angle (rad) at which the ligament has its length.

    `beta` (rad) is the angle between ARM and the line from the dome's centre to the tuberosity.
    """
    radius = np.linalg.norm(ARM)
    square = d.PATELLAR_LIGAMENT_LENGTH**2 - tuberosity[2] ** 2
    wanted = radius * np.cos(beta) + np.sqrt(square - (radius * np.sin(beta)) ** 2)

    def excess(phi):
        return np.linalg.norm(_dome_centre(phi) - tuberosity[:2]) - wanted

    phis = np.radians(np.arange(-99.0, 60.0, 3.0))
    signs = [excess(phi) > 0.0 for phi in phis]
    last = signs.index(False)
    return brentq(excess, phis[last - 1], phis[last], xtol=1e-14)


def _cross(a, b):
    return a[0] * b[1] - a[1] * b[0]


def _state(beta, tuberosity):
    """Return the patella's pose at beta, and the residual moment about the dome's centre."""
    phi = _contact(beta, tuberosity)
    normal = groove_frame(phi)[1]
    centre = _dome_centre(phi)
    to = tuberosity[:2] - centre
    rotation = np.arctan2(to[1], to[0]) - np.arctan2(ARM[1], ARM[0]) + beta
    rotation = (rotation + np.pi) % (2.0 * np.pi) - np.pi
    origin = centre - _rotated(rotation, button.DOME_CENTRE)
    upper = origin + _rotated(rotation, d.SUPERIOR_POLE[:2])
    lower = origin + _rotated(rotation, d.INFERIOR_POLE[:2])
    path = taut_path(np.array(d.QUADRICEPS_ORIGIN), np.append(upper, 0.0), outline())
    pull = -path.end_direction[:2]
    span = np.append(tuberosity[:2] - lower, tuberosity[2])
    ligament = (span / np.linalg.norm(span))[:2]
    tangent = np.array([-normal[1], normal[0]])
    ratio = -(pull @ tangent) / (ligament @ tangent)
    total = pull + ratio * ligament
    moment = _cross(upper - centre, pull) + ratio * _cross(lower - centre, ligament)
    dome = np.arccos(np.clip(normal @ _rotated(rotation, np.array([1.0, 0.0])), -1.0, 1.0))
    pose = PatellaPose(*origin, rotation, ratio, -total @ normal, phi, dome, path.wrap_angle)
    return pose, moment


def solve_patella(coordinates):
    """Return the PatellaPose at knee coordinates (6,) in mm and rad."""
    tuberosity = transform(inverse(knee_pose(coordinates)), np.array(d.TUBEROSITY))
    beta = brentq(lambda b: _state(b, tuberosity)[1], *BETA_RANGE, xtol=1e-13)
    return _state(beta, tuberosity)[0]


def patella_motion(coordinates):
    """Return the PatellaPose of every frame; coordinates (f, 6), mm and rad."""
    return [solve_patella(row) for row in coordinates]
