"""First touch along -y, against brute force and closed forms."""

import numpy as np
import pytest

from contact_bodies import dished_insert, flat_insert, graded_sphere, joined
from tkamb.geometry.closest import HeightBound
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import knee_pose, pose, transform
from tkamb.geometry.surface import Surface

UP = np.array([0.0, 1.0, 0.0])


def vertex_clearance(femoral, insert, at):
    """Return the smallest clearance at any vertex of either body, by brute force."""
    moved = Surface(transform(at, femoral.vertices), femoral.faces)
    above = moved.vertices + UP * (0.1 - moved.vertices[:, 1:2])
    down = 0.1 - insert.rays.first(above, -UP)[0]
    below = insert.vertices - UP * (0.1 + insert.vertices[:, 1:2])
    up = moved.rays.first(below, UP)[0] - 0.1
    return min((moved.vertices[:, 1] - down).min(), (up - insert.vertices[:, 1]).min())


def bodies():
    femoral = joined(
        graded_sphere(20e-3, (0, 0, -21e-3)), graded_sphere(22e-3, (2e-3, 1e-3, 21e-3))
    )
    insert = dished_insert(
        lambda x, z: 8e-3 + x**2 / 0.1 + 6e-3 * np.exp(-((z / 6e-3) ** 2)),
        half_x=22e-3,
        half_z=38e-3,
        spacing=1.1e-3,
    )
    return femoral, insert


@pytest.mark.parametrize("seed", range(3))
def test_first_touch_is_just_below_the_clearance_of_the_vertices(seed):
    """Edges may touch before vertices, by less than the sagitta of the facets."""
    rng = np.random.default_rng(seed)
    femoral, insert = bodies()
    scale = np.array([6e-3, 20e-3, 3e-3, 0.2, 0.05, 1.5])
    at = knee_pose(rng.uniform(-1, 1, 6) * scale)
    touches = FirstTouch(femoral, insert, 0.0).at(at)
    vertices = vertex_clearance(femoral, insert, at)
    travel = min(t.travel for t in touches)
    assert travel <= vertices + 1e-12
    assert travel > vertices - 30e-6
    assert FirstTouch(femoral, insert).travel(at) == pytest.approx(travel, abs=1e-12)


def test_two_spheres_touch_on_the_line_of_their_centres():
    femoral = joined(graded_sphere(20e-3, (0, 0, -12e-3)), graded_sphere(20e-3, (0, 0, 12e-3)))
    touch = FirstTouch(femoral, flat_insert(10e-3, half_z=28e-3), 0.0)
    tilt = np.radians(1.0)
    medial, lateral = touch.at(knee_pose([1e-3, 40e-3, 0, 0, tilt, 0]))
    for result, side in ((medial, -1), (lateral, 1)):
        height = 40e-3 - 20e-3 - 10e-3 + side * 12e-3 * np.sin(tilt)
        assert result.travel == pytest.approx(height, abs=5e-6)
        assert result.point == pytest.approx([1e-3, 10e-3, side * 12e-3], abs=0.4e-3)
    assert medial.travel < lateral.travel


def test_a_condyle_beside_the_insert_has_no_touch():
    femoral = joined(graded_sphere(20e-3, (0, 0, -60e-3)), graded_sphere(20e-3, (0, 0, 5e-3)))
    medial, lateral = FirstTouch(femoral, flat_insert(10e-3), -30e-3).at(np.eye(4))
    assert medial is None
    assert lateral.travel == pytest.approx(-30e-3, abs=1e-6)
    beside = pose(np.eye(3), [1.0, 0, 0])
    assert np.isnan(FirstTouch(femoral, flat_insert(10e-3)).travel(beside))


def test_travel_depends_on_the_pose_and_not_on_the_femoral_frame():
    femoral, insert = bodies()
    at = knee_pose([1e-3, 5e-3, 0.5e-3, 0.05, 0.01, 0.7])
    first = FirstTouch(femoral, insert).travel(at)
    raised = at + np.outer([0, 1, 0, 0], [0, 0, 0, 7e-3])
    assert FirstTouch(femoral, insert).travel(raised) == pytest.approx(first + 7e-3, abs=1e-12)
    frame = knee_pose([3e-3, 2e-3, -4e-3, 0.3, 0.2, 2.0])
    other = FirstTouch(femoral.moved(frame), insert)
    assert other.travel(at @ np.linalg.inv(frame)) == pytest.approx(first, abs=1e-12)


def test_the_height_bound_is_above_the_surface_everywhere():
    _, insert = bodies()
    points = insert.triangles.mean(axis=1)
    above = HeightBound(insert).over(points) - points[:, 1]
    assert (above >= -1e-15).all()
    assert np.median(above[insert.face_normals[:, 1] > 0.5]) < 0.2e-3


def test_crossing_edges_touch_where_no_vertex_lies():
    """The ridges of two roofs cross; no vertex lies over the other roof's ridge."""
    ridge = np.array([[-1.0, 0, 0], [1, 0, 0], [0, -0.5, 1], [0, -0.5, -1]]) * 1e-2
    below = Surface(ridge, np.array([[0, 2, 1], [0, 1, 3]]), "ridge")
    above = Surface(ridge[:, [2, 1, 0]] * [1, -1, 1], np.array([[0, 1, 2], [0, 3, 1]]), "roof")
    at = pose(np.eye(3), [1e-3, 4e-3, 2e-3])
    result = FirstTouch(above, below).either(at)
    assert result.travel == pytest.approx(4e-3, abs=1e-15)
    assert result.point == pytest.approx([1e-3, 0, 0], abs=1e-15)


def test_supports_and_boxes_bound_their_triangles():
    femoral, _ = bodies()
    tree = femoral.tree
    count = len(tree.boxes) // 2
    assert np.array_equal(np.unique(tree.faces), np.arange(len(femoral.faces)))
    while count:
        points = tree.corners.reshape(count, -1, 3)
        boxes, planes = tree.boxes[count : 2 * count], tree.supports[count : 2 * count]
        assert (points > boxes[:, None, :3]).all() and (points < boxes[:, None, 3:]).all()
        along = np.einsum("pij,pj->pi", points, planes[:, :3])
        assert (along <= planes[:, 3:] + 1e-15).all()
        count //= 2
