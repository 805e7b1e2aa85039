"""Hill-type strength: points of the curves, geometry of the rigid tendon, OpenSim's curves."""

import numpy as np
import pytest

from plane_leg import muscle
from tkamb.run.muscles.leg import (
    active_force_length,
    force_velocity,
    passive_force_length,
    rigid_tendon_strength,
)

ENDS = ("femur_r", [0.0, 0.0, 0.0]), ("tibia_r", [0.0, 0.0, 0.0])
PENNATE = muscle("pennate", *ENDS, force=900.0, pennation_rad=0.4)


def test_the_curves_pass_their_known_points():
    assert active_force_length(np.array([1.0])) == pytest.approx(1.0, abs=1e-3)
    assert active_force_length(np.array([0.3, 1.8])) == pytest.approx(0.0, abs=0.12)
    np.testing.assert_allclose(force_velocity(np.array([-3.0, -1.0, 0.0])), [0, 0, 1], atol=1e-3)
    assert force_velocity(np.array([1.0])) == force_velocity(np.array([5.0]))
    assert 1.7 < force_velocity(np.array([1.0])) < 1.9
    np.testing.assert_allclose(passive_force_length(np.array([0.5, 1.0, 1.6])), [0, 0, 1])


def test_fibres_have_constant_width_and_their_force_is_along_the_tendon():
    lengths = np.linspace(0.21, 0.33, 7)[:, None]
    active, passive = rigid_tendon_strength([PENNATE], lengths, np.zeros_like(lengths))
    along = lengths - PENNATE.tendon_slack_length_m
    width = PENNATE.optimal_fibre_length_m * np.sin(0.4)
    fibre = np.hypot(along, width)
    cosine = along / fibre
    isometric = active_force_length(fibre / PENNATE.optimal_fibre_length_m)
    np.testing.assert_allclose(active, 900.0 * isometric * cosine, rtol=1e-3)
    stretched = passive_force_length(fibre / PENNATE.optimal_fibre_length_m)
    np.testing.assert_allclose(passive, 900.0 * stretched * cosine)


def test_the_fibre_velocity_is_the_path_velocity_times_the_cosine():
    """The reference is a finite difference of the fibre length."""
    length, speed, h = 0.28, 0.35, 1e-6
    width = PENNATE.optimal_fibre_length_m * np.sin(PENNATE.pennation_rad)

    def fibre(path):
        return np.hypot(path - PENNATE.tendon_slack_length_m, width)

    rate = (fibre(length + h * speed) - fibre(length - h * speed)) / (2 * h)
    moving, _ = rigid_tendon_strength([PENNATE], np.array([[length]]), np.array([[speed]]))
    isometric, _ = rigid_tendon_strength([PENNATE], np.array([[length]]), np.zeros((1, 1)))
    expected = force_velocity(np.array([rate])) / force_velocity(np.zeros(1))
    assert (moving / isometric)[0, 0] == pytest.approx(expected[0], rel=1e-6)


def test_a_path_shorter_than_the_tendon_is_slack_and_too_long_fibres_give_nan():
    lengths = np.array([[0.19, 0.2, 0.45]]).T
    active, passive = rigid_tendon_strength([PENNATE], lengths, np.zeros_like(lengths))
    np.testing.assert_array_equal(active[:2], 0.0)
    np.testing.assert_array_equal(passive[:2], 0.0)
    assert np.isnan(active[2, 0]) and np.isnan(passive[2, 0])


def test_the_curves_agree_with_opensim():
    peer = pytest.importorskip("opensim", reason="the package opensim is not installed")
    peer.Logger.removeFileSink()
    curves = peer.DeGrooteFregly2016Muscle()
    lengths, speeds = np.linspace(0.4, 1.7, 14), np.linspace(-1.0, 1.0, 11)
    peer_values = [curves.calcActiveForceLengthMultiplier(float(x)) for x in lengths]
    np.testing.assert_allclose(active_force_length(lengths), peer_values, atol=1e-12)
    peer_values = [curves.calcForceVelocityMultiplier(float(v)) for v in speeds]
    np.testing.assert_allclose(force_velocity(speeds), np.maximum(peer_values, 0.0), atol=1e-12)
    # OpenSim's passive curve begins at 0.2 optimal lengths, and has 0.02 at the optimal length
    peer_values = [curves.calcPassiveForceMultiplier(float(x)) for x in lengths]
    np.testing.assert_allclose(passive_force_length(lengths), peer_values, atol=0.02)
