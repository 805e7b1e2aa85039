"""results.csv, summary.json and contact.h5: exact round trip, complete files, killed writers."""

import json
import os
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from kept_runs import keep
from synthetic_run import make_run
from tkamb.errors import InputError
from tkamb.files import claim_directory
from tkamb.run.columns import COLUMNS, columns_as_markdown, is_ligament, ligament_of
from tkamb.run.maps import ContactMaps, MapWriter, read_maps, write_maps
from tkamb.run.metrics import map_rows
from tkamb.run.results import Results, csv_rows, read_csv
from tkamb.run.results_folder import read_results, write_results
from tkamb.run.summary import notes_of
from tkamb.run.tabulate import RowTable

ROOT = Path(__file__).parents[1]


def test_written_and_read_results_are_identical(tmp_path):
    run = make_run("gait", frames=21)
    run.columns["force_ap_N"][3] = np.nextafter(0.1, 1)
    run.columns["force_ap_N"][4] = 5e-324
    run.columns["force_ap_N"][5] = -0.0
    write_results(run, tmp_path)
    copy = read_results(tmp_path)
    assert list(copy.columns) == list(run.columns)
    for name, values in run.columns.items():
        if name == "status":
            assert copy.status == values
        else:
            assert np.array_equal(copy[name], values, equal_nan=True), name
            assert np.array_equal(np.signbit(copy[name]), np.signbit(values)), name
    assert copy.summary == json.loads((tmp_path / "summary.json").read_text())
    for name in ("points_m", "triangles", "time_s", "pressure_Pa", "gap_m", "nodal_force_N"):
        assert np.array_equal(getattr(copy.maps, name), getattr(run.maps, name)), name
    assert copy.maps.attributes["model"] == "synthetic"
    assert copy.maps.attributes["units"].startswith("SI")


def test_columns_have_the_order_of_the_table():
    run = make_run(frames=5, maps=False)
    names_in_table = [
        column.name for column in COLUMNS if "<" not in column.name and not column.optional
    ]
    written = [name for name in run.columns if not is_ligament(name)]
    assert written == names_in_table
    ligaments = [name for name in run.columns if is_ligament(name)]
    assert [ligament_of(name) for name in ligaments] == ["PCL_anterolateral", "MCL_anterior"]
    names = list(run.columns)
    assert names.index(ligaments[0]) == names.index("external_adduction_moment_Nm") + 1


def test_a_column_that_is_not_modelled_is_empty():
    run = Results({"time_s": [0.0, 0.5], "flexion_deg": [0.0, 60.0], "status": ["ok", "singular"]})
    assert "force_total_N" in run.not_modelled
    assert "flexion_deg" not in run.not_modelled
    header, first, second = (",".join(row) for row in csv_rows(run.columns))
    row = dict(zip(header.split(","), second.split(","), strict=True))
    assert row["force_total_N"] == ""
    assert row["flexion_deg"] == "60.0"
    assert row["status"] == "singular"
    absent_count = sum("<" in column.name or column.optional for column in COLUMNS)
    assert len(first.split(",")) == len(COLUMNS) - absent_count


def test_a_column_of_an_earlier_release_is_read_under_its_new_name(tmp_path):
    path = tmp_path / "results.csv"
    path.write_text("time_s,softest_N_per_mm,status\n0.0,120.5,ok\n")
    assert read_csv(path)["smallest_stiffness_N_per_mm"] == [120.5]


@pytest.mark.parametrize(
    ("columns", "complaint"),
    [
        ({"time_s": [0.0], "status": ["ok"], "force_N": [1.0]}, "unknown column 'force_N'"),
        ({"time_s": [0.0, 1.0], "status": ["ok"]}, "time_s"),
        ({"time_s": [0.0]}, "'status' is missing"),
    ],
)
def test_unknown_missing_or_uneven_columns_are_refused(columns, complaint):
    with pytest.raises(InputError, match=complaint):
        Results(columns)


def test_a_damaged_csv_is_refused_with_the_line_or_column(tmp_path):
    write_results(make_run(frames=5, maps=False), tmp_path)
    path = tmp_path / "results.csv"
    text = path.read_text()
    path.write_text(text + "1,2,3\n")
    with pytest.raises(InputError, match="line 7 has 3 cells"):
        read_results(tmp_path)
    path.write_text(text.replace("\n3.0,", "\nthree,"))
    with pytest.raises(InputError, match=r"'time_s'.*'three'"):
        read_results(tmp_path)
    path.unlink()
    with pytest.raises(InputError, match="holds no results"):
        read_results(tmp_path)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    write_results(make_run(frames=5, maps=False), tmp_path)
    before = (tmp_path / "results.csv").read_text()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left"):
        write_results(make_run(frames=9, maps=False), tmp_path)
    assert (tmp_path / "results.csv").read_text() == before
    assert [path.name for path in tmp_path.glob(".*")] == [".tkamb"]


def test_a_claimed_folder_is_created_and_a_file_is_refused(tmp_path):
    assert claim_directory(tmp_path / "a" / "b").is_dir()
    assert not list((tmp_path / "a" / "b").iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        claim_directory(tmp_path / "file")
    with pytest.raises(InputError, match="cannot be written"):
        claim_directory(tmp_path / "file" / "below")


def test_maps_of_an_earlier_run_are_removed(tmp_path):
    write_results(make_run(frames=5), tmp_path)
    assert (tmp_path / "contact.h5").exists()
    write_results(make_run(frames=5, maps=False), tmp_path)
    assert read_results(tmp_path).maps is None


def test_maps_are_read_on_first_access(tmp_path):
    run = make_run(frames=5)
    write_maps(run.maps, tmp_path / "contact.h5")
    maps = ContactMaps(tmp_path / "contact.h5")
    assert "pressure_Pa" not in vars(maps)
    assert maps.pressure_Pa.shape == (5, len(maps.points_m))
    with pytest.raises(InputError, match=r"no such contact\.h5"):
        read_maps(tmp_path / "nothing.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(InputError, match="is damaged"):
        read_maps(tmp_path / "text.h5")


def test_a_failed_frame_is_nan_in_the_maps(tmp_path):
    points = np.zeros((4, 3))
    with MapWriter(tmp_path / "contact.h5", points, [[0, 1, 2]], {}) as writer:
        writer.append(0.0, np.ones(4), np.zeros(4), np.zeros((4, 3)), np.eye(4))
        writer.append_failed(0.1)
    maps = read_maps(tmp_path / "contact.h5")
    assert np.array_equal(maps.time_s, [0.0, 0.1])
    assert np.isfinite(maps.pressure_Pa[0]).all()
    assert np.isnan(maps.pressure_Pa[1]).all()
    assert np.isnan(maps.nodal_force_N[1]).all()


def test_an_error_of_hdf5_without_a_number_is_one_line(tmp_path, monkeypatch):
    def full(dataset, size, axis):
        raise RuntimeError("no space left\nthe state of the library")

    writer = MapWriter(tmp_path / "contact.h5", np.zeros((4, 3)), [[0, 1, 2]], {})
    writer.append(0.0, np.ones(4), np.zeros(4), np.zeros((4, 3)), np.eye(4))
    with monkeypatch.context() as patch:
        patch.setattr(h5py.Dataset, "resize", full)
        with pytest.raises(InputError, match=r"cannot be written \(no space left\)"):
            writer.flush()
    writer.close()


WRITER = """
import sys, numpy as np
from tkamb.run.maps import MapWriter
n = 500
rng = np.random.default_rng(1)
noise = rng.normal(size=n)
with MapWriter(sys.argv[1], np.zeros((n, 3)), [[0, 1, 2]], {"model": "kill"}) as writer:
    for k in range(1_000_000):
        writer.append(k, noise + k, noise - k, np.full((n, 3), k), np.eye(4) * k)
        if k % 3 == 0:
            writer.flush()
        print(k - k % 3, flush=True)
"""


@pytest.mark.parametrize("frames", [1, 7, 40, 111])
def test_flushed_maps_are_readable_after_a_kill(tmp_path, frames):
    path = tmp_path / "contact.h5"
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, cwd=ROOT
    )
    flushed = [int(process.stdout.readline()) for _ in range(frames)]
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    maps = read_maps(path)
    assert len(maps) >= flushed[-1] + 1
    k = np.arange(len(maps))
    assert np.array_equal(maps.time_s, k)
    assert np.allclose(maps.pressure_Pa - maps.pressure_Pa[0], k[:, None])
    assert np.allclose(maps.gap_m - maps.gap_m[0], -k[:, None])
    assert np.array_equal(maps.nodal_force_N[:, 3, 1], k)
    assert np.array_equal(maps.femoral_pose[:, 2, 2], k)
    with h5py.File(path) as file:
        assert file.attrs["model"] == "kill"


def test_the_documentation_lists_every_column():
    page = ROOT / "docs" / "results.md"
    advice = "run scripts/make/results_page"
    assert columns_as_markdown() in page.read_text(encoding="utf-8"), advice


@pytest.mark.parametrize("error", [OSError, RuntimeError, KeyError])
def test_any_error_of_h5py_on_a_damaged_file_is_an_input_error(tmp_path, monkeypatch, error):
    write_maps(make_run("bend", frames=3).maps, tmp_path / "contact.h5")

    def broken(*_):
        raise error("bad object header")

    monkeypatch.setattr(h5py.Group, "__contains__", broken)
    with pytest.raises(InputError, match=r"contact.h5: is damaged: bad object header"):
        read_maps(tmp_path / "contact.h5")


def test_memory_for_a_long_recording_hardly_grows_with_its_frames(tmp_path, monkeypatch):
    """100,000 frames of the shipped knee, 3,132 points each, would have 12 GB of maps."""
    monkeypatch.setattr("tkamb.run.maps.BLOCK_BYTES", 1e6)
    peaks = []
    for frames in (200, 800):
        run = make_run("bend", frames)
        folder = keep(run, tmp_path / str(frames))
        tracemalloc.start()
        table = RowTable()
        for k in range(frames):
            table.add(k, {name: values[k] for name, values in run.columns.items()})
        results = read_results(folder)
        assert len(map_rows(results)) == frames
        np.testing.assert_array_equal(results.maps.peaks_Pa, run.maps.pressure_Pa.max(axis=1))
        np.testing.assert_allclose(results.maps.forces_N, run.maps.nodal_force_N.sum(axis=1))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    per_frame = (peaks[1] - peaks[0]) / 600
    assert 100_000 * per_frame < 5e8
    assert per_frame < 0.2 * 8 * 5 * len(run.maps.points_m)


def test_a_row_table_has_the_rows_in_the_order_of_the_frames():
    table = RowTable()
    table.add(4, {"time_s": 0.4, "status": "ok"})
    table.add(2, {"time_s": 0.2, "flexion_deg": 5.0, "status": "failed: x"})
    columns = table.columns(None, range(2, 5, 2))
    assert columns["time_s"].tolist() == [0.2, 0.4] and columns["status"] == ["failed: x", "ok"]
    assert columns["flexion_deg"][0] == 5.0 and np.isnan(columns["flexion_deg"][1])
    assert len(table) == 2 and 2 in table and 3 not in table


def test_a_scene_with_muscles_has_no_note_on_missing_muscles():
    notes = ["Without [muscles] only the quadriceps acts.", "Skin moves."]
    output = SimpleNamespace(notes=notes)
    assert notes_of(SimpleNamespace(output=output, muscles=None)) == notes
    assert notes_of(SimpleNamespace(output=output, muscles=object())) == ["Skin moves."]
