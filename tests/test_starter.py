"""`tkamb new`: its files run unchanged and replace no file; a person's lengths and masses."""

import re
import shutil

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from scenes import MODEL
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.scene import load_scene
from tkamb.io.starter import lay_out
from tkamb.io.starter.person import Person


def test_the_new_scene_runs_unchanged(tmp_path):
    assert main(["new", str(tmp_path / "knee")]) == 0
    started = tkamb.simulate(tmp_path / "knee" / "scene.toml", contact="foundation")
    shipped = tkamb.simulate(MODEL / "scene.toml", contact="foundation", frames=slice(30, 81, 10))
    np.testing.assert_allclose(started["flexion_deg"], shipped["flexion_deg"], rtol=1e-6)
    # The new scene has fewer triangles and two of the six ligaments, but the same leg and loads.
    np.testing.assert_allclose(started["quadriceps_N"], shipped["quadriceps_N"], rtol=0.02)
    np.testing.assert_allclose(started["force_total_BW"], shipped["force_total_BW"], rtol=0.05)


def test_the_scene_of_the_page_gives_the_results_of_the_starter(tmp_path):
    """The page has centimetres, other plate axes, the force on the plate and a solved patella."""
    assert main(["new", str(tmp_path / "knee")]) == 0
    page = (MODEL.parents[1] / "docs" / "your_own_patient.md").read_text(encoding="utf-8")
    written = re.findall(r"^`(\S+)`:\n\n```\w+\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(written) == 4
    overrides = {"ligament": [], "contact.model": "foundation", "contact.resolution_mm": 2.0}
    frames = slice(0, 6, 5)
    started = tkamb.simulate(
        tkamb.load_scene(tmp_path / "knee" / "scene.toml", overrides), frames=frames
    )
    for name, text in written:
        (tmp_path / "knee" / name).write_text(text, encoding="utf-8")
    of_page = tkamb.simulate(tmp_path / "knee" / "scene.toml", frames=frames)
    for name in ("ground_reaction_ap_N", "ground_reaction_si_N", "force_total_BW"):
        np.testing.assert_allclose(of_page[name], started[name], rtol=1e-3)
    # The starter's patella motion was solved on finer meshes.
    np.testing.assert_allclose(of_page["quadriceps_N"], started["quadriceps_N"], rtol=3e-3)
    assert "Nobody was measured" not in str(of_page.summary["notes"])


def test_a_folder_with_files_is_refused_and_stays_unchanged(tmp_path, capfd):
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["new", str(tmp_path)]) == 2
    assert "not empty" in capfd.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_an_empty_folder_is_accepted(tmp_path):
    assert main(["new", str(tmp_path / "empty")]) == 0
    (tmp_path / "second").mkdir()
    assert main(["new", str(tmp_path / "second")]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "second"]


@pytest.mark.parametrize("name", ["file", "file/below"])
def test_a_path_that_is_no_folder_is_refused(tmp_path, capfd, name):
    (tmp_path / "file").write_text("mine")
    assert main(["new", str(tmp_path / name)]) == 2
    assert len(capfd.readouterr().err.strip().splitlines()) == 1
    assert (tmp_path / "file").read_text() == "mine"


def test_a_full_disk_is_named(tmp_path, capfd, monkeypatch):
    def full(source, target, **_):
        reason = f"[Errno 28] No space left on device: '{target}'"
        raise shutil.Error([(str(source), str(target), reason)])

    monkeypatch.setattr(shutil, "copytree", full)
    assert main(["new", str(tmp_path / "knee")]) == 2
    assert "cannot be written (No space left on device)" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_scene_with_a_byte_order_mark_is_read(tmp_path):
    scene = lay_out(tmp_path / "knee")
    plain = load_scene(scene)
    scene.write_bytes(b"\xef\xbb\xbf" + scene.read_bytes())
    assert load_scene(scene) == plain


def test_a_recording_of_one_row_is_named(tmp_path, capfd):
    scene = lay_out(tmp_path / "knee")
    motion = scene.parent / "motion.csv"
    motion.write_text("".join(motion.read_text().splitlines(True)[:2]))
    assert main(["run", str(scene), "--out", str(tmp_path / "out")]) == 2
    assert "has one row, at 1.2 s" in capfd.readouterr().err


FRAMES = slice(0, 6, 5)


def run(scene):
    return tkamb.simulate(scene, contact="foundation", resolution_mm=2.0, frames=FRAMES)


@pytest.fixture(scope="module")
def knees(tmp_path_factory):
    """Return the results of one body's right and left knee."""
    folder, body = tmp_path_factory.mktemp("new"), {"mass": 92.0, "height": 1.83, "sex": "male"}
    return {side: run(lay_out(folder / side, Person(side, **body))) for side in ("right", "left")}


def test_a_left_leg_is_the_mirror_image_of_the_right_one(knees):
    for name in ("force_total_BW", "medial_force_N", "lateral_force_N", "quadriceps_N"):
        np.testing.assert_allclose(knees["left"][name], knees["right"][name], rtol=2e-3)
    for name in [name for name in knees["right"].columns if name.startswith("ligament_")]:
        np.testing.assert_allclose(knees["left"][name], knees["right"][name], rtol=1e-3, atol=0.1)


def test_neither_leg_raises_a_question(knees):
    for results in knees.values():
        assert results.summary["questions"] == []


def test_forces_go_with_body_weight(tmp_path):
    """A change of mass alone scales all weights and the ground reaction, but not the ligaments."""
    light = tkamb.load_scene(lay_out(tmp_path / "light", Person(mass=60.0)), {"ligament": []})
    heavy = tkamb.load_scene(lay_out(tmp_path / "heavy", Person(mass=120.0)), {"ligament": []})
    forces = [
        tkamb.simulate(scene, contact="foundation", resolution_mm=2.0, frames=FRAMES)
        for scene in (light, heavy)
    ]
    np.testing.assert_allclose(forces[1]["quadriceps_N"], 2 * forces[0]["quadriceps_N"], rtol=0.02)


def test_the_urdf_holds_the_published_lengths_and_masses(tmp_path):
    body = Person("left", 68.0, 1.62, "female")
    model = pin.buildModelFromUrdf(str(lay_out(tmp_path / "p", body).parent / "patient.urdf"))
    masses = sum(inertia.mass for inertia in model.inertias)
    assert masses == pytest.approx(68.0 * (0.1478 + 0.0481 + 0.0129) + 0.1, rel=1e-5)
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    places = {f.name: data.oMf[k].translation for k, f in enumerate(model.frames)}
    assert places["tibia"][1] == pytest.approx(0.039 * 1.62, abs=1e-6)
    assert places["hip"][1] - places["femur"][1] == pytest.approx(0.245 * 1.62, abs=5e-3)
    assert places["femur"][1] - places["tibia"][1] == pytest.approx(0.246 * 1.62, abs=2e-2)


def test_the_medial_ligament_is_on_the_medial_side(tmp_path):
    for side, sign in (("right", -1), ("left", 1)):
        scene = tkamb.load_scene(lay_out(tmp_path / side, Person(side)))
        medial = next(bundle for bundle in scene.ligament if bundle.name.startswith("MCL"))
        assert sign * medial.proximal.point_mm[2] > 30.0
        assert sign * medial.distal.point_mm[2] > 25.0


@pytest.mark.parametrize("option", [("--mass-kg", "5"), ("--height-mm", "1.83")])
def test_an_impossible_body_is_refused_and_nothing_is_written(tmp_path, capfd, option):
    assert main(["new", str(tmp_path / "p"), *option]) == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and option[0] in lines[0]
    assert not (tmp_path / "p").exists()


def test_a_person_is_checked_in_python_too():
    with pytest.raises(InputError, match="kg"):
        Person(mass=900.0)
