"""Output folders: ownership, one writer at a time, and files that change together."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tkamb import files
from tkamb.errors import InputError
from tkamb.files import JOURNAL, MARKER, replaced_file, replaced_together
from tkamb.io.claim import claimed_directory, settle

ROOT = Path(__file__).parents[1]

HOLD = """
import sys
from tkamb.io.claim import claimed_directory
with claimed_directory(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


def names(folder):
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def holder(tmp_path):
    """Start another process that locks the folder `out`."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "out")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=ROOT,
    )
    assert process.stdout.readline() == b"held\n"
    yield process
    process.kill()
    process.communicate()


def test_only_one_process_writes_at_a_time(tmp_path, holder):
    with (
        pytest.raises(InputError, match="another tkamb is writing"),
        claimed_directory(tmp_path / "out"),
    ):
        pass
    assert names(tmp_path / "out") == {MARKER}
    holder.kill()  # SIGKILL: the system releases the lock
    holder.wait()
    with claimed_directory(tmp_path / "out") as folder:
        assert (folder / MARKER).is_file()


def test_a_thread_may_lock_a_folder_twice(tmp_path):
    with claimed_directory(tmp_path / "out") as outer, claimed_directory(tmp_path / "out") as inner:
        assert outer == inner


def test_a_foreign_folder_is_refused_without_force(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    refused = pytest.raises(InputError, match=r"not tkamb's own .*thesis.tex.*force=True")
    with refused, claimed_directory(tmp_path):
        pass
    assert names(tmp_path) == {"thesis.tex"}
    with claimed_directory(tmp_path, force=True):
        pass
    with claimed_directory(tmp_path):  # the marker makes the folder tkamb's own
        pass
    assert (tmp_path / "thesis.tex").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "text", "ours"),
    [
        ("summary.json", '{"versions": {"tkamb": "0.0.9"}}', True),
        (".frames/run.json", '{"version of tkamb": "0.0.9"}', True),
        ("rows.jsonl", '{"key": "a", "row": {}}\n', True),
        ("summary.json", '{"versions": {"opensim": "4.6"}}', False),
        ("summary.json", "[" * 100_000, False),
        ("results.csv", "time_s\n", False),
        (".frames/holiday.jpg", "", False),
    ],
)
def test_folders_of_earlier_releases_are_recognised(tmp_path, name, text, ours):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    if ours:
        with claimed_directory(tmp_path):
            pass
        return
    with pytest.raises(InputError, match="not tkamb's own"), claimed_directory(tmp_path):
        pass


@pytest.mark.parametrize("exists", [False, True])
def test_bad_input_leaves_no_new_file_or_folder(tmp_path, exists):
    out = tmp_path / "a" / "out"
    if exists:
        out.mkdir(parents=True)
    with pytest.raises(InputError), claimed_directory(out):
        raise InputError("bad")
    assert names(tmp_path) == ({"a"} if exists else set())
    assert not exists or not names(out)


def test_only_temporary_files_of_tkamb_are_removed(tmp_path):
    others = [".results.csv.12.part", ".tkamb-notes.part", ".backup.part"]
    for name in (".tkamb-0123456789ab.part", *others):
        (tmp_path / name).write_text("x")
    link = tmp_path / ".tkamb-0123456789ac.part"
    link.symlink_to(tmp_path / ".backup.part")
    with claimed_directory(tmp_path, force=True):
        assert names(tmp_path) == {MARKER, link.name, *others}


@pytest.mark.parametrize("kind", ["link", "hard link", "fifo", "folder"])
def test_a_marker_that_is_no_file_is_refused(tmp_path, kind):
    out = tmp_path / "out"
    out.mkdir()
    marker = out / MARKER
    (tmp_path / "precious").write_text("mine")
    if kind == "link":
        marker.symlink_to(tmp_path / "precious")
    elif kind == "hard link":
        marker.hardlink_to(tmp_path / "precious")
    elif kind == "fifo":
        os.mkfifo(marker)
    else:
        marker.mkdir()
    with pytest.raises(InputError), claimed_directory(out):
        pass
    assert (tmp_path / "precious").read_text() == "mine"


@pytest.mark.parametrize("name", ["x" * 300, "nul\0"])
def test_an_impossible_folder_name_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="cannot be written"), claimed_directory(tmp_path / name):
        pass
    assert not names(tmp_path)


def write_two(folder, text):
    with replaced_together(folder) as files:
        for name in ("results.csv", "summary.json"):
            files.path(name).write_text(text)
        files.remove("report.html")


def test_files_change_together(tmp_path):
    (tmp_path / "report.html").write_text("old")
    write_two(tmp_path, "new")
    assert names(tmp_path) == {"results.csv", "summary.json"}

    def half():
        with replaced_together(tmp_path) as files:
            files.path("results.csv").write_text("newer")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        half()
    assert (
        names(tmp_path) == {"results.csv", "summary.json"}
        and (tmp_path / "results.csv").read_text() == "new"
    )


def test_interrupted_renames_are_completed_later(tmp_path, monkeypatch):
    for renames in range(1, 4):
        folder = tmp_path / str(renames)
        folder.mkdir()
        (folder / MARKER).touch()
        write_two(folder, "old")
        (folder / "report.html").write_text("old")
        remaining = [renames]
        replace = os.replace

        def dying(source, target, remaining=remaining, replace=replace):
            if remaining[0] == 0:
                raise SystemExit
            remaining[0] -= 1
            replace(source, target)

        with monkeypatch.context() as patch:
            patch.setattr(files.os, "replace", dying)
            with pytest.raises(SystemExit) if renames < 3 else pytest.MonkeyPatch.context():
                write_two(folder, "new")
        settle(folder)
        assert {name: (folder / name).read_text() for name in ("results.csv", "summary.json")} == {
            "results.csv": "new",
            "summary.json": "new",
        }
        assert not (folder / "report.html").exists() and not (folder / JOURNAL).exists()


@pytest.mark.parametrize(
    "content",
    [
        "no JSON",
        json.dumps({"written": {"../results.csv": ".tkamb-0123456789ab.part"}, "removed": []}),
        json.dumps({"written": {}, "removed": ["thesis.tex"]}),
        json.dumps({"written": {"results.csv": "thesis.tex"}, "removed": []}),
    ],
)
def test_a_journal_that_names_other_files_than_tkambs_changes_nothing(tmp_path, content):
    (tmp_path / "thesis.tex").write_text("mine")
    (tmp_path / MARKER).touch()
    (tmp_path / JOURNAL).write_text(content)
    with pytest.raises(InputError, match=r"is damaged|as JSON"):
        settle(tmp_path)
    assert names(tmp_path) == {"thesis.tex", MARKER, JOURNAL}


def test_a_long_name_can_be_written(tmp_path):
    path = tmp_path / ("n" * 250 + ".html")
    with replaced_file(path) as temporary:
        temporary.write_text("x")
    assert path.read_text() == "x"
    with pytest.raises(InputError, match="cannot be written"):
        files.write_text(tmp_path / ("n" * 256), "x")
    assert names(tmp_path) == {path.name}


def test_text_with_bytes_that_are_not_utf8_can_be_written(tmp_path):
    files.write_text(tmp_path / "a.json", json.dumps({"f": "\udcff"}, ensure_ascii=False))
    assert json.loads((tmp_path / "a.json").read_text()) == {"f": "\udcff"}
