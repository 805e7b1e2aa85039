"""Imports of subject JW's trial og3 from several usual file layouts give equal results."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest

from tkamb.cli import main
from tkamb.io.recordings.c3d import read_c3d
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.show.storage import write_storage, write_trc

JW = Path(__file__).parents[2] / "shared" / "data" / "jw"
TRIAL = JW / "motion" / "jw_ngait_og3.c3d"
pytestmark = pytest.mark.skipif(
    not JW.is_dir(), reason="subject JW's files are not beside the project"
)
INTO = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation from the file's axes, z up, to a table's axes, y up."""


def imported(folder, *options):
    """Import JW's leg without implant, and return the case."""
    arguments = ["--side", "right", "--mass-kg", "66.7", "--out", str(folder)]
    assert main(["import", str(JW / "JW.osim"), *map(str, options), *arguments]) == 0
    return load_case(load_scene(folder / "scene.toml"))


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    return imported(tmp_path_factory.mktemp("reference"), "--c3d", TRIAL)


def assert_same(case, reference, N=1e-3, Nm=1e-3):
    np.testing.assert_allclose(case.motion.time, reference.motion.time, atol=1e-6)
    np.testing.assert_allclose(case.motion.coordinates, reference.motion.coordinates, atol=1e-5)
    np.testing.assert_allclose(case.ground.force, reference.ground.force, atol=N)
    about = [
        each.ground.moment + np.cross(each.ground.point, each.ground.force)
        for each in (case, reference)
    ]
    np.testing.assert_allclose(*about, atol=Nm)


def units_of_one_maker(content):
    units = ["nt", "nt", "nt", "ntmm", "ntmm", "ntmm"] * 3
    content["parameters"]["ANALOG"]["UNITS"]["value"][:18] = units


def equal_labels_of_the_arms(content):
    labels = content["parameters"]["POINT"]["LABELS"]["value"]
    labels[labels.index("RWrist")] = "RElbow"


def equal_channels(content):
    labels = content["parameters"]["ANALOG"]["LABELS"]["value"]
    labels[20] = labels[19]


def metres_and_volts(content):
    """Write plates of type 4 in metres and volts, with a calibration matrix to N and N·m."""
    content["parameters"]["POINT"]["UNITS"]["value"] = ["m"]
    content["data"]["points"][:3] *= 1e-3
    plates, analog = content["parameters"]["FORCE_PLATFORM"], content["parameters"]["ANALOG"]
    for key in ("CORNERS", "ORIGIN"):
        plates[key]["value"] = np.asarray(plates[key]["value"]) * 1e-3
    content["data"]["analogs"][0, :18] /= np.tile([[100.0]] * 3 + [[1e5]] * 3, (3, 1))
    analog["UNITS"]["value"][:18] = ["V"] * 18
    plates["TYPE"]["value"] = [4, 4, 4]
    matrices = np.repeat(100.0 * np.eye(6)[:, :, None], 3, axis=2)
    content.add_parameter("FORCE_PLATFORM", "CAL_MATRIX", matrices)


def a_plate_of_unknown_type(content):
    """Add a fourth plate of a type that is not read, far from the walkway."""
    plates = content["parameters"]["FORCE_PLATFORM"]
    plates["USED"]["value"], plates["TYPE"]["value"] = [4], [2, 2, 2, 21]
    for key in ("CORNERS", "ORIGIN", "CHANNEL"):
        value = np.asarray(plates[key]["value"])
        plates[key]["value"] = np.concatenate([value, value[..., -1:]], axis=-1)


def moments_in_newton_metres(content):
    """The units of the moments still say N·mm."""
    for plate in range(3):
        content["data"]["analogs"][0, 6 * plate + 3 : 6 * plate + 6] *= 1e-3


def moments_in_newton_metres_that_say_nothing(content):
    """The plates are of type 4, with a calibration to N·m in a file in mm."""
    plates, analog = content["parameters"]["FORCE_PLATFORM"], content["parameters"]["ANALOG"]
    moments_in_newton_metres(content)
    analog["UNITS"]["value"][:18] = ["V"] * 18
    plates["TYPE"]["value"] = [4, 4, 4]
    content.add_parameter("FORCE_PLATFORM", "CAL_MATRIX", np.repeat(np.eye(6)[:, :, None], 3, 2))


CHANGES = [
    moments_in_newton_metres,
    moments_in_newton_metres_that_say_nothing,
    units_of_one_maker,
    equal_labels_of_the_arms,
    equal_channels,
    metres_and_volts,
    a_plate_of_unknown_type,
]


@pytest.mark.parametrize("change", CHANGES)
def test_the_same_trial_in_another_form_gives_the_same_case(tmp_path, reference, change):
    content = ezc3d.c3d(str(TRIAL))
    change(content)
    content.write(str(tmp_path / "og3.c3d"))
    assert_same(imported(tmp_path / "out", "--c3d", tmp_path / "og3.c3d"), reference)


def test_a_header_that_counts_channels_gives_the_same_case(tmp_path, reference, capsys):
    """The third word of the header holds the number of channels, not of values per frame."""
    content = bytearray(TRIAL.read_bytes())
    values, samples = (int.from_bytes(content[at : at + 2], "little") for at in (4, 18))
    content[4:6] = (values // samples).to_bytes(2, "little")
    (tmp_path / "og3.c3d").write_bytes(content)
    assert_same(imported(tmp_path / "out", "--c3d", tmp_path / "og3.c3d"), reference)
    assert "the size of the file fits 56 markers" in capsys.readouterr().out


@pytest.mark.parametrize("reversed_plates", [(0, 1, 2), (1,), (0,)])
def test_a_force_that_points_down_is_named(tmp_path, reference, capsys, reversed_plates):
    """The right foot stands on plates 2 and 3, the left one on plate 1."""
    content = ezc3d.c3d(str(TRIAL))
    for plate in reversed_plates:
        content["data"]["analogs"][0, 6 * plate : 6 * plate + 6] *= -1
    content.write(str(tmp_path / "og3.c3d"))
    arguments = ("--c3d", tmp_path / "og3.c3d")
    if reversed_plates == (0,):
        assert_same(imported(tmp_path / "out", *arguments), reference)
        printed = capsys.readouterr().out
        assert "force plate 1: the vertical force points down, with up to" in printed
        return
    arguments = ["import", JW / "JW.osim", *arguments, "--side", "right", "--mass-kg", "66.7"]
    assert main([*map(str, arguments), "--out", str(tmp_path / "out")]) == 2
    number = 2 if 0 in reversed_plates else reversed_plates[0] + 1
    assert f"force plate {number}: the vertical force points down" in capsys.readouterr().err


def drift_without_a_baseline(content):
    content["data"]["analogs"][0, [2, 8, 14]] -= 5.0


def drift_with_a_baseline(content):
    drift_without_a_baseline(content)
    content["parameters"]["FORCE_PLATFORM"]["ZERO"]["value"] = [1, 20]


def test_a_drift_is_subtracted_if_the_file_states_unloaded_frames(tmp_path, reference):
    content = ezc3d.c3d(str(TRIAL))
    drift_with_a_baseline(content)
    content.write(str(tmp_path / "og3.c3d"))
    assert_same(imported(tmp_path / "out", "--c3d", tmp_path / "og3.c3d"), reference, Nm=2e-3)


def test_a_drift_without_a_baseline_is_reported_and_stays_under_the_foot(
    tmp_path, reference, capsys
):
    content = ezc3d.c3d(str(TRIAL))
    drift_without_a_baseline(content)
    content.write(str(tmp_path / "og3.c3d"))
    case = imported(tmp_path / "out", "--c3d", tmp_path / "og3.c3d")
    assert "force plate 2 reads 5.0 N while nobody stands on it" in capsys.readouterr().out
    difference = case.ground.force[:, 1] - reference.ground.force[:, 1]
    assert difference.max() < 5.5 and difference.min() > -0.5
    assert case.ground.drift == pytest.approx({2: 5.0, 3: 5.0}, abs=0.01)


def test_a_standing_trial_needs_only_its_markers(tmp_path):
    standing = JW / "motion" / "jw_1legstand1.c3d"
    content = ezc3d.c3d(str(standing))
    content["data"]["analogs"][0, :, -51:] = np.nan
    content["parameters"]["FORCE_PLATFORM"]["TYPE"]["value"] = [2, 9, 2]
    content.write(str(tmp_path / "standing.c3d"))
    scenes = []
    for name, static in (("a", standing), ("b", tmp_path / "standing.c3d")):
        imported(tmp_path / name, "--c3d", TRIAL, "--static", static)
        scenes.append(load_scene(tmp_path / name / "scene.toml").motion.markers)
    assert scenes[0] == scenes[1]


def test_markers_and_a_table_of_three_plates_give_the_case_of_the_c3d(tmp_path, reference):
    recording = read_c3d(TRIAL)
    columns = {"time": recording.analog_time}
    for plate in recording.plates:
        force, about = plate.force @ INTO.T, plate.wrench[:, 3:] @ INTO.T
        point = np.zeros_like(force)
        loaded = force[:, 1] > 20
        point[loaded, 0] = about[loaded, 2] / force[loaded, 1]  # The plates are at height 0.
        point[loaded, 2] = -about[loaded, 0] / force[loaded, 1]
        moment = about - np.cross(point, force)
        for kind, values in (("force_{}_v", force), ("force_{}_p", point), ("moment_{}_m", moment)):
            for k, axis in enumerate("xyz"):
                columns[f"ground_{kind.format(plate.number)}{axis}"] = values[:, k]
    write_storage(tmp_path / "g.mot", columns, in_degrees=False)
    points = {label: recording.points[:, k] @ INTO.T for k, label in enumerate(recording.labels)}
    write_trc(tmp_path / "og3.trc", recording.time, points, recording.rate_Hz)
    arguments = ("--trc", tmp_path / "og3.trc", "--grf", tmp_path / "g.mot")
    assert_same(imported(tmp_path / "found", *arguments), reference, N=0.05, Nm=0.15)
    options_c3d = (
        "--c3d",
        TRIAL,
        "--grf",
        tmp_path / "g.mot",
    )  # z is up in the C3D, y in the table
    assert_same(imported(tmp_path / "beside", *options_c3d), reference, N=0.05, Nm=0.15)
    named = ("--grf-force", "ground_force_2,ground_force_3", "--interval", "2.075:3.9333334")
    assert_same(imported(tmp_path / "named", *arguments, *named), reference, N=0.05, Nm=0.15)


def test_emg_of_a_recording_without_markers_is_read(tmp_path):
    content, emg_file = ezc3d.c3d(str(TRIAL)), ezc3d.c3d()
    labels = content["parameters"]["ANALOG"]["LABELS"]["value"][18:34]
    emg_file["parameters"]["POINT"]["RATE"]["value"] = [120.0]
    emg_file["parameters"]["ANALOG"]["RATE"]["value"] = [1200.0]
    emg_file["parameters"]["ANALOG"]["LABELS"]["value"] = labels
    emg_file["parameters"]["ANALOG"]["UNITS"]["value"] = ["V"] * 16
    emg_file["data"]["points"] = np.zeros((4, 0, 291))
    emg_file["data"]["analogs"] = content["data"]["analogs"][:, 18:34]
    emg_file.write(str(tmp_path / "emg.c3d"))
    recording = read_c3d(tmp_path / "emg.c3d")
    np.testing.assert_allclose(
        recording.channel("vasmed"), read_c3d(TRIAL).channel("vasmed"), rtol=1e-6
    )
    assert len(recording.analog_time) == 2910
