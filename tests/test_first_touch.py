"""First touch along -y, against brute force and closed forms."""

import numpy as np
import pytest

from contact_bodies import dished_insert, flat_insert, graded_sphere, joined
from tkamb.geometry.bounds import HeightBound, Patches
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import knee_pose, pose, transform
from tkamb.geometry.surface import Surface

UP = np.array([0.0, 1.0, 0.0])


def vertex_clearance(femoral, insert, at):
    """Return the smallest clearance at any vertex of either body, every one of them tried."""
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


@pytest.mark.parametrize("seed", range(8))
def test_no_vertex_is_lower_and_edges_only_a_little(seed):
    """Edges may touch before vertices do, by less than the sagitta of the facets."""
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


def test_two_spheres_touch_where_they_must():
    femoral = joined(graded_sphere(20e-3, (0, 0, -12e-3)), graded_sphere(20e-3, (0, 0, 12e-3)))
    touch = FirstTouch(femoral, flat_insert(10e-3, half_z=28e-3), 0.0)
    tilt = np.radians(1.0)
    medial, lateral = touch.at(knee_pose([1e-3, 40e-3, 0, 0, tilt, 0]))
    for found, side in ((medial, -1), (lateral, 1)):
        height = 40e-3 - 20e-3 - 10e-3 + side * 12e-3 * np.sin(tilt)
        assert found.travel == pytest.approx(height, abs=5e-6)
        assert found.point == pytest.approx([1e-3, 10e-3, side * 12e-3], abs=0.4e-3)
    assert medial.travel < lateral.travel


def test_a_condyle_beside_the_insert_is_none():
    femoral = joined(graded_sphere(20e-3, (0, 0, -60e-3)), graded_sphere(20e-3, (0, 0, 5e-3)))
    medial, lateral = FirstTouch(femoral, flat_insert(10e-3), -30e-3).at(np.eye(4))
    assert medial is None
    assert lateral.travel == pytest.approx(-30e-3, abs=1e-6)
    away = pose(np.eye(3), [1.0, 0, 0])
    assert np.isnan(FirstTouch(femoral, flat_insert(10e-3)).travel(away))


def test_travel_moves_with_the_pose_and_not_with_the_femoral_frame():
    femoral, insert = bodies()
    at = knee_pose([1e-3, 5e-3, 0.5e-3, 0.05, 0.01, 0.7])
    first = FirstTouch(femoral, insert).travel(at)
    raised = at + np.outer([0, 1, 0, 0], [0, 0, 0, 7e-3])
    assert FirstTouch(femoral, insert).travel(raised) == pytest.approx(first + 7e-3, abs=1e-12)
    frame = knee_pose([3e-3, 2e-3, -4e-3, 0.3, 0.2, 2.0])
    other = FirstTouch(femoral.moved(frame), insert)
    assert other.travel(at @ np.linalg.inv(frame)) == pytest.approx(first, abs=1e-12)


def test_the_ceiling_is_above_the_surface_everywhere():
    _, insert = bodies()
    lift = np.random.default_rng(0).uniform(0, 1e-3, len(insert.vertices))
    ceiling = HeightBound(insert, lift)
    points = insert.triangles.mean(axis=1)
    above = ceiling.over(points) - points[:, 1]
    assert (above >= -1e-15).all()
    assert np.median(above[insert.face_normals[:, 1] > 0.5]) < 0.2e-3
    rng = np.random.default_rng(1)
    low = rng.uniform(-30e-3, 25e-3, (60, 2))
    high = low + rng.uniform(0, 20e-3, (60, 2))
    marked = ceiling.vertices_in_rectangles(low, high)
    top = np.zeros(len(insert.vertices), bool)
    top[insert.faces[insert.face_normals[:, 1] > 0]] = True
    for a, b, plane in zip(low, high, ceiling.planes(low, high), strict=True):
        xz = insert.vertices[:, ::2]
        inside = ((xz >= a) & (xz <= b)).all(axis=1)
        assert np.isin(np.flatnonzero(inside), marked).all()
        inside &= top
        height = insert.vertices[inside, 1] - xz[inside] @ plane[:2]
        assert (height <= plane[2] + 1e-15).all()
        assert (height + lift[inside] <= plane[3] + 1e-15).all()


def test_patches_stay_in_their_boxes():
    femoral, _ = bodies()
    reach = np.linspace(0, 1, len(femoral.vertices))
    patches = Patches(femoral, reach)
    at = knee_pose([1e-3, 5e-3, 0.5e-3, 0.3, 0.1, 1.2])
    low, high = patches.extent(at)
    directions = np.random.default_rng(2).normal(size=low.shape)
    least = patches.least(at, np.arange(len(low)), directions)
    seen = []
    for patch in range(len(low)):
        faces = patches.faces(np.array([patch]))
        corners = femoral.faces[faces].ravel()
        points = transform(at, femoral.vertices[corners])
        assert (points >= low[patch] - 1e-15).all() and (points <= high[patch] + 1e-15).all()
        assert (points @ directions[patch]).min() >= least[patch] - 1e-15
        assert patches.reach[patch] == reach[corners].max()
        seen.append(faces)
    assert np.array_equal(np.sort(np.concatenate(seen)), np.arange(len(femoral.faces)))


def test_a_flat_face_along_the_bounding_box_makes_patches():
    """The mean of three equal heights may be rounded below the lowest of them."""
    plate = flat_insert(10e-3, 24e-3, 24e-3)
    for height in np.linspace(0.1, 0.7, 50):
        surface = Surface(plate.vertices + np.array([0.0, height, 0.0]), plate.faces, "plate")
        low, high = Patches(surface, np.zeros(len(surface.vertices))).extent(np.eye(4))
        assert (low.min(axis=0) < surface.bounds[0] + 1e-9).all()
        assert (high.max(axis=0) > surface.bounds[1] - 1e-9).all()
