"""Failures of every open, write, flush, sync and rename.

After a failure the folder has the old or the new results, and the error is one line.
"""

import re
import shutil

import numpy as np
import pytest

from faults import ERRORS, Faults
from lattice_blocks import block
from scenes import write_scene
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.claim import settle
from tkamb.io.mesh_files import write_hexahedra
from tkamb.io.scene import Scene
from tkamb.run.reproduction import verify_results
from tkamb.run.results_folder import read_results
from tkamb.studies.kept_rows import KeptRows

pytestmark = pytest.mark.usefixtures("plain_report")

MOST = 400
"""Upper limit of the number of file operations in a run of two frames."""


@pytest.fixture
def quick_case(monkeypatch):
    """Read scenes and build their recording only once."""
    from tkamb.run import simulation

    parts = ((simulation, "load_case", Scene.model_dump_json), (simulation, "recording_of", id))
    for module, name, key_of in parts:
        cache = {}

        make = getattr(module, name)

        def cached(argument, make=make, key_of=key_of, cache=cache):
            key = key_of(argument)
            if key not in cache:
                cache[key] = make(argument)
            return cache[key]

        monkeypatch.setattr(module, name, cached)


def snapshot(out):
    """Return name -> content of the visible files of a folder."""
    if not out.exists():
        return {}
    return {p.name: p.read_bytes() for p in out.iterdir() if not p.name.startswith(".")}


def check_old_or_new(out, before, frames):
    """Return "old" for unchanged files, or "new" for new results, which are checked."""
    if snapshot(out) == before:
        return "old"
    settle(out)
    verdict = verify_results(out)
    assert not verdict.differs, verdict.lines()
    results = read_results(out)
    assert len(results) == frames
    computed = [not status.startswith("failed: not computed") for status in results.status]
    assert np.isfinite(results["hip_force_si_N"][computed]).all()
    return "new"


def test_a_run_survives_any_fault(tmp_path, monkeypatch, capfd, quick_case):
    """The folder has the results of an earlier run. A resumed run is then complete."""
    scene = write_scene(tmp_path / "scene", ("contact",))
    out = tmp_path / "out"
    first, second = (["run", str(scene), "--out", str(out), "--frames", f] for f in ("0:1", "0:2"))
    assert main(second) == 0
    expected = read_results(out).columns["hip_force_si_N"]
    assert main(first) == 0
    shutil.move(out, tmp_path / "earlier")
    states, kinds = set(), set()
    shutil.copytree(tmp_path / "earlier", out)
    with (every := Faults(out)).injected(monkeypatch):
        assert main(second) == 0
    for number in numbers_of_faults(every.calls):
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(tmp_path / "earlier", out)
        capfd.readouterr()
        before, faults = snapshot(out), Faults(out, number, ERRORS[number % 3])
        with faults.injected(monkeypatch):
            status = main(second)
        if len(faults.calls) <= number:  # the number of writes depends on time
            assert status == 0
            continue
        kinds.add(faults.calls[number][0])
        check_message(status, capfd.readouterr().err, faults.calls[number])
        state = check_old_or_new(out, before, 2)
        states.add(state)
        if number % 9:  # the rest takes a whole run
            continue
        options = ["--resume"] if state == "new" else []
        assert main([*second, *options]) == 0, (faults.calls[number], capfd.readouterr().err)
        assert np.array_equal(read_results(out).columns["hip_force_si_N"], expected)
        assert {p.name for p in out.iterdir() if p.name.startswith(".")} == {".tkamb"}
    assert states == {"old", "new"}
    assert kinds >= {"open", "write", "flush", "fsync", "replace", "mkdir"}


def numbers_of_faults(calls):
    """Return the numbers of the first two and the last call of each operation on each file."""
    numbers = {}
    for number, (what, name) in enumerate(calls):
        kind = re.sub(r"[0-9a-f]{12}|[0-9]{6}", "N", name)  # temporary files, and frames
        numbers.setdefault((what, kind), []).append(number)
    return sorted({n for group in numbers.values() for n in (*group[:2], group[-1])})


def message_of(call):
    """Return the message of a call's InputError; None: no error."""
    try:
        call()
    except InputError as error:
        return str(error)
    return None


def test_a_study_keeps_the_rows_before_and_after_a_failed_write(tmp_path, monkeypatch):
    for number in range(MOST):
        folder = tmp_path / str(number)
        folder.mkdir()
        rows = KeptRows(folder, False)
        rows.put("a", {"x": 1.0})
        faults = Faults(folder, number, ERRORS[number % 3])
        with faults.injected(monkeypatch):
            message = message_of(lambda rows=rows: rows.put("b", {"x": 2.0}))
            assert message is None or "cannot be written" in message
        rows.put("c", {"x": 3.0})
        resumed = KeptRows(folder, True)
        assert resumed.get("a") == {"x": 1.0} and resumed.get("c") == {"x": 3.0}
        assert resumed.get("b") in (None, {"x": 2.0})
        if len(faults.calls) <= number:
            break
    assert number > 1


def test_a_changed_row_counts_as_absent(tmp_path):
    KeptRows(tmp_path, False).put("a", {"x": 1.5})
    path = tmp_path / "rows.jsonl"
    path.write_text(path.read_text().replace("1.5", "1.6"))
    assert KeptRows(tmp_path, True).get("a") is None


def test_a_failed_export_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "export"
    nodes, _, cells, _ = block((2, 1, 2), np.full(3, 1e-3), 0.0)

    def write():
        write_hexahedra(path, nodes, cells, {}, {})

    write()
    new = path.read_bytes()
    for number in range(MOST):
        path.write_bytes(b"old")
        faults = Faults(tmp_path, number, ERRORS[number % 3])
        with faults.injected(monkeypatch):
            message = message_of(write)
            assert message is None or "cannot be written" in message
        if len(faults.calls) <= number:
            break
        assert path.read_bytes() in (b"old", new)
        assert [p.name for p in tmp_path.iterdir()] == ["export"]
    assert number > 1 and path.read_bytes() == new


def check_message(status, output, call):
    """Check that a failure has one line, and that the error is an expected one."""
    assert status in (0, 1, 2), call
    assert output.count("\n") == bool(status), (call, output)
    assert "unexpected error" not in output and "Traceback" not in output, (call, output)
