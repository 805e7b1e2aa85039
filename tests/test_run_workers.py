"""`tkamb run --workers`: results with several processes, and errors of workers."""

import functools
from contextlib import suppress

import numpy as np
import pytest

from scenes import fast_scene, write_scene
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.scene import load_scene
from tkamb.run.columns import KINDS
from tkamb.run.results_folder import read_results
from tkamb.run.simulation import simulate
from tkamb.run.workers import PoolOptions, Task

SCENE = fast_scene()
FRAMES = slice(0, 101, 12)
EFFORT = ("body_seconds", "query_seconds", "contact_seconds", "iterations")


def numbers(results):
    """Return name -> values of the numeric columns."""
    return {name: results[name] for name in results.columns if KINDS.get(name) != "text"}


def doubled_facet(folder):
    """Return the shipped scene with an insert that is read with a warning."""
    scene, record = write_scene(folder), 50
    mesh = scene.parent / "insert.stl"
    content = mesh.read_bytes()
    count = int.from_bytes(content[80:84], "little") + 1
    duplicate = content[84 : 84 + record]
    mesh.write_bytes(content[:80] + count.to_bytes(4, "little") + content[84:] + duplicate)
    return scene


def test_two_workers_resumed_with_one_have_the_results_of_one_process(
    tmp_path, caplog, capfd, monkeypatch
):
    """Two workers are interrupted. Their frames, and the last ones, are those of one process.

    Workers do not repeat the warnings of this process.
    """
    computed, scene, out = [], doubled_facet(tmp_path / "knee"), tmp_path / "out"

    def stop_after(frames):
        for k in frames:
            if len(computed) == 7:
                raise KeyboardInterrupt
            computed.append(k)
            yield k

    with pytest.raises(KeyboardInterrupt, match="7 of 9 frames are kept"):
        simulate(scene, frames=FRAMES, directory=out, workers=2, progress=stop_after)
    assert [message for message in caplog.messages if "duplicate" in message]
    assert "duplicate" not in capfd.readouterr().err
    shared = simulate(scene, frames=FRAMES, directory=out, resume=True)
    assert shared.summary["resumed_frames"] == 7 and shared.summary["unfinished_frames"] == 0
    assert np.isfinite(read_results(out)["force_total_BW"]).all()
    serial = simulate(SCENE, frames=FRAMES)
    assert list(shared["status"]) == list(serial["status"])
    for name, values in numbers(shared).items():
        if name not in EFFORT:
            scale = np.nanmax(np.abs(serial[name]), initial=1e-12)
            np.testing.assert_allclose(
                values, serial[name], rtol=0, atol=1e-5 * scale, err_msg=name
            )
    largest = np.nanmax(serial.maps.pressure_Pa)
    assert np.nanmax(np.abs(shared.maps.pressure_Pa - serial.maps.pressure_Pa)) < 1e-5 * largest


def test_a_bad_number_of_workers_is_refused_before_the_folder_is_created(tmp_path, capsys):
    assert main(["run", str(SCENE), "--workers", "0", "--out", str(tmp_path / "out")]) == 2
    assert "--workers" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_pool_starts_its_workers_immediately_and_ends_them_with_its_block():
    task, jobs = Task(functools.partial, (max,)), [(n, 10 - n) for n in range(10)]
    with PoolOptions(2).team(task, len(jobs)) as team:
        answers = dict(team.answers(jobs))
    assert answers == {n: max(n, 10 - n) for n in range(10)}
    with suppress(RuntimeError), PoolOptions(2).team(task, len(jobs)) as team:
        assert [process.poll() for process in team.processes] == [None, None]
        raise RuntimeError
    assert all(process.poll() is not None for process in team.processes)
    with PoolOptions(1).team(task, len(jobs)) as team:
        assert not team.processes and dict(team.answers(jobs)) == answers


def test_an_error_in_the_preparation_is_raised_by_the_caller(tmp_path, capfd):
    missing = tmp_path / "scene.toml"
    with pytest.raises(InputError, match="no such scene file") as caught:
        list(PoolOptions(2).answers(Task(load_scene, (missing,)), [(0, None), (1, None)]))
    assert caught.value.where == missing
    assert capfd.readouterr().err == ""


def test_an_error_in_a_job_is_raised_by_the_caller():
    with pytest.raises(InputError, match="workers: cannot be 0"):
        list(
            PoolOptions(2).answers(Task(functools.partial, (PoolOptions,)), [(0, None), (0, None)])
        )
