"""C3D files: byte orders, integers, long recordings, damage, and comparison with ezc3d."""

import os
import sys
from pathlib import Path

import ezc3d
import numpy as np
import pytest

from damaged_recordings import TEXTS, WORDS, damaged, read_all
from raw_c3d import MACHINES, RawC3d
from recordings import standing_markers, write_c3d
from tkamb.errors import InputError
from tkamb.io.recordings.c3d import read_c3d
from tkamb.show.storage import write_trc

JW = Path(__file__).parents[2] / "shared" / "data" / "jw" / "motion"
POINTS = np.round(np.random.default_rng(3).normal(0.0, 400.0, (12, 3, 3)), 1)  # mm
POINTS[4, 1] = np.nan
ANALOG = np.random.default_rng(4).integers(-900, 900, (120, 2)).astype(float)


def raw(machine="intel", **options):
    file = RawC3d(machine, **options)
    file.add("POINT", "LABELS", ["A", "B", "C"]).add("POINT", "UNITS", ["mm"])
    file.add("ANALOG", "LABELS", ["emg one", "emg two"]).add("ANALOG", "UNITS", ["V", "V"])
    file.add("ANALOG", "SCALE", np.array([0.01, 0.5])).add("ANALOG", "GEN_SCALE", np.array([2.0]))
    file.add("ANALOG", "OFFSET", [3, 7]).add("ANALOG", "RATE", np.array([1000.0]))
    return file


@pytest.mark.parametrize("integers", [False, True], ids=["floats", "integers"])
@pytest.mark.parametrize("machine", MACHINES)
def test_numbers_of_every_processor_type_are_read(tmp_path, machine, integers):
    path = raw(machine, integers=integers, first=31).write(tmp_path / "a.c3d", POINTS, ANALOG)
    recording = read_c3d(path)
    np.testing.assert_allclose(recording.points, POINTS * 1e-3, atol=1e-7)
    volts = (ANALOG - [3, 7]) * [0.01, 0.5] * 2.0
    channels = np.stack([recording.channels[name] for name in ("emg one", "emg two")], axis=1)
    np.testing.assert_allclose(channels, volts, rtol=1e-6)
    np.testing.assert_allclose(recording.time, (30 + np.arange(12)) / 100.0)
    if machine == "mips":
        return  # ezc3d cannot read this type
    theirs = ezc3d.c3d(str(path))["data"]
    np.testing.assert_allclose(channels.T, theirs["analogs"][0], rtol=1e-6)
    visible = np.isfinite(recording.points)
    points = theirs["points"][:3].transpose(2, 1, 0) * 1e-3
    np.testing.assert_allclose(recording.points[visible], points[visible], atol=1e-9)


def test_a_negative_offset_is_subtracted(tmp_path):
    file = raw().add("ANALOG", "OFFSET", [3, -7])
    recording = read_c3d(file.write(tmp_path / "a.c3d", POINTS, ANALOG))
    np.testing.assert_allclose(recording.channels["emg two"], (ANALOG[:, 1] + 7), rtol=1e-6)


def test_unsigned_analog_values_reach_65535(tmp_path):
    file = (
        raw(integers=True)
        .add("ANALOG", "FORMAT", ["UNSIGNED"])
        .add("ANALOG", "OFFSET", [40000] * 2)
    )
    words = np.full((120, 2), 60000.0)
    recording = read_c3d(file.write(tmp_path / "a.c3d", POINTS, words))
    np.testing.assert_allclose(recording.channels["emg two"], 20000.0 * 0.5 * 2.0)


@pytest.mark.skipif(not JW.is_dir(), reason="subject JW's recordings are not beside the project")
@pytest.mark.parametrize("name", ["jw_ngait_og3", "jw_2legsquat1", "jw_1legstand1"])
def test_markers_and_plates_agree_with_ezc3d(name):
    path = JW / f"{name}.c3d"
    mine, theirs = read_c3d(path), ezc3d.c3d(str(path), extract_forceplat_data=True)
    points = theirs["data"]["points"][:3].transpose(2, 1, 0) * 1e-3
    visible = np.isfinite(mine.points)
    np.testing.assert_array_equal(mine.points[visible], points[visible])
    assert np.isnan(points[~visible]).all() or (points[~visible] == 0).all()
    assert mine.first_frame == theirs["header"]["points"]["first_frame"]
    for plate, other in zip(mine.plates, theirs["data"]["platform"], strict=True):
        np.testing.assert_allclose(plate.force.T, other["force"], atol=1e-9)
        np.testing.assert_allclose(plate.moment.T * 1e3, other["moment"], atol=1e-6)


def long_points(count):
    points = np.tile([100.0, 200.0, 1.0], (count, 1, 1))
    points[:, 0, 0] += np.arange(count) * 1e-3
    return points


@pytest.mark.parametrize(
    ("first", "how"),
    [(1, "TRIAL"), (101, "TRIAL"), (1, "LONG_FRAMES"), (1, "wrapped"), (1, "FRAMES")],
)
def test_recordings_of_more_than_65535_frames_are_read_completely(tmp_path, first, how):
    count = 70_000
    file = RawC3d(first=first)
    file.add("POINT", "LABELS", ["A"]).add("POINT", "UNITS", ["mm"])
    last, stated = first + count - 1, min(count, 65536 - first)
    if how in ("TRIAL", "wrapped"):
        file.add("TRIAL", "ACTUAL_START_FIELD", [first, 0])
        file.add("TRIAL", "ACTUAL_END_FIELD", [last % 65536, last // 65536])
    else:
        file.add("POINT", how, np.array([float(count)]))
    if how == "wrapped":
        stated = last % 65536
    path = file.write(tmp_path / "a.c3d", long_points(count), frames=stated)
    recording = read_c3d(path)
    assert len(recording.points) == count
    assert recording.points[-1, 0, 0] == pytest.approx(0.1 + (count - 1) * 1e-6, abs=1e-7)
    assert recording.time[-1] == pytest.approx((last - 1) / 100.0)


@pytest.mark.parametrize("stated", [65535, 70_000 - 65_536])
def test_a_wrong_number_of_frames_is_refused(tmp_path, stated):
    file = RawC3d().add("POINT", "LABELS", ["A"]).add("POINT", "UNITS", ["mm"])
    path = file.write(tmp_path / "a.c3d", long_points(70_000), frames=stated)
    with pytest.raises(InputError, match=r"long enough for 700\d\d"):
        read_c3d(path)


def header_word(number, value):
    """Return a change of a 16-bit word of the header, counted from 1."""

    def change(content):
        content[2 * number - 2 : 2 * number] = value.to_bytes(2, "little")

    return change


def parameter_value(group, name, value):
    """Return a change of the first value of an integer or float parameter."""

    def change(content):
        at = content.index(name.encode(), content.index(group.encode(), 512)) + len(name) + 2
        size = {2: 2, 4: 4}[content[at]]
        first = at + 2 + content[at + 1]
        new = value.to_bytes(2, "little") if size == 2 else np.float32(value).tobytes()
        content[first : first + size] = new

    return change


CONTRADICTIONS = {
    "markers of the header": [header_word(2, 7)],
    "markers of the parameter": [parameter_value("POINT", "USED", 2)],
    "channels for values": [header_word(3, 2)],
    "values of the header": [header_word(3, 30)],
    "channels of the parameter": [parameter_value("ANALOG", "USED", 5)],
    "samples of the header": [header_word(10, 5)],
    "no samples": [header_word(10, 0)],
    "integers by the parameter": [parameter_value("POINT", "SCALE", 0.1)],
    "two at once": [header_word(2, 7), header_word(3, 2)],
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_contradictions_that_the_size_of_the_file_decides_are_resolved(tmp_path, name):
    points, analog = np.tile(POINTS, (20, 1, 1)), np.tile(ANALOG, (20, 1))
    path = raw().write(tmp_path / "a.c3d", points, analog)
    expected = read_c3d(path)
    assert expected.notices == ()
    content = bytearray(path.read_bytes())
    for change in CONTRADICTIONS[name]:
        change(content)
    (tmp_path / "b.c3d").write_bytes(content)
    recording = read_c3d(tmp_path / "b.c3d")
    np.testing.assert_array_equal(recording.points, expected.points)
    assert recording.channels.keys() == expected.channels.keys()
    for channel, values in expected.channels.items():
        np.testing.assert_array_equal(recording.channels[channel], values)
    (notice,) = recording.notices
    assert "fits 3 markers and 2 analog channels with 10 samples per frame, as floats" in notice


@pytest.mark.parametrize("change", [header_word(2, 4), header_word(3, 30), header_word(10, 3)])
def test_contradictions_that_no_size_decides_are_refused(tmp_path, change):
    """Two frames of either layout, or of neither, end within the last block."""
    content = bytearray(raw().write(tmp_path / "a.c3d", POINTS[:2], ANALOG[:20]).read_bytes())
    change(content)
    if content[18] == 3:
        content += bytes(4096)
    (tmp_path / "a.c3d").write_bytes(content)
    with pytest.raises(InputError, match=r"by its header|which is no multiple"):
        read_c3d(tmp_path / "a.c3d")


@pytest.mark.parametrize("labels", [True, False])
def test_a_recording_of_rotations_alone_is_named(tmp_path, labels):
    file = RawC3d().add("ROTATION", "USED", [7]).add("ROTATION", "DATA_START", [9])
    if labels:
        file.add("ROTATION", "LABELS", [f"S{k}" for k in range(7)])
    path = file.write(tmp_path / "a.c3d", POINTS[:, :0])
    with pytest.raises(InputError, match=r"rotations of 7 segments, and no markers.*--motion"):
        read_c3d(path)


def test_damaged_files_are_read_or_refused(tmp_path):
    c3d = raw("mips", integers=True).write(tmp_path / "a.c3d", POINTS, ANALOG)
    trc = tmp_path / "a.trc"
    write_trc(trc, np.arange(20) / 100.0, standing_markers(20), 100.0)
    results = []
    for seed in range(300):
        source = (c3d, trc)[seed % 2]
        path = tmp_path / f"damaged{source.suffix}"
        words = WORDS if source is c3d else TEXTS
        path.write_bytes(damaged(source.read_bytes(), seed, words))
        results.append(read_all(path))
    assert 20 < results.count("read") < 280  # some files are read, some refused


def test_a_parameter_with_too_many_dimensions_is_refused(tmp_path):
    path = raw().write(tmp_path / "a.c3d", POINTS, ANALOG)
    content = bytearray(path.read_bytes())
    at = content.index(b"SCALE") + 5 + 2
    content[at + 1] = 200
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged parameter"):
        read_c3d(path)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no FIFO in its folders")
def test_paths_that_are_not_regular_files_are_refused(tmp_path):
    os.mkfifo(tmp_path / "fifo.c3d")
    (tmp_path / "folder.c3d").mkdir()
    (tmp_path / "device.c3d").symlink_to("/dev/zero")
    with open(tmp_path / "sparse.c3d", "wb") as file:
        file.truncate(40 * 10**9)
    words = {"fifo": "FIFO", "folder": "folder", "device": "device", "sparse": "MB large"}
    for name, word in words.items():
        with pytest.raises(InputError, match=word):
            read_c3d(tmp_path / f"{name}.c3d")


def test_markers_are_read_despite_a_wrong_analog_rate(tmp_path):
    file = raw().add("ANALOG", "RATE", np.array([1500.0]))
    recording = read_c3d(file.write(tmp_path / "a.c3d", POINTS, ANALOG))
    np.testing.assert_allclose(recording.points, POINTS * 1e-3, atol=1e-7)
    with pytest.raises(InputError, match="holds 10 samples a frame"):
        recording.channel("emg one")
    assert "1500 Hz" in recording.all_notices[0]


def test_more_than_255_labels_are_read_from_a_second_parameter(tmp_path):
    markers = {f"M{k}": np.zeros((3, 3)) + 0.001 * (k + 1) for k in range(300)}
    recording = read_c3d(write_c3d(tmp_path / "a.c3d", markers))
    assert recording.labels[299] == "M299"
    np.testing.assert_allclose(recording.points[0, 299], 0.3, atol=1e-6)
