"""Errors as one line: closed streams, unusual files, unexpected exceptions."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import tkamb.__main__
from scenes import MODEL, fast_scene, write_scene
from tkamb import files
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.files import read_bytes, read_xml
from tkamb.io.recordings.tables import read_table
from tkamb.run.guard import interrupt_as_such, printable, terminated_as_interrupted
from tkamb.run.press import PressReport
from tkamb.run.results_folder import read_results
from tkamb.run.simulation import simulate

pytestmark = pytest.mark.usefixtures("plain_report")

ROOT = Path(__file__).parents[1]
MESHES = [str(MODEL / name) for name in ("femoral_component.stl", "insert.stl")]


def shell(command, cwd):
    """Run a shell command with the program for TKAMB; return status, stdout and stderr."""
    line = command.replace("TKAMB", f"{sys.executable} -m tkamb.cli")
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.run(
        ["bash", "-c", line], cwd=cwd, env=environment, capture_output=True, text=True, timeout=120
    )
    return process.returncode, process.stdout, process.stderr


@pytest.mark.parametrize(
    ("command", "status", "lines"),
    [
        ("TKAMB contact list > /dev/full", 1, 1),
        ("TKAMB --version > /dev/full", 1, 1),
        ("TKAMB scene --schema >&-", 1, 1),
        ("TKAMB scene --schema 2>&-", 0, 0),
        ("TKAMB scene --schema <&- >&- 2>&-", 1, 0),
        ("TKAMB run nothing.toml 2> /dev/full", 2, 0),
        ("TKAMB run nothing.toml 2>&-", 2, 0),
        ("TKAMB run nothing.toml >&-", 2, 1),
        ("PYTHONIOENCODING=ascii TKAMB contact list", 0, 0),
        ("set -o pipefail; TKAMB scene --schema | head -1", 0, 0),
        ("TKAMB run $'no\\xffsuch.toml'", 2, 1),
        ("TKAMB run $'a\\x1b[31m.toml'", 2, 1),
    ],
)
def test_closed_and_full_streams_give_at_most_one_line(tmp_path, command, status, lines):
    exit_status, _, output = shell(command, tmp_path)
    assert exit_status == status, output
    assert output.count("\n") == lines and "Traceback" not in output, output
    assert "\x1b" not in output
    assert not list(tmp_path.iterdir())


def test_control_characters_in_names_are_escaped(tmp_path):
    name = tmp_path / "a\x1b[31m\x9b1m\u202e.stl"
    shutil.copy(MESHES[1], name)
    exit_status, printed, _ = shell("TKAMB mesh check *.stl", tmp_path)
    assert exit_status == 0 and "a\\u001b[31m\\u009b1m\\u202e.stl" in printed
    assert printed.replace("\n", "").isprintable()
    assert printable("3\u00a0°\t\n") == "3\u00a0°\t\n"
    assert json.loads(f'"{printable(chr(0x9B) + chr(0x7F))}"') == "\x9b\x7f"


def test_a_load_that_is_not_carried_is_reported_on_standard_error(capfd, monkeypatch):
    monkeypatch.setattr(PressReport, "carried", False)
    line = ["press", *MESHES, "--load", "10", "--resolution", "9", "--contact", "foundation"]
    assert main(line) == 1
    printed, output = capfd.readouterr()
    assert printed and output.count("\n") == 1 and "not carried" in output


def test_an_interrupt_during_the_imports_is_one_line(monkeypatch, capsys):

    class Interrupted:
        def find_spec(self, name, path=None, target=None):
            if name == "tkamb.cli":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "tkamb.cli")
    monkeypatch.setattr(sys, "meta_path", [Interrupted(), *sys.meta_path])
    assert tkamb.__main__.main() == 130
    output = capsys.readouterr().err
    assert output.startswith("tkamb: interrupted") and output.count("\n") == 1


def refused(capfd, *arguments):
    """Return the message of a command that must end with status 2 and one line."""
    assert main([str(argument) for argument in arguments]) == 2
    output = capfd.readouterr().err
    assert output.count("\n") == 1 and output.startswith("tkamb: ")
    return output


@pytest.mark.parametrize("kind", ["fifo", "device", "folder", "socketless link", "nul", "long"])
def test_paths_that_are_no_regular_files_are_refused(tmp_path, capfd, kind):
    path = tmp_path / "odd"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "device":
        path = Path("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    elif kind == "socketless link":
        path.symlink_to(path)
    else:
        path = tmp_path / ("a\0b" if kind == "nul" else "n" * 256)
    assert "odd" in refused(capfd, "run", path, "--out", tmp_path / "o") or kind != "fifo"
    refused(capfd, "press", path, MESHES[1], "--load", 100)
    refused(capfd, "press", *MESHES, "--load", 100, "--pose-file", path)
    refused(capfd, "mesh", "check", path)
    refused(capfd, "verify", path)
    refused(capfd, "report", path)
    refused(capfd, "methods", path)
    refused(capfd, "export", path, "--vtp", "--out", tmp_path / "o")
    refused(capfd, "compare", path, path, "--out", tmp_path / "o")
    refused(
        capfd, "run", MODEL / "scene.toml", "--set", f"patient.urdf='{path}'".replace("\0", "x")
    )
    refused(capfd, "run", MODEL / "scene.toml", "--set", f"motion.file='{path}'".replace("\0", "x"))
    assert not (tmp_path / "o").exists()


def test_large_files_are_refused_before_they_are_read(tmp_path, capfd):
    for name in ("scene.toml", "motion.csv", "mesh.stl", "leg.urdf"):
        os.truncate(os.open(tmp_path / name, os.O_CREAT | os.O_WRONLY), 2_000_000_000)
    out = ("--out", tmp_path / "o")  # no other process writes there
    assert "MB large" in refused(capfd, "run", tmp_path / "scene.toml", *out)
    assert "MB large" in refused(capfd, "press", tmp_path / "mesh.stl", MESHES[1], "--load", 1)
    for key, name in (("motion.file", "motion.csv"), ("patient.urdf", "leg.urdf")):
        setting = f"{key}='{tmp_path / name}'"
        assert "MB large" in refused(capfd, "run", MODEL / "scene.toml", "--set", setting, *out)


def test_a_table_with_a_hundred_thousand_columns_is_read(tmp_path):
    path = tmp_path / "wide.csv"
    names = [f"c{k}" for k in range(100_000)]
    path.write_text(",".join(names) + "\n" + ",".join("1" for _ in names) + "\n")
    assert read_table(path).columns["c99999"] == [1.0]
    path.write_text(",".join([*names, "c5"]) + "\n" + ",".join("1" for _ in [*names, ""]) + "\n")
    with pytest.raises(InputError, match="two columns named 'c5'"):
        read_table(path).column("c5")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<a>" * 100_000 + "</a>" * 100_000, "nests elements"),
        ("<robot>" + "<link>" * 200 + "</link>" * 200 + "</robot>", "nests elements"),
        ("", "not a readable"),
        ("<robot>", "not a readable"),
        ('<?xml version="1.0" encoding="no-such"?><robot/>', "not a readable"),
    ],
)
def test_deeply_nested_or_truncated_xml_is_refused(tmp_path, text, words):
    path = tmp_path / "a.xml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_xml(path)


def test_a_deeply_nested_scene_is_refused(tmp_path, capfd):
    path = tmp_path / "scene.toml"
    path.write_text("a = " + "[" * 100_000)
    assert "nests values" in refused(capfd, "run", path)


def test_a_file_one_byte_above_the_limit_is_refused(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(bytes(11))
    assert len(read_bytes(path, 11)) == 11
    with pytest.raises(InputError, match="large"):
        read_bytes(path, 10)
    assert files.sha256_of(path) == files.hashlib.sha256(bytes(11)).hexdigest()


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            ZeroDivisionError("float division"),
            "unexpected error: ZeroDivisionError: float division",
        ),
        (MemoryError(), "not enough memory"),
        (RecursionError("too deep"), "RecursionError"),
        (OSError(5, "Input/output error"), "Input/output error"),
        (KeyError("many\nlines"), "KeyError"),
    ],
)
def test_an_unexpected_error_is_one_line_and_a_log(tmp_path, monkeypatch, capfd, error, words):
    def fails(*_):
        raise error

    monkeypatch.setattr("tkamb.run.simulation.load_case", fails)
    scene = write_scene(tmp_path / "scene", ("contact",))
    assert main(["run", str(scene), "--out", str(tmp_path / "out")]) == 1
    output = capfd.readouterr().err
    assert output.count("\n") == 1 and words in output
    (log,) = (tmp_path / "out").glob("tkamb-error-*.log")
    assert str(log) in output
    assert "Traceback" in log.read_text() and "load_case" in log.read_text()


def test_version_prints_the_name_and_ends_with_status_0(capsys):
    with pytest.raises(SystemExit) as exit_status:
        main(["--version"])
    assert exit_status.value.code == 0
    assert capsys.readouterr().out.startswith("tkamb ")


def test_an_interrupt_within_a_compiled_loop_is_a_keyboard_interrupt():
    """Python raises a SystemError with the cause KeyboardInterrupt."""

    def loop(cause):
        try:
            raise SystemError("returned a result with an exception set") from cause
        except SystemError as first:
            raise SystemError("returned a result with an exception set") from first

    with pytest.raises(KeyboardInterrupt), interrupt_as_such():
        loop(KeyboardInterrupt())
    with pytest.raises(SystemError), interrupt_as_such():
        loop(ValueError())


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (["--axes", "-x,+y,-z"], "write --mesh-axes=VALUE if the value begins with -"),
        (["--pose=0,30,1"], "give 6 values, with spaces between"),
    ],
)
def test_a_value_that_the_parser_does_not_read_has_a_remedy(capsys, value, words):
    with pytest.raises(SystemExit) as ended:
        main(["press", "femoral.stl", "insert.stl", "--load", "100", *value])
    assert ended.value.code == 2
    assert words in capsys.readouterr().err


def test_a_folder_of_a_scene_has_its_run_as_remedy(tmp_path, capsys):
    (tmp_path / "scene.toml").touch()
    assert main(["report", str(tmp_path)]) == 2
    assert f"tkamb run {tmp_path / 'scene.toml'}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)]
)
def test_a_terminated_live_window_leaves_nothing(tmp_path, number):
    command = [sys.executable, "-m", "tkamb.cli", "live", str(fast_scene()), "--out", "kept"]
    environment = os.environ | {"TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT), "BROWSER": "true"}
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True
    )
    while not (line := process.stderr.readline()).startswith("tkamb: live:"):
        assert line
    assert list(tmp_path.glob("tkamb-live-*"))
    process.send_signal(number)
    _, output = process.communicate(timeout=60)
    assert process.returncode == 130 and output.splitlines()[-1].startswith("tkamb: interrupted")
    assert not list(tmp_path.iterdir())


def test_a_terminated_run_publishes_its_frames(tmp_path):
    scene, out = fast_scene(), tmp_path / "out"

    def terminated(frames):
        for k in frames:
            if k == 3:
                signal.raise_signal(signal.SIGTERM)
            yield k

    with (
        pytest.raises(KeyboardInterrupt, match="3 of 6 frames"),
        terminated_as_interrupted(),
    ):
        simulate(scene, frames=slice(0, 6), directory=out, progress=terminated)
    assert len(read_results(out).maps) == 3
