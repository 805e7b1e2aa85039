"""The solids of the viewer: decimated surfaces, foot, floor, bones, muscles; and load paths."""

from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib import colormaps
from scipy.spatial import cKDTree

from knees import UP, bent_knee
from shared_trials import SHANK, THIGH, two_flexors
from tkamb.geometry.frames import inverse, transform
from tkamb.geometry.surface import Surface
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.load import PointForces
from tkamb.run.metrics import JUMP
from tkamb.run.muscles.shared_muscles import SharedMuscles
from tkamb.run.read_scene import recording_of
from tkamb.show.style import PRESSURE_MAP
from tkamb.show.view import drawing as colours
from tkamb.show.view.draw import draw
from tkamb.show.view.drawing import SLACK, activation_scale, pressure_scale, rgb, strain_scale
from tkamb.show.view.lines import LEAST_ACTIVATION, SLACK_FORCE, muscle_strands, path_strands
from tkamb.show.view.payload import MAX_TRIANGLES, decimate, shade
from tkamb.show.view.run import open_run
from tkamb.show.view.solids import box, floor_and_foot, hull, revolved, solids, sphere_points
from viewed import MODELS, shipped_run

DM = MODELS / "dm" / "scene.toml"


@pytest.fixture(scope="module")
def run():
    return open_run(shipped_run())


@pytest.fixture(scope="module")
def drawing(run):
    return draw(run)


def surface(mesh):
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64), "body")


@cache
def ball(rings=60):
    return surface(trimesh.creation.uv_sphere(radius=0.03, count=[rings, rings]))


@lru_cache(2)
def samples_of(whole, spacing=1e-4):
    """Return the tree of samples of a surface with about this spacing, m."""
    mesh = trimesh.Trimesh(whole.vertices, whole.faces)
    samples = trimesh.sample.sample_surface(mesh, int(mesh.area / spacing**2), seed=1)[0]
    return cKDTree(np.concatenate([samples, whole.vertices]))


@pytest.mark.parametrize(("most", "largest"), [(6000, 1e-4), (2000, 5e-4), (500, 2e-3)])
def test_a_decimated_surface_is_within_its_stated_error(most, largest):
    whole = ball()
    fewer, error = decimate(whole, most)
    assert 0 < len(fewer.faces) <= most and 0 < error < largest
    for one, other in ((fewer, whole), (whole, fewer)):
        assert samples_of(other).query(one.vertices)[0].max() < error + 2e-4


def test_a_decimated_surface_faces_outwards_and_keeps_its_volume():
    whole = ball()
    fewer, error = decimate(whole, 1500)
    outwards = np.einsum("ij,ij->i", fewer.face_normals, fewer.triangles.mean(axis=1))
    assert (outwards > 0).all()
    volume = [trimesh.Trimesh(one.vertices, one.faces).volume for one in (fewer, whole)]
    assert abs(volume[0] - volume[1]) < error * 4 * np.pi * 0.03**2


def test_decimation_keeps_flat_faces_and_sharp_edges():
    box = trimesh.creation.box((0.02, 0.03, 0.04))
    for _ in range(5):
        box = box.subdivide()
    fewer, error = decimate(surface(box), 3000)
    assert len(fewer.faces) <= 3000 and error < 1e-4
    off_the_box = np.abs(np.abs(fewer.vertices) - (0.01, 0.015, 0.02)).min(axis=1)
    assert off_the_box.max() < 1e-8
    assert trimesh.Trimesh(fewer.vertices, fewer.faces).volume == pytest.approx(24e-6, rel=1e-6)


def test_a_small_surface_is_not_decimated():
    whole = ball(20)
    fewer, error = decimate(whole, len(whole.faces))
    assert fewer is whole and error == 0.0


def test_the_shipped_implant_is_drawn_within_a_third_of_a_millimetre(drawing):
    for solid in drawing.solids:
        drawn = shade(solid.surface)
        assert len(drawn.faces) <= MAX_TRIANGLES
        assert drawn.error < 0.35e-3


def test_the_ground_reaction_acts_on_the_drawn_floor(run, drawing):
    floor = next(one for one in drawing.solids if one.name == "floor")
    arrow = next(one for one in drawing.arrows if one.name == "ground reaction")
    for row, k in enumerate(run.frames):
        local = transform(inverse(floor.poses[row]), arrow.points[row])
        assert abs(local[1]) < 1e-9
        up = run.case.ground.force[k] @ [0.0, 1.0, 0.0]
        assert floor.poses[row][:3, 1] @ arrow.forces[row] == pytest.approx(up, rel=1e-9)
    marker = next(one for one in drawing.markers if one.name == "centre of pressure")
    np.testing.assert_array_equal(marker.points, arrow.points)


def test_the_foot_is_on_the_floor_and_contains_the_ankle(run, drawing):
    foot = next(one for one in drawing.solids if one.name == "foot")
    floor = next(one for one in drawing.solids if one.name == "floor")
    for row, k in enumerate(run.frames):
        ankle = run.recording.geometry(k).state.point("tibia", np.zeros(3))
        sole = transform(inverse(floor.poses[row]) @ foot.poses[row], foot.surface.vertices)
        assert abs(sole[:, 1].min()) < 1e-3
        local = transform(inverse(foot.poses[row]), ankle)
        low, high = foot.surface.bounds
        assert (local > low).all() and (local < high).all()


def test_no_floor_is_drawn_if_the_reaction_acts_at_the_ankle():
    scene = load_scene(
        MODELS / "deep_knee_bend" / "scene.toml", {"ground_reaction.applied": "ankle"}
    )
    assert floor_and_foot(load_case(scene), (), ()) == ((), ())


def test_centres_of_pressure_lie_on_the_insert(run, drawing):
    rays = run.case.insert.rays
    markers = [one for one in drawing.markers if "centre of pressure" in one.name][-2:]
    for marker in markers:
        assert np.isfinite(marker.points).all()
        down, _ = rays.first(marker.points + np.array([0.0, 1e-3, 0.0]), np.array([0.0, -1.0, 0.0]))
        np.testing.assert_allclose(down, 1e-3, atol=1e-9)


def test_a_load_path_is_interrupted_at_a_jump():
    x = np.array([0.0, 1e-3, 2e-3, 2e-3 + 1.5 * JUMP, 3e-3 + 1.5 * JUMP, np.nan, 0.0])
    points = np.column_stack([x, np.zeros(7), np.zeros(7)])
    strands = path_strands({"medial": points})
    assert [strand.points.shape[1] for strand in strands] == [3, 2]


def test_a_load_path_of_few_frames_is_not_interrupted():
    x = np.array([0.0, 0.9, 2.1, 3.2]) * 2 * JUMP
    points = np.column_stack([x, np.zeros(4), np.zeros(4)])
    assert [strand.points.shape[1] for strand in path_strands({"lateral": points})] == [4]


def test_the_bone_mesh_of_the_scene_is_drawn():
    data = Path(__file__).parents[2] / "shared" / "data" / "dm"
    if not data.is_dir():
        pytest.skip("subject DM's data are not beside the project")
    case = load_case(load_scene(DM, {"motion.frames": 26}))
    recording = recording_of(case)
    states = [recording.geometry(k).state for k in range(2)]
    made = solids(case, recording.poses[:2], states, None, [-1] * 2)
    femur = next(one for one in made if one.name == "femur")
    given = trimesh.load(data / "geometry" / "bone_femur.stl")
    assert len(femur.surface.faces) == len(given.faces)
    hip = np.linalg.norm(femur.surface.vertices, axis=1).max()
    assert 0.3 < hip < 0.6


def test_simple_solids_are_closed_and_have_the_volume_of_their_shapes():
    radius, height = np.array([0.02, 0.01, 0.03]), np.array([0.0, 0.1, 0.2])
    cones = np.diff(height) * (radius[1:] ** 2 + radius[1:] * radius[:-1] + radius[:-1] ** 2) / 3
    share = 28 / (2 * np.pi) * np.sin(2 * np.pi / 28)  # area of a 28-gon over its circle's
    for made, volume, rel in (
        (box(np.array([0.3, 0.1, 0.2]), "box"), 6e-3, 1e-12),
        (hull(sphere_points(), "ball"), 4 / 3 * np.pi, 0.01),
        (revolved(radius, height, "shaft"), np.pi * share * cones.sum(), 1e-9),
    ):
        mesh = trimesh.Trimesh(made.vertices, made.faces, process=False)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume == pytest.approx(volume, rel=rel)


@pytest.mark.parametrize(
    ("scale", "name", "lowest"),
    [
        (colours.pressure_scale, PRESSURE_MAP, 0.0),
        (colours.strain_scale, "YlOrRd", 0.15),
        (colours.activation_scale, "BuPu", 0.35),
        (colours.wear_scale, "YlGnBu", 0.0),
    ],
)
def test_the_colour_scales_equal_those_of_matplotlib(scale, name, lowest):
    wanted = colormaps[name](np.linspace(lowest, 1.0, 256))[:, :3] * 255.0
    assert np.array_equal(scale(), np.round(wanted))


def frames():
    """Return the bent knee with active flexors, with slack ones, and without a solution."""
    ground = PointForces("tibia", np.array([[0.06, -0.45, 0.0]]), 700 * UP[None])
    knee = replace(bent_knee(), ground=ground)
    active, _ = SharedMuscles(two_flexors(1, least=0.0)).frame(0).solve(knee, 0.05)
    zero = 0.0 * active.share.force
    slack = replace(active, share=replace(active.share, force=zero, activation=zero))
    return [
        active,
        slack,
        replace(active, share=replace(active.share, status="failed: for a test")),
    ]


def test_lines_connect_shank_and_thigh_and_are_nan_without_a_solution():
    geometries = frames()
    strands, _ = muscle_strands(geometries)
    assert [strand.name for strand in strands] == ["hamstring", "gastrocnemius"]
    for k, strand in enumerate(strands):
        assert strand.layer == "muscles"
        start = transform(geometries[0].state.pose("tibia"), SHANK[k])
        end = transform(geometries[0].state.pose("femur"), THIGH[k])
        np.testing.assert_allclose(strand.points[:2], [[start, end]] * 2)
        assert np.isnan(strand.points[2]).all()


def test_colours_follow_the_activation_and_slack_muscles_are_grey():
    geometries = frames()
    strands, limit = muscle_strands(geometries)
    share = geometries[0].share
    assert share.force[1:].min() > SLACK_FORCE
    assert limit == max(share.activation[1:].max(), LEAST_ACTIVATION)
    for strand, activation in zip(strands, share.activation[1:], strict=True):
        wanted = activation_scale()[int(activation / limit * 255)]
        np.testing.assert_array_equal(strand.colours[0], [wanted, wanted])
        np.testing.assert_array_equal(strand.colours[1], [rgb(SLACK)] * 2)


def test_the_activation_scale_differs_from_other_scales_and_darkens():
    scale = activation_scale().astype(int)
    for other in (pressure_scale(), strain_scale(), rgb(SLACK)[None]):
        difference = np.abs(scale[:, None] - other[None].astype(int)).max(axis=2)
        assert difference.min() > 8
    light = scale @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(light) <= 0.5).all()
    assert light[0] - light[-1] > 100


def test_without_muscles_there_are_no_strands():
    assert muscle_strands([bent_knee()]) == ((), 0.0)
