"""C3D recordings: wrenches of force plates, clocks, and refused files."""

import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from recordings import AMTI_CORNERS, standing_markers, write_c3d
from tkamb.errors import InputError
from tkamb.io.recordings.c3d import read_c3d
from tkamb.io.recordings.filtering import OddSample
from tkamb.io.recordings.ground_reaction import load_ground_reaction
from tkamb.io.recordings.markers import matched_labels
from tkamb.io.recordings.recording_tables import GroundReactionTable
from tkamb.io.recordings.tables import read_table
from tkamb.run.plausibility.movement import sample_questions

JW = Path(__file__).parents[2] / "shared" / "data" / "jw" / "motion"
COUNT, RATIO = 20, 10
A, B, Z0 = 0.12, 0.2, -0.04  # m: position of the sensors of a type 3 plate


def pushes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return force (k, 3) N, point (k, 3) m on the surface and free moment (k) N·m, lab axes."""
    t = np.linspace(0.0, 1.0, COUNT * RATIO)
    force = np.stack([30 * np.sin(3 * t), 20 * np.cos(4 * t), 380 + 100 * np.sin(5 * t)], axis=1)
    point = np.stack([0.2 + 0.1 * t, 0.15 + 0.05 * t**2, 0 * t], axis=1)
    return force, point, 5 * np.cos(2 * t)


def plate_signals(kind: int, corners: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the channels (c, k) of a plate of a type under `pushes`, N, N·mm and mm."""
    force, point, free = pushes()
    x, y = corners[0] - corners[1], corners[0] - corners[3]
    axes = np.stack([x / np.linalg.norm(x), y / np.linalg.norm(y), np.zeros(3)])
    axes[2] = np.cross(axes[0], axes[1])
    moment = np.cross(point - corners.mean(axis=0), force)
    moment[:, 2] += free
    f, m, p = force @ axes.T, moment @ axes.T, (point - corners.mean(axis=0)) @ axes.T
    if kind == 1:
        turned = (np.array([0, 0, 1.0]) @ axes.T)[2] * free
        return np.column_stack([f, p[:, :2] * 1e3, turned * 1e3]).T
    moment_about_origin = m + np.cross(origin if kind != 3 else [0, 0, origin[2]], f)
    if kind != 3:
        return np.column_stack([f, moment_about_origin * 1e3]).T
    # one of many distributions over the eight sensors with this force and moment
    fx = [f[:, 0] / 2, f[:, 0] / 2]
    fy = [
        f[:, 1] / 2 + moment_about_origin[:, 2] / (2 * A),
        f[:, 1] / 2 - moment_about_origin[:, 2] / (2 * A),
    ]
    roll, pitch = moment_about_origin[:, 0] / (4 * B), moment_about_origin[:, 1] / (4 * A)
    quarter = f[:, 2] / 4
    fz = [quarter + roll - pitch, quarter + roll + pitch, quarter - roll + pitch]
    return np.array([*fx, *fy, *fz, quarter - roll - pitch])


FLIPPED = AMTI_CORNERS[[1, 0, 3, 2]]  # x and z are reversed, so that z points down


@pytest.mark.parametrize("corners", [AMTI_CORNERS, FLIPPED], ids=["up", "down"])
@pytest.mark.parametrize("kind", [1, 2, 3, 4])
def test_each_plate_type_gives_the_applied_wrench(tmp_path, kind, corners):
    origin = {2: [0.003, -0.002, -0.03], 3: [A, B, Z0], 4: [0.0, 0.0, -0.05]}.get(kind, [0, 0, 0])
    signals = plate_signals(kind, corners, np.array(origin, float))
    plate = {"type": kind, "corners": corners, "origin": origin}
    plate["channels"] = list(range(1, len(signals) + 1))
    if kind == 4:
        matrix = np.diag([2.0, 2.0, 2.0, 3.0, 3.0, 3.0])
        matrix[0, 5] = 0.1
        signals = np.linalg.solve(matrix, signals)
        plate["matrix"] = matrix
    units = {1: ["N"] * 3 + ["mm"] * 2 + ["Nmm"], 2: ["N"] * 3 + ["N.mm"] * 3, 3: ["N"] * 8}
    path = write_c3d(
        tmp_path / "p.c3d",
        standing_markers(COUNT),
        analog={f"c{k}": s for k, s in enumerate(signals)},
        units=units.get(kind, ["V"] * 6),
        plates=[plate],
    )
    force, point, free = pushes()
    moment = np.cross(point, force)
    moment[:, 2] += free
    wrench = read_c3d(path).plates[0].wrench
    np.testing.assert_allclose(wrench[:, :3], force, atol=1e-3)  # the file holds single precision
    np.testing.assert_allclose(wrench[:, 3:], moment, atol=1e-3)


def two_plates(tmp_path: Path, **more) -> Path:
    """Write a recording with half of the load on each of two plates of type 2."""
    second_corners = AMTI_CORNERS + np.array([0.0, 0.5, 0.0])
    halves = [
        0.5 * plate_signals(2, corners, np.zeros(3)) for corners in (AMTI_CORNERS, second_corners)
    ]
    plates = [
        {"type": 2, "corners": AMTI_CORNERS, "channels": range(1, 7)},
        {"type": 2, "corners": second_corners, "channels": range(7, 13)},
    ]
    signals = np.concatenate(halves)
    return write_c3d(
        tmp_path / "two.c3d",
        standing_markers(COUNT),
        analog={f"c{k}": s for k, s in enumerate(signals)},
        units=(["N"] * 3 + ["Nmm"] * 3) * 2,
        plates=plates,
        **more,
    )


def test_one_foot_on_two_plates_has_the_sum_of_their_wrenches(tmp_path):
    path = two_plates(tmp_path)
    table = GroundReactionTable(
        file=path, plates=(1, 2), laboratory_axes="+x,+z,-y", cutoff_Hz="none"
    )
    time = read_c3d(path).analog_time
    ground = load_ground_reaction(table, time, "right")
    force, point, free = pushes()
    axes_rotation = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    np.testing.assert_allclose(ground.force, force @ axes_rotation.T, atol=1e-3)
    np.testing.assert_allclose(ground.point, point @ axes_rotation.T, atol=1e-5)
    np.testing.assert_allclose(ground.moment[:, 1], free, atol=1e-3)
    assert ground.loaded.all()
    on_plate = table.model_copy(update={"force": "on the plate"})
    with pytest.raises(InputError, match="leave out the key force"):
        load_ground_reaction(on_plate, time, "right")


def test_an_outlier_in_a_c3d_file_is_called_a_spike_of_the_plates(tmp_path):
    path = two_plates(tmp_path)
    table = GroundReactionTable(file=path, plates=(1, 2), cutoff_Hz=6.0)
    ground = SimpleNamespace(odd=(OddSample(path, "upward force", 0.05, 75.8, "N"),))
    motion = SimpleNamespace(time=np.linspace(0.0, 0.1, 11), odd=())
    scene = SimpleNamespace(ground_reaction=table)
    case = SimpleNamespace(motion=motion, tibia=None, ground=ground, scene=scene)
    (question,) = sample_questions(case)
    assert "two.c3d: upward force of plates 1, 2 at 0.05 s lies 75.8 N" in question.text
    assert "spike" in question.text and "cell" not in question.text


def test_the_centre_of_pressure_on_a_step_is_on_the_same_line_of_action(tmp_path):
    path = two_plates(tmp_path)
    reactions = {}
    for surface in (0.0, 400.0):
        table = GroundReactionTable(
            file=path,
            plates=(1, 2),
            laboratory_axes="+x,+z,-y",
            cutoff_Hz="none",
            surface_mm=surface,
        )
        reactions[surface] = load_ground_reaction(table, np.array([0.05, 0.1]), "right")
    flat, step = reactions.values()
    np.testing.assert_allclose(step.force, flat.force)
    np.testing.assert_allclose(step.point[:, 1] - flat.point[:, 1], 0.4)
    shift = step.point - flat.point
    np.testing.assert_allclose(np.cross(shift, flat.force)[:, [0, 2]], 0.0, atol=1e-9)
    for ground in reactions.values():
        moment_about_origin = ground.moment + np.cross(ground.point, ground.force)
        np.testing.assert_allclose(
            moment_about_origin, flat.moment + np.cross(flat.point, flat.force), atol=1e-9
        )
        np.testing.assert_allclose(ground.moment[:, [0, 2]], 0.0, atol=1e-9)
    table = GroundReactionTable(file=tmp_path / "x.mot", cutoff_Hz="none", surface_mm=1.0)
    with pytest.raises(InputError, match="surface_mm"):
        load_ground_reaction(table, np.array([0.05]), "right")


def test_the_wrench_below_the_force_threshold_is_unchanged(tmp_path):
    path = two_plates(tmp_path)
    table = GroundReactionTable(
        file=path, plates=(1,), laboratory_axes="+x,+z,-y", cutoff_Hz="none", unloaded_N=195.0
    )
    recording = read_c3d(path)
    ground = load_ground_reaction(table, recording.analog_time, "right")
    assert 0 < ground.loaded.sum() < len(ground.loaded)
    axes_rotation = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    moment_about_origin = ground.moment + np.cross(ground.point, ground.force)
    np.testing.assert_allclose(
        moment_about_origin, recording.plates[0].wrench[:, 3:] @ axes_rotation.T, atol=1e-6
    )


def test_times_count_from_the_first_frame_of_the_recording(tmp_path):
    path = two_plates(tmp_path, first_frame=217)
    recording = read_c3d(path)
    np.testing.assert_allclose(recording.time, (217 + np.arange(COUNT)) / 100.0, rtol=1e-12)
    assert recording.analog_time[0] == pytest.approx(recording.time[0], abs=1e-12)
    assert len(recording.analog_time) == COUNT * RATIO
    assert recording.analog_time[RATIO] == pytest.approx(recording.time[1], abs=1e-12)
    np.testing.assert_allclose(read_table(path).time(), recording.time)


def test_channels_without_a_plate_are_available_by_name(tmp_path):
    signal = np.sin(np.arange(COUNT * RATIO))
    path = write_c3d(
        tmp_path / "emg.c3d", standing_markers(), analog={"soleus": signal}, units=["V"]
    )
    recording = read_c3d(path)
    np.testing.assert_allclose(recording.channels["soleus"], signal, atol=1e-6)
    assert recording.channel_units == {"soleus": "V"} and recording.plates == ()


def test_gaps_of_markers_are_nan(tmp_path):
    markers = standing_markers()
    markers["JW:RToe"][3] = np.nan
    markers["JW:RHeel"][5] = 0.0
    points = read_c3d(write_c3d(tmp_path / "g.c3d", markers)).points
    assert np.isnan(points[5, 0]).all() and np.isnan(points[3, 1]).all()
    assert np.isfinite(points[:, 2]).all()


def test_labels_match_independent_of_prefix_and_dots():
    matches = matched_labels(
        ["R.Thigh.Superior", "R_Heel", "Nobody", "RToe"],
        ["JW:RThighSuperior", "RHeel", "A:RToe", "B:RToe"],
    )
    assert matches == {"R.Thigh.Superior": "JW:RThighSuperior", "R_Heel": "RHeel"}


def written(tmp_path: Path, **changes) -> Path:
    """Write a recording of one plate under `pushes`, with changed arguments of `write_c3d`."""
    signals = plate_signals(2, AMTI_CORNERS, np.zeros(3))
    plate = {"type": 2, "channels": list(range(1, 7))} | changes.pop("plate", {})
    arguments = {
        "analog": {f"c{k}": s for k, s in enumerate(signals)},
        "units": ["N"] * 3 + ["Nmm"] * 3,
        "plates": [plate],
    } | changes
    return write_c3d(tmp_path / "bad.c3d", standing_markers(COUNT), **arguments)


def truncated(path: Path, share: float) -> Path:
    """Shorten a file to a share of its length, and return its path."""
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    return path


def with_analog_rate(path: Path, analog_rate: float) -> Path:
    """Change ANALOG:RATE, the second RATE in the file, and return the path."""
    content = bytearray(path.read_bytes())
    offset = content.index(b"RATE", content.index(b"RATE") + 4) + 8
    content[offset : offset + 4] = struct.pack("<f", analog_rate)
    path.write_bytes(content)
    return path


REFUSED = {
    "analog rate no multiple": (lambda d: with_analog_rate(written(d), 1050.0), "no multiple"),
    "analog rate of other samples": (
        lambda d: with_analog_rate(written(d), 2000.0),
        "10 samples a frame",
    ),
    "analog rate below the markers'": (lambda d: with_analog_rate(written(d), 50.0), "no multiple"),
    "half of the file": (lambda d: truncated(written(d), 0.5), "cut short"),
    "no parameters": (lambda d: truncated(written(d), 0.02), "C3D"),
    "text": (lambda d: text(d, "not a recording at all" * 100), "not a C3D file"),
    "empty": (lambda d: text(d, ""), "not a C3D file"),
    "not there": (lambda d: d / "none.c3d", "no such file"),
    "type 5 with six channels": (lambda d: written(d, plate={"type": 5}), "6 of 8 channels"),
    "type 7": (lambda d: written(d, plate={"type": 7}), "type 7"),
    "type 0": (lambda d: written(d, plate={"type": 0}), "type 0"),
    "channel that is not there": (
        lambda d: written(d, plate={"channels": [1, 2, 3, 4, 5, 99]}),
        "99",
    ),
    "no units": (lambda d: written(d, units=[""] * 6), "unit"),
    "pounds": (lambda d: written(d, units=["lbf"] * 6), "lbf"),
    "furlongs": (lambda d: written(d, point_unit="fur"), "'fur'"),
    "no surface": (lambda d: written(d, plate={"corners": 0 * AMTI_CORNERS}), "corners"),
    "type 4, no matrix": (lambda d: written(d, plate={"type": 4}, units=["V"] * 6), "CAL_MATRIX"),
    "type 3 with six channels": (lambda d: written(d, plate={"type": 3}), "channels"),
    "NaN in a channel": (
        lambda d: written(d, analog={f"c{k}": np.full(COUNT * RATIO, np.nan) for k in range(6)}),
        "no value that is a number",
    ),
}


def text(folder: Path, content: str) -> Path:
    """Write a text into a file with the suffix of a recording."""
    path = folder / "text.c3d"
    path.write_text(content)
    return path


@pytest.mark.parametrize("mistake", REFUSED)
def test_an_unreadable_file_or_plate_is_refused_in_one_line(tmp_path, mistake):
    make, words = REFUSED[mistake]
    path = make(tmp_path)
    with pytest.raises(InputError) as caught:
        read_c3d(path).plate(1)
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("plates", "words"), [((), "plates"), ((3,), "no force plate 3"), ((1, 9), "no force plate 9")]
)
def test_missing_plate_numbers_are_refused(tmp_path, plates, words):
    table = GroundReactionTable(file=two_plates(tmp_path), plates=plates, cutoff_Hz="none")
    with pytest.raises(InputError, match=words):
        load_ground_reaction(table, np.zeros(1), "right")


def test_a_downward_ground_reaction_is_refused(tmp_path):
    signals = -plate_signals(2, AMTI_CORNERS, np.zeros(3))
    path = written(tmp_path, analog={f"c{k}": s for k, s in enumerate(signals)})
    table = GroundReactionTable(
        file=path, plates=(1,), laboratory_axes="+x,+z,-y", cutoff_Hz="none"
    )
    with pytest.raises(InputError, match="down"):
        load_ground_reaction(table, np.array([0.05]), "right")


@pytest.mark.skipif(not JW.is_dir(), reason="subject JW's recordings are not beside the project")
def test_the_vertical_force_of_jw_s_squat_is_the_body_weight():
    recording = read_c3d(JW / "jw_2legsquat1.c3d")
    vertical = sum(plate.force[:, 2] for plate in recording.plates)
    assert recording.points.shape == (1637, 56, 3)
    assert np.median(vertical) == pytest.approx(645.0, abs=5.0)  # N, stated with the data
    assert "vasmed" in recording.channels and "Fz1" not in recording.channels


@pytest.mark.skipif(not JW.is_dir(), reason="subject JW's recordings are not beside the project")
def test_jw_s_gait_begins_at_its_first_frame():
    recording = read_c3d(JW / "jw_ngait_og3.c3d")
    assert recording.time[0] == pytest.approx(217 / 120, abs=1e-9)
    assert np.isnan(read_c3d(JW / "jw_stairupf1.c3d").points).mean() == pytest.approx(
        0.15, abs=0.01
    )
