"""Condyles, closest and lowest points, against closed forms, brute force and DM's gaps."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from shapes import bicondylar, nearest_on_triangles, plate, sphere, trough, two_dishes
from tkamb.geometry.closest import ClosestPointQuery
from tkamb.geometry.condyles import LowestPoints, condyle_faces, condyle_split
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import inverse, knee_pose, pose, transform
from tkamb.geometry.nearest import NearestPoints, sampled
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.meshes import axes_rotation, load_surface

DATA = Path(__file__).parents[2] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the measured data are missing")

RADIUS = 0.02
STEPS = [1e-3, 1e-4, 1e-5, 1e-7, -1e-7, -1e-5, -1e-4, -1e-3]

MEDIAL_MM = """-0.57 -0.70 -0.61 -0.64 -0.64 -0.46 -0.40 -0.69 -0.56 -0.61 -0.72 -0.60 -0.34
-0.59 -0.33 -0.08 -0.18 0.01 -0.12 -0.46 -0.47"""
LATERAL_MM = """0.12 -0.35 -0.24 -0.29 -1.00 -1.24 -0.64 -0.22 -0.22 -0.10 -0.29 -0.32 -0.42
0.03 0.27 0.58 0.07 0.67 -0.07 0.27 0.28"""


def lifted(y, x=0.0, z=0.0, turn=None):
    return pose(np.eye(3) if turn is None else turn.as_matrix(), [x, y, z])


def part(subject, name):
    path = DATA / subject / "geometry" / f"{name}.stl"
    return load_surface(path, "m", "-x,+y,-z", name=name, closed=True)


# nearest points


def test_nearest_points_of_triangles_of_any_size_or_shape_are_exact():
    """Against dense samples; some triangles are slivers or have no area."""
    rng = np.random.default_rng(0)
    triangles = rng.normal(size=(200, 3, 3))
    triangles[:40, 2] = triangles[:40, 1] + 1e-4 * rng.normal(size=(40, 3))
    triangles[40:60, 2] = (triangles[40:60, 0] + triangles[40:60, 1]) / 2
    triangles[60:70, 1:] = triangles[60:70, :1]
    points = rng.normal(size=(200, 3)) * 1.5
    u, v = (g.ravel() for g in np.meshgrid(*2 * [np.linspace(0, 1, 61)]))
    weights = np.stack([1 - u - v, u, v], axis=1)[u + v <= 1]
    dense = np.einsum("sj,kjc->ksc", weights, triangles)
    sampled_distance = np.linalg.norm(dense - points[:, None], axis=2).min(axis=1)
    for scale in (1.0, 1e-3, 1e-5):
        distance = np.empty(len(points))
        for k, (corners, point) in enumerate(zip(triangles * scale, points * scale, strict=True)):
            result = NearestPoints(Surface(corners, np.arange(3)[None])).at(point)
            distance[k] = result.distance[0] / scale
            assert np.linalg.norm(result.points[0] - point) / scale == pytest.approx(distance[k])
        assert (distance <= sampled_distance + 1e-9).all()
        assert np.allclose(distance, sampled_distance, atol=6e-3)


def test_nearest_points_equal_a_brute_force_search():
    insert = two_dishes()
    rng = np.random.default_rng(1)
    points = rng.uniform([-0.02, -0.002, -0.04], [0.02, 0.03, 0.04], (150, 3))
    result = NearestPoints(insert).at(points)
    for point, distance in zip(points, result.distance, strict=True):
        all_feet = nearest_on_triangles(insert.triangles, np.tile(point, (len(insert.faces), 1)))
        assert distance == pytest.approx(np.linalg.norm(all_feet - point, axis=1).min(), abs=1e-15)


def test_nearest_points_within_reach_equal_those_without_a_limit():
    insert = two_dishes()
    rng = np.random.default_rng(2)
    points = rng.uniform([-0.02, -0.002, -0.04], [0.02, 0.03, 0.04], (400, 3))
    unlimited = insert.nearest.at(points)
    near, result = insert.nearest.within(points, 2e-3)
    assert np.array_equal(near, np.flatnonzero(unlimited.distance <= 2e-3)) and 20 < len(near) < 380
    assert np.array_equal(result.distance, unlimited.distance[near])
    assert np.array_equal(result.faces, unlimited.faces[near])
    back = insert.nearest.at(points[::-1])  # another way through the tree
    assert np.array_equal(back.faces[::-1], unlimited.faces)


def test_samples_have_the_area_of_the_surface():
    insert = two_dishes()
    samples, owner, areas = sampled(insert, 5e-4)
    assert areas.sum() == pytest.approx(insert.mesh.area)
    assert np.allclose(np.bincount(owner, areas), insert.mesh.area_faces)
    middle = areas @ samples / areas.sum()
    assert np.allclose(middle, insert.mesh.centroid, atol=1e-9)


# condyles


@pytest.mark.parametrize("kind", ["sphere", "torus"])
@pytest.mark.parametrize("shift", [0.0, 0.007])
def test_two_condyles_are_split_in_the_notch(kind, shift):
    femoral = bicondylar(kind).moved(lifted(0.0, z=shift))
    split = condyle_split(femoral)
    assert split == pytest.approx(shift, abs=1.5e-3)
    medial, lateral = condyle_faces(femoral, split)
    assert len(medial) + len(lateral) == len(femoral.faces)
    assert femoral.triangles[lateral][:, :, 2].mean() > split


@pytest.mark.parametrize("shape", ["sphere", "cylinder", "barrel", "unicondylar"])
def test_one_condyle_is_not_split(shape):
    if shape == "sphere":
        femoral = sphere(RADIUS)
    elif shape == "cylinder":
        mesh = trimesh.creation.cylinder(RADIUS, 0.05)
        femoral = Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    elif shape == "barrel":
        femoral = Surface(sphere(RADIUS).vertices * [1.0, 1.0, 1.8], sphere(RADIUS).faces)
    else:
        cut = sphere(RADIUS).vertices * [1.4, 1.0, 0.4]
        femoral = Surface(np.minimum(cut, [1.0, 0.004, 1.0]), sphere(RADIUS).faces)
    assert condyle_split(femoral) is None
    medial, lateral = condyle_faces(femoral, None)
    assert len(medial) == len(femoral.faces)
    assert len(lateral) == 0


# closest points


@pytest.mark.parametrize("turned", [False, True])
def test_the_gap_of_a_sphere_over_a_plane_is_exact_on_both_sides_of_touch(turned):
    """Gap, points and normal. A face of the sphere may be lowest, with a sagitta of 10 µm."""
    ball, top = sphere(RADIUS, 5), 0.01
    turn = Rotation.from_rotvec([0.3, 0.2, -0.5]) if turned else None
    query = ClosestPointQuery(ball, plate(top), None)
    for gap in STEPS:
        at = lifted(top + RADIUS + gap, 0.003, 0.002, turn)
        lowest = transform(at, ball.vertices)[:, 1].min() - top
        result = query.at(at)
        assert result.lateral is None
        assert result.medial.gap == pytest.approx(lowest, abs=1e-9)
        assert result.medial.point_on_femoral[1] == pytest.approx(top + lowest, abs=1e-9)
        assert result.medial.point_on_insert[1] == pytest.approx(top, abs=1e-9)
        assert result.medial.centre == pytest.approx([0.003, top, 0.002], abs=2e-4)
        assert np.allclose(result.medial.normal, [0, 1, 0], atol=1e-9)


def test_the_gap_of_a_sphere_in_a_trough_is_exact_on_both_sides_of_touch():
    """Trough of radius 30 mm, sphere of 20 mm: gap = 30 - 20 - distance of the axes."""
    outer, depth = 0.03, 0.006
    query = ClosestPointQuery(sphere(RADIUS, 5), trough(outer, depth, 5e-4), None)
    axis = np.array([0.0, depth + outer, 0.0])
    for gap in STEPS:
        for angle in (0.0, 0.2):
            towards = np.array([np.sin(angle), -np.cos(angle), 0.0])
            centre = axis + (outer - RADIUS - gap) * towards
            result = query.at(lifted(centre[1], centre[0])).medial
            assert result.gap == pytest.approx(gap, abs=1.2e-5)
            assert result.centre == pytest.approx(axis + outer * towards, abs=4e-4)
            assert result.normal @ -towards > np.cos(np.radians(0.7))


def test_the_gap_is_continuous_through_touch_with_slope_one():
    ball = sphere(RADIUS, 4)
    query = ClosestPointQuery(ball, trough(0.03), None)
    turn = Rotation.from_rotvec([0.1, 0.4, 0.2])
    start = 0.026 - query.at(lifted(0.026, turn=turn)).medial.gap
    steps = np.array([3, 2, 1, 0.5, 0.1, 0.01, -0.01, -0.1, -0.5, -1, -2, -3]) * 1e-6
    gaps = [query.at(lifted(start + step, turn=turn)).medial.gap for step in steps]
    assert np.allclose(gaps, steps, atol=5e-8)


def test_an_overlap_without_a_femoral_vertex_inside_is_found():
    """Only the inside of a femoral face lies in the insert."""
    mesh = trimesh.creation.box((0.06, 0.01, 0.06))
    slab = Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64))
    ball = sphere(0.01, 4)
    ball = Surface(np.maximum(ball.vertices, [-1, -0.005, -1]), ball.faces)
    ball = ball.moved(lifted(0.005))
    query = ClosestPointQuery(slab, ball, None)
    for depth in (1e-3, 1e-4, 1e-5):
        result = query.at(lifted(0.015 - depth + 0.005)).medial
        assert result.gap == pytest.approx(-depth, rel=0.02, abs=1e-6)


def test_each_condyle_has_its_own_gap():
    femoral, insert = bicondylar(), two_dishes()
    split = condyle_split(femoral)
    query = ClosestPointQuery(femoral, insert, split)
    level = query.at(lifted(0.006 + 0.022))
    assert level.medial.gap == pytest.approx(0, abs=1.5e-5)
    assert level.lateral.gap == pytest.approx(level.medial.gap, abs=2e-6)
    assert level.medial.centre[2] == pytest.approx(-0.022, abs=3e-4)
    assert level.lateral.centre[2] == pytest.approx(0.022, abs=3e-4)
    varus = query.at(knee_pose([0, 0.028, 0, 0, np.radians(1), 0]))
    expected = 0.044 * np.sin(np.radians(1))
    assert varus.lateral.gap - varus.medial.gap == pytest.approx(expected, rel=0.03)


def test_the_height_bound_does_not_change_gaps(monkeypatch):
    """From 1 mm apart to 2 mm inside the gaps equal those of a search over all vertices."""
    femoral, insert = bicondylar(), two_dishes()
    bounded, unbounded = (ClosestPointQuery(femoral, insert, 0.0) for _ in range(2))
    monkeypatch.setattr(
        unbounded, "_ceiling", SimpleNamespace(over=lambda points: np.full(len(points), np.inf))
    )
    rng = np.random.default_rng(2)
    for height in (0.029, 0.028, 0.0279, 0.026):
        at = knee_pose([*rng.uniform(-4e-3, 4e-3, 3), *rng.uniform(-0.05, 0.05, 2), 0.7])
        at[1, 3] = height
        result, expected = bounded.at(at), unbounded.at(at)
        for side in ("medial", "lateral"):
            bounded_gap, full_gap = vars(getattr(result, side)), vars(getattr(expected, side))
            assert all(np.array_equal(bounded_gap[key], full_gap[key]) for key in full_gap)


def test_a_move_in_the_plane_does_not_change_the_gap():
    ball, insert = sphere(RADIUS, 4), plate()
    for height in (0.0301, 0.0295):
        before = ClosestPointQuery(ball, insert, None).at(lifted(height)).medial
        shift = np.array([0.002, 0.0, -0.003])
        moved = ball.moved(lifted(0.01, 0.02, -0.01, Rotation.from_rotvec([0.1, 0.2, 0.3])))
        back = inverse(lifted(0.01, 0.02, -0.01, Rotation.from_rotvec([0.1, 0.2, 0.3])))
        after = (
            ClosestPointQuery(moved, insert, None).at(lifted(height, *shift[[0, 2]]) @ back).medial
        )
        assert after.gap == pytest.approx(before.gap, abs=1e-12)
        assert np.allclose(after.centre, before.centre + shift, atol=2e-4)


# lowest points


def test_lowest_point_of_a_rolling_ball_stays_under_its_centre():
    ball = sphere(RADIUS, 4)
    lowest = LowestPoints(ball, None)
    for angle in np.linspace(0, 1, 15):
        turn = Rotation.from_rotvec([angle, 0.3, 2 * angle])
        medial, lateral = lowest.at(lifted(0.03, 0.004, -0.002, turn))
        assert lateral is None
        assert medial == pytest.approx([0.004, 0.01, -0.002], abs=2e-4)
        assert medial[1] == pytest.approx(
            transform(lifted(0.03, turn=turn), ball.vertices)[:, 1].min()
        )


def test_lowest_points_of_two_condyles_lie_below_their_centres():
    femoral = bicondylar()
    medial, lateral = LowestPoints(femoral, 0.0).at(knee_pose([0, 0.03, 0, 0, 0, 0.5]))
    assert medial == pytest.approx([0, 0.008, -0.022], abs=2e-4)
    assert lateral == pytest.approx([0, 0.008, 0.022], abs=2e-4)


# real implants


@needs_data
@pytest.mark.parametrize("subject", ["dm", "jw"])
def test_real_femurs_split_near_the_middle(subject):
    assert condyle_split(part(subject, "femoral_component")) == pytest.approx(0.0, abs=1e-3)


@needs_data
def test_gaps_of_subject_dm_over_the_gait_cycle_agree_with_the_table():
    """At steps of 5 %, the gaps are those of the data's table within 0.05 mm in 19 of 21 frames."""
    insert, femoral = part("dm", "tibial_insert"), part("dm", "femoral_component")
    placement = insert_placement(insert)
    axes = pose(axes_rotation("-x,+y,-z"), np.zeros(3))
    query = ClosestPointQuery(femoral, insert.moved(placement), condyle_split(femoral))
    rows = np.loadtxt(DATA / "dm" / "fluoroscopy" / "gait_cycle.sto", skiprows=5)[::5]
    turns = Rotation.from_euler("XYZ", rows[:, 4:7]).as_matrix()
    poses = placement @ axes @ pose(turns, rows[:, 1:4]) @ inverse(axes)
    gaps = [query.at(at) for at in poses]
    for text, result in (
        (MEDIAL_MM, [g.medial.gap for g in gaps]),
        (LATERAL_MM, [g.lateral.gap for g in gaps]),
    ):
        table = np.array(text.split(), float)
        assert (np.abs(1e3 * np.array(result) - table) < 0.05).sum() >= 19


@needs_data
@pytest.mark.parametrize("subject", ["dm", "jw"])
def test_gaps_of_real_implants_are_continuous_through_touch_and_flexion(subject):
    """The gap is continuous through touch, and the centre moves without jumps."""
    insert = part(subject, "tibial_insert")
    insert = insert.moved(insert_placement(insert))
    femoral = part(subject, "femoral_component")
    query = ClosestPointQuery(femoral, insert, condyle_split(femoral))
    height, path = 0.042, []
    for flexion in np.radians(np.arange(0.0, 21.0, 2.0)):
        for _ in range(5):
            gaps = query.at(knee_pose([0, height, 0, 0, 0, flexion]))
            height -= gaps.lateral.gap
        near = [query.at(knee_pose([0, height + d, 0, 0, 0, flexion])) for d in (1e-6, -1e-6)]
        assert near[0].lateral.gap == pytest.approx(1e-6, abs=1e-6)
        assert near[1].lateral.gap == pytest.approx(-1e-6, abs=1e-6)
        assert np.linalg.norm(near[0].lateral.centre - near[1].lateral.centre) < 2e-4
        assert near[0].lateral.normal @ near[1].lateral.normal > np.cos(np.radians(0.5))
        path.append(near[0].lateral.centre)
    bends = np.linalg.norm(np.diff(path, 2, axis=0)[:, [0]], axis=1)
    assert bends.max() < 8e-4
