"""The stages of a run on a terminal, and `tkamb run --profile`: times, files and modules."""

import io
import json
import re

from scenes import write_scene
from tkamb.cli import main
from tkamb.run.timing import Profile, Stages


def profiled(folder, drop, capsys, *options):
    """Return the profile of a run of the shipped scene without the tables in `drop`."""
    scene = write_scene(folder / "scene", drop)
    out = folder / "out"
    run = ["run", str(scene), "--out", str(out), "--frames", "0:101:50", "--profile", "--json"]
    status = main([*run, *options])
    assert status == 0
    return json.loads(capsys.readouterr().out)["profile"]


def test_the_profile_has_files_frames_and_times(tmp_path, capsys):
    report = profiled(tmp_path, (), capsys, "--contact", "foundation")
    names = {path.rsplit("/", 1)[-1] for path in report["files"]}
    assert {"scene.toml", "patient.urdf", "motion.csv", "insert.stl"} <= names
    assert report["frames"] == 3 and report["not_modelled"] == []
    parts = {name: seconds for name, seconds in report["seconds"].items() if name != "all"}
    assert {"read", "contact", "equations of motion"} <= set(parts)
    assert abs(sum(parts.values()) - report["seconds"]["all"]) < 1e-6


def test_the_profile_lists_files_outside_the_scene_s_folder(tmp_path, capsys):
    out, scene = tmp_path / "out", write_scene(tmp_path / "scene")
    (tmp_path / "elsewhere").mkdir()
    (scene.parent / "insert.stl").rename(tmp_path / "elsewhere" / "insert.stl")
    scene.write_text(scene.read_text().replace('"insert.stl"', '"../elsewhere/insert.stl"'))
    run = ["run", str(scene), "--out", str(out), "--frames", "0:1", "--profile", "--json"]
    assert main([*run, "--contact", "foundation"]) == 0
    files = json.loads(capsys.readouterr().out)["profile"]["files"]
    assert str(tmp_path / "elsewhere" / "insert.stl") in files
    assert len(files) == len(set(files))
    assert all(path.startswith(str(tmp_path)) for path in files)


def test_a_minimal_scene_reads_only_its_files(tmp_path, capsys):
    muscles = ("quadriceps", "patellar_ligament", "patella")
    drop = ("contact", "implant", "ligament", "tibia", "ground_reaction", *muscles)
    report = profiled(tmp_path, drop, capsys)
    names = {path.rsplit("/", 1)[-1] for path in report["files"]}
    assert names == {"scene.toml", "patient.urdf", "motion.csv"}
    assert "contact" not in report["seconds"] and "prepare contact" not in report["seconds"]
    assert "femorotibial contact" in report["not_modelled"]


def test_the_profile_lists_only_files_that_are_read(tmp_path):
    profile = Profile()
    (tmp_path / "written").write_text("x")
    (tmp_path / "read").write_text("x")
    (tmp_path / "read").read_text()
    opened = [path for path in profile.opened if path.parent == tmp_path]
    assert opened == [tmp_path / "read"]


class Terminal(io.StringIO):
    def isatty(self):
        return True


def run_through(stream):
    """Return the output of three stages, the second with four frames, the third with two plots."""
    with Stages(3, stream) as stages:
        stages.begin("reading")
        assert list(stages.frames(range(4))) == [0, 1, 2, 3]
        assert list(stages.plots("ab")) == ["a", "b"]
    return stream.getvalue()


def test_a_terminal_shows_each_stage_with_its_time_or_a_progress_bar():
    output = run_through(Terminal())
    assert re.search(r"1/3 reading … \d+\.\d s\n", output)
    assert re.search(r"2/3 computing frames: 100%.*4/4 \[\d\d:\d\d<\d\d:\d\d", output)
    assert re.search(r"3/3 writing results and report: 100%.*2/2 \[\d\d:\d\d<", output)


def test_a_pipe_gets_no_output():
    assert run_through(io.StringIO()) == ""
