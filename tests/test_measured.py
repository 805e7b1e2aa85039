"""Comparison of measured and predicted forces: clock, sums, gaps, errors and frame counts."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from jw_gait import needs_jw
from synthetic_run import make_run
from tkamb.errors import InputError
from tkamb.io.recordings.measured import load_measured_force
from tkamb.io.recordings.recording_tables import MeasuredTable
from tkamb.run.columns import CONTRIBUTIONS, belongs
from tkamb.run.recorded import compare_measured, comparison_words, measured_column
from tkamb.run.results import Results
from tkamb.run.simulation import simulate
from tkamb.show.axis import horizontal_axis
from tkamb.show.headline import cards
from tkamb.show.panels import panels

POUND = 0.45359237 * 9.80665


def measured_at(path, at, content="time,a,b\n0,10,1\n1,20,2\n2,30,3\n3,40,4\n4,50,5\n", **changes):
    path.write_text(content, encoding="utf-8")
    table = {"file": path, "unit": "N", "offset_s": 0.0, "columns": {"total": "a"}} | changes
    at = np.asarray(at, float)
    return load_measured_force(MeasuredTable(**table), at).at(at)


def test_forces_are_summed_in_newtons_at_the_times_of_the_motion(tmp_path):
    columns = {"total": {"a": 1.0, "b": 2.0}, "medial": {"b": 3.0}}
    forces = measured_at(tmp_path / "m.csv", [1.0, 1.75], unit="lbf", offset_s=0.5, columns=columns)
    clock = np.array([0.5, 1.25])
    total, medial = (12 + 12 * clock) * POUND, 3 * (1 + clock) * POUND
    np.testing.assert_allclose(forces["total"], total)
    np.testing.assert_allclose(forces["medial"], medial)
    np.testing.assert_allclose(forces["lateral"], total - medial)


def test_forces_are_nan_in_gaps_and_outside_the_measurement(tmp_path):
    content = "time,a,\n0,1,\n1,2,\n2,,\n3,4,\n4,5,\n10,11,\n11,12,\n"
    at = [-0.1, 0.5, 1.5, 2.5, 3.5, 4.0, 7.0, 10.5, 11.1]
    force = measured_at(tmp_path / "m.csv", at, content)["total"]
    measured = [0.5, 3.5, 4.0, 10.5]
    np.testing.assert_array_equal(np.isfinite(force), np.isin(at, measured))
    np.testing.assert_allclose(force[np.isfinite(force)], np.array(measured) + 1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"offset_s": 100.0}, "measured from 100 to 104 s, but the motion lasts from 0 to 1 s"),
        ({"columns": {"total": "A"}}, "no column 'A'"),
    ],
)
def test_a_measurement_that_does_not_fit_is_refused(tmp_path, changes, words):
    with pytest.raises(InputError, match=words):
        measured_at(tmp_path / "m.csv", [0.0, 1.0], **changes)


@pytest.mark.parametrize("columns", [{"time": "t"}, {"time": {"t": 1.0}, "total": "a"}])
def test_columns_that_name_no_force_are_refused(tmp_path, columns):
    with pytest.raises(ValidationError, match="'columns'"):
        MeasuredTable(file=tmp_path, unit="N", offset_s=0.0, columns=columns)


def run_with_measurement(frames=40):
    """Return columns and summary of a run that predicts 1.5 times the measured force plus 30 N.

    Two frames failed, one has no prediction, and three are not measured.
    """
    run = make_run("gait", frames, maps=False)
    columns = {k: v for k, v in run.columns.items() if k == "status" or np.isfinite(v).any()}
    measured = 800 + 300 * np.sin(np.arange(frames) / 5)
    columns["force_si_N"] = 1.5 * measured + 30
    columns["status"] = ["ok"] * frames
    for k in (4, 20):
        columns["status"][k] = "failed: for a test"
        columns["force_si_N"][k] = np.nan
    columns["force_si_N"][7] = np.nan
    measured = measured.copy()
    measured[-3:] = np.nan
    columns[measured_column("total")] = measured
    return columns, run.summary


def test_errors_of_a_linear_prediction_have_closed_forms():
    columns, summary = run_with_measurement()
    weight = summary["body_mass_kg"] * 9.80665
    comparison = compare_measured(columns, ["total"], weight)
    assert set(comparison) == {"total"}
    one, m = comparison["total"], columns[measured_column("total")]
    m = m[np.isfinite(m) & np.isfinite(columns["force_si_N"])]
    assert one["bias_N"] == pytest.approx(0.5 * m.mean() + 30)
    assert one["rmse_N"] ** 2 == pytest.approx(one["bias_N"] ** 2 + 0.25 * m.var())
    assert one["rmse_BW"] * weight == pytest.approx(one["rmse_N"])
    assert one["pearson_r"] == pytest.approx(1.0)
    assert one["r_squared"] == pytest.approx(1 - one["rmse_N"] ** 2 / m.var())
    assert one["peak_predicted_N"] == pytest.approx(1.5 * one["peak_measured_N"] + 30)
    assert one["peak_predicted_time_s"] == one["peak_measured_time_s"]


def test_without_contact_the_condyle_forces_by_equilibrium_are_compared():
    columns, _ = run_with_measurement()
    del columns["medial_force_N"], columns["lateral_force_N"]
    columns[measured_column("medial")] = columns["medial_force_equilibrium_N"] - 50.0
    one = compare_measured(columns, ["medial"], 700.0)["medial"]
    assert one["predicted"] == "medial_force_equilibrium_N"
    assert one["bias_N"] == pytest.approx(50.0)


def test_every_frame_is_counted():
    columns, _ = run_with_measurement()
    one = compare_measured(columns, ["total"], 700.0)["total"]
    counts = {key: value for key, value in one.items() if key.startswith("frames_")}
    assert counts == {
        "frames_compared": 34,
        "frames_failed": 2,
        "frames_without_measurement": 3,
        "frames_without_prediction": 1,
    }
    left_out = columns[measured_column("total")][[4, 7, 20]]
    assert one["measured_where_not_compared_N"] == [left_out.min(), left_out.max()]


@pytest.mark.parametrize("lost", ["force_si_N", measured_column("total")])
def test_a_run_without_prediction_or_measurement_has_no_comparison(lost):
    columns, _ = run_with_measurement()
    columns[lost][:] = np.nan
    one = compare_measured(columns, ["total"], 700.0)["total"]
    assert one["frames_compared"] == 0
    assert "rmse_N" not in one
    value, words, incomplete = comparison_words({"total": one})
    assert value == "no frame to compare"
    assert "0 of 40 frames compared" in words
    assert incomplete


def test_the_report_draws_the_measured_force_behind_the_prediction():
    columns, summary = run_with_measurement()
    summary = summary | {"measured": compare_measured(columns, ["total"], 700.0)}
    results = Results(columns, summary)
    lines = {panel.name: panel for panel in panels(results)}["forces"].lines
    behind = [line for line in lines if line.behind]
    assert [line.name for line in behind] == ["measured_total_N"]
    card = next(c for c in cards(results, horizontal_axis(results)) if "measured" in c.title)
    assert card.warning
    for words in ("34 of 40 frames compared", "2 failed", "3 without measurement", "r 1.00"):
        assert words in card.detail


SCENE = Path(__file__).parents[1] / "models" / "jw" / "ngait_og3_measured.toml"
LATE_STANCE = 15


@pytest.mark.slow
@needs_jw
def test_the_results_have_muscle_groups_contributions_measured_force_and_emg():
    run = simulate(SCENE, frames=slice(LATE_STANCE, LATE_STANCE + 1))
    groups = run.summary["muscle_groups"]
    assert set(groups["knee extensors"]) == {"recfem", "vasint", "vaslat", "vasmed"}
    assert set(groups["thigh to foot"]) == {"gaslat", "gasmed"}
    for side, family in CONTRIBUTIONS.items():
        parts = [run[name] for name in run.columns if belongs(name, family)]
        np.testing.assert_allclose(sum(parts), run[f"{side}_force_equilibrium_N"], atol=1e-6)
    assert run.summary["measured"]["total"]["frames_compared"] == 1
    emg = run.summary["emg"]["muscles"]
    assert {f"envelope_{name}" for name in emg} <= set(run.columns)
    assert all(one["frames_compared"] == 1 for one in emg.values())
