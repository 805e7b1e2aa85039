"""Jobs over a Dask cluster: the same answers as here, whatever dies."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from test_uncertainty import SCENE, bodies_alone
from tkamb.cli import main
from tkamb.errors import ComputationError, InputError
from tkamb.run import workers as cluster
from tkamb.run.workers import PoolOptions, Task
from tkamb.studies.uncertainty.run import estimate_uncertainty


class Adder:
    """Adds its base to what it is given, after a while."""

    made = 0

    def __init__(self, base, seconds=0.0):
        type(self).made += 1
        self.base, self.seconds = base, seconds

    def __call__(self, number, job):
        time.sleep(self.seconds)
        return number, self.base + job, os.getpid()


def distributed():
    return pytest.importorskip("distributed", reason="Dask is not installed")


def test_answers_of_a_cluster_are_those_of_this_process_and_preparation_is_done_once():
    with distributed().LocalCluster(
        n_workers=1, threads_per_worker=4, processes=False, dashboard_address=None
    ) as place:
        Adder.made = 0
        task, wanted = Task(Adder, (10,)), [(n, n**2) for n in range(20)]
        there = dict(PoolOptions(1, place.scheduler_address).answers(task, wanted))
        assert Adder.made == 1
        assert there == dict(PoolOptions(1).answers(task, wanted))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense"])
def test_a_scheduler_that_is_not_there_is_one_line(address, tmp_path, monkeypatch, capsys):
    distributed()
    monkeypatch.setattr(cluster, "CLUSTER", replace(cluster.CLUSTER, answer_seconds=0.5))
    folder = tmp_path / "out"
    assert main(["uncertainty", str(SCENE), "--dask", address, "--out", str(folder)]) == 2
    said = capsys.readouterr().err.strip()
    assert "no Dask scheduler answers" in said and "\n" not in said
    assert not folder.exists()


def test_without_dask_the_install_line_is_given(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'tkamb\[cluster\]'"):
        PoolOptions(1, "local").check()


def test_workers_are_counted():
    for wrong in (0, 1000):
        with pytest.raises(InputError, match="workers"):
            PoolOptions(wrong)


@pytest.mark.slow
def test_a_worker_killed_in_the_middle_changes_nothing():
    module = distributed()
    with module.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as place:
        scene = bodies_alone(uncertainty__ligament_strain=0.02)
        options = {"samples": 40, "frames": slice(0, 101, 25)}
        seen = []

        def kill_one(samples, count):
            for index, one in enumerate(samples):
                if index == 5:
                    with module.Client(place.scheduler_address, set_as_default=False) as client:
                        os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
                seen.append(one[0])
                yield one

        there = estimate_uncertainty(
            scene, **options, dask=place.scheduler_address, progress=kill_one
        )
    assert sorted(seen) == list(range(40))
    here = estimate_uncertainty(scene, **options)
    for name, band in here.bands.items():
        np.testing.assert_array_equal(band, there.bands[name])


ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}


@pytest.fixture
def start(tmp_path):
    """Give what starts a scheduler with one worker, processes of their own, and its address."""
    distributed()
    python, quiet = [sys.executable, "-m"], ["--no-dashboard"]
    running = []

    def started():
        file = tmp_path / f"scheduler{len(running)}.json"
        command = ["distributed.cli.dask_scheduler", "--port", "0", "--scheduler-file", str(file)]
        scheduler = subprocess.Popen([*python, *command, *quiet])
        running.append(scheduler)
        while not file.exists() and scheduler.poll() is None:
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        command = ["distributed.cli.dask_worker", address, "--nthreads", "1"]
        running.append(subprocess.Popen([*python, *command, *quiet], env=ENVIRONMENT))
        return scheduler, address

    yield started
    for process in reversed(running):
        process.kill()
        process.wait()


@pytest.mark.slow
def test_a_scheduler_started_anew_and_a_client_gone_and_back_lose_and_double_nothing(
    start, tmp_path
):
    scene, folder = bodies_alone(uncertainty__ligament_strain=0.02), tmp_path / "out"
    options = {"samples": 120, "frames": slice(None)}
    scheduler, address = start()

    def killing(samples, count):
        for index, one in enumerate(samples):
            if index == 5:
                scheduler.kill()
            yield one

    with pytest.raises(ComputationError, match="go on with resume=True"):
        estimate_uncertainty(scene, **options, dask=address, directory=folder, progress=killing)
    first = _kept(folder)
    assert 5 <= first < 120
    _, address = start()
    client = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "from test_uncertainty import bodies_alone\n"
            "from tkamb.studies.uncertainty.run import estimate_uncertainty\n"
            "estimate_uncertainty(bodies_alone(uncertainty__ligament_strain=0.02), samples=120, "
            f"resume=True, directory={str(folder)!r}, dask={address!r})",
        ],
        env=ENVIRONMENT,
    )
    while _kept(folder) < first + 5 and client.poll() is None:
        time.sleep(0.02)
    client.kill()
    client.wait()
    second, counted = _kept(folder), []
    assert first < second < 120

    def counting(samples, count):
        for one in samples:
            counted.append(one[0])
            yield one

    there = estimate_uncertainty(
        scene, **options, dask=address, directory=folder, resume=True, progress=counting
    )
    assert len(set(counted)) == len(counted) == 120 - second
    here = estimate_uncertainty(scene, **options)
    for name, band in here.bands.items():
        np.testing.assert_array_equal(band, there.bands[name])
    assert main(["verify", str(folder)]) == 0


def _kept(folder):
    """Return how many samples a folder holds."""
    return len(list(folder.glob(".frames/*.frame")))


@pytest.mark.slow
def test_a_scheduler_killed_in_the_middle_is_said_in_one_line(start):
    scheduler, address = start()
    found = []

    def killing(answers):
        for one in answers:
            found.append(one)
            if len(found) == 5:
                scheduler.kill()
            yield one

    answers = PoolOptions(1, address).answers(Task(Adder, (1, 0.1)), [(n, n) for n in range(400)])
    with pytest.raises(ComputationError, match="scheduler has ended"):
        list(killing(answers))
    assert 5 <= len(found) < 400


@pytest.mark.slow
def test_a_local_cluster_of_processes_gives_the_same_tables():
    distributed()
    scene = bodies_alone(uncertainty__segment_mass=0.1)
    options = {"samples": 24, "frames": slice(0, 101, 50)}
    one = estimate_uncertainty(scene, **options)
    two = estimate_uncertainty(scene, **options, dask="local", workers=2)
    for name, band in one.bands.items():
        np.testing.assert_array_equal(band, two.bands[name])
