"""The Methods paragraph: the model of a run with the numbers of its scene."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import tkamb
from scenes import MODEL
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.geometry.frames import SIDES
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.ligaments import BUNDLES
from tkamb.run.results import read_csv
from tkamb.run.summary import measures
from tkamb.show.sections import methods


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a short run of the shipped knee."""
    out = tmp_path_factory.mktemp("methods") / "run"
    scene = str(MODEL / "scene.toml")
    options = ["--contact", "foundation", "--frames", "0:101:50", "--out", str(out)]
    assert main(["run", scene, *options]) == 0
    return out


def test_the_paragraph_needs_only_the_folder(run, capsys):
    capsys.readouterr()
    assert main(["methods", str(run)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for words in (
        "75 kg",
        "MCL_anterior k = 91.25 N/mm, L0 = 82.73 mm",
        "elastic foundation of independent columns",
        "points lay 1 mm apart",
        "E = 561.5 MPa",
        "coefficient of 0.05",
        "doi:10.1016/0021-9290(91)90019-J",
        "3 frames were computed; none of them failed.",
        "Nobody was measured",  # a note of the scene, since the shipped knee is synthetic
    ):
        assert words in text
    assert f"tkamb {tkamb.__version__}" in text


def test_the_paragraph_has_thickness_meshes_tolerance_and_rate(run):
    """The numbers are those of the files: insert.stl, and motion.csv with 101 rows in 4 s."""
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    text = " ".join(methods(summary).sentences)
    assert "The motion had 25 frames per second." in text
    insert = trimesh.load_mesh(MODEL / "insert.stl")
    assert f"{len(insert.faces)} triangles for the insert" in text
    low, high = summary["measures"]["insert_thickness_mm"]
    assert 0.3 * insert.extents.min() < low <= high < insert.extents.min()
    assert "mm thick" in text
    assert "relative tolerance of 1e-06" in text
    columns = read_csv(run / "results.csv")
    thickness = [columns[f"{side}_thickness_mm"] for side in SIDES]
    assert [low, high] == [np.nanmin(thickness), np.nanmax(thickness)]
    del summary["measures"]
    assert "triangles for" not in " ".join(methods(summary).sentences)


def test_a_resampled_motion_is_not_called_recorded(run):
    """motion.csv has 25 rows a second; 51 frames in 4 s are 12.5 a second."""
    case = load_case(load_scene(MODEL / "scene.toml", {"motion.frames": 51}))
    columns = {f"{side}_thickness_mm": np.array([np.nan, 5.0]) for side in SIDES}
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    summary["measures"] = measures(case, columns)
    summary["scene_tables"]["motion"]["frames"] = 51
    text = " ".join(methods(summary).sentences)
    assert "The motion was resampled to 12.5 frames per second." in text
    case = replace(case, motion=replace(case.motion, time=case.motion.time**1.1))
    assert "frame_rate_Hz" not in measures(case, columns)


@pytest.mark.parametrize(
    ("key", "value", "words", "absent"),
    [
        ("ligament", [], "No ligaments were modelled", "two-line"),
        ("contact.friction", 0.08, "coefficient of 0.08", "0.05"),
        ("motion.cutoff_Hz", 6.0, "low-pass filtered at 6 Hz", "It was not filtered"),
        ("ground_reaction.applied", "ankle", "at the ankle's centre", "free moment"),
        ("contact.model", "hertz", "Hertz's theory", "elastic foundation"),
    ],
)
def test_the_paragraph_follows_the_scene(run, key, value, words, absent):
    scene = tkamb.load_scene(MODEL / "scene.toml", {"contact.model": "foundation", key: value})
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    summary["scene_tables"] = scene.model_dump(mode="json", exclude_none=True)
    text = " ".join(methods(summary).sentences)
    assert words in text
    assert absent not in text


def test_generic_bundles_have_numbers_and_sources(run):
    overrides = {"ligament": [], "generic_ligaments": {"ligaments": ["LCL"]}}
    scene = tkamb.load_scene(MODEL / "scene.toml", overrides)
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    summary["scene_tables"] = scene.model_dump(mode="json", exclude_none=True)
    paragraph = methods(summary)
    text = " ".join(paragraph.sentences)
    assert "LCL k = 72.22 N/mm, strain -0.05" in text and "PCL_" not in text
    assert any("Ligament-bone interaction" in one for one in paragraph.references)
    assert any("Abdel-Rahman" in one for one in paragraph.references)


def test_the_references_are_those_of_the_used_methods(run):
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    cited = " ".join(methods(summary).references)
    assert "Shin" in cited and "Sharma" in cited
    assert "Lu TW" not in cited and "Hughes" not in cited


def test_a_summary_of_an_earlier_version_is_refused():
    with pytest.raises(InputError, match="run the scene again"):
        methods({"frames": 3})


def test_the_report_has_the_paragraph(run):
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "Methods paragraph" in page and "Carpentier" in page


def test_the_paragraph_states_that_an_error_was_not_measured(run):
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    summary["known_error"] = "not measured"
    assert "was not measured" in " ".join(methods(summary).sentences)


def test_the_page_of_equations_has_every_generic_bundle():
    text = (MODEL.parents[1] / "docs" / "equations.md").read_text(encoding="utf-8")
    for name, bundle in BUNDLES.items():
        ends = [f"({', '.join(f'{v:g}' for v in p)})" for p in (bundle.proximal, bundle.distal)]
        row = [name, f"{bundle.stiffness_N_per_mm:g}", f"{bundle.reference_strain:g}", *ends]
        assert f"| {' | '.join(row)} |" in text
