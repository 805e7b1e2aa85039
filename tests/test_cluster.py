"""Jobs on a Dask cluster: the same results as in this process, also after a crash."""

import functools
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
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
    """Adds its base to a job after a delay."""

    instances = 0

    def __init__(self, base, seconds=0.0):
        type(self).instances += 1
        self.base, self.seconds = base, seconds

    def __call__(self, number, job):
        time.sleep(self.seconds)
        return number, self.base + job, os.getpid()


def distributed():
    return pytest.importorskip("distributed", reason="Dask is not installed")


def test_a_cluster_prepares_once_and_gives_the_results_of_this_process():
    with distributed().LocalCluster(
        n_workers=1, threads_per_worker=4, processes=False, dashboard_address=None
    ) as dask_cluster:
        Adder.instances = 0
        task, jobs = Task(Adder, (10,)), [(n, n**2) for n in range(20)]
        results = dict(PoolOptions(1, dask_cluster.scheduler_address).answers(task, jobs))
        assert Adder.instances == 1
        assert results == dict(PoolOptions(1).answers(task, jobs))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense"])
def test_a_missing_scheduler_is_an_error_of_one_line(address, tmp_path, monkeypatch, capsys):
    distributed()
    monkeypatch.setattr(cluster, "ANSWER_SECONDS", 0.5)
    folder = tmp_path / "out"
    assert main(["uncertainty", str(SCENE), "--dask", address, "--out", str(folder)]) == 2
    message = capsys.readouterr().err.strip()
    assert "no Dask scheduler answers" in message and "\n" not in message
    assert not folder.exists()


def test_dask_local_listens_on_no_port():
    """A scheduler would serve addresses and folders by HTTP to every user of the machine."""
    task, jobs = Task(functools.partial, (max,)), [(n, n) for n in range(3)]
    crew = PoolOptions(2, "local")
    with crew.team(task, len(jobs)) as team:
        answers = dict(team.answers(jobs))
        assert len(team.processes) == 2
        numbers = {os.getpid(), *(process.pid for process in team.processes)}
        listening = set()
        for number in numbers:
            lines = Path(f"/proc/{number}/net/tcp").read_text().splitlines()[1:]
            inodes = {line.split()[9] for line in lines if line.split()[3] == "0A"}
            for file in Path(f"/proc/{number}/fd").iterdir():
                with suppress(OSError):
                    listening |= {inode for inode in inodes if f"[{inode}]" in os.readlink(file)}
        assert not listening
    assert answers == {0: 0, 1: 1, 2: 2}


def test_without_dask_the_error_gives_the_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'tkamb\[cluster\]'"):
        PoolOptions(1, "tcp://host:1").check()


def test_the_number_of_workers_is_limited():
    for count in (0, 1000):
        with pytest.raises(InputError, match="workers"):
            PoolOptions(count)


@pytest.mark.slow
def test_a_killed_worker_does_not_change_the_bands():
    module = distributed()
    with module.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as dask_cluster:
        scene = bodies_alone(uncertainty__ligament_strain=0.02)
        options = {"samples": 40, "frames": slice(0, 101, 25)}
        address = dask_cluster.scheduler_address
        numbers = []

        def kill_one(samples, count):
            for index, sample in enumerate(samples):
                if index == 5:
                    with module.Client(address, set_as_default=False) as client:
                        os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
                numbers.append(sample[0])
                yield sample

        distributed_run = estimate_uncertainty(scene, **options, dask=address, progress=kill_one)
    assert sorted(numbers) == list(range(40))
    local_run = estimate_uncertainty(scene, **options)
    for name, band in local_run.bands.items():
        np.testing.assert_array_equal(band, distributed_run.bands[name])


ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}


@pytest.fixture
def start(tmp_path):
    """Return a function that starts a scheduler with a worker and returns process and address."""
    distributed()
    python, options = [sys.executable, "-m"], ["--no-dashboard"]
    processes = []

    def start_scheduler():
        file = tmp_path / f"scheduler{len(processes)}.json"
        command = ["distributed.cli.dask_scheduler", "--port", "0", "--scheduler-file", str(file)]
        scheduler = subprocess.Popen([*python, *command, *options])
        processes.append(scheduler)
        while not file.exists() and scheduler.poll() is None:
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        command = ["distributed.cli.dask_worker", address, "--nthreads", "1"]
        processes.append(subprocess.Popen([*python, *command, *options], env=ENVIRONMENT))
        return scheduler, address

    yield start_scheduler
    for process in reversed(processes):
        process.kill()
        process.wait()


@pytest.mark.slow
def test_restarts_of_scheduler_and_client_neither_lose_nor_repeat_samples(start, tmp_path):
    scene, folder = bodies_alone(uncertainty__ligament_strain=0.02), tmp_path / "out"
    options = {"samples": 120, "frames": slice(None)}
    scheduler, address = start()

    def killing(samples, count):
        for index, sample in enumerate(samples):
            if index == 5:
                scheduler.kill()
            yield sample

    with pytest.raises(ComputationError, match="go on with resume=True"):
        estimate_uncertainty(scene, **options, dask=address, directory=folder, progress=killing)
    first = _stored_samples(folder)
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
    while _stored_samples(folder) < first + 5 and client.poll() is None:
        time.sleep(0.02)
    client.kill()
    client.wait()
    second, numbers = _stored_samples(folder), []
    assert first < second < 120

    def recording(samples, count):
        for sample in samples:
            numbers.append(sample[0])
            yield sample

    distributed_run = estimate_uncertainty(
        scene, **options, dask=address, directory=folder, resume=True, progress=recording
    )
    assert len(set(numbers)) == len(numbers) == 120 - second
    local_run = estimate_uncertainty(scene, **options)
    for name, band in local_run.bands.items():
        np.testing.assert_array_equal(band, distributed_run.bands[name])
    assert main(["verify", str(folder)]) == 0


def _stored_samples(folder):
    return len(list(folder.glob(".frames/*.frame")))


@pytest.mark.slow
def test_a_killed_scheduler_is_a_computation_error(start):
    scheduler, address = start()
    results = []

    def killing(answers):
        for answer in answers:
            results.append(answer)
            if len(results) == 5:
                scheduler.kill()
            yield answer

    answers = PoolOptions(1, address).answers(Task(Adder, (1, 0.1)), [(n, n) for n in range(400)])
    with pytest.raises(ComputationError, match="scheduler has ended"):
        list(killing(answers))
    assert 5 <= len(results) < 400
