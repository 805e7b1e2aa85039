"""The shipped deep knee bend: meshes, motion, chain, and the script that makes its files."""

import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from tkamb.geometry.closest import ClosestPointQuery
from tkamb.geometry.frames import inverse, knee_pose, pose, transform
from tkamb.io.recordings.meshes import load_surface
from tkamb.io.scene import load_scene
from tkamb.studies.designs.femoral import normal

ROOT = Path(__file__).parents[1]
MODEL = ROOT / "models" / "deep_knee_bend"
MESHES = ("femoral_component", "insert", "patellar_button")
WEIGHT, HEIGHT = 75.0 * 9.80665, 1.75

sys.path.insert(0, str(ROOT / "scripts"))

from deep_knee_bend import comparison, model  # noqa: E402
from deep_knee_bend import dimensions as d  # noqa: E402
from deep_knee_bend.implant import FEMORAL, INSERT  # noqa: E402

PROFILE = FEMORAL.profile


def columns(name):
    return np.genfromtxt(MODEL / name, delimiter=",", names=True)


@pytest.fixture(scope="module")
def motion():
    return columns("motion.csv")


@pytest.fixture(scope="module")
def scene():
    return load_scene(MODEL / "scene.toml")


@pytest.fixture(scope="module")
def poses(motion):
    """Return pose_femoral_in_insert of every frame, m."""
    lengths = [motion[name] * 1e-3 for name in ("ap_mm", "si_mm", "ml_mm")]
    names = ("axial_rotation_deg", "adduction_deg", "flexion_deg")
    angles = [np.radians(motion[name]) for name in names]
    return knee_pose(np.stack([*lengths, *angles], axis=1))


@pytest.fixture(scope="module")
def patella(motion):
    """Return pose_patella_in_femur of every frame, m."""
    c, s = (f(np.radians(motion["patella_rotation_deg"])) for f in (np.cos, np.sin))
    o, ones = np.zeros_like(c), np.ones_like(c)
    rotation = np.stack([c, -s, o, s, c, o, o, o, ones], axis=1).reshape(-1, 3, 3)
    place = np.stack([motion["patella_ap_mm"], motion["patella_si_mm"], o], axis=1)
    return pose(rotation, place * 1e-3)


def surface(name):
    return load_surface(MODEL / f"{name}.stl", "mm", "+x,+y,+z", name=name)


@pytest.fixture(scope="module")
def insert_in_tibia():
    robot = ElementTree.parse(MODEL / "patient.urdf").getroot()
    joint = next(j for j in robot.findall("joint") if j.get("name") == "knee_ap")
    return pose(np.eye(3), [float(x) for x in joint.find("origin").get("xyz").split()])


@pytest.mark.parametrize("name", MESHES)
def test_meshes_are_closed_and_turn_outwards(name):
    path = MODEL / f"{name}.stl"
    mesh = trimesh.load(path)
    assert path.stat().st_size < 1_500_000
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.body_count == 1
    assert mesh.euler_number == 2
    assert mesh.area_faces.min() > 1e-4


def test_insert_frame_is_the_middle_of_the_flat_bottom():
    mesh = trimesh.load(MODEL / "insert.stl")
    assert mesh.bounds[0, 1] == 0.0
    flat = mesh.vertices[mesh.vertices[:, 1] == 0.0][:, [0, 2]]
    np.testing.assert_allclose(flat.min(axis=0) + flat.max(axis=0), 0.0, atol=1e-4)
    on_flat = mesh.triangles[:, :, 1].max(axis=1) == 0.0
    np.testing.assert_allclose(mesh.face_normals[on_flat], [[0, -1, 0]] * on_flat.sum(), atol=1e-6)


def test_sagittal_arcs_meet_with_a_common_tangent():
    for joint in PROFILE.joints:
        below, above = (PROFILE.point(joint + step) for step in (-1e-9, 1e-9))
        assert np.linalg.norm(above - below) < 1e-6
    phi = np.linspace(*PROFILE.range, 500)[1:-1]
    tangent = PROFILE.point(phi + 1e-6) - PROFILE.point(phi - 1e-6)
    np.testing.assert_allclose(np.sum(tangent * normal(phi), axis=1), 0.0, atol=1e-10)


def test_facets_are_within_five_micrometres_where_the_condyles_meet():
    mesh = trimesh.load(MODEL / "femoral_component.stl")
    middles = mesh.triangles_center[np.abs(np.abs(mesh.triangles_center[:, 2]) - 23.0) < 7.0]
    error = []
    for (start, end), centre, radius in zip(
        np.radians([arc[:2] for arc in d.SAGITTAL_ARCS]),
        PROFILE.centres,
        PROFILE.radii,
        strict=True,
    ):
        arm = middles[:, :2] - centre
        phi, reach = np.arctan2(-arm[:, 0], -arm[:, 1]), np.linalg.norm(arm, axis=1)
        low, high = max(start, np.radians(-12.0)), min(end, np.radians(134.0))
        in_arc = (phi > low) & (phi < high) & (np.abs(reach - radius) < 3.5)
        exact = radius - FEMORAL.depth(phi[in_arc], middles[in_arc, 2])
        error.append(exact - reach[in_arc])
    error = np.concatenate(error)
    assert len(error) > 5000
    assert np.abs(error).max() < 5e-3

    mesh = trimesh.load(MODEL / "insert.stl")
    x, y, z = mesh.triangles_center.T
    dish = (np.abs(x) < 14.0) & (np.abs(np.abs(z) - 23.0) < 8.0) & (y > 5.0)
    assert np.abs(y[dish] - INSERT.height(x[dish], z[dish])).max() < 5e-3


def test_both_condyles_touch_in_every_frame(poses):
    query = ClosestPointQuery(surface("femoral_component"), surface("insert"), 0.0)
    gaps = [query.at(p) for p in poses]
    condyle_gaps = np.array([[g.medial.gap, g.lateral.gap] for g in gaps])
    assert np.abs(condyle_gaps).max() < 2e-5


def test_motion_is_a_bend_from_rest_to_rest(motion):
    flexion = motion["flexion_deg"]
    assert len(flexion) == 101
    assert flexion[0] == 0.0
    assert flexion[-1] == pytest.approx(120.0)
    assert (np.diff(flexion) > 0).all()
    assert flexion[1] < 0.01
    assert flexion[-1] - flexion[-2] < 0.01


def test_chain_has_the_right_joints_and_masses():
    chain = pin.buildModelFromUrdf(str(MODEL / "patient.urdf"), pin.JointModelFreeFlyer())
    robot = ElementTree.parse(MODEL / "patient.urdf").getroot()
    axes = {
        j.get("name"): (j.get("type"), j.find("axis").get("xyz"))
        for j in robot.findall("joint")
        if j.get("type") != "fixed"
    }
    assert axes == {
        "ankle": ("revolute", "0 0 1"),
        "knee_ap": ("prismatic", "1 0 0"),
        "knee_si": ("prismatic", "0 1 0"),
        "knee_ml": ("prismatic", "0 0 1"),
        "knee_axial_rotation": ("revolute", "0 -1 0"),
        "knee_adduction": ("revolute", "-1 0 0"),
        "knee_flexion": ("revolute", "0 0 1"),
        "patella_ap": ("prismatic", "1 0 0"),
        "patella_si": ("prismatic", "0 1 0"),
        "patella_rotation": ("revolute", "0 0 1"),
    }
    assert chain.nv == 16
    masses = sorted(i.mass for i in chain.inertias if i.mass > 0)
    np.testing.assert_allclose(masses, [0.1, 75 * (0.0433 + 0.0137), 75 * 0.1416], rtol=1e-6)


def test_knee_coordinates_of_the_chain_are_those_of_the_package(motion, poses):
    chain = pin.buildModelFromUrdf(str(MODEL / "patient.urdf"))
    data = chain.createData()
    k = 70
    names = ("ap_mm", "si_mm", "ml_mm", "axial_rotation_deg", "adduction_deg", "flexion_deg")
    q = np.zeros(chain.nq)
    for name in names:
        joint = chain.getJointId(f"knee_{name.rsplit('_', 1)[0]}")
        value = motion[name][k]
        q[chain.joints[joint].idx_q] = value * 1e-3 if name.endswith("mm") else np.radians(value)
    pin.framesForwardKinematics(chain, data, q)
    place = chain.jointPlacements[chain.getJointId("knee_ap")]
    tibia = data.oMf[chain.getFrameId("tibia")]
    femur = data.oMf[chain.getFrameId("femur")]
    np.testing.assert_allclose(
        ((tibia * place).inverse() * femur).homogeneous, poses[k], atol=1e-12
    )


def test_no_ligament_is_overstrained_and_the_pcl_is_slack_before_45_deg(
    scene, motion, poses, insert_in_tibia
):
    strain = {}
    for bundle in scene.ligament:
        assert bundle.law == "two-line"
        femur = transform(poses, np.array(bundle.proximal.point_mm) * 1e-3)
        tibia = transform(inverse(insert_in_tibia), np.array(bundle.distal.point_mm) * 1e-3)
        length = np.linalg.norm(femur - tibia, axis=1)
        strain[bundle.name] = length / (bundle.slack_length_mm * 1e-3) - 1.0
    assert len(strain) == 6
    assert max(s.max() for s in strain.values()) < 0.08
    for name, values in strain.items():
        if name.startswith("PCL"):
            assert (values[motion["flexion_deg"] < 45] < 0).all()
            assert (values[motion["flexion_deg"] > 80] > 0.01).all()
        else:
            assert values.min() > -0.04


def test_patella_touches_the_groove_on_a_ligament_of_constant_length(
    scene, poses, patella, insert_in_tibia
):
    button, component = surface("patellar_button"), surface("femoral_component")
    ends = scene.patellar_ligament
    proximal = transform(poses @ patella, np.array(ends.proximal.point_mm) * 1e-3)
    distal = transform(inverse(insert_in_tibia), np.array(ends.distal.point_mm) * 1e-3)
    length = np.linalg.norm(proximal - distal, axis=1)
    np.testing.assert_allclose(length, ends.length_mm * 1e-3, atol=2e-8)
    query = ClosestPointQuery(button, component, None)
    gaps = [query.at(p).medial.gap for p in patella[::5]]
    assert np.abs(gaps).max() < 2e-5


def test_ground_reaction_fits_a_whole_body_in_balance(motion):
    ground, lean = columns("ground_reaction.csv"), columns("tibia.csv")
    force = np.stack([ground[f"force_{a}_N"] for a in "xyz"], axis=1)
    point = np.stack([ground[f"point_{a}_mm"] for a in "xyz"], axis=1) * 1e-3
    share = force[:, 1] / WEIGHT
    assert share[0] == pytest.approx(0.5, abs=1e-3)
    assert share[-1] == pytest.approx(0.7, abs=1e-3)
    assert (np.abs(force[:, [0, 2]]).max(axis=1) < 0.03 * WEIGHT).all()
    foot = 0.152 * HEIGHT
    assert point[:, 0].min() > -foot / 4
    assert point[:, 0].max() < 3 * foot / 4
    angle = np.radians(lean["lean_deg"])
    knee = 0.4426 * np.stack([np.sin(angle), np.cos(angle)], axis=1) + [0, 0.039 * HEIGHT]
    arm = point[:, :2] - knee
    moment = arm[:, 1] * force[:, 0] - arm[:, 0] * force[:, 1]
    assert moment.min() > 0.0
    assert 0.05 < moment.max() / (WEIGHT * HEIGHT) < 0.08
    assert (np.diff(moment[motion["flexion_deg"] < 100]) > -0.2).all()


def test_package_finds_the_patella_where_the_script_put_it(motion):
    from tkamb.io.scene.case import load_case
    from tkamb.run.read_scene import recording_of

    case = load_case(load_scene(MODEL / "scene.toml", {"patella.motion": "solved"}))
    frames = np.arange(0, 101, 5)
    states = recording_of(case, near=True).extensor.states
    for k, state in zip(frames, states[::5], strict=True):
        ap, si, rotation = state.coordinates
        assert ap * 1e3 == pytest.approx(motion["patella_ap_mm"][k], abs=0.03)
        assert si * 1e3 == pytest.approx(motion["patella_si_mm"][k], abs=0.03)
        assert np.degrees(rotation) == pytest.approx(motion["patella_rotation_deg"][k], abs=0.1)


@pytest.mark.slow
def test_script_makes_what_is_shipped(tmp_path):
    model.make(tmp_path)
    assert comparison.differences(tmp_path, MODEL) == []
    names = {path.name for path in tmp_path.iterdir()}
    named = re.findall(r'"([\w.]+\.(?:stl|csv|urdf))"', (MODEL / "scene.toml").read_text())
    assert set(named) <= names


def test_comparison_notices_a_difference(tmp_path):
    shipped, copy = tmp_path / "shipped", tmp_path / "made"
    for folder, value in ((shipped, "1.0000000"), (copy, "1.0000100")):
        folder.mkdir()
        (folder / "motion.csv").write_text(f"time_s\n{value}\n")
    assert comparison.differences(copy, shipped) == ["motion.csv: differs"]
    (copy / "motion.csv").write_text("time_s\n1.0000001\n")
    assert comparison.differences(copy, shipped) == []
