"""Strength of a Hill-type muscle with a rigid tendon.

With the path's length L, the tendon's slack length, and the fibres' width w = l_o sin(alpha_o)
constant, the fibres have

    l cos(alpha) = L - l_slack,   l = sqrt(w² + (L - l_slack)²),   dl/dt = cos(alpha) dL/dt,

and the muscle pulls with

    F = (a f_l(l/l_o) f_v(dl/dt / (l_o v_max)) + f_p(l/l_o)) F_max cos(alpha),

f_l a sum of three bells, f_v of one arsinh, f_p exponential beyond the optimal length. A path
that is shorter than the tendon is slack: it does not pull. Where the path that pulls is longer
than muscle and tendon, as one past the patella to the tibia, L is that of a twin in the model.

Reference: De Groote et al., Ann Biomed Eng 44:2922 (2016), doi:10.1007/s10439-016-1591-9; the
coefficients are those of the authors' code, with which f_l(1) = f_v(0) = 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.io.opensim.model import OpenSimMuscle

BELLS = (
    (0.8150671134243542, 1.055033428970575, 0.162384573599574, 0.063303448465465),
    (0.433004984392647, 0.716775413397760, -0.029947116970696, 0.200356847296188),
    (0.1, 1.0, 0.353553390593274, 0.0),
)
"""Height, place, width at length 0 and its growth, of each bell of the active force."""
VELOCITY = (-0.3211346127989808, -8.149, -0.374, 0.8825327733249912)


@dataclass(frozen=True)
class HillSettings:
    """Curves of force, length and velocity of a muscle."""

    passive_shape: float = 4.0
    """Shape of the passive curve (exponent); Thelen (2003) has 4 for adults under 65."""
    passive_strain: float = 0.6
    """Strain beyond the optimal length at which the passive force is F_max."""
    longest_fibre_ratio: float = 1.8
    """Fibre length over the optimal one beyond which the curves do not hold. Chosen: f_p(1.6) is 1
    already."""


HILL = HillSettings()


def active_force_length(length: Array) -> Array:
    """Return f_l at fibre lengths over the optimal one."""
    total = np.zeros_like(length)
    for height, place, width, growth in BELLS:
        total += height * np.exp(-0.5 * ((length - place) / (width + growth * length)) ** 2)
    return total


def force_velocity(velocity: Array) -> Array:
    """Return f_v at fibre velocities over the largest, positive where they lengthen.

    Held beyond ±1: fibres that shorten faster do not pull.
    """
    scale, slope, shift, level = VELOCITY
    inside = np.clip(velocity, -1.0, 1.0)
    return np.maximum(scale * np.arcsinh(slope * inside + shift) + level, 0.0)


def passive_force_length(length: Array) -> Array:
    """Return f_p at fibre lengths over the optimal one."""
    growth = HILL.passive_shape * np.maximum(length - 1.0, 0.0) / HILL.passive_strain
    return np.expm1(growth) / np.expm1(HILL.passive_shape)


def rigid_tendon_strength(
    muscles: Sequence[OpenSimMuscle], lengths_m: Array, speeds: Array
) -> tuple[Array, Array]:
    """Return the forces (..., m), N, at full activation without the passive one, and the passive.

    Args:
        muscles: m muscles.
        lengths_m: (..., m) of their paths.
        speeds: (..., m) m/s, of their paths' lengths.

    Returns:
        Both NaN where fibres are longer than `HILL.longest_fibre_ratio`.
    """
    optimal = np.array([muscle.optimal_fibre_length_m for muscle in muscles])
    slack = np.array([muscle.tendon_slack_length_m for muscle in muscles])
    width = optimal * np.sin([muscle.pennation_rad for muscle in muscles])
    fastest = optimal * np.array([muscle.max_contraction_velocity for muscle in muscles])
    strength = np.array([muscle.max_isometric_force_N for muscle in muscles])
    along = lengths_m - slack
    fibre = np.hypot(width, along)
    cosine = np.where(along > 0.0, along / np.maximum(fibre, 1e-300), 0.0)
    length = np.where(fibre > HILL.longest_fibre_ratio * optimal, np.nan, fibre / optimal)
    active = active_force_length(length) * force_velocity(cosine * speeds / fastest)
    return strength * cosine * active, strength * cosine * passive_force_length(length)
