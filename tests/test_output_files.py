"""No command replaces foreign files. A command that fails does not change any file."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from pendulum_leg import changed, recorded_leg
from scenes import write_scene
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.claim import check_output_file
from tkamb.io.importing import patient as importing


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def imported(tmp_path: Path) -> list[str]:
    """Import a leg, and return the arguments."""
    arguments = recorded_leg(tmp_path)
    assert main(arguments) == 0
    return arguments


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("patient.urdf", b"<robot name='somebody'/>"),
        ("patient.urdf", b"\xff\xfe no text \r\n"),
        ("patient.urdf", b""),
        ("scene.toml", b"# mine\r\n"),
        ("motion.csv", b"time,flexion\r\n0,0\r\n"),
    ],
)
def test_import_replaces_no_file_of_somebody_else(tmp_path, capsys, name, content):
    arguments = recorded_leg(tmp_path)
    if name == "motion.csv":
        time = np.linspace(0.0, 1.0, 41)
        from tkamb.show.storage import write_storage

        write_storage(tmp_path / "b.mot", {"time": time, "knee_r_0": -time}, False)
        arguments = changed(arguments, trc=None, motion=str(tmp_path / "b.mot"))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_bytes(content)
    (tmp_path / "out" / "notes.txt").write_bytes(b"\r\n")
    before = contents(tmp_path / "out")
    assert main(arguments) == 2
    output = capsys.readouterr().err
    assert f"{name}: exists already" in output and "choose another --out" in output
    assert contents(tmp_path / "out") == before


def test_another_subject_in_the_same_folder_is_refused(tmp_path, capsys):
    arguments = imported(tmp_path)
    before = contents(tmp_path / "out")
    heavier = changed(arguments, mass_kg="70", scene="other.toml")
    assert main(heavier) == 2
    assert "patient.urdf: exists already with another content" in capsys.readouterr().err
    assert contents(tmp_path / "out") == before


def test_two_trials_of_one_subject_share_the_patient(tmp_path):
    arguments = imported(tmp_path)
    urdf = (tmp_path / "out" / "patient.urdf").stat()
    assert main(changed(arguments, scene="again.toml", interval="0.1:0.8")) == 0
    assert (tmp_path / "out" / "patient.urdf").stat().st_ino == urdf.st_ino
    assert (tmp_path / "out" / "again.toml").is_file()


@pytest.mark.parametrize("kind", ["dangling link", "folder"])
def test_a_link_or_folder_is_not_replaced(tmp_path, kind):
    arguments, place = recorded_leg(tmp_path), tmp_path / "out" / "patient.urdf"
    place.parent.mkdir()
    place.symlink_to(tmp_path / "elsewhere") if kind == "dangling link" else place.mkdir()
    assert main(arguments) == 2
    assert place.is_symlink() or place.is_dir()
    assert not (tmp_path / "elsewhere").exists()
    assert [p.name for p in place.parent.iterdir()] == ["patient.urdf"]


@pytest.mark.parametrize("error", [InputError("wrong"), KeyboardInterrupt(), ZeroDivisionError()])
@pytest.mark.parametrize("shared", [False, True])
def test_a_failing_import_leaves_the_folder_as_it_was(tmp_path, monkeypatch, error, shared):
    arguments = recorded_leg(tmp_path)
    if shared:
        assert main(arguments) == 0
        arguments = changed(arguments, scene="second.toml")
    before = contents(tmp_path / "out")

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(importing, "load_case", fail)
    monkeypatch.chdir(tmp_path)
    assert main(arguments) != 0
    after = contents(tmp_path / "out")
    logs = [name for name in after if name.startswith("tkamb-error-")]  # of unexpected errors
    assert {name: text for name, text in after.items() if name not in logs} == before


@pytest.mark.parametrize(
    "name", ["../scene.toml", "/tmp/scene.toml", "patient.urdf", "a/b.toml", ""]
)
def test_a_scene_name_with_a_folder_or_another_suffix_is_refused(tmp_path, capsys, name):
    assert main(changed(recorded_leg(tmp_path), scene=name)) == 2
    assert "--scene" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.fixture
def meshes(tmp_path) -> tuple[str, str]:
    """Return a ball and a plate as files, mm."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=20.0)
    ball.apply_translation([0, 30, 0])
    plate = trimesh.creation.box([40, 10, 40])
    paths = tmp_path / "ball.stl", tmp_path / "plate.stl"
    for mesh, path in zip((ball, plate), paths, strict=True):
        mesh.export(path)
    return str(paths[0]), str(paths[1])


def commands(meshes: tuple[str, str]) -> dict[str, list[str]]:
    drop = ("contact", "implant", "patella", "patellar_ligament", "quadriceps", "ligament")
    scene = write_scene(Path(meshes[0]).parent / "scene", drop)
    return {
        "map.vtp": ["press", *meshes, "--load=100", "--contact=foundation", "--resolution=2"],
        "grid.vtu": ["mesh", "lattice", meshes[1], "--resolution=4"],
        "check.html": ["check", str(scene)],
    }


@pytest.mark.parametrize("name", ["map.vtp", "grid.vtu", "check.html"])
def test_a_command_replaces_its_own_file_alone(tmp_path, meshes, capsys, name):
    place, command = tmp_path / name, commands(meshes)[name]
    foreign = b"<VTKFile>somebody's mesh</VTKFile>"
    place.write_bytes(foreign)
    assert main([*command, f"--out={place}"]) == 2
    assert "tkamb did not write it" in capsys.readouterr().err
    assert place.read_bytes() == foreign
    assert main([*command, f"--out={place}", "--force"]) == 0
    written = place.read_bytes()
    assert written != foreign
    assert main([*command, f"--out={place}"]) == 0  # The file is now tkamb's own.


@pytest.mark.parametrize(
    ("name", "content", "allowed"),
    [
        ("a.png", b"\x89PNG\r\n\x1a\n picture", True),
        ("a.png", b"notes", False),
        ("a.gif", b"GIF89a", True),
        ("a.mp4", b"\x00\x00\x00\x20ftypisom", True),
        ("a.mp4", b"notes", False),
        ("a.html", b"<html>my page</html>", False),
        ("a.html", b'<html><meta name="generator" content="tkamb">', True),
        ("a.inp", b"*HEADING\nmy own deck", False),
        ("a.inp", b"** run; written by tkamb; mm, N, MPa.", True),
        ("a.vtp", b"", True),
    ],
)
def test_only_files_of_tkamb_are_replaced(tmp_path, name, content, allowed):
    (tmp_path / name).write_bytes(content)
    if allowed:
        check_output_file(tmp_path / name)
    else:
        with pytest.raises(InputError, match="did not write it"):
            check_output_file(tmp_path / name)
    check_output_file(tmp_path / name, force=True)
    check_output_file(tmp_path / "new.vtp")


def test_a_folder_is_not_replaced_by_a_file(tmp_path):
    (tmp_path / "a.vtp").mkdir()
    with pytest.raises(InputError, match="is not a file"):
        check_output_file(tmp_path / "a.vtp", force=True)
