"""Verification of results: changed, exchanged or missing files are reported."""

import json
import shutil
import zipfile
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from interrupted_runs import held_elsewhere
from scenes import write_scene
from tkamb import files
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.scene import load_scene
from tkamb.run.identity import input_hashes
from tkamb.run.recorder import Shard, Shards
from tkamb.run.results_folder import read_results, write_results
from tkamb.show.comparison import SAME, compare_folders
from tkamb.show.comparison_page import comparison_html, table_lines

pytestmark = pytest.mark.usefixtures("plain_report")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return a folder with a scene and its results."""
    folder = tmp_path_factory.mktemp("finished")
    scene = write_scene(folder / "scene", contact__resolution_mm=3.0, contact__model="foundation")
    assert main(["run", str(scene), "--out", str(folder / "out"), "--frames", "0:9:4"]) == 0
    return folder


@pytest.fixture
def run(finished, tmp_path):
    """Return the folder of the scene and that of a copy of the results."""
    shutil.copytree(finished / "out", tmp_path / "out")
    return finished / "scene", tmp_path / "out"


def verified(out, capfd):
    """Return exit status and output of `tkamb verify`."""
    capfd.readouterr()
    status = main(["verify", str(out)])
    output = capfd.readouterr()
    return status, output.out + output.err


def test_unchanged_results_are_verified(run, capfd):
    status, output = verified(run[1], capfd)
    assert status == 0 and "input file(s) have not changed" in output
    assert main(["report", str(run[1])]) == 0
    assert verified(run[1], capfd)[0] == 0


def change_cell(out):
    """Increase one number of results.csv by 5 %."""
    path = out / "results.csv"
    header, first, *other_lines = path.read_text().splitlines()
    cells = first.split(",")
    cells[5] = repr(float(cells[5]) * 1.05)
    path.write_text("\n".join([header, ",".join(cells), *other_lines]) + "\n")


def change_map(out):
    """Invert one bit of contact.h5."""
    path = out / "contact.h5"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def change_summary(out):
    """Increase the body mass in summary.json."""
    path = out / "summary.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"body_mass_kg": content["body_mass_kg"] + 1}))


CHANGES = [
    (change_cell, "results.csv has changed"),
    (change_map, "contact.h5 has changed"),
    (change_summary, "summary.json has changed"),
    (lambda out: (out / "contact.h5").unlink(), "contact.h5 is missing"),
]


def test_the_base_of_a_scene_is_an_input(tmp_path, capfd):
    base = write_scene(tmp_path, contact__resolution_mm=3.0, contact__model="foundation")
    scene, out = tmp_path / "own.toml", tmp_path / "out"
    scene.write_text('base = "scene.toml"\n[patient]\nmass_kg = 80.0\n')
    assert main(["run", str(scene), "--out", str(out), "--frames", "0:1"]) == 0
    assert verified(out, capfd)[0] == 0
    base.write_text(base.read_text() + "\n# by another hand\n")
    status, output = verified(out, capfd)
    assert status != 0 and f"input {base} has changed" in output


@pytest.mark.parametrize(("change", "words"), CHANGES)
def test_every_command_reports_changed_results(run, capfd, change, words):
    scene, out = run
    change(out)
    status, output = verified(out, capfd)
    assert status == 1 and words in output
    resume = ["run", str(scene / "scene.toml"), "--out", str(out), "--frames", "0:9:4", "--resume"]
    view = ["view", str(out), "--html", str(out / "v.html")]
    for command in (["report", str(out)], resume, view):
        assert main(command) == 2
        assert words in capfd.readouterr().err
    with pytest.raises(InputError, match=words):
        read_results(out)


def test_changed_input_files_are_named(finished, tmp_path, capfd):
    shutil.copytree(finished, tmp_path / "moved")
    out, motion = tmp_path / "moved" / "out", finished / "scene" / "motion.csv"
    before = motion.read_text()
    try:
        motion.write_text(before + "\n")
        status, output = verified(out, capfd)
        assert status == 1 and f"{motion} has changed since it was read" in output
        motion.unlink()
        status, output = verified(out, capfd)
        assert status == 1 and f"{motion}: no such file" in output
    finally:
        motion.write_text(before)


def test_results_of_another_code_get_a_note(run, capfd, monkeypatch):
    monkeypatch.setattr("tkamb.run.reproduction.code_identity", lambda: "other")
    status, output = verified(run[1], capfd)
    code = json.loads((run[1] / "summary.json").read_text())["identity"]["code of tkamb"]
    assert status == 0 and "computed by other code" in output
    assert f", {code[:12]}; this is " in output and ", other)" in output


def test_a_run_of_another_code_is_not_resumed(run, capfd, monkeypatch):
    monkeypatch.setattr("tkamb.run.identity.code_identity", lambda: "other")
    scene, out = run
    command = ["run", str(scene / "scene.toml"), "--out", str(out), "--frames", "0:9:4", "--resume"]
    assert main(command) == 2
    assert "another code of tkamb" in capfd.readouterr().err


def test_a_folder_without_results_is_refused(tmp_path, capfd):
    for name, text in (("summary.json", "{}"), ("summary.json", "[1]"), ("notes.txt", "x")):
        folder = tmp_path / f"{name}{len(text)}"
        folder.mkdir()
        (folder / name).write_text(text)
        status, output = verified(folder, capfd)
        assert status == 2 and output.count("\n") == 1
    assert verified(tmp_path / "nothing", capfd)[0] == 2


def test_results_without_hashes_cannot_be_verified(run, capfd):
    path = run[1] / "summary.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({k: v for k, v in content.items() if k != "files"}))
    status, output = verified(run[1], capfd)
    assert status == 1 and "no SHA-256" in output


def test_a_frame_of_another_run_or_number_counts_as_absent(tmp_path):
    first_run, other = (Shards(tmp_path / name, {"scene": name}, False) for name in "ab")
    for shards in (first_run, other):
        shards.folder.parent.mkdir()
        for frame in range(2):
            shards.put(frame, Shard({"time_s": float(frame)}, {"pressure": np.ones(3)}))
    first, second = (first_run.folder / f"00000{k}.frame" for k in range(2))
    assert first_run.get(0) is not None
    shutil.copy(other.folder / first.name, first)
    assert first_run.get(0) is None
    shutil.copy(second, first)
    assert first_run.get(0) is None and first_run.get(1) is not None


def test_a_symbolic_link_in_place_of_the_frames_folder_is_refused(tmp_path):
    target = tmp_path / "target"
    target.mkdir()
    (target / "000000.frame").write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".frames").symlink_to(target)
    with pytest.raises(InputError, match="symbolic link"):
        Shards(tmp_path / "out", {}, False)
    assert (target / "000000.frame").read_text() == "mine"


def test_a_second_run_in_a_folder_at_the_same_time_is_refused(run, capfd):
    scene, out = run
    with held_elsewhere(out):
        assert main(["run", str(scene / "scene.toml"), "--out", str(out), "--frames", "0:1"]) == 2
    output = capfd.readouterr().err
    assert "another tkamb is writing" in output and output.count("\n") == 1
    assert verified(out, capfd)[0] == 0


@pytest.mark.parametrize("command", ["verify", "methods", "view", "compare", "export"])
def test_a_reader_changes_nothing_in_a_folder_with_a_journal(
    run, tmp_path, capfd, monkeypatch, command
):
    """A journal of someone else could name the user's files."""
    monkeypatch.setattr(files, "LONGEST_WAIT", 0.0)
    out = run[1]
    journal = {"written": {"results.csv": "mine.csv"}, "removed": ["summary.json", "mine.csv"]}
    (out / files.JOURNAL).write_text(json.dumps(journal))
    (out / "mine.csv").write_text("mine")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    more = {
        "view": ["--html", str(tmp_path / "page.html")],
        "compare": [str(out), "--out", str(tmp_path / "compared")],
        "export": ["--vtp", "--out", str(tmp_path / "maps")],
    }
    assert main([command, str(out), *more.get(command, [])]) == 2
    message = capfd.readouterr().err
    assert files.JOURNAL in message and "tkamb report" in message
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert main(["report", str(out)]) == 2
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_a_report_completes_the_writing_of_a_killed_run(run, capfd):
    out = run[1]
    content = (out / "results.csv").read_bytes()
    part = ".tkamb-0123456789ab.part"
    (out / "results.csv").rename(out / part)
    journal = {"written": {"results.csv": part}, "removed": ["report.html"]}
    (out / files.JOURNAL).write_text(json.dumps(journal))
    assert main(["report", str(out)]) == 0
    assert (out / "results.csv").read_bytes() == content
    assert verified(out, capfd)[0] == 0


def test_a_folder_with_other_files_is_written_only_with_force(
    finished, tmp_path, capfd, monkeypatch
):
    (tmp_path / "results.csv").write_text("mine\n")
    command = [
        "run",
        str(finished / "scene" / "scene.toml"),
        "--frames",
        "0:1",
        "--out",
        str(tmp_path),
    ]
    assert main(command) == 2
    assert "--force" in capfd.readouterr().err
    assert (tmp_path / "results.csv").read_text() == "mine\n"
    (tmp_path / "results.csv").rename(tmp_path / "other.csv")
    assert main([*command, "--force"]) == 0
    assert (tmp_path / "other.csv").read_text() == "mine\n"


def test_a_refused_scene_leaves_no_output_folder(finished, tmp_path, capfd):
    link = ("--set", "quadriceps.origin.link=nowhere")
    out = tmp_path / "out"
    scene = str(finished / "scene" / "scene.toml")
    assert main(["run", scene, "--frames", "0:2", "--out", str(out), *link]) == 2
    assert capfd.readouterr().err.count("\n") == 1
    assert not out.exists()


def test_a_copy_in_another_folder_is_the_same_run_and_a_changed_byte_is_named(
    finished, tmp_path, capfd
):
    """Scene and results are copied to another folder; then one input changes there."""
    other = tmp_path / "home" / "b"
    shutil.copytree(finished / "scene", other / "scene")
    again = ["run", str(other / "scene" / "scene.toml"), "--out", str(other / "out")]
    assert main([*again, "--frames", "0:9:4"]) == 0
    first, second = read_results(finished / "out").summary, read_results(other / "out").summary
    for key in ("scene_sha256", "inputs", "scene_tables"):
        assert first[key] == second[key]
    comparison = compare_folders([finished / "out", other / "out"])
    assert not comparison.notes and not any(one.max_abs for one in comparison.differences)
    assert f"note: {SAME}" in table_lines(comparison) and SAME in comparison_html(comparison)
    ground = other / "scene" / "ground_reaction.csv"
    ground.write_text(ground.read_text() + "\n")
    assert main([*again, "--frames", "0:9:4"]) == 0
    assert read_results(other / "out").summary["scene_sha256"] != first["scene_sha256"]
    (note,) = compare_folders([finished / "out", other / "out"]).notes
    assert "input file ground_reaction.csv" in note


INPUTS = {
    "scene": "own.toml",
    "base": "scene.toml",
    "urdf": "patient.urdf",
    "motion": "motion.csv",
    "shank": "tibia.csv",
    "plate": "ground_reaction.csv",
    "mesh": "insert.stl",
    "muscles": "leg.osim",
    "file of the muscles' model": "wraps.xml",
    "emg": "emg.csv",
    "measured forces": "forces.csv",
}
"""Kind of an input -> its file."""


@pytest.fixture(scope="module")
def every_kind(tmp_path_factory):
    """Return a scene with an input of each kind. Only their bytes matter."""
    folder = tmp_path_factory.mktemp("kinds")
    base = write_scene(folder)
    (folder / "leg.osim").write_text('<OpenSimDocument file="wraps.xml"/>')
    for name in ("wraps.xml", "emg.csv", "forces.csv"):
        (folder / name).write_text(name)
    scene = folder / "own.toml"
    scene.write_text(
        f'base = "{base.name}"\n[muscles]\nmodel = "leg.osim"\n'
        '[muscles.emg]\nfile = "emg.csv"\nhigh_pass_Hz = "none"\ncutoff_Hz = 6\n'
        'channels = { VL = ["vaslat"] }\n'
        '[measured]\nfile = "forces.csv"\nunit = "N"\noffset_s = 0\ncolumns = { total = "all" }\n'
    )
    return scene


def hashes(scene):
    """Return the hashes of a scene's inputs, of which all files are read."""
    return input_hashes(SimpleNamespace(scene=load_scene(scene), femoral=True), scene)


@pytest.mark.parametrize("kind", INPUTS)
def test_compare_names_the_input_of_which_one_byte_differs(finished, every_kind, monkeypatch, kind):
    path = every_kind.parent / INPUTS[kind]
    content, before = path.read_bytes(), hashes(every_kind)
    try:
        path.write_bytes(
            bytes([content[0] ^ 1]) + content[1:] if kind == "mesh" else content + b" "
        )
        after = hashes(every_kind)
    finally:
        path.write_bytes(content)
    stored = read_results(finished / "out", check=False)
    runs = {
        name: replace(stored, summary=stored.summary | {"inputs": inputs})
        for name, inputs in (("a", before), ("b", after))
    }
    monkeypatch.setattr("tkamb.show.comparison.read_results", lambda path: runs[path.name])
    (note,) = compare_folders(["a", "b"]).notes
    assert f"differ in the input file {INPUTS[kind]}. " in note


def test_compare_names_the_setting_and_the_version_that_differ(run, tmp_path):
    shutil.copytree(run[1], tmp_path / "b")
    results = read_results(tmp_path / "b")
    results.summary["scene_tables"]["motion"]["cutoff_Hz"] = 5.0
    results.summary["versions"]["numpy"] = "1.0"
    write_results(results, tmp_path / "b")
    notes = " ".join(compare_folders([run[1], tmp_path / "b"]).notes)
    assert "setting motion.cutoff_Hz" in notes and "version of numpy" in notes


def test_a_pack_is_verified_and_computed_again_elsewhere(finished, tmp_path, capfd):
    scene, pack = str(finished / "scene" / "scene.toml"), tmp_path / "run.zip"
    out = ["--out", str(tmp_path / "out"), "--frames", "0:9:4", "--pack", str(pack)]
    assert main(["run", scene, *out]) == 0
    assert main(["verify", str(pack), "--rerun"]) == 0
    assert "computed again: 3 frames" in capfd.readouterr().out
    with zipfile.ZipFile(pack) as archive:
        archive.extractall(tmp_path / "elsewhere")
    moved, motion = tmp_path / "elsewhere", tmp_path / "elsewhere" / "inputs" / "motion.csv"
    assert main(["verify", str(moved), "--rerun", "--inputs", str(moved / "inputs")]) == 0
    motion.write_text(motion.read_text() + "\n")
    assert main(["verify", str(moved)]) == 1
    assert "motion.csv has changed since it was read" in capfd.readouterr().err
    assert main(["verify", str(moved), "--inputs", str(finished / "scene")]) == 0
    assert main(["verify", str(moved), "--inputs", str(tmp_path / "out")]) == 2


def test_a_second_computation_names_the_column_that_differs(finished, tmp_path, capfd):
    shutil.copytree(finished / "out", tmp_path / "out")
    results = read_results(tmp_path / "out")
    results.columns["quadriceps_N"][1] *= 1.01
    write_results(results, tmp_path / "out")
    capfd.readouterr()
    assert main(["verify", str(tmp_path / "out"), "--rerun"]) == 1
    error = capfd.readouterr().err
    assert "quadriceps_N differs by" in error and error.count("\n") == 1
