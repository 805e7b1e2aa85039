"""Recorded poses of the implant, with markers that give only the shank's pose."""

import xml.etree.ElementTree as ElementTree
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from contact_bodies import flat_insert
from pendulum_leg import changed, moving_leg, pendulum_osim
from tkamb.cli import main
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import inverse, knee_pose, pose, transform
from tkamb.io.importing.anatomy import find_leg
from tkamb.io.importing.links import find_links
from tkamb.io.importing.model_fit import ModelChain
from tkamb.io.importing.patient import import_patient
from tkamb.io.importing.recorded_poses import ROLES, PoseRecording, read_poses
from tkamb.io.opensim.read import read_osim
from tkamb.io.recordings.meshes import axes_rotation, load_surface
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.show.storage import write_storage, write_trc

ROOT = Path(__file__).parents[1]
DM = ROOT.parent / "shared" / "data" / "dm"
BEND = ROOT / "models" / "deep_knee_bend"
AXES = "+x,+y,+z"
FRAMES = {"femoral component": "femur_implant_r", "insert": "tibia_r"}
IMPLANT = {
    '<Body name="femur_r">': '<Body name="femur_r"><components><PhysicalOffsetFrame '
    'name="femur_implant_r"><socket_parent>..</socket_parent><translation>0 -0.4 0</translation>'
    "<orientation>0 0 0</orientation></PhysicalOffsetFrame></components>"
}
"""The femoral mesh is at the knee's pin joint, the insert's mesh at the tibia's origin."""
needs_dm = pytest.mark.skipif(
    not DM.is_dir(), reason="subject DM's files are not beside the project"
)


def write_poses(path: Path, time: np.ndarray, poses: np.ndarray) -> Path:
    """Write poses (n, 4, 4), m, of the femoral mesh in the insert mesh, with angles in rad."""
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("XYZ")
    values = np.concatenate([angles, poses[:, :3, 3]], axis=1)
    write_storage(path, {"time": time} | dict(zip(ROLES, values.T, strict=True)), in_degrees=False)
    return path


@pytest.fixture(scope="module")
def bent_leg(tmp_path_factory) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Write a knee bend as poses over per cent of a cycle, and as markers. One is never visible.

    Returns:
        The arguments of the import, and the poses of tibia and femur (n, 4, 4) in ground.
    """
    tmp_path = tmp_path_factory.mktemp("leg")
    osim = pendulum_osim(tmp_path / "leg.osim", IMPLANT)
    q, markers = moving_leg(osim)
    model = read_osim(osim)
    chain = ModelChain(model, list(model.markers))
    poses, names = chain.kinematics.poses(q), ["ground", *model.bodies]
    tibia, femur = (poses[:, names.index(body)] for body in ("tibia_r", "femur_r"))
    component = femur @ pose(np.eye(3), [0.0, -0.4, 0.0])
    percent = np.linspace(0.0, 100.0, len(q))
    recorded = write_poses(tmp_path / "poses.sto", percent, inverse(tibia) @ component)
    markers["M.tibia_r.0"] = np.full_like(markers["M.tibia_r.0"], np.nan)
    time = np.arange(len(q)) / 60.0
    write_trc(tmp_path / "leg.trc", time, markers, 60.0)
    ground = {f"plate_2_{kind}{axis}": 0 * time for kind in "vp" for axis in "xyz"}
    ground["plate_2_vy"] = 300.0 + 0 * time
    write_storage(tmp_path / "ground.mot", {"time": time} | ground, in_degrees=False)
    options = {
        "trc": tmp_path / "leg.trc",
        "grf": tmp_path / "ground.mot",
        "grf-force": "plate_2",
        "side": "right",
        "mass-kg": 53.5,
        "femoral": BEND / "femoral_component.stl",
        "insert": BEND / "insert.stl",
        "insert-frame": FRAMES["insert"],
        "mesh-unit": "mm",
        "mesh-axes": AXES,
        "poses": recorded,
        "pose-sequence": "XYZ",
        "pose-units": "rad,m",
        "stride": f"0:{time[-1]}",
        "out": "out",
    }
    line = [word for key, value in options.items() for word in (f"--{key}", str(value))]
    return ["import", str(osim), *line], tibia, femur


def test_the_scene_reproduces_the_recorded_shank_and_femur(bent_leg, tmp_path, capsys):
    """Two shank markers and two joint centres reproduce the recorded shank and knee.

    The knee is a pin joint, so that the thigh's markers give its centre exactly.
    """
    arguments, tibia, femur = bent_leg
    options = {"without": "M.foot_r.1", "out": str(tmp_path / "out")}
    assert main(changed(arguments, **options)) == 0
    output = capsys.readouterr().out
    assert "not recorded: M.tibia_r.0" in output and "thigh's 3 markers" in output
    assert "plate_2_v*" in output and "left out, as given: M.foot_r.1" in output
    scene = load_scene(tmp_path / "out" / "scene.toml")
    centre_markers = {centre.name: list(centre.markers_mm) for centre in scene.tibia.joint_centre}
    assert centre_markers["ankle_centre"] == ["M.foot_r.0", "M.foot_r.2", "M.foot_r.3"]
    case = load_case(scene)
    assert case.motion.cycle_percent is not None and case.tibia is not None
    np.testing.assert_allclose(case.motion.time, np.arange(60) / 60.0, atol=1e-9)
    assert case.tibia.residual is not None and case.tibia.residual.max() < 2e-6  # m; file 1e-6
    ankle = tibia @ pose(np.eye(3), [0.0, -0.42, 0.0])
    np.testing.assert_allclose(case.tibia.pose[5:-5], ankle[5:-5], atol=5e-5)  # filtered
    link = ankle @ case.chain.insert_in_tibia @ knee_pose(case.motion.raw_coordinates)
    np.testing.assert_allclose(link, femur @ pose(np.eye(3), [0.0, -0.4, 0.0]), atol=2e-6)
    np.testing.assert_allclose(case.ground.force[:, 1], 300.0)


@pytest.fixture(scope="module")
def block(tmp_path_factory) -> Path:
    """Write a simple insert: a block of 50 × 10 × 80 mm on y = 0."""
    path = tmp_path_factory.mktemp("block") / "insert.stl"
    mesh = flat_insert(10e-3, 25e-3, 40e-3).mesh.copy()
    mesh.apply_scale(1e3).export(path)
    return path


@pytest.mark.parametrize("side", ["right", "left"])
def test_poses_out_of_the_sagittal_plane_keep_their_side(block, tmp_path, side):
    """T_femur_in_tibia is the recorded pose between the two mesh frames, on either side."""
    osim = pendulum_osim(tmp_path / "leg.osim", IMPLANT)
    if side == "left":
        osim.write_text(osim.read_text().replace("_r", "_l"))
    leg = find_leg(read_osim(osim), side)
    insert = load_surface(block, "mm", AXES, name="insert")
    frames = {part: name.replace("_r", f"_{side[0]}") for part, name in FRAMES.items()}
    links = find_links(leg, insert_placement(insert, axes_rotation(AXES)), AXES, frames, False)
    turns = Rotation.from_euler("XYZ", np.linspace([2, 5, 5], [-1, -4, 60], 11), degrees=True)
    poses = pose(turns.as_matrix(), np.linspace([1e-3, 0.01, 3e-3], [-2e-3, 0.012, 1e-3], 11))
    file = write_poses(tmp_path / "poses.sto", np.linspace(0, 1, 11), poses)
    recording = PoseRecording(file, ROLES, "XYZ", "rad", "m", stance=(0.2, 0.5))
    result = read_poses(recording, links, insert, AXES, 4.0, None)
    ankle, offset = (pose(np.eye(3), [0.0, y, 0.0]) for y in (-0.42, -0.4))
    np.testing.assert_allclose(result.femur, inverse(ankle) @ poses @ inverse(offset), atol=1e-7)
    assert list(np.flatnonzero(result.in_stance)) == [2, 3, 4, 5]


MISTAKES = {
    "poses of no mesh": ({"femoral": None, "insert": None}, "needs --insert"),
    "units guessed": ({"pose_units": None}, "--pose-units"),
    "unit of no length": ({"pose_units": "rad,ft"}, "--pose-units"),
    "sequence guessed": ({"pose_sequence": None}, "--pose-sequence"),
    "sequence of two axes": ({"pose_sequence": "XY"}, "--pose-sequence"),
    "four columns": ({"pose_columns": "a,b,c,d"}, "--pose-columns"),
    "columns that are not there": ({"pose_columns": "a,b,c,x,y,z"}, "column"),
    "role that is none": ({"pose_signs_turned": "rotation_4"}, "rotation_4"),
    "per cent taken for seconds": ({"stride": None}, "cut-off"),
    "stride outside the recording": ({"stride": "5:6"}, "leg.trc"),
    "stride and interval": ({"interval": "0:1"}, "--interval"),
    "stance outside": ({"stance": "200:300"}, "--stance"),
    "stride without poses": ({"poses": None}, "needs --poses"),
    "marker that is not there": ({"without": "X"}, "'X'"),
    "too few markers": ({"without": "M.tibia_r.1,M.tibia_r.2"}, "three are needed"),
    "force that is not there": ({"grf_force": "plate_3"}, "plate_3"),
    "force of no table": ({"grf": None}, "needs --grf"),
    "standing trial of poses": ({"static": "s.trc"}, "--static"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_and_nothing_is_written(bent_leg, block, tmp_path, capsys, mistake):
    options, words = MISTAKES[mistake]
    options = {"insert": str(block)} | options
    status = main(changed(bent_leg[0], **options, out=str(tmp_path / "out")))
    lines = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert status == 2, lines
    assert len(lines) == 1 and words in lines[0], lines
    assert not (tmp_path / "out").exists()


@needs_dm
@pytest.mark.parametrize(
    "name", ["scene.toml", pytest.param("mirrored.toml", marks=pytest.mark.slow)]
)
def test_the_script_writes_dms_scenes_that_are_shipped(name):
    loader = SourceFileLoader("dm_scenes", str(ROOT / "scripts/make/dm_scenes"))
    script = module_from_spec(spec_from_loader("dm_scenes", loader))
    loader.exec_module(script)
    patient = import_patient(script.request(DM, name), ROOT / "models/dm")
    assert patient.scene.text() == (ROOT / "models/dm" / name).read_text()
    assert patient.urdf == (ROOT / "models/dm/patient.urdf").read_text()
    output = "\n".join(patient.report)
    assert "forward, up, right are the file's -x,+y,-z" in output
    assert "knee 'knee_r'" in output and "88 femorotibial ligament strands" in output


def test_dms_links_are_where_its_model_has_them():
    """Computed by hand from DM.osim: insert in tibia, femur body in femur, knee centre (mm)."""
    robot = ElementTree.parse(ROOT / "models/dm/patient.urdf").getroot()
    origins = {j.get("name"): j.find("origin") for j in robot.findall("joint")}
    by_hand = {
        "knee_ap": "0.0194574092 0.364034932 0.00405038804 0.0523557571 2.465549e-05 -0.0698144929",
        "femur_r_mount": (
            "-0.0422246576 0.41594999 -0.00329731027 -0.0174528836 -9.883354e-06 0.0820282336"
        ),
    }
    for name, values in by_hand.items():
        result = " ".join(origins[name].get(key) for key in ("xyz", "rpy")).split()
        np.testing.assert_allclose(
            np.array(result, float), np.array(values.split(), float), atol=1e-9
        )
    scene = load_scene(ROOT / "models/dm/scene.toml")
    centres = {c.name: c.tibia_mm for c in scene.tibia.joint_centre}
    assert centres["knee_centre"] == pytest.approx((16.874, 393.996, 9.440), abs=2e-3)
    hip = transform(np.eye(4), np.array(origins["hip_mount"].get("xyz").split(), float))
    assert np.linalg.norm(hip) == pytest.approx(0.418, abs=1e-3)
    assert len(scene.ligament) == 88
    assert scene.patellar_ligament.length_mm == pytest.approx(75.986)
