"""Tables are read, or refused with a one-line message."""

import numpy as np
import pytest

from scenes import MODEL, write_scene
from tkamb.errors import InputError
from tkamb.io.recordings.tables import READERS, Table, read_table
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case

TRC = (
    "PathFileType\t4\t(X/Y/Z)\tshank.trc\n"
    "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\n"
    "120\t120\t4\t2\tmm\n"
    "Frame#\tTime\tSuperior\t\t\tInferior\t\t\t\n"
    "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\t\n"
    "\n"
    "1\t0.000\t1\t2\t3\t4\t5\t6\t\n"
    "2\t0.008\t1\t2\t3\t-nan(ind)\t5\t6\t\n"
    "3\t0.017\t-0\t0\t0\t4\t5\t6\t\n"
    "4\t0.025\t1\t2\t3\t4\t\t6\t\n"
)


def written(folder, name, text):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_csv_with_comments_and_spaces_is_read(tmp_path):
    table = read_table(written(tmp_path, "a.csv", "# run 3\ntime, angle\n0,1\n\n0.5, 2e0\n"))
    np.testing.assert_array_equal(table.time(), [0, 0.5])
    np.testing.assert_array_equal(table.complete_column("angle"), [1, 2])


@pytest.mark.parametrize(
    ("written", "words"),
    [
        ("time;Fz, N\n0,5;-1,25e3\n1;\n", "semicolons between its cells and commas in its numbers"),
        ("time\tFz, N\n0.5\t-1.25e3\n1\t\n", "tabs between its cells"),
    ],
)
def test_a_csv_of_a_german_spreadsheet_is_read_with_a_notice(tmp_path, written, words):
    path = tmp_path / "measured.csv"
    path.write_text(written)
    table = read_table(path)
    assert table.column("time").tolist() == [0.5, 1.0]
    assert table.column("Fz, N")[0] == -1250.0 and np.isnan(table.column("Fz, N")[1])
    assert words in table.notices[0]


@pytest.mark.parametrize("suffix", ["sto", "mot"])
def test_storage_reads_header_and_columns(tmp_path, suffix):
    text = "walk\nversion=1\ninDegrees=yes\nendheader\ntime\tknee\n0\t1\n1\t2\n"
    table = read_table(written(tmp_path, f"a.{suffix}", text))
    assert table.in_degrees is True
    np.testing.assert_array_equal(table.column("knee"), [1, 2])


def test_trc_gaps_are_nan_and_time_is_the_cameras(tmp_path):
    table = read_table(written(tmp_path, "a.trc", TRC))
    assert table.unit_scale(None, "length_unit") == 1e-3
    assert np.isnan(table.column("Inferior_x")[1])
    assert np.isnan(table.column("Inferior_y")[3])
    assert np.isnan([table.column(f"Superior_{axis}")[2] for axis in "xyz"]).all()
    np.testing.assert_array_equal(np.isnan(table.column("Inferior_x")), [0, 1, 0, 0])
    np.testing.assert_allclose(np.diff(table.time()), 1 / 120, rtol=1e-12)
    assert abs(table.time() - [0, 0.008, 0.017, 0.025]).max() < 1e-3


def test_trc_time_that_is_not_even_stays(tmp_path):
    table = read_table(written(tmp_path, "a.trc", TRC.replace("0.025", "0.050")))
    np.testing.assert_array_equal(table.time(), [0, 0.008, 0.017, 0.050])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "", "is empty"),
        ("a.csv", "time,x\n", "no data rows"),
        ("a.csv", "time,x\n0,1\n1\n", "line 3 has 1 cells, the header 2"),
        ("a.csv", "time,x\n0,one\n", "line 2 holds 'one'"),
        ("a.sto", "time\tx\n0\t1\n", "no 'endheader'"),
        ("a.trc", "time,x\n", "not a .trc"),
        ("a.xls", "time,x\n", "unknown table format 'xls'"),
    ],
)
def test_unusable_file_is_one_clear_line(tmp_path, name, text, message):
    path = written(tmp_path, name, text)
    with pytest.raises(InputError, match=message) as caught:
        read_table(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_words_that_only_contain_nan_are_no_gaps(tmp_path):
    text = "time,x\n0,NaN\n1,-nan(ind)\n2,-1.#IND\n3,\n"
    values = read_table(written(tmp_path, "a.csv", text)).column("x")
    assert np.isnan(values).all()
    with pytest.raises(InputError, match="holds 'banana'"):
        read_table(written(tmp_path, "a.csv", "time,x\n0,banana\n"))


def test_equal_columns_are_refused_only_where_one_is_needed(tmp_path):
    table = read_table(written(tmp_path, "a.csv", "time,x,arm,arm\n0,1,2,3\n"))
    assert table.column("x")[0] == 1.0 and "two columns named 'arm'" in table.notices[0]
    with pytest.raises(InputError, match="two columns named 'arm'"):
        table.column("arm")


def test_a_missing_file_is_refused():
    with pytest.raises(InputError, match="no such file"):
        read_table("nowhere.csv")


def test_missing_column_lists_the_nearest(tmp_path):
    table = read_table(written(tmp_path, "a.csv", "time,knee_flexion_r,hip\n0,1,2\n"))
    with pytest.raises(InputError, match="no column 'knee_flexion'; did you mean knee_flexion_r"):
        table.column("knee_flexion")


@pytest.mark.parametrize(
    ("times", "message"),
    [("0 1 1", "row 2 .1. to 3 .1."), ("0 2 1", "row 2 .2. to 3 .1."), ("0 nan 1", "row 2")],
)
def test_time_must_rise(tmp_path, times, message):
    rows = "\n".join(times.split())
    table = read_table(written(tmp_path, "a.csv", f"time\n{rows}\n"))
    with pytest.raises(InputError, match=message):
        table.time()


def test_a_gap_in_a_needed_column_is_refused(tmp_path):
    table = read_table(written(tmp_path, "a.csv", "time,x\n0,1\n1,\n2,nan\n"))
    with pytest.raises(InputError, match=r"2 missing or non-finite.*row 2"):
        table.complete_column("x")


@pytest.mark.parametrize("cell", ["inf", "-Infinity", "1e400"])
def test_an_infinite_cell_is_refused(tmp_path, cell):
    with pytest.raises(InputError, match=rf"line 3 holds '{cell}', which is not finite"):
        read_table(written(tmp_path, "a.csv", f"time,x\n0,1\n1,{cell}\n"))


def test_units_must_be_stated_and_agree(tmp_path):
    trc = read_table(written(tmp_path, "a.trc", TRC))
    with pytest.raises(InputError, match="is in mm by its own header, but the scene says m"):
        trc.unit_scale("m", "length_unit")
    csv = read_table(written(tmp_path, "a.csv", "time\n0\n"))
    with pytest.raises(InputError, match="no unit of length"):
        csv.unit_scale(None, "length_unit")


def test_a_format_is_one_reader_and_one_row(tmp_path, monkeypatch):
    """A new reader, for lines of `name: numbers`, is chosen by the suffix or by `format`."""

    def read_toy(path):
        lines = [line.split(":") for line in path.read_text(encoding="utf-8").splitlines()]
        return Table(path, {name: np.array(cells.split(), float) for name, cells in lines})

    monkeypatch.setitem(READERS, "toy", read_toy)
    scene = write_scene(tmp_path, motion__file="motion.toy")
    recorded = read_table(tmp_path / "motion.csv")
    lines = [f"{name}: {' '.join(map(repr, v.tolist()))}" for name, v in recorded.columns.items()]
    written(tmp_path, "motion.toy", "\n".join(lines))
    shipped = load_case(load_scene(MODEL / "scene.toml")).motion
    toy = load_case(load_scene(scene)).motion
    np.testing.assert_array_equal(toy.coordinates, shipped.coordinates)
    named = load_case(load_scene(scene, {"motion.format": "toy"})).motion
    np.testing.assert_array_equal(named.velocity, shipped.velocity)
    with pytest.raises(InputError, match=r"unknown table format 'toys', use csv, .*toy"):
        load_scene(scene, {"motion.format": "toys"})
