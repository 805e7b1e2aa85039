"""Sliding paths and cross-shear ratios with closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import pose, transform
from tkamb.studies.wear.engine import SlidingHistory, cross_shear_ratio, step_sliding

UP = np.array([[0.0, 1.0, 0.0]])
POINT = np.array([[0.01, 0.008, -0.02]])


def translated(positions):
    positions = np.asarray(positions, float)
    return pose(np.broadcast_to(np.eye(3), (len(positions), 3, 3)), positions)


def turned(axis, angles, centre):
    """Return poses of a body that rotates about an axis through a centre."""
    rotation = Rotation.from_rotvec(np.outer(angles, axis)).as_matrix()
    return pose(rotation, centre - rotation @ centre)


def history(path, pressure=1e6, normals=UP):
    frames = len(path)
    return SlidingHistory.of_cycle(translated(path), np.full((frames, 1), pressure), POINT, normals)


def test_a_translation_slides_by_its_tangential_part():
    poses = translated([[0, 0, 0], [0.003, 0.5, 0.004]])
    sliding = step_sliding(poses, np.repeat(POINT, 3, axis=0), np.repeat(UP, 3, axis=0))
    assert sliding == pytest.approx(np.broadcast_to([0.003, 0.0, 0.004], (1, 3, 3)), abs=1e-15)


@pytest.mark.parametrize("steps", [1, 7])
def test_a_rotation_slides_along_its_arc_for_any_steps(steps):
    centre, angle = np.array([0.002, 0.03, -0.02]), 1.2
    poses = turned([0.0, 0.0, 1.0], np.linspace(0, angle, steps + 1), centre)
    straight_below = np.array([[0.002, 0.005, 0.01]])
    sliding = step_sliding(poses, straight_below, UP)
    assert sliding.sum(axis=(0, 1)) == pytest.approx([0.025 * angle, 0, 0], abs=1e-14)


def test_a_rolling_wheel_does_not_slide_at_its_contact():
    radius, angle = 0.02, 1e-3
    centre = np.array([0.0, radius, 0.0])
    rotation = Rotation.from_rotvec([0, 0, -angle]).as_matrix()
    rolled = pose(rotation, np.array([radius * angle, radius, 0.0]) - rotation @ centre)
    sliding = step_sliding(np.stack([np.eye(4), rolled]), np.zeros((1, 3)), UP)
    assert np.linalg.norm(sliding) < radius * angle**2  # second order, because the contact moves


def test_sliding_equals_finite_differences_of_femoral_points():
    axis = np.array([0.3, -0.5, 0.8])
    poses = turned(axis, [0.0, 1e-5], np.array([0.01, 0.02, 0.03])) @ translated([[0, 0, 0]])
    displacement = transform(poses[1], POINT) - transform(poses[0], POINT)
    assert step_sliding(poses, POINT, UP)[0] == pytest.approx(displacement * [1, 0, 1], rel=1e-4)


def test_a_closed_loop_has_zero_net_sliding_and_the_path_of_its_length():
    angle = np.linspace(0, 2 * np.pi, 400 + 1)
    circle = 0.005 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    loop = history(circle)
    assert loop.sliding.sum(axis=0) == pytest.approx(np.zeros((1, 3)), abs=1e-16)
    assert loop.distance[0] == pytest.approx(2 * np.pi * 0.005, rel=2e-5)
    assert loop.cross_shear[0] == pytest.approx(0.5, abs=1e-9)


@pytest.mark.parametrize(("width", "length"), [(0.0, 10.0), (1.0, 9.0), (3.0, 7.0), (5.0, 5.0)])
@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_cross_shear_of_rectangular_paths_has_the_closed_form(width, length, turn):
    """The ratio is A/(A + B) for any direction of the rectangle (Turell et al. 2005)."""
    corners = np.array([[0, 0, 0], [length, 0, 0], [length, 0, width], [0, 0, width], [0, 0, 0]])
    path = corners @ Rotation.from_rotvec([0, turn, 0]).as_matrix().T * 1e-3
    assert history(path).cross_shear[0] == pytest.approx(width / (width + length), abs=1e-12)


def test_cross_shear_is_weighted_by_work():
    """For two perpendicular strokes of equal length the ratio is that of the pressures."""
    sliding = np.array([[[0.01, 0, 0]], [[0, 0, 0.01]]])
    work = np.array([[3e6], [1e6]]) * 0.01
    assert cross_shear_ratio(work, sliding, UP)[0] == pytest.approx(0.25, abs=1e-12)


def test_cross_shear_is_the_same_on_a_tilted_surface():
    tilt = Rotation.from_rotvec([0.4, 0.9, -0.3])
    corners = np.array([[0, 0, 0], [7, 0, 0], [7, 0, 3], [0, 0, 3], [0, 0, 0]]) * 1e-3
    tilted = history(tilt.apply(corners), normals=tilt.apply(UP))
    assert tilted.cross_shear[0] == pytest.approx(0.3, abs=1e-12)


def test_without_contact_work_distance_and_cross_shear_are_zero():
    unloaded = history(np.array([[0, 0, 0], [0.01, 0, 0], [0.01, 0, 0.01]]), pressure=0.0)
    assert (unloaded.total_work, unloaded.distance, unloaded.cross_shear) == (0.0, 0.0, 0.0)
