"""Subject DM: the scene loads, and its recordings are those of a walking subject."""

import re
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tkamb.geometry.closest import ClosestPointQuery
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import inverse, knee_pose, pose, transform
from tkamb.io.recordings.ground_reaction import load_ground_reaction
from tkamb.io.recordings.markers import marker_trajectories
from tkamb.io.recordings.meshes import axes_rotation, load_surface
from tkamb.io.recordings.motion import load_motion
from tkamb.io.recordings.tables import read_table
from tkamb.io.recordings.tibia import load_tibia
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.knee.ligament_laws import QuadraticToe
from tkamb.knee.ligament_paths import bundle_paths
from tkamb.knee.ligaments import build_ligaments
from tkamb.run.plausibility.movement import marker_questions
from tkamb.run.read_scene import recording_of

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data" / "dm"
SCENE = ROOT / "models" / "dm" / "scene.toml"
BODY_WEIGHT = 69.98 * 9.80665
STANCE = slice(0, 61)

pytestmark = pytest.mark.skipif(
    not (DATA / "DM.osim").is_file(), reason="subject DM's files (../shared/data/dm) are absent"
)

MEDIAL_MM = (
    "-0.57 -0.70 -0.61 -0.64 -0.64 -0.46 -0.40 -0.69 -0.56 -0.61 -0.72 "
    "-0.60 -0.34 -0.59 -0.33 -0.08 -0.18 0.01 -0.12 -0.46 -0.47"
)
LATERAL_MM = (
    "0.12 -0.35 -0.24 -0.29 -1.00 -1.24 -0.64 -0.22 -0.22 -0.10 -0.29 "
    "-0.32 -0.42 0.03 0.27 0.58 0.07 0.67 -0.07 0.27 0.28"
)
"""Condylar gaps every 5 % of the cycle, from the data's notes."""


@cache
def case() -> Case:
    return load_case(load_scene(SCENE))


def test_motion_is_a_closed_gait_cycle():
    motion = case().motion
    assert motion.closed_cycle
    np.testing.assert_allclose(motion.cycle_percent, np.arange(101), atol=1e-9)
    flexion = np.rad2deg(motion.raw_coordinates[:, 5])
    assert 5 < flexion.min() < 6
    assert 52 < flexion.max() < 54
    assert np.argmax(flexion) in range(75, 86)
    assert np.abs(np.rad2deg(motion.raw_coordinates[:, 4])).max() < 3


def test_frames_changed_by_the_filter_are_in_swing_or_at_the_seam():
    motion = case().motion
    rough = (motion.deviation_translation > 5e-4) | (motion.deviation_rotation > np.deg2rad(0.5))
    assert 0 < rough.sum() < 20
    assert set(np.flatnonzero(rough)) <= {0, 99, 100, *range(62, 96)}


def test_condylar_gaps_of_the_recorded_poses_agree_with_the_notes():
    query = ClosestPointQuery(case().femoral, case().insert, case().split)
    result = [query.at(pose) for pose in knee_pose(case().motion.raw_coordinates[::5])]
    for side, stated in (("medial", MEDIAL_MM), ("lateral", LATERAL_MM)):
        gaps = np.array([getattr(gap, side).gap for gap in result]) * 1e3
        expected = np.array([float(value) for value in stated.split()])
        assert (np.abs(gaps - expected) <= 0.05).sum() >= 19


def test_gaps_cannot_distinguish_the_mirrored_convention():
    """Spread of the medial less the lateral gap in swing, mm."""
    roles = ("rotation_1", "rotation_2", "translation_3")
    mirrored = load_scene(SCENE.with_name("mirrored.toml"))
    assert mirrored.motion.signs_turned == roles
    assert mirrored.ligament == case().scene.ligament
    query = ClosestPointQuery(case().femoral, case().insert, case().split)
    part = mirrored.implant.insert
    turn = axes_rotation(part.axes)
    placed = insert_placement(load_surface(part.mesh, part.unit, part.axes, name="insert"), turn)
    turn = pose(turn, np.zeros(3))
    spread = {}
    for turned in ((), roles[:1], roles[1:2], roles):
        table = mirrored.motion.model_copy(update={"signs_turned": turned})
        motion = load_motion(table, "right", placed @ turn, turn)
        result = [query.at(place) for place in knee_pose(motion.raw_coordinates[62:101:3])]
        spread[turned] = 1e3 * np.std([gap.medial.gap - gap.lateral.gap for gap in result])
    assert spread[roles] == pytest.approx(spread[()], abs=0.05)
    assert min(spread[roles[:1]], spread[roles[1:2]]) > 1.5 * spread[()]


def test_the_shank_rolls_forward_in_stance():
    tibia = case().tibia
    assert np.median(tibia.residual) < 0.010
    assert tibia.residual.max() < 0.015
    up, right = tibia.pose[:, :3, 1], tibia.pose[:, :3, 2]
    assert up[STANCE, 1].min() > np.cos(np.deg2rad(30))
    assert right[:, 2].min() > 0.95
    lean = np.rad2deg(np.arctan2(up[:, 0], up[:, 1]))
    assert -25 < lean[0] < -10  # at heel strike the shank leans back
    assert (np.diff(lean[:60]) > 0).all()  # then it rolls forward over the foot
    assert 0.09 < tibia.pose[STANCE, 1, 3].min() < 0.13  # ankle height, m


def test_belt_carries_the_foot_backward():
    foot = case().tibia.pose[15:45, 0, 3]
    speed = -np.polyfit(case().motion.time[15:45], foot, 1)[0]
    assert 0.3 < speed < 0.7


def test_marker_set_has_only_two_shank_markers():
    """The third marker is missing throughout, so joint centres are needed."""
    recorded = read_table(case().scene.tibia.file)
    assert np.isnan(recorded.column("R_Shank_Superior_x")).all()
    for name in case().scene.tibia.markers_mm:
        assert np.isfinite(recorded.column(f"{name}_x")).all()


def test_ground_reaction_carries_the_body_under_the_right_foot():
    ground, tibia = case().ground, case().tibia
    vertical = ground.force[:, 1] / BODY_WEIGHT
    assert 0.9 < vertical[15:35].max() < 1.1
    assert 0.9 < vertical[35:60].max() < 1.1
    assert np.abs(vertical[75:95]).max() < 0.05
    assert ground.force[5:25, 0].mean() < 0 < ground.force[40:60, 0].mean()
    from_ankle = (ground.point - tibia.pose[:, :3, 3])[5:60]
    assert -0.08 < from_ankle[:, 0].min() < from_ankle[:, 0].max() < 0.20
    assert np.abs(from_ankle[:, 2]).max() < 0.06
    assert (np.diff(from_ankle[:, 0]) > 0).mean() > 0.95  # from heel to toe
    assert np.abs(ground.moment[STANCE]).max() < 10


def test_centre_of_pressure_lies_between_heel_and_toe_markers():
    scene, ground, motion = case().scene, case().ground, case().motion
    recorded = read_table(scene.tibia.file)
    turn = np.diag([-1.0, 1.0, -1.0])
    feet = {}
    for side in "RL":
        markers = marker_trajectories(recorded, [f"{side}_Heel", f"{side}_Toe"], 1e-3) @ turn
        feet[side] = [
            np.stack([np.interp(motion.time, recorded.time(), m[:, k]) for k in range(3)], axis=1)
            for m in np.moveaxis(markers, 1, 0)
        ]
    for k in range(5, 61):
        heel, toe = feet["R"]
        assert heel[k, 0] - 0.02 < ground.point[k, 0] < toe[k, 0] + 0.02
        assert abs(ground.point[k, 2] - 0.5 * (heel[k, 2] + toe[k, 2])) < 0.05
        left_foot = 0.5 * (feet["L"][0][k] + feet["L"][1][k])
        assert abs(ground.point[k, 2] - left_foot[2]) > 0.1


def test_stride_is_the_most_representative_one():
    """Of all strides it is the nearest to the mean of ground reaction and shank lean."""
    scene = case().scene
    plate = read_table(scene.ground_reaction.file)
    vertical = plate.column("ground_force_2_vy")
    strikes = plate.time()[1:][(vertical[1:] >= 20) & (vertical[:-1] < 20)]
    at = np.linspace(strikes[:-1], strikes[1:], 50, endpoint=False, axis=1).ravel()
    force = load_ground_reaction(scene.ground_reaction, at, "right").force
    up = load_tibia(scene.tibia, at, "right", 6.0).pose[:, :3, 1]
    lean = np.arctan2(up[:, [0, 2]], up[:, [1]])
    strides = len(strikes) - 1
    forces, leans = force.reshape(strides, 50, 3), lean.reshape(strides, 50, 2)
    score = sum(
        distance / distance.mean()
        for distance in (
            np.sqrt(np.mean((v - np.mean(v, axis=0)) ** 2, axis=(1, 2))) for v in (forces, leans)
        )
    )
    best = int(np.argmin(score))
    assert len(score) == 10
    np.testing.assert_allclose(scene.motion.cycle_s, strikes[best : best + 2], atol=1e-3)


def test_chain_carries_the_models_masses():
    masses = {name: case().chain.model.inertias[k].mass for k, name in _joints_with_mass()}
    assert masses["knee_flexion"] == pytest.approx(9.34239977)
    assert masses["patella_rotation"] == pytest.approx(0.1)
    shank = 2.99427025 + 0.04149104 + 1.13869862 + 0.18209958
    assert max(masses.values()) == pytest.approx(9.34239977)
    assert any(mass == pytest.approx(shank) for mass in masses.values())


def _joints_with_mass():
    model = case().chain.model
    return [(k, name) for k, name in enumerate(model.names) if model.inertias[k].mass > 0]


def test_ligament_law_is_that_of_opensim():
    """Blankevoort1991Ligament: k e²/(2 e_t) below the transition strain e_t = 0.06, else linear."""
    strain = np.linspace(-0.02, 0.12, 141)
    toe, line = 0.5 * strain**2 / 0.06, strain - 0.5 * 0.06
    expected = 4000 * np.where(strain <= 0, 0, np.where(strain <= 0.06, toe, line))
    np.testing.assert_allclose(QuadraticToe(4000).tension(1 + strain, 1.0), expected, atol=1e-9)


def test_ligaments_are_near_their_slack_length_in_stance():
    """No ligament is torn or very slack while the foot is loaded."""
    chain, motion = case().chain, case().motion
    femur = knee_pose(motion.coordinates)
    tibia_r = inverse(chain.insert_in_tibia) @ chain.link_in("tibia_r", "tibia")
    poses = {
        "femur_r": femur @ chain.link_in("femur_r", "femur"),
        "tibia_r": np.broadcast_to(tibia_r, femur.shape),
    }
    bundles: dict[str, list] = {}
    total = np.zeros(len(femur))
    for strand in build_ligaments(case().ligaments, poses, motion.coordinates[:, 5]):
        length = strand.length(poses)
        bundles.setdefault(re.sub(r"\d+$", "", strand.name), []).append(strand.strain(length))
        total += strand.force(length)
    counts = {name: len(strands) for name, strands in bundles.items()}
    assert counts == {
        "MCLs": 20, "MCLd": 10, "pMC": 10, "LCL": 10, "PFL": 10, "PCLal": 10, "PCLpm": 10, "pCAP": 8
    }  # fmt: skip
    for strains in bundles.values():
        assert np.array(strains)[:, STANCE].max() < 0.09
        assert np.array(strains)[:, STANCE].min() > -0.15
    for name in ("MCLs", "MCLd", "LCL"):
        assert np.abs(np.mean(bundles[name], axis=0)[STANCE]).max() < 0.08
    assert total[STANCE].max() < 0.5 * BODY_WEIGHT


def test_the_superficial_mcl_passes_around_the_insert():
    """Its straight lines would pass 2 to 3 mm through the medial rim."""
    recording = recording_of(case())
    strands = [one for one in recording.knee.ligaments if one.name.startswith("MCLs")]
    insert = recording.knee.contact.pair.insert
    assert len(strands) == 20
    for frame in range(0, 61, 20):
        state, share = recording.loads(frame).geometry.state, np.linspace(0.0, 1.0, 80)[:, None]
        paths = bundle_paths(strands, {link: state.pose(link) for link in strands[0].links})
        for points in paths.points:
            parts = [a + share * (b - a) for a, b in pairwise(points)]
            assert not insert.winding.inside(np.concatenate(parts)).any()
            straight = points[0] + share * (points[-1] - points[0])
            assert insert.winding.inside(straight).any()


def test_hip_is_above_the_knee():
    hip = transform(case().chain.link_in("hip", "femur"), np.zeros(3))
    assert np.linalg.norm(hip) == pytest.approx(0.418, abs=2e-3)
    assert hip[1] > 0.41


def test_a_misplaced_shank_marker_is_asked_about():
    """The residual of the fit is 8 mm; a misplaced marker moves by 87 mm, more than skin."""
    assert not list(marker_questions(case()))
    scene = load_scene(SCENE)
    places = scene.tibia.markers_mm
    places["R_Shank_Inferior"] = tuple(np.array(places["R_Shank_Inferior"]) + 50.0)
    (question,) = marker_questions(load_case(scene))
    assert question.text.startswith("the markers of the shank lie ")
