"""The tree of boxes and its searches: sorted triangles, NaN and inf, other array types."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from shapes import plate, sphere
from tkamb.geometry import first_touch, nearest, rays
from tkamb.geometry.first_touch import MOST_CORNERS, FirstTouch
from tkamb.geometry.frames import pose
from tkamb.geometry.surface import Surface

DOWN = (0.0, -1.0, 0.0)
NONE = np.array([[np.nan, 0.0, 0.0], [0.0, np.nan, 0.0], [0.0, 0.0, np.inf], [-np.inf, 0.0, 0.0]])
"""Points that are not finite."""
WALL = [
    -0.013631006651548021,
    0.0031447617921752657,
    -0.02176825365033125,
    -0.00838428271569204,
    0.021726416192594522,
    -0.022365226031762588,
    -0.009741992311259998,
    0.0038915233313396138,
    -0.022210745799818354,
]
SLIVER = [
    -0.0020669894239509334,
    0.009999999999999998,
    -0.023084007821442487,
    -0.022784576370504496,
    0.009999999999999998,
    -0.020726760257400948,
    -0.016221770321141592,
    0.009999999999999998,
    -0.021473476494820253,
]
"""Corners, m, of an upright and a level triangle along one line, to within rounding."""


def ribbon(count):
    """Return a strip of `count` triangles, in order along x."""
    x = np.arange(count + 2.0)
    corners = np.stack([x, 0.0 * x, x % 2], axis=1)
    first = np.arange(count)[:, None]
    return Surface(corners, first + np.arange(3))


def test_a_point_that_is_not_finite_has_no_nearest_point():
    ball = sphere(0.02, 2)
    result = ball.nearest.at(np.concatenate([NONE, [[0.0, 0.03, 0.0]]]))
    assert np.isinf(result.distance[:-1]).all() and (result.faces[:-1] == -1).all()
    assert np.isnan(result.points[:-1]).all()
    assert result.points[-1] == pytest.approx([0.0, 0.02, 0.0])


def test_rays_that_are_not_finite_have_no_crossing():
    rays = sphere(0.02, 2).rays
    start = np.array([[0.0, 0.05, 0.0]])
    for origins, directions in [(NONE, DOWN), (np.tile(start, (4, 1)), NONE), (start, np.zeros(3))]:
        distance, face, weights = rays.first_in_face(origins, directions)
        assert np.isinf(distance).all() and (face == -1).all() and np.isnan(weights).all()
        assert len(rays.all(origins, directions)[0]) == 0
    after, _ = rays.first(np.concatenate([NONE, start]), DOWN)
    assert after[-1] == pytest.approx(0.03)


def test_rays_have_one_common_direction_or_one_each():
    rays = sphere(0.02, 2).rays
    for count, directions in [(3, 2), (3, 0), (1, 2)]:
        with pytest.raises(ValueError, match=f"{directions} directions for {count} rays"):
            rays.first(np.zeros((count, 3)), np.ones((directions, 3)))


def test_a_pose_that_is_not_finite_has_no_first_touch(monkeypatch):
    """Every comparison with NaN is false, so the search would compare all triangles."""
    touch = FirstTouch(sphere(0.02, 2), plate())
    monkeypatch.setattr(first_touch, "_least_clearance", None)
    for place in [(0, 0), (0, 3), (1, 3)]:
        at = np.eye(4)
        at[place] = np.nan
        assert np.isnan(touch.travel(at))


def test_a_side_without_a_triangle_does_not_touch():
    medial, lateral = FirstTouch(sphere(0.02, 2), plate(), -1.0).at(pose(np.eye(3), [0, 0.05, 0]))
    assert medial is None
    assert lateral.travel == pytest.approx(0.02)


def test_cuts_of_slivers_fit_into_the_work_array():
    """A wall along a sliver: by rounding its corners lie on either side of each edge."""
    wall, sliver = np.ravel(WALL), np.ravel(SLIVER)
    buffers = np.full((2, MOST_CORNERS + 8, 3), np.pi)
    plane = first_touch._plane(sliver)
    work = buffers[0, :MOST_CORNERS], buffers[1, :MOST_CORNERS]
    first_touch._over_each_other(wall, sliver, plane, np.inf, *work, np.empty(3))
    assert (buffers[:, MOST_CORNERS - 1] != np.pi).any(), "fewer corners than the maximum"
    assert (buffers[:, MOST_CORNERS:] == np.pi).all()


def test_other_array_types_do_not_trigger_compilation():
    ball = sphere(0.02, 2)
    points = np.zeros((4, 3))
    queries = [lambda p: ball.rays.first(p, DOWN), lambda p: ball.rays.all(p, DOWN)]
    queries += [lambda p: ball.rays.first(points, p), ball.nearest.at]
    queries += [lambda p: ball.nearest.within(p, 1)]
    loops = rays._first_crossings, rays._all_crossings, nearest._nearest_points
    fixed = points + 0.0
    fixed.setflags(write=False)
    others = fixed, points.astype(np.float32), np.asfortranarray(points), points.tolist()
    for query in queries:
        query(points)
    signatures_before = [set(loop.signatures) for loop in loops]
    for query in queries:
        for other in others:
            query(other)
    assert [set(loop.signatures) for loop in loops] == signatures_before


def test_sorted_triangles_are_divided_in_linear_time(monkeypatch):
    """Some triangles appear twice, to fill the leaves, which must not make the work quadratic."""
    orders = []
    monkeypatch.setattr(nearest, "_halve", lambda centres, order, leaves: orders.append(order))
    for count in (5, 63, 100):
        assert np.array_equal(np.unique(ribbon(count).tree.faces), np.arange(count))
    assert len(orders) == 3 and all((np.diff(order) >= 0).all() for order in orders)


def heights_over(points, triangle):
    """Return the height of a triangle's plane at points (n, 3); NaN beside the triangle."""
    a, b, c = triangle
    weights = np.linalg.solve(np.stack([b - a, c - a])[:, [0, 2]].T, (points - a)[:, [0, 2]].T).T
    inside = (weights >= 0.0).all(axis=1) & (weights.sum(axis=1) <= 1.0)
    return np.where(inside, a[1] + weights @ [b[1] - a[1], c[1] - a[1]], np.nan)


def clearance(upper, lower):
    """Return the smallest clearance of two triangles, at corners and crossings of edges in plan
    view.
    """
    clearances = [*(upper[:, 1] - heights_over(upper, lower))]
    clearances += [*(heights_over(lower, upper) - lower[:, 1])]
    for i, j in np.ndindex(3, 3):
        (p, q), (r, s) = upper[[i, i - 1]], lower[[j, j - 1]]
        along, across = np.linalg.solve(np.stack([q - p, r - s], axis=1)[[0, 2]], (r - p)[[0, 2]])
        if min(along, across) >= 0.0 and max(along, across) <= 1.0:
            clearances.append(p[1] + along * (q - p)[1] - r[1] - across * (s - r)[1])
    return np.nan_to_num(clearances, nan=np.inf).min()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1e-6, 0.03, 1e3]))
def test_first_touch_is_the_least_clearance_of_any_two_triangles(seed, scale):
    rng = np.random.default_rng(seed)
    counts = rng.integers(1, 12, 2)
    femoral, insert = (
        Surface(rng.normal(size=(3 * n, 3)) * scale, np.arange(3 * n).reshape(-1, 3))
        for n in counts
    )
    at = pose(Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3) * scale)
    upper = femoral.moved(at).triangles
    upward = insert.triangles[insert.face_normals[:, 1] > 0.0]
    assume(len(upward))
    expected = min(clearance(upper_triangle, other) for upper_triangle in upper for other in upward)
    result = FirstTouch(femoral, insert).travel(at)
    if np.isinf(expected):
        assert np.isnan(result)
    else:
        assert result == pytest.approx(expected, abs=1e-9 * scale)
