"""Knee coordinates: signs, inverse transformation, and the twist by finite differences."""

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import (
    inverse,
    knee_coordinates,
    knee_pose,
    knee_twist,
    mirrored_pose,
    pose,
    transform,
)
from tkamb.units import DEGREE


def test_signs_are_those_of_grood_and_suntay():
    """Flexion turns the shaft backwards, varus lifts the lateral condyle, and external rotation
    turns the front outwards.
    """
    shaft, anterior = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    lateral_condyle = np.array([0.0, 0.0, 0.02])
    turn = 5 * DEGREE
    assert transform(knee_pose([0, 0, 0, 0, 0, turn]), shaft)[0] < -0.08
    assert transform(knee_pose([0, 0, 0, 0, turn, 0]), lateral_condyle)[1] > 0.0017
    assert transform(knee_pose([0, 0, 0, turn, 0, 0]), anterior)[2] > 0.08


def test_coordinates_of_a_pose_are_recovered_to_160_degrees():
    rng = np.random.default_rng(1)
    low = np.array([-0.02, 0, -0.01, -0.4, -0.2, -0.1])
    high = np.array([0.02, 0.05, 0.01, 0.4, 0.2, 160 * DEGREE])
    expected = rng.uniform(low, high, (500, 6))
    result = np.array([knee_coordinates(knee_pose(c)) for c in expected])
    np.testing.assert_allclose(result, expected, atol=1e-12)


def test_other_angle_orders_are_converted_by_the_rotation_matrix():
    angles = np.array([0.3, -0.4, 1.1])
    original = pose(Rotation.from_euler("XYZ", angles).as_matrix(), np.zeros(3))
    recovered = knee_pose(knee_coordinates(original))
    np.testing.assert_allclose(recovered, original, atol=1e-14)
    assert abs(knee_coordinates(original)[4] + angles[0]) > 0.01


def test_twist_is_the_derivative_of_the_pose():
    rng = np.random.default_rng(2)
    c, rate, step = rng.uniform(-0.5, 1.5, (40, 6)), rng.normal(size=(40, 6)), 1e-6
    point = np.array([0.01, -0.02, 0.03])
    velocity, spin = knee_twist(c, rate)
    ahead = transform(knee_pose(c + step * rate), point)
    behind = transform(knee_pose(c - step * rate), point)
    arm = transform(knee_pose(c), point) - c[:, :3]
    np.testing.assert_allclose(
        (ahead - behind) / (2 * step), velocity + np.cross(spin, arm), atol=1e-9
    )


def test_inverse_and_mirror_image_of_a_pose_are_exact():
    femoral_pose = knee_pose([0.01, 0.03, 0.002, 0.1, 0.05, 1.0])
    np.testing.assert_allclose(femoral_pose @ inverse(femoral_pose), np.eye(4), atol=1e-15)
    c = knee_coordinates(mirrored_pose(femoral_pose))
    np.testing.assert_allclose(c, [0.01, 0.03, -0.002, -0.1, -0.05, 1.0], atol=1e-15)
