"""Rays: exact distances, no gaps between triangles, every crossing once."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from inserts import dished, raised
from shapes import sphere
from tkamb.geometry.height_field import inside_intervals
from tkamb.geometry.surface import Surface

DOWN = (0.0, -1.0, 0.0)


def brute(surface, origins, direction):
    """Return the first crossings of nearly vertical rays, from all triangles."""
    a, b, c = np.moveaxis(surface.triangles, 1, 0)
    e1, e2, d = b - a, c - a, np.asarray(direction, float)
    p = np.cross(d, e2)
    det = np.einsum("ij,ij->i", e1, p)
    best = np.full(len(origins), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for n, origin in enumerate(origins):
            s = origin - a
            u = np.einsum("ij,ij->i", s, p) / det
            q = np.cross(s, e1)
            v, t = q @ d / det, np.einsum("ij,ij->i", e2, q) / det
            hit = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1 + 1e-12) & (t >= 0)
            best[n] = t[hit].min(initial=np.inf)
    return best


def test_barycentric_coordinates_of_crossings_are_exact():
    """Through faces, edges and vertices; NaN beside the sphere."""
    surface = sphere(0.02, 3, (0.0, 0.0, 0.0))
    upper = surface.vertices[surface.vertices[:, 1] > 5e-3]
    middles = surface.triangles.mean(axis=1)
    ends = surface.vertices[surface.mesh.edges_unique].mean(axis=1)
    aims = np.concatenate([upper, middles[middles[:, 1] > 5e-3], ends[ends[:, 1] > 5e-3]])
    origins = np.concatenate([aims * [1, 0, 1] + [0, 0.05, 0], [[0.03, 0.05, 0.0]]])
    distance, face, weights = surface.rays.first_in_face(origins, DOWN)
    assert face[-1] == -1 and np.isnan(weights[-1]).all()
    assert (face[:-1] >= 0).all() and (weights[:-1] > -1e-9).all()
    np.testing.assert_allclose(weights[:-1].sum(axis=1), 1.0, atol=1e-12)
    points = np.einsum("ij,ijk->ik", weights[:-1], surface.triangles[face[:-1]])
    hit = origins[:-1] + distance[:-1, None] * DOWN
    np.testing.assert_allclose(points, hit, atol=1e-11)


@pytest.mark.parametrize("far", [0.0, 1.0, 100.0])
def test_first_agrees_with_all_triangles_in_double_precision(far):
    surface = sphere(0.02, 3, (far, 0.0, far))
    rng = np.random.default_rng(1)
    direction = np.array([0.3, -1.0, 0.2]) / np.linalg.norm([0.3, -1.0, 0.2])
    origins = rng.uniform(-0.02, 0.02, (200, 3)) + np.array([far, 0.05, far])
    distance, face = surface.rays.first(origins, direction)
    expected = brute(surface, origins, direction)
    assert ((face >= 0) == np.isfinite(expected)).mean() > 0.99
    common = (face >= 0) & np.isfinite(expected)
    assert common.sum() > 50
    np.testing.assert_allclose(distance[common], expected[common], atol=1e-13 * (1 + far))


def test_hits_lie_in_the_plane_of_their_triangle():
    surface, _ = dished()
    rng = np.random.default_rng(2)
    origins = np.column_stack(
        [rng.uniform(-0.02, 0.02, 2000), np.full(2000, 0.5), rng.uniform(-0.03, 0.03, 2000)]
    )
    distance, face = surface.rays.first(origins, DOWN)
    assert (face >= 0).all()
    hit = origins + distance[:, None] * DOWN
    offset = np.einsum("ij,ij->i", hit - surface.triangles[face, 0], surface.face_normals[face])
    assert np.abs(offset).max() < 1e-15


def test_rays_through_vertices_and_edges_meet_the_surface():
    surface, top = dished()
    x, z = np.linspace(-0.02, 0.02, 161), np.linspace(-0.03, 0.03, 241)
    xx, zz = (v.ravel() for v in np.meshgrid(x, z, indexing="ij"))
    origins = np.column_stack([xx, np.full(len(xx), 0.1), zz])
    distance, face = surface.rays.first(origins, DOWN)
    assert (face >= 0).all()
    on_vertex = (np.arange(161)[:, None] % 2 == 0) & (np.arange(241) % 2 == 0)
    np.testing.assert_allclose(0.1 - distance[on_vertex.ravel()], top(xx, zz)[on_vertex.ravel()])


def test_all_crossings_appear_once_and_sorted():
    surface, _ = dished()
    x, z = np.linspace(-0.0199, 0.0199, 80), np.linspace(-0.0299, 0.0299, 120)
    xx, zz = (v.ravel() for v in np.meshgrid(x, z, indexing="ij"))
    origins = np.column_stack([xx, np.full(len(xx), 0.1), zz])
    vertical = surface.vertices[np.abs(surface.vertices[:, 1]) > 1e-6][:500] * [0.999, 0, 0.999]
    origins = np.concatenate([origins, vertical + np.array([0, 0.1, 0])])
    ray, distance, face = surface.rays.all(origins, DOWN)
    np.testing.assert_array_equal(np.bincount(ray), np.full(len(origins), 2))
    np.testing.assert_array_equal(ray, np.sort(ray))
    assert (np.diff(distance.reshape(-1, 2), axis=1) > 0.005).all()
    up = surface.face_normals[face, 1].reshape(-1, 2)
    assert (up[:, 0] > 0).all()
    assert (up[:, 1] < 0).all()


def test_rays_through_the_centre_of_a_sphere_cross_it_twice():
    ball = sphere(0.02, 5)
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(500, 3))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    ray, distance, _ = ball.rays.all(-0.05 * unit, directions)
    np.testing.assert_array_equal(ray, np.repeat(np.arange(500), 2))
    assert np.abs(distance.reshape(-1, 2) - [0.03, 0.07]).max() < 2e-5


def test_rays_from_inside_and_on_the_surface_have_exact_distances():
    ball = sphere(0.02, 4)
    caster = ball.rays
    inside, _ = caster.first([[0.0, 0.0, 0.0]], DOWN)
    assert inside[0] == pytest.approx(0.02, abs=1e-9)
    on, _ = caster.first([[0.0, -0.02, 0.0]], DOWN)
    assert on[0] == pytest.approx(0.0, abs=1e-12)
    beyond, face = caster.first([[0.0, -0.0201, 0.0]], DOWN)
    assert np.isinf(beyond[0])
    assert face[0] == -1


def test_intervals_on_a_grid_are_exact_and_closed():
    """Lines through vertices, edges and along walls have even numbers of crossings."""
    x, z = np.linspace(-0.02, 0.02, 81), np.linspace(-0.03, 0.03, 121)
    height = 0.01 + 0.002 * np.sin(200 * x)[:, None] * np.cos(150 * z)
    solid = np.ones((80, 120), bool)
    solid[30:50, 40:60] = False
    surface = raised(x, z, height, solid)
    result = inside_intervals(surface, 1, z, x)
    assert result.mended == 0
    i, k = result.second, result.first
    hole = (i > 30) & (i < 50) & (k > 40) & (k < 60)
    assert not hole.any()
    assert len(i) == 81 * 121 - 19 * 19
    np.testing.assert_allclose(result.lower, 0.0, atol=1e-18)
    np.testing.assert_allclose(result.upper, height[i, k], atol=1e-17)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_intervals_agree_with_rays_on_random_grids(seed):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn[:, 0] *= np.sign(np.linalg.det(turn))
    surface, _ = dished(spacing=2e-3)
    surface = Surface(surface.vertices @ turn.T, surface.faces)
    low, high = surface.bounds
    axis = int(rng.integers(3))
    lines = [np.sort(rng.uniform(low[(axis + s) % 3], high[(axis + s) % 3], 20)) for s in (1, 2)]
    result = inside_intervals(surface, axis, *lines)
    a, b = (v.ravel() for v in np.meshgrid(*lines, indexing="ij"))
    origins = np.empty((400, 3))
    origins[:, axis] = low[axis] - 0.01
    origins[:, (axis + 1) % 3], origins[:, (axis + 2) % 3] = a, b
    ray, distance, _ = surface.rays.all(origins, np.eye(3)[axis])
    np.testing.assert_array_equal(ray[::2], result.first * 20 + result.second)
    np.testing.assert_allclose(low[axis] - 0.01 + distance[::2], result.lower, atol=1e-12)
    np.testing.assert_allclose(low[axis] - 0.01 + distance[1::2], result.upper, atol=1e-12)


def test_a_surface_computes_rays_and_normals_once_and_does_not_pickle_them():
    ball = sphere(0.02, 3, (0.0, 0.0, 0.0))
    assert ball.rays is ball.rays and ball.nearest is ball.nearest
    assert ball.corner_normals is ball.corner_normals
    copied = pickle.loads(pickle.dumps(ball))
    assert set(vars(copied)) == {"vertices", "faces", "name", "merged"}
    origins, up = np.array([[0.0, -1.0, 0.0]]), (0.0, 1.0, 0.0)
    assert copied.rays.first(origins, up)[0] == ball.rays.first(origins, up)[0]
