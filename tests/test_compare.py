"""`tkamb compare`: differences between runs, and notes on different settings."""

import json
from dataclasses import replace

import numpy as np
import pytest

from kept_runs import keep
from synthetic_run import make_run
from tkamb.cli import main
from tkamb.contact.flags import AT_EDGE
from tkamb.run.metrics import peak_pressure
from tkamb.run.results import Results
from tkamb.show import comparison_page as page
from tkamb.show.comparison import compare_folders
from tkamb.show.comparison_page import shown_frame


def written(folder, results, **summary):
    """Write results without a report, with changed keys of the summary; return the folder."""
    return keep(replace(results, summary=results.summary | summary), folder)


def chosen(results, frames):
    """Return results of these frames, without maps."""
    columns = {
        name: [values[k] for k in frames] if name == "status" else values[frames]
        for name, values in results.columns.items()
    }
    return Results(columns, results.summary)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return folders of two runs.

    The second has 7 N more force at 60 deg, a failed frame and another contact model.
    """
    root = tmp_path_factory.mktemp("runs")
    bend = make_run("bend", frames=21)
    other = make_run("bend", frames=21)
    other.columns["force_total_N"][10] += 7.0
    other.columns["status"][3] = "failed: no balance"
    for name, values in other.columns.items():
        if name not in ("time_s", "flexion_deg", "status"):
            values[3] = np.nan
    contact = {"model": "hertz", "resolution_mm": 1.5, "material": "none"}
    return written(root / "a", bend), written(root / "b", other, contact=contact)


def of(comparison, column):
    """Return the difference of a column."""
    (one,) = [one for one in comparison.differences if one.column == column]
    return one


def test_a_known_difference_is_found_at_its_frame(folders):
    found = compare_folders(folders)
    assert found.runs[1].pairing.exact
    one = of(found, "force_total_N")
    assert (one.max_abs, one.at_frame, one.frames) == (pytest.approx(7.0), 10, 20)
    peak = np.nanmax(np.abs(found.runs[0].results[one.column]))
    assert one.percent == pytest.approx(700.0 / peak)
    assert one.at == pytest.approx(60.0)
    assert one.rms == pytest.approx(7.0 / np.sqrt(20)) and one.mean == pytest.approx(7.0 / 20)
    assert of(found, "medial_area_mm2").max_abs == 0.0


def test_different_settings_are_noted(folders):
    notes = " ".join(compare_folders(folders).notes)
    assert "contact, model. a: synthetic; b: hertz" in notes
    assert "b: 1 of 21 frames failed" in notes
    assert "body mass" not in notes


def test_frames_of_one_recording_are_paired_without_interpolation(folders, tmp_path):
    some = chosen(make_run("bend", frames=21, maps=False), list(range(0, 21, 4)))
    found = compare_folders([folders[0], written(tmp_path / "some", some)])
    assert found.runs[1].pairing.exact
    assert of(found, "force_total_N").frames == 6
    assert of(found, "force_total_N").max_abs == 0.0
    assert any("15 frames of a have no matching frame" in note for note in found.notes)


def test_other_frames_are_interpolated_to_second_order(folders, tmp_path):
    """Twice as many frames reduce the error of linear interpolation to a quarter."""
    errors = []
    for frames in (38, 75):  # only the first and last frame have the times of 21 frames
        other = make_run("bend", frames=frames, maps=False)
        other.columns["time_s"] += 1.0
        found = compare_folders([folders[0], written(tmp_path / str(frames), other)])
        assert not found.runs[1].pairing.exact
        errors.append(of(found, "quadriceps_N").rms)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.25)


def test_the_shown_frame_has_the_largest_force_of_frames_with_maps_in_both_runs(folders, tmp_path):
    some = chosen(make_run("bend", frames=21), list(range(0, 17, 4)))
    kept = keep(replace(some, maps=make_run("bend", frames=21).maps), tmp_path / "part")
    force = make_run("bend", frames=21)["force_total_BW"]
    assert shown_frame(compare_folders([folders[0], folders[0]])) == np.argmax(force)
    found = compare_folders([folders[0], kept])
    assert np.argmax(force) not in range(0, 17, 4)
    assert shown_frame(found) == max(range(0, 17, 4), key=lambda k: force[k])


def test_runs_over_a_non_monotonic_axis_are_not_compared(folders, tmp_path):
    there_and_back = make_run("bend", frames=30, maps=False)
    there_and_back.columns["time_s"] += 1.0
    there_and_back.columns["flexion_deg"][20:] = there_and_back["flexion_deg"][19:9:-1] - 0.5
    found = compare_folders([folders[0], written(tmp_path / "back", there_and_back)])
    assert found.differences == ()
    assert any("does not rise or fall throughout" in note for note in found.notes)


def test_runs_with_different_axes_are_refused_without_a_chosen_axis(folders, tmp_path, capfd):
    gait = written(tmp_path / "gait", make_run("gait", frames=21, maps=False))
    out = tmp_path / "out"
    assert main(["compare", str(folders[0]), str(gait), "--out", str(out)]) == 2
    error = capfd.readouterr().err
    assert "over cycle" in error and "--axis" in error and error.count("\n") == 1
    assert not out.exists()
    notes = compare_folders([folders[0], gait], "cycle").notes
    assert any("The runs differ in side. a: right; gait: left" in note for note in notes)


def test_released_coordinates_are_listed_completely_and_compared_in_any_order(folders, tmp_path):

    def notes(*released):
        bend, runs = make_run("bend", frames=21, maps=False), []
        for k, names in enumerate(released):
            contact = bend.summary["contact"] | {"released": list(names)}
            runs.append(written(tmp_path / f"{len(names)}{k}{names[0]}", bend, contact=contact))
        return [note for note in compare_folders(runs).notes if "released" in note]

    (note,) = notes(["adduction"], ["ml", "adduction", "ap"])
    assert ": adduction;" in note and ": adduction, ap, ml." in note
    assert notes(["ap", "ml"], ["ml", "ap"]) == []


def test_computing_times_are_not_compared(tmp_path):
    runs = []
    for k in range(2):
        run = make_run("bend", frames=21, maps=False)
        for name in run.columns:
            if "seconds" in name:
                run.columns[name] = np.full(21, 0.1 + k)
        runs.append(written(tmp_path / str(k), run))
    assert not [one for one in compare_folders(runs).differences if one.max_abs > 0]


def test_the_page_is_self_contained_and_has_the_chosen_frame(folders, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(page, "QUANTITIES", page.QUANTITIES[:4])
    out = tmp_path / "out"
    paths = [str(folder) for folder in folders]
    assert main(["compare", *paths, "--frame", "10", "--out", str(out), "--json"]) == 0
    printed = json.loads(capfd.readouterr().out)
    assert printed["runs"][1]["failed_frames"] == 1
    text = (out / "compare.html").read_text(encoding="utf-8")
    assert "frame 10, flexion 60°" in text.replace("\n", " ")
    assert "http://" not in text and "https://" not in text
    assert text.count("<figure") == 5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{a}"], "two to 8"),
        (["{a}", "nowhere"], "nowhere"),
        (["{a}", "{a}", "--frame", "99"], "99"),
    ],
)
def test_bad_input_gives_one_line(folders, tmp_path, monkeypatch, capfd, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(["compare", *(word.format(a=folders[0]) for word in arguments)]) == 2
    error = capfd.readouterr().err
    assert words in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_peak_pressure_at_the_edge_of_the_insert_has_a_doubt(tmp_path):
    results = make_run("bend", frames=21)
    largest = peak_pressure(results)
    assert largest["doubt"] == ""
    status = list(results.status)
    status[largest["frame"]] = f"the {largest['side']} {AT_EDGE} (within 2.5 mm)"
    edge = Results(results.columns | {"status": status}, results.summary, results.maps)
    folders = [written(tmp_path / "interior", results), written(tmp_path / "edge", edge)]
    comparison = compare_folders(folders)
    runs = comparison.as_dict()["runs"]
    assert runs[0]["peak_pressure"]["doubt"] == "" and AT_EDGE in runs[1]["peak_pressure"]["doubt"]
    lines = [line for line in page.table_lines(comparison) if "peak pressure" in line]
    assert AT_EDGE not in lines[0] and lines[1].startswith("edge: ") and AT_EDGE in lines[1]
    html = page.comparison_html(comparison).replace("\xa0", " ")
    assert lines[1] in html.replace("&#39;", "'")
