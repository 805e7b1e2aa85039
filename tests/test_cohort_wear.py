"""Wear in a cohort: the results of `tkamb wear` for each run, group and law."""

import csv
import json

import pytest

pytest.importorskip("pyarrow")

from tkamb.cli import main
from tkamb.studies.cohort.outcome import Outcome
from wear_bodies import balls_scene

pytestmark = pytest.mark.usefixtures("plain_report")


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    """Return the folder of a cohort with two wear factors and a law without parameters."""
    folder = tmp_path_factory.mktemp("cohort")
    balls_scene(folder)
    file = folder / "wear.toml"
    file.write_text(
        """
        title = "Two wear factors"
        frames = "0:101:50"
        set = { "contact.resolution_mm" = 6.0, "wear.law" = "archard" }
        [wear]
        cycles = 1000
        updates = 1
        frames_per_cycle = 6
        [[trial]]
        name = "bend"
        scene = "scene.toml"
        [[design]]
        name = "one"
        set = { "wear.wear_factor_mm3_per_Nm" = 1e-7 }
        [[design]]
        name = "two"
        set = { "wear.wear_factor_mm3_per_Nm" = 2e-7 }
        [[design]]
        name = "none"
        set = { "wear.law" = "pressure-cross-shear" }
        """,
        encoding="utf-8",
    )
    assert main(["cohort", str(file), "--out", str(folder / "out")]) in (0, 1)
    return folder


def rows(folder, name):
    with open(folder / "out" / name, encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_each_run_has_wear_or_the_reason_of_its_failure(cohort):
    one, two, none = rows(cohort, "runs.csv")
    volume = [float(run["wear_volume_mm3_per_Mc"]) for run in (one, two)]
    assert volume[1] == pytest.approx(2 * volume[0], rel=1e-3)
    assert float(one["wear_volume_mm3_per_Mc_high"]) == pytest.approx(2 * volume[0])
    assert float(one["wear_first_archard_mm3_per_Mc"]) > 0
    assert none["wear_volume_mm3_per_Mc"] == "" and "no parameters" in none["wear_failed"]
    assert none["failed"] == "" and float(none["peak_force_total_BW"]) > 0
    groups = {(row["design"], row["column"]): row for row in rows(cohort, "groups.csv")}
    assert float(groups["two", "volume_mm3_per_Mc"]["mean"]) == pytest.approx(volume[1])
    page = (cohort / "out" / "cohort.html").read_text(encoding="utf-8")
    assert "Worn volume" in page and "the contact area cancels" in page
    assert "first cycle by archard" in page and "largest depth" in page


@pytest.mark.slow
def test_the_wear_of_a_run_is_that_of_the_wear_command(cohort, capsys):
    run = ["run", str(cohort / "scene.toml"), "--frames", "0:101:50", "--resolution", "6"]
    assert main([*run, "--out", str(cohort / "run")]) == 0
    capsys.readouterr()
    wear = ["wear", str(cohort / "run"), "--cycles", "1000", "--updates", "1", "--json"]
    options = ["--set", "wear.law=archard", "--wear-factor", "1e-7", "--frames-per-cycle", "6"]
    assert main([*wear, *options, "--out", str(cohort / "worn")]) == 0
    report = json.loads(capsys.readouterr().out)
    row = rows(cohort, "runs.csv")[0]
    assert float(row["wear_volume_mm3_per_Mc"]) == pytest.approx(report["volume_mm3_per_Mc"])
    assert main([*wear, "--set", "patient.mass_kg=80", "--out", str(cohort / "no")]) == 2
    assert "cannot be changed after the run in this folder" in capsys.readouterr().err


def test_a_stored_outcome_includes_its_wear():
    outcome = Outcome("", {}, ["ok"], None, {"volume_mm3_per_Mc": 1.5}, "")
    stored = Outcome.of(outcome.shard())
    assert (dict(stored.wear), stored.wear_problem) == ({"volume_mm3_per_Mc": 1.5}, "")
