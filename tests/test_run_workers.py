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
EFFORT = ("body_seconds", "query_seconds", "contact_seconds", "iterations")


@pytest.fixture(scope="module")
def serial():
    """Return the results of a run in one process."""
    return simulate(SCENE, frames=slice(0, 101, 8))


def numbers(results):
    """Return name -> values of the numeric columns."""
    return {name: results[name] for name in results.columns if KINDS.get(name) != "text"}


def test_two_workers_have_the_results_of_one_process(serial, tmp_path):
    shared = simulate(SCENE, frames=slice(0, 101, 8), directory=tmp_path / "out", workers=2)
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


def test_a_run_with_two_workers_is_resumed_with_one(tmp_path, monkeypatch):
    computed = []

    def stop_after(frames):
        for k in frames:
            if len(computed) == 11:
                raise KeyboardInterrupt
            computed.append(k)
            yield k

    out, frames = tmp_path / "out", slice(0, 101, 8)
    with pytest.raises(KeyboardInterrupt, match="11 of 13 frames are kept"):
        simulate(SCENE, frames=frames, directory=out, workers=2, progress=stop_after)
    results = simulate(SCENE, frames=frames, directory=out, resume=True)
    assert results.summary["resumed_frames"] == 11 and results.summary["unfinished_frames"] == 0
    assert np.isfinite(read_results(out)["force_total_BW"]).all()


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


def test_workers_do_not_repeat_warnings(tmp_path, caplog, capfd):
    scene = write_scene(tmp_path / "knee")
    mesh = scene.parent / "insert.stl"
    content, record = mesh.read_bytes(), 50
    count = int.from_bytes(content[80:84], "little") + 1
    duplicate = content[84 : 84 + record]
    mesh.write_bytes(content[:80] + count.to_bytes(4, "little") + content[84:] + duplicate)
    simulate(scene, frames=slice(0, 96, 8), workers=2)
    assert [message for message in caplog.messages if "duplicate" in message]
    assert "duplicate" not in capfd.readouterr().err
