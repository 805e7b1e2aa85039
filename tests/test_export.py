"""`tkamb export`: results as an OpenSim storage file."""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest

from synthetic_run import make_run
from tkamb.cli import main
from tkamb.io.recordings.tables import read_table
from tkamb.run.results_folder import write_results

pytestmark = pytest.mark.usefixtures("plain_report")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("results") / "run"
    write_results(make_run("gait", frames=21, maps=False), path)
    return path


def exported(folder, tmp_path):
    """Return the path of the storage file of a results folder."""
    path = tmp_path / "run.sto"
    assert main(["export", str(folder), "--sto", str(path)]) == 0
    return path


def test_the_storage_file_has_every_number_under_its_name(folder, tmp_path, capsys):
    run = make_run("gait", frames=21, maps=False)
    path = exported(folder, tmp_path)
    table = read_table(path)
    assert table.in_degrees is True
    for name, values in run.columns.items():
        if name != "status":
            column = table.columns["time" if name == "time_s" else name]
            np.testing.assert_allclose(column, values, rtol=1e-9, err_msg=name)
    code, ok = table.columns["status"], np.array([words == "ok" for words in run.status])
    failed = ~ok & np.isnan(run["force_total_N"])
    np.testing.assert_array_equal(code, np.where(ok, 0, np.where(failed, 2, 1)))
    assert ok.any() and failed.any() and not (ok | failed).all()
    assert "21 frames" in capsys.readouterr().out


@pytest.mark.skipif(
    importlib.util.find_spec("opensim") is None, reason="the package opensim is not installed"
)
def test_opensim_reads_the_storage_file(folder, tmp_path):
    path = exported(folder, tmp_path)
    script = (
        "import sys, opensim; t = opensim.TimeSeriesTable(sys.argv[1]); "
        "print(t.getNumRows(), t.getDependentColumn('force_total_N').to_numpy()[7])"
    )
    # in another process, since opensim writes opensim.log into the working directory
    process = subprocess.run(
        [sys.executable, "-c", script, str(path)], cwd=tmp_path, capture_output=True, check=True
    )
    rows, force = process.stdout.split()[-2:]
    assert int(rows) == 21
    run = make_run("gait", frames=21, maps=False)
    assert float(force) == pytest.approx(run["force_total_N"][7], rel=1e-9)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("run.csv", "does not end in .sto or .mot"),
        ("there.sto", "exists already"),
        ("no/run.sto", "no/run"),
    ],
)
def test_a_path_that_cannot_be_written_is_refused_in_one_line(
    folder, tmp_path, capsys, name, words
):
    (tmp_path / "there.sto").write_text("mine")
    (tmp_path / "no").write_text("a file")
    assert main(["export", str(folder), "--sto", str(tmp_path / name)]) == 2
    output = capsys.readouterr().err
    assert words in output and output.count("\n") == 1
    assert (tmp_path / "there.sto").read_text() == "mine"


def test_a_folder_without_results_is_refused_in_one_line(tmp_path, capsys):
    assert main(["export", str(tmp_path), "--sto", str(tmp_path / "a.sto")]) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "a.sto").exists()
