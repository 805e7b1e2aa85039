"""Wear in the output of a run: the report's section and the viewer's layer."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

import shapes
from headless import Page, chromium
from synthetic_run import make_run
from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR
from tkamb.io.mesh_files import write_triangles
from tkamb.io.recordings.polygon_files import read_vtp, read_vtp_values
from tkamb.run.results_folder import read_results
from tkamb.show.report import report_html
from tkamb.show.sections import OTHER_WEAR, wear_section
from tkamb.show.view.drawing import INSERT, rgb, wear_colours, wear_scale
from tkamb.show.view.payload import pack
from tkamb.show.view.run import open_run
from tkamb.show.view.show import Show
from tkamb.show.view.solids import worn_insert
from viewed import shipped_run

PIXEL = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010806000000"
    "1f15c4890000000d49444154789c63606060f80f00010401005f6e3b4c0000000049454e44ae426082"
)
WEAR = {
    "first": "The wear factor differs by a factor of two.",
    "cycles": 5e6,
    "volume_mm3": 5.64,
    "mass_mg": 5.25,
    "max_depth_mm": 0.05,
    "mean_depth_mm": 0.01,
    "worn_area_mm2": 400.0,
    "medial_share": 0.6,
    "volume_mm3_per_Mc": 1.13,
    "mass_mg_per_Mc": 1.05,
    "creep_depth_mm": None,
    "creep_volume_mm3": None,
    "volume_mm3_range": [2.26, 15.8],
    "range_source": "two whole-knee tests",
    "geometry": "the contact area cancels",
    "laws_side_by_side": [
        {
            "law": "contact-area",
            "first_volume_mm3_per_Mc": 1.59,
            "first_volume_mm3_per_Mc_range": [0.64, 4.45],
            "geometry": "a conforming insert wears more",
        }
    ],
    "law": "archard",
    "material": "mine",
    "control": "displacement",
    "contact": "foundation",
    "resolution_mm": 2.0,
    "blocks": 10,
    "status": "ok",
    "source": "gait.csv",
    "questions": ["creep is not modelled"],
    "notes": ["a simulator's cycle"],
    "bands": {
        "samples": 32,
        "standard_deviations": {"wear_factor (relative)": 0.44},
        "not_varied": "loads",
        "volume_mm3_p05": 2.6,
        "volume_mm3_p95": 10.3,
    },
}

OTHERS = (("another's", "these"), ("this", "others"))
"""Hashes of a scene and of its files. One of each pair differs from the hash of `worn`."""


def put_wear(folder, summary):
    """Write wear of a scene into a folder: depth 1 mm on a plate where z is negative."""
    content = WEAR | {
        "scene_sha256": ["another's", summary["scene_sha256"]],
        "files_sha256": summary["identity"]["content of a file"],
        "run_frames": summary["identity"]["choice of frames"],
    }
    (folder / "wear.json").write_text(json.dumps(content), encoding="utf-8")
    (folder / "wear.png").write_bytes(PIXEL)
    plate = shapes.plate()
    depth = np.where(plate.vertices[:, 2] < 0, 1.0, 0.0)
    write_triangles(folder / "wear.vtp", plate.vertices, plate.faces, {"wear_depth_mm": depth})


@pytest.fixture
def worn(tmp_path):
    """Return results in a folder with wear of their scene."""
    results = make_run("bend")
    identity = {"content of a file": "these", "choice of frames": [0, 101, 1]}
    summary = results.summary | {"scene_sha256": "this", "identity": identity}
    put_wear(tmp_path, summary)
    return replace(results, directory=tmp_path, summary=summary)


def test_the_report_shows_wear_with_its_band_after_a_caution(worn, monkeypatch):
    monkeypatch.setattr("tkamb.show.report.svg_text", lambda *_: "<svg></svg>")
    page = report_html(worn)
    section = page[page.index("<h2>Wear</h2>") :]
    section = section[: section.index("</section>")]
    words = re.sub(r"<[^>]+>", " ", section)
    assert words.index("factor of two") < words.index("5.64")
    ranged = ("2.26 to 15.8", "two whole-knee tests", "the contact area cancels")
    for found in (
        *ranged,
        "contact-area",
        "1.59",
        "0.64 to 4.45",
        "a conforming insert wears more",
    ):
        assert found in words
    for found in ("5,000,000", "2.6 to 10.3", "not modelled", "archard", "creep is not modelled"):
        assert found in words
    assert 'src="data:image/png;base64,' in section


def test_wear_of_another_scene_is_not_shown(worn):
    folder = worn.directory
    others = [WEAR | {"scene_sha256": [s], "files_sha256": f} for s, f in OTHERS]
    for content in (WEAR, *others, []):
        (folder / "wear.json").write_text(json.dumps(content), encoding="utf-8")
        assert wear_section(worn) == {"other": OTHER_WEAR}
        assert worn_insert(worn, "right") == ()
    (folder / "wear.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"wear\.json"):
        wear_section(worn)
    (folder / "wear.json").unlink()
    assert wear_section(worn) is None


def test_wear_of_other_frames_of_the_run_is_not_shown(worn):
    """Wear of the whole motion is shown with a run of any frames."""
    path = worn.directory / "wear.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    for frames, there in (([0, 101, 1], True), ([20, 101, 40], False), (None, True)):
        path.write_text(json.dumps(content | {"run_frames": frames}), encoding="utf-8")
        assert (wear_section(worn) != {"other": OTHER_WEAR}) == there
        assert bool(worn_insert(worn, "right")) == there


def test_the_viewers_layer_has_the_depths_of_the_file_and_mirrors_a_left_knee(worn):
    (right,), (left,) = worn_insert(worn, "right"), worn_insert(worn, "left")
    points, faces = read_vtp(worn.directory / "wear.vtp")
    assert right.surface.vertices == pytest.approx(points)
    assert left.surface.vertices == pytest.approx(points @ MIRROR)
    assert right.wear == pytest.approx(np.where(points[:, 2] < 0, 1.0, 0.0))
    assert (left.surface.faces == faces[:, ::-1]).all()
    with pytest.raises(InputError, match="lacks 'depth'"):
        read_vtp_values(worn.directory / "wear.vtp", "depth")


def test_unworn_points_have_the_colour_of_the_insert():
    colours = wear_colours([0.0, 1e-9, 0.2], 0.2)
    assert colours[0] == pytest.approx(rgb(INSERT))
    assert colours[1] == pytest.approx(wear_scale()[0])
    assert colours[2] == pytest.approx(wear_scale()[255])


@pytest.mark.slow
def test_the_page_switches_between_the_new_and_the_worn_insert(tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(shipped_run(), folder)
    put_wear(folder, read_results(folder).summary)
    show = Show([open_run(folder)])
    assert show.drawings[0].deepest_wear == 1.0
    assert len(pack(show.drawings)) > 0
    path = tmp_path / "view.html"
    show.write_html(path)
    with chromium() as browser:
        page = Page(browser).open(path.as_uri())
        shown = "['insert', 'worn insert', 'pressure map'].map(tkamb.layerShown)"
        bar = "getComputedStyle(document.getElementById('wear-bar')).display"
        assert page.evaluate(shown) == [True, False, True]
        assert page.evaluate(bar) == "none"
        page.evaluate("document.querySelector('[data-layer=\"worn insert\"]').click()")
        assert page.evaluate(shown) == [False, True, False]
        assert page.evaluate(bar) != "none"
        page.evaluate("document.querySelector('[data-layer=\"worn insert\"]').click()")
        assert page.evaluate(shown) == [True, False, True]
        assert page.problems == []


@pytest.mark.parametrize(
    "damage", [{"bands": 3}, {"bands": {"samples": 1}}, {"cycles": "many"}, {"questions": None}]
)
def test_a_damaged_wear_json_is_refused(worn, damage):
    path = worn.directory / "wear.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | damage), encoding="utf-8")
    with pytest.raises(InputError, match=r"not as tkamb wear writes it.*run tkamb wear again"):
        wear_section(worn)


def test_wear_without_the_hash_of_a_scene_is_not_shown(worn):
    path = worn.directory / "wear.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"scene_sha256": 5}))
    assert wear_section(worn) == {"other": OTHER_WEAR}
