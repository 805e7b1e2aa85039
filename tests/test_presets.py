"""Presets: their changes to a scene, the options that override them, the data that they need."""

import json
import sys
from importlib.metadata import EntryPoint
from types import SimpleNamespace

import pytest

from scenes import write_scene
from tkamb import load_scene, named_classes, simulate
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.presets import PRESETS, Preset, find_preset
from tkamb.io.scene import with_preset
from tkamb.io.scene.case import load_case
from tkamb.run.identity import case_of_results, run_again
from tkamb.run.results_folder import read_results
from tkamb.show.report import report_html

SOURCE = "sharma-2008"
FAST = {"contact.model": "hertz", "motion.frames": 11}


@pytest.fixture
def scene_file(tmp_path):
    return write_scene(tmp_path / "scene")


def test_a_preset_changes_the_scene(scene_file):
    scene = load_scene(scene_file, preset=SOURCE)
    contact = scene.contact
    assert (contact.model, contact.resolution_mm) == ("lattice-source", 1.5)
    assert contact.options == {"loops": "source", "law": "nonlinear", "pressure_rule": "source"}
    assert contact.adjust
    assert contact.adjust_restore_when == "both"
    assert (contact.friction, contact.material) == (0.05, "polyethylene")
    assert scene.motion.motion == "roll-slip"
    assert scene.ground_reaction.applied == "ankle"
    assert load_scene(scene_file).preset is None


def test_only_changed_keys_are_reported(scene_file):
    preset = load_scene(scene_file, preset=SOURCE).preset.as_dict()
    changes = {entry["key"]: (entry["before"], entry["after"]) for entry in preset["changes"]}
    assert changes["ground_reaction.applied"] == ("cop", "ankle")
    assert changes["contact.adjust"] == (None, True)
    for same in ("contact.friction", "contact.material", "contact.post", "muscles"):
        assert same not in changes
    assert preset["overridden"] == preset["departures"] == []


def test_overrides_replace_values_of_the_preset(scene_file):
    scene = load_scene(
        scene_file, {"contact.adjust": False, "contact.options.law": "linear"}, SOURCE
    )
    assert not scene.contact.adjust
    assert scene.contact.options["law"] == "linear"
    assert scene.contact.options["loops"] == "source"
    assert set(scene.preset.overridden) == {"contact.adjust", "contact.options.law"}
    assert any("replaced it: contact.adjust" in words for words in scene.preset.sentences())


def test_another_contact_model_does_not_get_the_lattices_options(scene_file):
    scene = load_scene(scene_file, {"contact.model": "hertz"}, SOURCE)
    assert scene.contact.options == {}
    assert set(scene.preset.overridden) == {"contact.model", "contact.options"}


def test_a_preset_can_be_applied_to_a_loaded_scene(scene_file):
    read = load_scene(scene_file, FAST)
    assert with_preset(read, SOURCE) == load_scene(scene_file, FAST, SOURCE)
    assert with_preset(read, SOURCE).preset == load_scene(scene_file, FAST, SOURCE).preset
    with pytest.raises(InputError, match="read already"):
        simulate(load_case(read), preset=SOURCE)


@pytest.mark.parametrize(
    ("drop", "words"),
    [
        (("ground_reaction",), r"needs \[ground_reaction\]: the force plate"),
        (("tibia", "ground_reaction"), r"needs \[tibia\].*also needs \[ground_reaction\]"),
        (("quadriceps", "patellar_ligament", "patella"), r"needs \[quadriceps\]"),
    ],
)
def test_missing_data_are_a_one_line_error(drop, words, capsys, tmp_path):
    scene_file = write_scene(tmp_path / "scene", drop)
    with pytest.raises(InputError, match=words):
        load_scene(scene_file, preset=SOURCE)
    out = tmp_path / "out"
    assert main(["run", str(scene_file), "--as", SOURCE, "--out", str(out)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not out.exists()


def test_skin_markers_lack_the_required_pose():
    content = {"motion": {"interpretation": "markers"}, "tibia": {"kind": "sagittal"}}
    with pytest.raises(InputError, match="recorded pose on the insert"):
        find_preset(SOURCE).apply(content, {}, "scene.toml")


def test_remaining_differences_are_reported():
    content = {"tibia": {"kind": "pose"}, "ligament": [{"law": "quadratic-toe"}]}
    departures = find_preset(SOURCE).departures(content)
    assert len(departures) == 2
    assert "in 3D" in departures[0]
    assert "quadratic-toe" in departures[1]


def test_a_run_records_the_preset_in_summary_and_report(scene_file, tmp_path):
    out = tmp_path / "out"
    run = ["run", str(scene_file), "--as", SOURCE, "--contact", "hertz", "--frames", "5:6"]
    assert main([*run, "--set", "motion.frames=11", "--out", str(out)]) == 0
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["preset"]["name"] == SOURCE
    assert {"contact.model", "contact.options"} <= set(summary["preset"]["overridden"])
    report = (out / "report.html").read_text(encoding="utf-8")
    assert "Run as sharma-2008 (Sharma, dissertation" in report
    assert "ground_reaction.applied = ankle (scene: cop)" in report


def test_simulate_and_load_scene_apply_a_preset_alike(scene_file):
    read = load_scene(scene_file, FAST)
    results = simulate(read, preset=SOURCE, frames=slice(5, 6))
    same = simulate(load_scene(scene_file, FAST, SOURCE), frames=slice(5, 6))
    assert results["force_total_N"] == same["force_total_N"]
    assert results.summary["preset"] == same.summary["preset"]
    assert results["force_total_N"] != simulate(read, frames=slice(5, 6))["force_total_N"]
    assert "Run as" in report_html(results)


def test_the_scene_of_results_is_read_again_with_its_preset(scene_file, tmp_path):
    """`view` and `export --deck` read the scene again. `run_again` returns the run's command."""
    out = tmp_path / "out"
    run = ["run", str(scene_file), "--as", SOURCE, "--contact", "hertz", "--frames", "5:6"]
    assert main([*run, "--set", "motion.frames=11", "--out", str(out)]) == 0
    results = read_results(out)
    case = case_of_results(results)
    assert case.scene.motion.motion == "roll-slip"
    assert case.scene.contact.adjust
    command = run_again(results.summary)
    assert f"{scene_file} --as {SOURCE} --set" in command


class MyStudy(Preset):
    name = "my-study"
    source = "nobody (2026)"
    settings = {"contact.friction": 0.1}  # noqa: RUF012


def test_another_package_can_offer_a_preset(scene_file, monkeypatch):
    points = [EntryPoint("my-study", f"{__name__}:MyStudy", "tkamb.io.presets")]
    monkeypatch.setitem(sys.modules, __name__, SimpleNamespace(MyStudy=MyStudy))
    monkeypatch.setattr(named_classes, "installed", lambda group, path: points)
    assert PRESETS.names() == (SOURCE, "my-study")
    assert load_scene(scene_file, preset="my-study").contact.friction == 0.1


def test_an_unknown_preset_is_refused_with_the_nearest_name(scene_file):
    with pytest.raises(InputError, match="did you mean sharma-2008"):
        load_scene(scene_file, preset="sharma-2007")
