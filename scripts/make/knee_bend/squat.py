"""The body in the sagittal plane: trunk lean from balance, then the ground reaction.

Both feet stand flat side by side and both legs move alike. So the body is a chain of three
segments: shanks, thighs, and head-arms-trunk. The trunk leans so that the centre of mass is over
the planned centre of pressure. Force and true centre of pressure follow from the acceleration of
the centre of mass and the rate of angular momentum. The tested leg has its share of the load,
because the centre of mass moves sideways towards it. Vertical forces under both feet balance the
body in the frontal plane, so that no foot pushes sideways.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from knee_bend import anthropometry as body
from knee_bend import dimensions as d

MILLI = 1e-3


@dataclass(frozen=True)
class Squat:
    """Forward lean of shank and trunk (rad), force (f, 3) N and its point (f, 3) mm, per frame.

    Laboratory: x forward, y up, z right. The origin is on the floor below the centre of the tested
    ankle.
    """

    shank_lean: np.ndarray
    trunk_lean: np.ndarray
    force: np.ndarray
    point: np.ndarray
    centre_of_mass: np.ndarray


def smooth(flexion):
    """Return the progress of the squat: 0 standing, 1 at the bottom."""
    s = flexion / np.radians(d.FLEXION_END)
    return s * s * (3.0 - 2.0 * s)


def shank_lean(flexion):
    """Return the forward lean (rad) of the shank."""
    start, end = np.radians(d.SHANK_LEAN)
    return start + (end - start) * np.sin(np.pi / 2 * flexion / np.radians(d.FLEXION_END))


def ankle_height():
    """Return the height (mm) of the ankle centre above the floor."""
    return d.ANKLE_HEIGHT_SHARE * d.HEIGHT


def _forward(lean):
    """Return unit vectors (f, 2) along a segment that leans forward, from distal to proximal."""
    return np.stack([np.sin(lean), np.cos(lean)], axis=1)


def _between(ends, flexion):
    return ends[0] + (ends[1] - ends[0]) * smooth(flexion)


def _second_derivative(time, values):
    return make_interp_spline(time, values, k=5).derivative(2)(time)


def squat(time, flexion):
    """Return the Squat for flexion (f,) rad at time (f,) s."""
    lean = shank_lean(flexion)
    thigh_lean = lean - flexion
    ankle = np.array([0.0, ankle_height()])
    knee = ankle + body.SHANK.length * _forward(lean)
    hip = knee + body.THIGH.length * _forward(thigh_lean)
    shank = knee - body.SHANK.centre * _forward(lean)
    thigh = hip - body.THIGH.centre * _forward(thigh_lean)
    planned = _between(d.CENTRE_OF_PRESSURE, flexion)
    legs = 2.0 * (body.SHANK.mass * shank + body.THIGH.mass * thigh + body.FOOT_MASS * ankle)
    missing = d.MASS_KG * planned - legs[:, 0] - body.HAT_MASS * hip[:, 0]
    trunk_lean = np.arcsin(missing / (body.HAT_MASS * body.HAT_CENTRE))
    trunk = hip + body.HAT_CENTRE * _forward(trunk_lean)
    centre = (legs + body.HAT_MASS * trunk) / d.MASS_KG
    parts = (
        (2.0 * body.SHANK.mass, 2.0 * body.SHANK.inertia_transverse, shank, lean),
        (2.0 * body.THIGH.mass, 2.0 * body.THIGH.inertia_transverse, thigh, thigh_lean),
        (body.HAT_MASS, body.HAT_INERTIA, trunk, trunk_lean),
    )
    total, moment = _dynamics(time, parts, centre)
    forward = (moment - (centre[:, 1] * MILLI) * total[:, 0]) / total[:, 1] / MILLI
    return _tested_leg(time, flexion, lean, trunk_lean, total, centre, centre[:, 0] + forward)


def _dynamics(time, parts, centre):
    """Return ground force (f, 2) N on both feet and moment (f,) N m about the centre of mass."""
    force = d.MASS_KG * _second_derivative(time, centre) * MILLI
    force[:, 1] += d.MASS_KG * d.GRAVITY
    moment = np.zeros(len(time))
    for mass, inertia, place, lean in parts:
        arm, pull = (place - centre) * MILLI, mass * _second_derivative(time, place) * MILLI
        moment += arm[:, 0] * pull[:, 1] - arm[:, 1] * pull[:, 0]
        moment -= inertia * _second_derivative(time, lean)
    return force, moment


def _tested_leg(time, flexion, lean, trunk_lean, total, centre, cop):
    share = _between(d.LEG_SHARE, flexion)
    sideways = d.FOOT_SPACING_HALF * (2.0 * share - 1.0)
    across = d.MASS_KG * _second_derivative(time, sideways) * MILLI
    force = share[:, None] * np.stack([total[:, 0], total[:, 1], across], axis=1)
    nothing = np.zeros_like(cop)
    point = np.stack([cop, nothing, nothing], axis=1)
    return Squat(lean, trunk_lean, force, point, centre)
