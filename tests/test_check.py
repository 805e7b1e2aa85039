"""`tkamb check`: content of a scene and questions on it, without a run."""

import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from mirrored_patient import write_mirrored_patient
from scenes import MODEL
from tkamb.cli import main
from tkamb.commands.check import check_html
from tkamb.io.starter import lay_out
from tkamb.run.muscles import sharing as static_optimisation
from tkamb.show.leg_picture import draw_leg, leg_frame, shown_frames
from tkamb.show.scene_check import _listed, _missing, check_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return the path of the starter scene, with a measured force."""
    path = lay_out(tmp_path_factory.mktemp("check") / "knee")
    (path.parent / "implant.csv").write_text("time,F\n1.0,367.75\n2.0,1471\n3.3,735.5\n")
    table = (
        '[measured]\nfile = "implant.csv"\ncolumns = {total = "F"}\nunit = "N"\noffset_s = 0.0\n'
    )
    path.write_text(f"{path.read_text()}\n{table}")
    return path


@pytest.fixture(scope="module")
def checked(scene):
    return check_scene(scene)


def test_a_check_lists_each_file_and_writes_only_the_picture(scene, capfd):
    before = sorted(scene.parent.iterdir())
    picture = scene.parent / "leg.png"
    assert main(["check", str(scene), "--out", str(picture)]) == 0
    output = capfd.readouterr().out
    assert "motion (motion.csv): 6 frames" in output
    assert "flexion 28.0 to 107.9 deg" in output
    assert "measured force (implant.csv): total 0.50 to 2.00 BW, 3 samples" in output
    assert "note: no unlikely value was found" in output and "not modelled: " in output
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert sorted(scene.parent.iterdir()) == sorted([*before, picture])
    picture.unlink()


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["a1", "a2", "a3", "b"], "a1–3, b"),
        (["a1", "a2"], "a1, a2"),
        (["a1", "a3", "a4"], "a1, a3, a4"),
        (["a", "a1", "a2"], "a, a1, a2"),
        (["a2", "a1", "a"], "a2, a1, a"),
        (["a09", "a10", "a11", "a12"], "a09, a10, a11, a12"),
    ],
)
def test_consecutively_numbered_names_are_abbreviated(names, words):
    assert _listed(names) == words


def test_a_ground_reaction_in_the_wrong_unit_raises_a_question(scene, checked):
    assert checked.questions == ()
    table = scene.parent / "ground_reaction.csv"
    text = table.read_text()
    header, *rows = text.splitlines()
    cells = [row.split(",") for row in rows]
    forces = [k for k, name in enumerate(header.split(",")) if name.endswith("_N")]
    for row in cells:
        for k in forces:
            row[k] = str(9.80665 * float(row[k]))
    table.write_text("\n".join([header, *(",".join(row) for row in cells)]) + "\n")
    result = check_scene(scene).as_dict()
    table.write_text(text)
    assert any("ground reaction" in question for question in result["questions"])
    assert json.loads(json.dumps(result)) == result


FILES = ("motion.csv", "ground_reaction.csv", "tibia.csv", "implant.csv")


def test_notices_on_every_recording_reach_check_run_summary_and_report(tmp_path, capfd):
    from tkamb.run.results_folder import read_results

    scene = lay_out(tmp_path / "knee")
    (scene.parent / "implant.csv").write_text("time,F\n1.0,367.75\n2.0,1471\n3.3,735.5\n")
    table = (
        '[measured]\nfile = "implant.csv"\ncolumns = {total = "F"}\nunit = "N"\noffset_s = 0.0\n'
    )
    scene.write_text(f"{scene.read_text()}\n{table}")
    for name in FILES:
        header, *rows = (scene.parent / name).read_text().splitlines()
        rows = [f"{header},x,x", *(f"{row},1,2" for row in rows)]
        (scene.parent / name).write_text("\n".join(rows) + "\n")
    expected = [f"{name}: has two columns named 'x'; neither is used" for name in FILES]
    result = check_scene(scene)
    assert sorted(result.as_dict()["notices"]) == sorted(expected)
    assert all(f"notice: {notice}" in result.lines() for notice in expected)
    figure = draw_leg(result.case, result.recording)
    assert all(notice.replace("'", "&#39;") in check_html(result, figure) for notice in expected)
    out = tmp_path / "out"
    run = [
        "run",
        str(scene),
        "--contact=foundation",
        "--resolution=4",
        "--frames=2:3",
        f"--out={out}",
    ]
    assert main(run) == 0
    error = capfd.readouterr().err
    assert all(error.count(f"notice: {notice}") == 1 for notice in expected)
    assert sorted(read_results(out).summary["remarks"]) == sorted(expected)
    assert "Notices on recordings" in (out / "report.html").read_text(encoding="utf-8")


def test_the_drawn_leg_agrees_with_the_chain_and_the_force_plate(checked):
    """Segments keep their lengths, the hip is above the ankle, the force acts on the plate."""
    case = checked.case
    frames = [leg_frame(case, checked.recording, k) for k in shown_frames(case)]
    assert len(frames) == 3
    shank = [np.linalg.norm(one.joints[1] - one.joints[2]) for one in frames]
    np.testing.assert_allclose(shank, shank[0], rtol=1e-12)
    for one in frames:
        np.testing.assert_allclose(one.joints[2], case.tibia.pose[one.frame, :3, 3], atol=1e-12)
        np.testing.assert_array_equal(one.force, case.ground.force[one.frame])
        np.testing.assert_array_equal(one.point, case.ground.point[one.frame])
        assert one.joints[0, 1] > one.joints[1, 1] > one.joints[2, 1] > one.point[1]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--out", "leg.jpg"], "does not end in .png or .html"),
        (["--set", "contact.model=magic"], "magic"),
        (["--set", "contact.material=cheese"], "polyethylene"),
        (["--set", "motion.file=no.csv"], "no.csv"),
    ],
)
def test_bad_input_gives_one_line(scene, tmp_path, monkeypatch, capfd, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(["check", str(scene), *arguments]) == 2
    error = capfd.readouterr().err
    assert words in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_page_has_the_files_and_the_picture(checked):
    figure = Figure()
    figure.add_subplot()
    text = check_html(checked, figure)
    assert "ground_reaction.csv" in text and "<svg" in text
    assert "http://" not in text.replace("http://www.w3.org", "")


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_mcl_is_drawn_on_the_side_labelled_medial(side, tmp_path):
    scene = MODEL / "scene.toml" if side == "right" else write_mirrored_patient(tmp_path)
    checked = check_scene(scene)
    figure = draw_leg(checked.case, checked.recording)
    knee = figure.axes[-1]
    words = {text.get_gid(): text for text in knee.texts}
    medial = words["side-left"].get_text() == "medial"
    assert medial == (side == "left")
    mcl, lcl = (words[f"ligament-{name}"].get_position()[0] for name in ("MCL", "LCL"))
    assert (mcl < lcl) == medial


def test_a_check_names_a_solver_that_is_not_installed(checked, monkeypatch):
    monkeypatch.setattr(static_optimisation, "find_spec", lambda name: None)
    plain = checked.case
    assert _missing(plain) == ()
    scene = plain.scene.model_copy(update={"muscles": object()})
    (words,) = _missing(replace(plain, scene=scene))
    assert "DAQP" in words and "pip install 'tkamb[muscles]'" in words
    lines = replace(checked, missing=(words,)).lines()
    assert lines[0] == f"missing: {words}" and "when that is installed" in lines[1]
