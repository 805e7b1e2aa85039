"""Killed or interrupted runs: complete files, readable results, and resumed runs."""

import json
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from interrupted_runs import deviations, interrupted
from scenes import fast_scene, write_scene
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.run.maps import read_maps
from tkamb.run.recorder import Shard, Shards, interrupt_later
from tkamb.run.results import Results
from tkamb.run.results_folder import read_results
from tkamb.run.simulation import simulate

pytestmark = pytest.mark.usefixtures("plain_report")

ROOT = Path(__file__).parents[1]
CLOCKS = ("body_seconds", "query_seconds", "contact_seconds")
FRAMES = ("--frames", "0:40:2")
TOTAL = 20


def start(scene, out, *more):
    """Start a run of 20 frames in another process."""
    command = [sys.executable, "-m", "tkamb.cli", "run", str(scene), "--out", str(out)]
    command += [*more, *FRAMES]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def wait_for_frames(process, out, count):
    """Wait until a number of frames is written or the run has ended."""
    while process.poll() is None and len(list((out / ".frames").glob("*.frame"))) < count:
        time.sleep(0.002)


def kill(process):
    process.send_signal(signal.SIGKILL)
    process.communicate()


def check_complete(out):
    """Check that every visible file in the folder can be read and is complete."""
    names = {path.name for path in out.iterdir() if not path.name.startswith(".")}
    known = {
        "results.csv",
        "results.csv-metadata.json",
        "summary.json",
        "contact.h5",
        "report.html",
    }
    assert names <= known
    if "contact.h5" in names:
        maps = read_maps(out / "contact.h5")
        assert np.isfinite(maps.pressure_Pa).all()
    if names >= {"results.csv", "summary.json"}:
        results = read_results(out)
        assert len(results) == TOTAL
        computed = [not status.startswith("failed: not computed") for status in results.status]
        assert computed == sorted(computed, reverse=True)
        assert np.isfinite(results["force_si_N"][computed]).all()
        assert np.isnan(results["force_si_N"][np.invert(computed)]).all()


def check_equal(results: Results, undisturbed: Results, tolerance=0.0):
    """Assert that two results have equal statuses, columns and pressure maps."""
    assert results.status == undisturbed.status
    assert list(results.columns) == list(undisturbed.columns)
    for name in results.columns:
        if name != "status" and name not in CLOCKS:
            np.testing.assert_allclose(
                results[name], undisturbed[name], rtol=tolerance, atol=1e-12, err_msg=name
            )
    if undisturbed.maps is not None:
        peak = np.nanmax(undisturbed.maps.pressure_Pa)
        np.testing.assert_allclose(
            results.maps.pressure_Pa, undisturbed.maps.pressure_Pa, atol=tolerance * peak
        )


@pytest.fixture(scope="module")
def undisturbed():
    """Return the results of the run without interruption."""
    return simulate(fast_scene(), frames=slice(0, 40, 2))


def kill_and_resume(out, waits):
    """Kill and resume a run after each wait (number of frames, seconds), and return its results."""
    for count, seconds in waits:
        process = start(fast_scene(), out, "--resume")
        wait_for_frames(process, out, count)
        time.sleep(seconds)
        kill(process)
        if out.exists():
            check_complete(out)
    process = start(fast_scene(), out, "--resume")
    assert process.wait(timeout=300) == 0, process.stderr.read()
    process.communicate()
    assert not (out / ".frames").exists()
    return read_results(out)


@pytest.mark.slow
def test_a_run_that_is_killed_repeatedly_has_the_results_of_an_undisturbed_run(
    tmp_path, undisturbed
):
    """The kills are at the start, at the first frames, in between and at the end."""
    waits = [(0, 0.5), (1, 0.0), (3, 0.01), (8, 0.03), (14, 0.0), (TOTAL, 0.02)]
    results = kill_and_resume(tmp_path / "out", waits)
    check_equal(results, undisturbed)
    assert results.summary["resumed_frames"] >= 14


@pytest.mark.slow
def test_a_run_killed_at_random_times_has_the_results_of_an_undisturbed_run(tmp_path, undisturbed):
    chance = random.Random(7)
    moments = [(chance.randrange(1, TOTAL + 1), chance.random() ** 2) for _ in range(20)]
    check_equal(kill_and_resume(tmp_path / "out", sorted(moments)), undisturbed)


@pytest.mark.parametrize(
    ("workers", "stops"), [(1, (4,)), pytest.param(2, (2, 5), marks=pytest.mark.slow)]
)
def test_a_lattice_depends_on_its_warm_start_within_the_stated_tolerance(workers, stops):
    """The run is interrupted and resumed, with one and two workers."""
    options = {"contact": "lattice", "resolution_mm": 4.0, "frames": slice(20, 36, 2)}
    reference = simulate(fast_scene(), **options)
    results = interrupted(fast_scene(), stops, workers=workers, **options)
    assert max(deviations(results, reference).values()) <= 1.0
    assert results.summary["resumed_frames"] == sum(stops)


@pytest.mark.slow
def test_a_resumed_run_with_released_coordinates_has_the_same_results(tmp_path):
    scene = write_scene(tmp_path / "scene", contact__released=["adduction"])
    options = {"frames": slice(30, 40, 2)}
    reference = simulate(scene, **options)
    out = tmp_path / "out"
    out.mkdir()
    stop_after(out, 3, scene=scene, **options)
    check_equal(simulate(scene, directory=out, resume=True, **options), reference, tolerance=1e-6)


def stop_after(directory, count, scene=None, **options):
    """Interrupt a run after a number of frames."""

    def progress(indices):
        for number, k in enumerate(indices):
            if number == count:
                raise KeyboardInterrupt
            yield k

    scene = scene or fast_scene()
    with pytest.raises(KeyboardInterrupt, match=f"{count} of "):
        simulate(scene, directory=directory, progress=progress, **options)


def test_an_interrupted_run_leaves_readable_results_and_states_their_number(tmp_path):
    out = tmp_path / "out"
    process = start(fast_scene(), out)
    wait_for_frames(process, out, 4)
    process.send_signal(signal.SIGINT)
    _, output = process.communicate(timeout=60)
    assert process.returncode == 130
    lines = output.decode().strip().splitlines()
    count = int(re.fullmatch(r"tkamb: interrupted: (\d+) of 20 frames .*--resume", lines[-1])[1])
    assert 4 <= count < TOTAL
    check_complete(out)
    results = read_results(out)
    assert len(results.maps) == count
    assert results.summary["unfinished_frames"] == TOTAL - count
    assert [s.startswith("failed: not computed") for s in results.status].index(True) == count


def test_a_run_without_contact_is_resumed(tmp_path):
    scene = write_scene(tmp_path / "scene", ("contact",))
    out = tmp_path / "out"
    out.mkdir()
    stop_after(out, 3, scene=scene, frames=slice(0, 8))
    assert not (out / "contact.h5").exists()
    results = simulate(scene, frames=slice(0, 8), directory=out, resume=True)
    check_equal(results, simulate(scene, frames=slice(0, 8)))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"frames": slice(0, 7)}, "another choice of frames"),
        ({"contact": "hertz"}, "another scene"),
        ({"resolution_mm": 2.0}, "another scene"),
    ],
)
def test_a_run_with_another_identity_is_not_resumed(tmp_path, change, word):
    options = {"frames": slice(0, 8)}
    stop_after(tmp_path, 2, **options)
    with pytest.raises(InputError, match=word):
        simulate(fast_scene(), directory=tmp_path, resume=True, **(options | change))
    assert (tmp_path / ".frames").exists()


def test_a_run_with_a_changed_file_is_not_resumed(tmp_path, capsys):
    scene = write_scene(tmp_path / "scene", ("contact",))
    out = tmp_path / "out"
    out.mkdir()
    stop_after(out, 2, scene=scene, frames=slice(0, 8))
    motion = scene.parent / "motion.csv"
    motion.write_text(motion.read_text() + "\n")
    command = ["run", str(scene), "--out", str(out), "--frames", "0:8", "--resume"]
    assert main(command) == 2
    output = capsys.readouterr().err
    assert "another content of a file" in output and output.count("\n") == 1


def test_a_finished_run_is_not_computed_again(tmp_path, capsys):
    command = ["run", str(fast_scene()), "--out", str(tmp_path), "--frames", "0:3"]
    assert main(command) == 0
    before = (tmp_path / "results.csv").read_bytes()
    assert main([*command, "--resume"]) == 0
    assert (tmp_path / "results.csv").read_bytes() == before
    assert main([*command[:-1], "0:4", "--resume"]) == 2
    assert "another choice of frames" in capsys.readouterr().err


def test_resume_in_an_empty_folder_computes_all_frames(tmp_path):
    results = simulate(fast_scene(), frames=slice(0, 2), directory=tmp_path, resume=True)
    assert len(results) == 2
    with pytest.raises(InputError, match="needs the folder"):
        simulate(fast_scene(), frames=slice(0, 2), resume=True)


def test_a_truncated_frame_counts_as_absent(tmp_path):
    shards = Shards(tmp_path, {"scene": "a"}, resume=False)
    shards.put(3, Shard({"time_s": 0.1, "x": float("nan")}, {"pressure": np.arange(4.0)}))
    shard = shards.get(3)
    assert shard.row["time_s"] == 0.1 and np.isnan(shard.row["x"])
    assert np.array_equal(shard.contact["pressure"], np.arange(4.0))
    path = next((tmp_path / ".frames").glob("*.frame"))
    content = path.read_bytes()
    for size in (0, 10, 40, len(content) - 1):
        path.write_bytes(content[:size])
        assert shards.get(3) is None
    assert shards.get(4) is None


@pytest.mark.parametrize("link", ["symbolic", "hard"])
@pytest.mark.parametrize("name", ["contact.h5", "run.json", "000000.frame"])
def test_a_resumed_run_writes_through_no_link(tmp_path, link, name):
    """The unfinished folder of someone else may hold links to the user's files."""
    mine, out = tmp_path / "mine", tmp_path / "out"
    stop_after(out, 2, frames=slice(0, 4))
    path = out / ".frames" / name
    content = path.read_bytes()
    mine.write_bytes(content)
    path.unlink()
    path.symlink_to(mine) if link == "symbolic" else path.hardlink_to(mine)
    simulate(fast_scene(), frames=slice(0, 4), directory=out, resume=True)
    assert mine.read_bytes() == content


def test_a_frame_with_the_right_hash_that_cannot_be_read_is_damaged(tmp_path):
    stop_after(tmp_path, 3, frames=slice(0, 8))
    identity = json.loads((tmp_path / ".frames" / "run.json").read_text())
    shards = Shards(tmp_path, identity, resume=True)
    path = tmp_path / ".frames" / "000001.frame"
    path.write_bytes(shards._digest(1, b"no archive") + b"no archive")
    with pytest.raises(InputError, match=r"000001\.frame: is damaged.*remove it"):
        simulate(fast_scene(), frames=slice(0, 8), directory=tmp_path, resume=True)


def test_an_interrupt_is_delayed_until_a_frame_is_written():
    written = []

    def write():
        with interrupt_later():
            signal.raise_signal(signal.SIGINT)
            written.append(True)

    with pytest.raises(KeyboardInterrupt):
        write()
    assert written
