"""Cohorts: runs, table, groups, parts, resuming, and failed runs."""

import gc
import json
import shutil
import tomllib
import weakref
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from faults import Faults
from interrupted_runs import broken_off, held_elsewhere
from synthetic_run import make_run
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.geometry.memory import give_back
from tkamb.io.claim import claimed_directory, settle
from tkamb.run.simulation import simulate
from tkamb.run.workers import PoolOptions
from tkamb.show.cohort_report import _split_into_plots, cohort_html, draw_groups
from tkamb.show.study_figures import design_bars, draw_designs, run_error
from tkamb.studies.cohort.outcome import Group, Outcome, chosen_map, groups_of, spread
from tkamb.studies.cohort.plan import CohortTable, load_cohort
from tkamb.studies.cohort.run import frame_table, run_cohort, write_cohort

KNEE = Path(__file__).parents[1] / "models" / "deep_knee_bend"
WRITTEN = {"cohort.parquet", "runs.csv", "groups.csv", "cohort.json", "cohort.html"}


@pytest.fixture
def file(tmp_path):
    """Return a cohort file without implants. One of its three subjects lacks its motion file."""
    for name in ("patient.urdf", "motion.csv", "tibia.csv", "ground_reaction.csv"):
        shutil.copy(KNEE / name, tmp_path)
    scene = (KNEE / "scene.toml").read_text()
    (tmp_path / "scene.toml").write_text(scene[: scene.index("[implant.femoral]")])
    path = tmp_path / "legs.toml"
    path.write_text(
        """
        title = "Three legs"
        frames = "0:101:20"
        [[subject]]
        name = "small"
        scale = 0.9
        [[subject]]
        name = "large"
        scale = 1.1
        [[subject]]
        name = "lost"
        set = { "motion.file" = "nowhere.csv" }
        [[trial]]
        name = "bend"
        scene = "scene.toml"
        [[design]]
        name = "plain"
        [[design]]
        name = "heavy"
        set = { "patient.mass_kg" = 100.0 }
        """
    )
    return path


def test_a_cohort_has_the_results_of_its_runs_and_lists_failures(file, tmp_path, capsys):
    folder = tmp_path / "out"
    assert main(["cohort", str(file), "--out", str(folder)]) == 0
    output = capsys.readouterr()
    assert "4 of 6 runs computed" in output.out
    assert "lost" in output.err and "nowhere.csv" in output.err
    assert {path.name for path in folder.iterdir()} == {*WRITTEN, ".tkamb"}
    table = pq.read_table(folder / "cohort.parquet").to_pydict()
    cohort = load_cohort(file)
    for run in (cohort.runs[1], cohort.runs[2]):
        results = simulate(run.scene, frames=cohort.frames)
        rows = [k for k, number in enumerate(table["run"]) if number == run.number]
        for name in ("time_s", "force_total_BW", "hip_moment_si_Nm"):
            assert [table[name][k] for k in rows] == list(results[name])
        assert {table["scene_sha256"][k] for k in rows} == {results.summary["scene_sha256"]}
        assert {table["subject"][k] for k in rows} == {run.labels["subject"]}
    runs = (folder / "runs.csv").read_text().splitlines()
    assert len(runs) == 7
    assert sum("nowhere.csv" in line for line in runs) == 2
    summary = json.loads((folder / "cohort.json").read_text())
    assert [run["run"] for run in summary["failed_runs"]] == [4, 5]
    assert summary["identity"]["code of tkamb"]
    page = (folder / "cohort.html").read_text()
    assert "Three legs" in page and "nowhere.csv" in page


def test_parts_workers_and_interruption_do_not_change_the_tables(file, tmp_path, monkeypatch):
    monkeypatch.setattr("tkamb.show.cohort_report.cohort_html", lambda *_: "page")
    resumed, in_parts = tmp_path / "resumed", tmp_path / "in_parts"

    with pytest.raises(KeyboardInterrupt, match="1 of 6 runs are kept"):
        run_cohort(file, resumed, progress=broken_off(1))
    assert not (resumed / "cohort.parquet").exists()
    run_counts = []

    def record_count(runs, count):
        run_counts.append(count)
        return runs

    run_cohort(file, resumed, crew=PoolOptions(2), resume=True, progress=record_count)
    assert run_counts == [5]
    for part in ("1/2", "2/2"):
        assert main(["cohort", str(file), "--out", str(in_parts), "--shard", part]) in (0, 1)
    run_cohort(file, in_parts, resume=True, progress=record_count)
    assert run_counts == [5, 0]
    for name in ("cohort.parquet", "runs.csv", "groups.csv"):
        assert (resumed / name).read_bytes() == (in_parts / name).read_bytes()
    assert not list(resumed.rglob("*.frame")) and not list(in_parts.rglob("*.frame"))


def outcome(scale, frames=41, kind="bend"):
    run = make_run(kind, frames)
    columns = {
        name: values * (scale if name.endswith(("_BW", "_N", "_MPa", "_mm2")) else 1.0)
        for name, values in run.columns.items()
        if name != "status" and name not in run.not_modelled
    }
    return Outcome("", columns, run.status, chosen_map(run, 60.0))


def test_each_run_has_the_same_weight_in_group_statistics(file):
    cohort = load_cohort(file)
    outcomes = {0: outcome(0.8, 41), 2: outcome(1.2, 201), 4: Outcome("gone", {}, [])}
    (group,) = groups_of(cohort, outcomes)
    assert (group.labels, group.numbers, group.failed) == ({"design": "plain"}, (0, 2), 1)
    peak = spread(group.peaks["force_total_BW"])
    original = make_run("bend", 201)["force_total_BW"].max()
    assert peak.mean == pytest.approx(original, rel=2e-3)  # for runs of 41 and 201 frames
    assert peak.sd == pytest.approx(0.4 * original / np.sqrt(2), rel=0.02)
    assert (peak.low, peak.high) == pytest.approx((0.8 * original, 1.2 * original), rel=0.01)
    flexion = make_run("bend", 201)["flexion_deg"]
    chosen = (flexion >= 30.0) & (flexion < 40.0)
    mean = 1.2 * make_run("bend", 201)["force_total_BW"][chosen].mean()
    assert group.edges[3] == 30.0
    assert group.bins["force_total_BW"][1, 3] == pytest.approx(mean, rel=1e-12)


def group_of_five_frames(file, **columns):
    """Return the group of one run with five frames. The fourth frame failed."""
    status = ["ok", "ok", "ok", "failed: no contact", "ok"]
    columns = {"time_s": np.arange(5.0), "flexion_deg": np.arange(5.0)} | columns
    columns = {name: np.array(values, float) for name, values in columns.items()}
    (group,) = groups_of(load_cohort(file), {0: Outcome("", columns, status)})
    return group


def test_the_recorded_motion_of_failed_frames_is_not_averaged(file):
    """If adduction is released, a failed frame has the recorded adduction instead."""
    group = group_of_five_frames(file, adduction_deg=[1.0, 2.0, 3.0, 90.0, 4.0])
    assert group.bins["adduction_deg"] == pytest.approx(np.array([[2.5]]))
    assert group.peaks["adduction_deg"] == pytest.approx([4.0])


def test_the_end_of_a_cycle_belongs_to_the_last_bin(file):
    group = group_of_five_frames(
        file, cycle_percent=[0.0, 45.0, 90.0, 95.0, 100.0], force_total_BW=[1, 2, 3, np.nan, 5]
    )
    assert (group.axis, group.edges[-1]) == ("cycle_percent", 100.0)
    expected = [1, *[np.nan] * 3, 2, *[np.nan] * 4, 4]
    np.testing.assert_array_equal(group.bins["force_total_BW"], [expected])


def test_the_map_is_at_the_requested_flexion_and_the_page_has_one_per_group(file):
    original = outcome(1.0)
    frame = original.chosen.frame
    assert original.columns["flexion_deg"][frame] == pytest.approx(60.0, abs=1.5)
    stored = Outcome.of(original.shard())
    np.testing.assert_array_equal(stored.chosen.pressure, original.chosen.pressure)
    cohort = load_cohort(file)
    outcomes = {n: outcome(1.0 + 0.05 * n, 21) for n in range(4)}
    status = ["ok"] * 18 + ["failed: lost", "residual force is 13 %", "medial condyle lifted"]
    outcomes[0] = replace(outcomes[0], status=status)
    page = cohort_html(cohort, outcomes, groups_of(cohort, outcomes))
    assert page.count("anterior ↑") == 2  # designs "plain" and "heavy"
    assert "2 to be read with care" in page.replace("\xa0", " ")
    assert "http" not in page.replace("http-equiv", "")
    table = frame_table(cohort, outcomes, {})
    assert table.num_rows == 4 * 21


def test_the_example_has_all_designs_on_seventeen_legs_with_two_models():
    folder = KNEE.parent / "designs"
    table = CohortTable.model_validate(tomllib.loads((folder / "cohort.toml").read_text()))
    assert len(table.subject) * len(table.trial) * len(table.contact) == 17 * 2
    assert {path.parent.name for path in folder.glob("*/design.toml")} == {
        design.name for design in table.design
    }


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("scale = 0.9", "scale = 5.0", "less than or equal to 1.4"),
        ("scale = 0.9", "size = 0.9", "unknown key 'subject.0.size'"),
        ('"small"', '"large"', "two entries called 'large'"),
        ('"scene.toml"', '"scenes.toml"', "scenes.toml"),
        ("patient.mass_kg", "patient.mas_kg", "unknown key 'patient.mas_kg'"),
        ('"0:101:20"', '"0-101"', "is not A:B or A:B:STEP"),
        ("[[trial]]", "[[trials]]", "unknown key 'trials'"),
        ("[[trial]]", "[[trial]", "is not TOML"),
        ('name = "bend"', 'name = "bend"\nsubjects = ["nobody"]', "no subject 'nobody'"),
    ],
)
def test_an_invalid_file_is_an_error_of_one_line(file, tmp_path, capsys, old, new, words):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    folder = tmp_path / "out"
    assert main(["cohort", str(file), "--out", str(folder)]) == 2
    message = capsys.readouterr().err.strip()
    assert words in message and "\n" not in message
    assert not folder.exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--workers", "0"], "cannot be 0; give a number from 1"),
        (["--shard", "3/2"], "3/2 is not a part"),
        (["--shard", "1"], "'1' is not I/N"),
        (["--frames", "500:600"], "not in the motion"),
    ],
)
def test_an_invalid_option_is_an_error(file, tmp_path, capsys, options, words):
    folder = tmp_path / "out"
    try:
        status = main(["cohort", str(file), "--out", str(folder), *options])
    except SystemExit as stop:
        status = stop.code
    message = capsys.readouterr().err.strip()
    assert words in message
    if "--frames" in options:  # the frames are checked for each trial, so every run fails
        assert status == 1
    else:
        assert status == 2 and "\n" not in message and not folder.exists()


def test_a_folder_in_use_or_of_another_cohort_is_refused(file, tmp_path, capsys):
    folder = tmp_path / "out"
    assert main(["cohort", str(file), "--out", str(folder), "--shard", "3/6"]) == 0
    file.write_text(file.read_text().replace("scale = 1.1", "scale = 1.2"))
    capsys.readouterr()
    assert main(["cohort", str(file), "--out", str(folder), "--resume", "--shard", "3/6"]) == 2
    assert "cannot resume" in capsys.readouterr().err
    with held_elsewhere(folder / "shard-3-of-6"):
        assert main(["cohort", str(file), "--out", str(folder), "--shard", "3/6"]) == 2
    message = capsys.readouterr().err.strip()
    assert "another tkamb is writing" in message and "\n" not in message


@pytest.mark.slow
def test_a_full_disk_leaves_all_files_or_none(file, tmp_path, monkeypatch):
    cohort, outcomes = load_cohort(file), {n: outcome(1.0, 5) for n in range(4)}

    def write(folder, number=None):
        folder.mkdir()
        injected = Faults(folder, number).injected(monkeypatch)
        with claimed_directory(folder), injected as faults, suppress(InputError):
            write_cohort(cohort, outcomes, {}, folder, report=lambda *_: "page")
        settle(folder)
        return faults.calls, WRITTEN & {path.name for path in folder.iterdir()}

    calls, written = write(tmp_path / "whole")
    assert written == WRITTEN
    for number in range(len(calls)):
        assert write(tmp_path / f"full{number}", number)[1] in (set(), WRITTEN)


def test_many_groups_are_divided_into_plots_of_one_scale():
    def group(design, contact, height):
        labels = {"design": design, "contact": contact}
        bins = {"force_total_BW": np.array([[0.0, height]])}
        return Group(labels, (0,), 0, "flexion_deg", np.array([0.0, 10.0, 20.0]), bins, bins)

    groups = [group(f"d{k}", model, k + 1.0) for k in range(6) for model in ("one", "two")]
    plots = _split_into_plots(groups)
    assert [words for words, _ in plots] == ["one", "two"]
    for words, part in plots:
        assert list(part) == [f"d{k}" for k in range(6)]
        assert {member.labels["contact"] for member in part.values()} == {words}
        figure = draw_groups(part, "force_total_BW", 6.0)
        assert figure.axes[0].get_ylim() == pytest.approx((0.0, 6.3))
    (plot,) = _split_into_plots(groups[:8])
    assert plot[0] == "" and list(plot[1])[:2] == ["d0, one", "d0, two"]
    same_label = [group(f"d{k}", "one", 1.0) for k in range(11)]  # no label divides them
    assert [len(part) for _, part in _split_into_plots(same_label)] == [8, 3]


def test_cyclic_references_are_freed_between_runs():
    """Surfaces and search trees refer to each other, so reference counts never free them."""
    ring = [np.zeros(4)]
    ring.append(ring)
    reference = weakref.ref(ring[0])
    gc.disable()
    try:
        del ring
        assert reference() is not None
        give_back()
        assert reference() is None
    finally:
        gc.enable()


def worn(pressure_scale, wear_scale=1.0):
    original = outcome(1.0, 11)
    columns = dict(original.columns)
    for side in ("medial", "lateral"):
        name = f"{side}_peak_pressure_MPa"
        columns[name] = columns[name] * pressure_scale
        columns[f"{side}_thickness_mm"] = np.full(11, 8.0)
        columns[f"{side}_area_mm2"] = np.full(11, 60.0)
    columns["approach_mm"] = np.full(11, 0.1)
    wear = {
        f"volume_mm3_per_Mc{end}": wear_scale * v
        for end, v in (("", 8.0), ("_low", 4.0), ("_high", 16.0))
    }
    return replace(original, columns=columns, wear=wear)


WITHOUT_DESIGNS = """
        [[trial]]
        name = "bend"
        scene = "scene.toml"
        [[subject]]
        name = "small"
        scale = 0.95
        [[subject]]
        name = "large"
        scale = 1.05
        [[contact]]
        name = "foundation"
        resolution_mm = 2.0
"""


@pytest.fixture
def two_by_two(tmp_path):
    """Return a cohort of two subjects and four designs: two thicknesses, two conformities."""
    for path in KNEE.iterdir():
        shutil.copy(path, tmp_path)
    entries = [
        f'[[design]]\nname = "{t} by {c}"\n'
        f'factors = {{ thickness = "{t} mm", conformity = "{c}" }}\n'
        for c in ("0.4", "0.8")
        for t in (6, 10)
    ]
    path = tmp_path / "two.toml"
    path.write_text(WITHOUT_DESIGNS.replace("        ", "") + "".join(entries))
    return load_cohort(path)


def test_the_figure_of_designs_has_factors_on_axis_and_legend(two_by_two):
    outcomes = {run.number: worn(1.0 + 0.1 * run.number, 2.0) for run in two_by_two.runs}
    bars = design_bars(two_by_two, groups_of(two_by_two, outcomes), outcomes)
    assert [(bar.place, bar.series) for bar in bars["pressure"]] == [
        (f"thickness {t} mm", f"conformity {c}") for c in ("0.4", "0.8") for t in (6, 10)
    ]
    error = run_error(two_by_two.runs[0], outcomes[0]).peak_pressure
    first = bars["pressure"][0]
    peaks = [
        max(
            np.nanmax(outcomes[run.number].columns[f"{side}_peak_pressure_MPa"])
            for side in ("medial", "lateral")
        )
        for run in two_by_two.runs
        if run.labels["design"] == "6 by 0.4"
    ]
    assert (first.low, first.high) == pytest.approx((min(peaks), max(peaks)))
    assert first.mean == pytest.approx(np.mean(peaks))
    assert first.least == pytest.approx((1 - error) * min(peaks))
    assert first.most == pytest.approx((1 + error) * max(peaks))
    wear = bars["wear"][0]
    assert (wear.mean, wear.least, wear.most) == pytest.approx((16.0, 8.0, 32.0))
    figure = draw_designs(bars)
    legend = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert legend == ["conformity 0.4", "conformity 0.8"]


def test_the_page_shows_designs_and_the_known_error_of_the_contact_model(two_by_two):
    outcomes = {run.number: worn(1.0) for run in two_by_two.runs}
    page = cohort_html(two_by_two, outcomes, groups_of(two_by_two, outcomes))
    page = page.replace("\xa0", " ")
    assert "Designs side by side" in page
    assert "foundation at 2 mm, polyethylene: In" in page
    assert "errors of the contact model alone" in page
    assert "Error of this method: squat" in page and "peak 0.90, RMS 0.47 BW" in page


def test_gait_is_binned_by_cycle_without_frames_outside_the_cycle(file):
    percent = np.array([np.nan, 5.0, 15.0, 15.0, np.nan])
    columns = {
        "time_s": np.arange(5.0),
        "flexion_deg": np.full(5, 10.0),
        "cycle_percent": percent,
        "force_total_BW": np.array([9.0, 1.0, 2.0, 4.0, 9.0]),
    }
    outcomes = {0: Outcome("", columns, ["ok"] * 5)}
    (group,) = groups_of(load_cohort(file), outcomes)
    assert group.axis == "cycle_percent"
    np.testing.assert_allclose(group.edges, [0.0, 10.0, 20.0])
    np.testing.assert_allclose(group.bins["force_total_BW"], [[1.0, 3.0]])
    np.testing.assert_allclose(group.peaks["force_total_BW"], [9.0])
