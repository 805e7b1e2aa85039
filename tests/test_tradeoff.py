"""The trade-off study: references, errors, Pareto front, rows, table and figure."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenes import write_scene
from tkamb.cli import main
from tkamb.contact.registry import BUILT_IN, contact_model
from tkamb.errors import InputError
from tkamb.geometry.memory import peak_rss
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.studies import tradeoff
from tkamb.studies.cases import case_names, copied_scene, study_case, thin_out
from tkamb.studies.kept_rows import KeptRows
from tkamb.studies.measures import (
    Job,
    errors,
    map_error,
    measure,
    measure_apart,
    quantities,
    raster_map,
)
from tkamb.studies.references import (
    common_limit,
    compute_reference,
    limits,
    read_references,
    reference_of,
    sphere_on_layer,
    write_references,
)
from tkamb.studies.tradeoff import CHANGES, EQUAL_RATIO, body_table, on_front, run_body_trade
from tradeoff_blocks import moved

ROOT = Path(__file__).parents[1]
KEYS = {
    "case", "contact", "resolution_mm", "prepare_seconds", "cold_seconds", "warm_seconds",
    "peak_rss_MB", "error_approach", "error_force", "error_mean_pressure",
    "error_peak_pressure", "error_area", "error_map", "on_front", "status", "reference_known",
    "values",
}  # fmt: skip


@pytest.fixture(scope="module")
def stored():
    return read_references()


def test_every_case_has_a_reference(stored):
    for name in case_names():
        reference = reference_of(study_case(name), stored)
        assert reference.values["approach"] > 0
        for part in ("approach", "medial_force", "lateral_force", "medial_peak_pressure"):
            scale = max(reference.values[part], 1e-3 * reference.values["medial_force"])
            assert reference.uncertainty[part] < 0.05 * scale, (name, part)


def test_refined_grids_converge_to_the_solution_of_the_elastic_layer(stored):
    reference = stored["sphere"]
    values, uncertainty = limits(reference.solved)
    for name in ("approach", "medial_peak_pressure"):
        tolerance = uncertainty[name] + reference.uncertainty[name]
        assert values[name] == pytest.approx(reference.values[name], abs=tolerance), name


def test_a_thick_layer_agrees_with_hertz_and_a_thin_layer_is_stiffer():
    thick = sphere_on_layer(20e-3, 2.0, 100.0, 5e8, 0.45)
    modulus = 5e8 / (1 - 0.45**2)
    radius = (3 * 100.0 * 20e-3 / (4 * modulus)) ** (1 / 3)
    assert thick.contact_radius == pytest.approx(radius, rel=3e-3)
    assert thick.pressure.max() == pytest.approx(1.5 * 100.0 / (np.pi * radius**2), rel=5e-3)
    thin = sphere_on_layer(20e-3, 2e-3, 100.0, 5e8, 0.45)
    assert thin.approach < 0.8 * thick.approach


def test_equal_condyles_share_the_load(stored):
    for name in ("two condyles", "conforming"):
        values = stored[name].values
        assert values["medial_force"] == pytest.approx(values["lateral_force"], rel=1e-3)
        total = values["medial_force"] + values["lateral_force"]
        assert total == pytest.approx(study_case(name).load, rel=0.02)


def test_a_missing_or_outdated_reference_is_refused(stored, tmp_path):
    case = study_case("sphere")
    with pytest.raises(InputError, match="earlier version"):
        reference_of(replace(case, load=701.0), stored)
    with pytest.raises(InputError, match="missing"):
        reference_of(case, {})
    path = tmp_path / "references.json"
    write_references(stored, path)
    again = read_references(path)
    assert again["sphere"].values == stored["sphere"].values
    path.write_text("[1]")
    with pytest.raises(InputError, match="recompute"):
        read_references(path)


def test_a_reference_can_be_computed_again(stored):
    case = study_case("sphere")
    coarse = compute_reference(case, (2.5, 2.0))
    assert coarse.hash == stored["sphere"].hash
    assert coarse.values["approach"] == pytest.approx(stored["sphere"].values["approach"], rel=0.1)


def test_the_reference_of_a_scene_is_stored_with_the_rows(tmp_path, monkeypatch, stored):
    computed_names = []

    def fake_reference(case):
        computed_names.append(case.name)
        return replace(stored["sphere"], hash=case.hash)

    monkeypatch.setattr(tradeoff, "compute_reference", fake_reference)
    cases = [replace(study_case("sphere"), name="scene 60 deg")]
    for resume in (False, True, False):
        kept = KeptRows(tmp_path, resume)
        reference = tradeoff.references_for(cases, False, lambda line: None, kept)["scene 60 deg"]
        assert reference.values == stored["sphere"].values
    assert computed_names == ["scene 60 deg"] * 2


def test_two_families_of_grids_have_a_common_limit():
    h = np.array([3.0, 2.0, 1.0, 3.0, 2.0, 1.0])
    family = np.array([0, 0, 0, 1, 1, 1])
    values = 5.0 + np.where(family == 0, 0.3, -0.7) * h**2
    limit, uncertainty = common_limit(h, values, family)
    assert limit == pytest.approx(5.0) and uncertainty < 1e-9
    disturbed = values + 0.1 * (family == 1)
    limit, uncertainty = common_limit(h, disturbed, family)
    assert 5.0 < limit < 5.1 and uncertainty == pytest.approx(0.05, abs=0.02)


def test_equal_results_have_no_error():
    case = study_case("sphere")
    model = contact_model("foundation", resolution=2e-3)
    result = model.press(model.prepare(case.pair), case.load, case.pose)
    values, raster = quantities(result), raster_map(result)
    assert set(errors(values, values).values()) == {0.0}
    assert map_error(raster, raster) == 0.0
    assert map_error({}, raster) == 1.0
    assert map_error({point: 1.1 * p for point, p in raster.items()}, raster) == pytest.approx(0.1)
    scaled = {name: 1.05 * value for name, value in values.items()}
    assert errors(scaled, values)["peak_pressure"] == pytest.approx(0.05)


def test_noise_in_time_does_not_change_the_front():
    rng = np.random.default_rng(3)
    points = [(10.0**a, 10.0**b) for a, b in rng.uniform(-3, 0, (40, 2))]
    front = on_front(points)
    assert 0 < sum(front) < 40
    best = min(points, key=lambda point: point[1])
    assert front[points.index(best)]
    for point, mark in zip(points, front, strict=True):
        if mark:
            assert not any(t * EQUAL_RATIO < point[0] and e <= point[1] for t, e in points)
    again = on_front(
        [(t * f, e) for (t, e), f in zip(points, rng.uniform(1, 1.05, 40), strict=True)]
    )
    changed = [p for p, a, b in zip(points, front, again, strict=True) if a != b]
    for point in changed:
        near = [t for t, e in points if (t, e) != point and 1 / 1.3 < t / point[0] < 1.3]
        assert near, "only points with nearly equal times may change"


def test_a_change_of_the_front_is_accepted_for_nearly_equal_times_alone():
    points = [(1.0, 0.1), (1.3, 0.05), (9.0, 0.01)]
    assert on_front(points) == [True, True, True]
    assert moved(points, [(1.0, 0.1), (1.1, 0.05), (9.0, 0.01)]) == []
    assert moved(points, [(1.0, 0.1), (0.5, 0.05), (9.0, 0.01)]) == [0]
    assert moved(points, [(1.0, 0.1), (1.4, 0.05), (7.0, 0.01)]) == []


def test_a_separate_process_gives_the_results_of_this_process():
    separate = measure_apart(Job("sphere", "foundation", 2.0))
    assert separate.status == "ok" and separate.warm_seconds > 0 and separate.prepare_seconds > 0
    assert 30 < separate.peak_rss_MB < 4000
    local = measure(Job("sphere", "foundation", 2.0))
    assert separate.values == pytest.approx(local.values)


def test_peak_memory_is_that_of_the_process_alone():
    array = np.ones(50_000_000)
    code = "from tkamb.geometry.memory import peak_rss; print(peak_rss())"
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert float(process.stdout) < 0.5 * array.nbytes / 1e6 < peak_rss()


def test_a_failed_or_stopped_job_has_a_status():
    assert measure_apart(Job("sphere", "foundation", -1.0)).status.startswith("failed: ")
    assert measure_apart(Job("sphere", "lattice", 0.7), longest=1.0).status == "stopped after 1 s"


def test_the_default_jobs_contain_every_setting_of_the_full_study():
    default, full = tradeoff.jobs(), tradeoff.jobs(full=True)
    assert {job.contact for job in default} >= set(BUILT_IN)
    assert {job.case for job in default} == set(case_names())
    labels = {job.label for job in default}
    assert {"lattice[tolerance=0.01]", "fe[newton=True]"} <= labels
    keys = [(job.case, job.label, job.resolution_mm) for job in default]
    assert len(set(keys)) == len(keys)
    full_keys = {(job.case, job.label, job.resolution_mm) for job in full}
    assert set(keys) < full_keys and {k[1:] for k in keys} == {k[1:] for k in full_keys}
    seconds = tradeoff.expected_seconds(default, tradeoff.cases_of(default))
    assert len(seconds) == len(default) and sum(seconds) < 900


@pytest.mark.slow
def test_an_interrupted_quick_study_is_resumed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tradeoff, "QUICK_MODELS", ("foundation", "lattice", "fe"))
    measured_jobs = []

    def stopped_at_the_third(job):
        measured_jobs.append(job)
        if len(measured_jobs) == 3:
            raise KeyboardInterrupt
        return measure_apart(job)

    monkeypatch.setattr(tradeoff, "measure_apart", stopped_at_the_third)
    arguments = ["tradeoff", "--quick", "--json", "--out", str(tmp_path)]
    assert main(arguments) == 130
    output = capsys.readouterr()
    assert len(json.loads(output.out)) == 2 and "--resume continues" in output.err
    assert (tmp_path / "tradeoff.txt").read_text().startswith("stopped: 2 of 6 rows")
    assert (tmp_path / "tradeoff.png").exists()
    assert main([*arguments, "--resume"]) == 0
    assert len(measured_jobs) == 3 + 4
    rows = json.loads(capsys.readouterr().out)
    assert rows == json.loads((tmp_path / "tradeoff.json").read_text())
    assert len(rows) == 6 and all(set(row) == KEYS for row in rows)
    by_name = {(row["case"], row["contact"]): row for row in rows}
    lattice, fe = by_name["two condyles", "lattice"], by_name["two condyles", "fe"]
    assert lattice["error_approach"] < 0.05 and fe["error_approach"] < 0.06
    assert lattice["error_force"] < 0.03
    assert any(row["on_front"] for row in rows)
    assert "no recommendation" in (tmp_path / "tradeoff.txt").read_text()
    assert (tmp_path / "tradeoff.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_scene_of_the_user_has_cases(tmp_path):
    path = write_scene(tmp_path)
    names = [name for name in case_names(path) if name.startswith("scene")]
    assert len(names) == 3
    shipped, from_scene = study_case("knee 60 deg"), study_case("scene 60 deg", path)
    assert from_scene.load == pytest.approx(shipped.load)


@pytest.mark.slow
def test_the_trade_off_of_the_body_shows_the_effect_of_each_change(tmp_path):
    kept = KeptRows(tmp_path, resume=False)
    rows = {row.name: row for row in run_body_trade(kept)}
    assert set(rows["as shipped"].changed.values()) == {0.0}
    assert all(row.status == "ok" and row.frame_seconds > 0 for row in rows.values())
    assert 0 < rows["filtered at 6 Hz"].changed["force_total_N"] < 0.01
    assert rows["coupled: points"].changed["force_total_N"] < 0.02
    assert rows["released: adduction"].changed["medial_force_N"] > 0.05
    assert rows["no wrapping"].changed["quadriceps_N"] > 0.05
    changes = [rows[f"every {n} frame"].changed["velocity"] for n in ("2nd", "5th", "10th")]
    assert changes == sorted(changes) and 0 < changes[0] < 0.01 < changes[2]
    assert len(body_table(list(rows.values()))) == len(rows) + 2
    assert [row.name for row in run_body_trade(kept)] == list(CHANGES)


def test_thinned_recordings_keep_the_remaining_instants(tmp_path):
    scene = load_scene(copied_scene(tmp_path))
    recorded = load_case(scene).motion
    thin_out(tmp_path, 5)
    thinned = load_case(scene).motion
    np.testing.assert_allclose(thinned.time, recorded.time[::5], atol=1e-12)
    np.testing.assert_allclose(thinned.coordinates, recorded.coordinates[::5], atol=1e-12)
    assert np.abs(thinned.velocity - recorded.velocity[::5]).max() > 0
