"""Two threads: their use, and results that do not depend on it."""

import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from lattice_bodies import condyles, dished_insert, pair
from tkamb.contact.lattice.linear.multifrontal import CholeskyFactor
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.geometry import threads
from tkamb.geometry.frames import knee_pose


@pytest.fixture
def with_threads(monkeypatch):
    def use(count):
        monkeypatch.setattr(threads, "threads", lambda: count)

    return use


@pytest.mark.parametrize("count", [1, 2])
def test_both_returns_the_results_also_in_nested_calls(with_threads, count):
    with_threads(count)

    def nested():
        return threads.both(lambda: 3, lambda: 4)

    assert threads.both(nested, nested) == ((3, 4), (3, 4))
    assert threads.in_halves(lambda chosen: list(range(9))[chosen], 9) == (
        [0, 1, 2, 3],
        [4, 5, 6, 7, 8],
    )


def test_two_functions_run_at_the_same_time(with_threads):
    """Each function waits for the other one; in sequence they would never end."""
    with_threads(2)
    meeting = threading.Barrier(2, timeout=30)
    assert sorted(threads.both(meeting.wait, meeting.wait)) == [0, 1]


def test_an_error_is_raised_after_the_other_function_has_ended(with_threads):
    with_threads(2)
    ended = []

    def fails():
        raise ValueError("mine")

    def slow():
        time.sleep(0.05)
        ended.append(True)

    with pytest.raises(ValueError, match="mine"):
        threads.both(fails, slow)
    assert ended == [True]
    with pytest.raises(ValueError, match="mine"):
        threads.both(slow, fails)
    assert threads.both(lambda: 1, lambda: 2) == (1, 2)


def test_a_forked_process_has_a_second_thread_of_its_own(with_threads):
    """As in `multiprocessing`: the child has neither the parent's thread nor its lock."""
    with_threads(2)
    assert threads.both(lambda: 1, lambda: 2) == (1, 2)
    busy, _ = threads._second()
    assert busy.acquire(blocking=False)  # as if the second thread were busy
    child = os.fork()
    if not child:
        meeting = threading.Barrier(2, timeout=30)
        os._exit(0 if sorted(threads.both(meeting.wait, meeting.wait)) == [0, 1] else 1)
    busy.release()
    assert os.waitpid(child, 0)[1] == 0


def test_a_wrong_number_of_threads_is_refused_in_one_line(tmp_path):
    command = [sys.executable, "-m", "tkamb", "run", "nothing.toml", "--out", tmp_path / "out"]
    environment = os.environ | {threads.VARIABLE: "many"}
    process = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=tmp_path)
    assert process.returncode == 2 and len(process.stderr.splitlines()) == 1
    assert "TKAMB_THREADS" in process.stderr and not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["lattice", "lattice-linear", "foundation"])
def test_a_press_does_not_depend_on_the_number_of_threads(with_threads, name):
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))
    pose = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, np.radians(0.3), 0.0])
    result = []
    for count in (1, 2):
        with_threads(count)
        model = contact_model(name, resolution=2e-3)
        result.append(model.press(model.prepare(bodies), 2000.0, pose))
    single, double = result
    assert single.status is double.status is ContactStatus.OK
    assert single.pose.tobytes() == double.pose.tobytes()
    assert single.pressure.tobytes() == double.pressure.tobytes()
    assert (single.pressure > 0).any()


@pytest.mark.parametrize("seed", range(20))
def test_the_two_shares_of_fronts_are_independent(seed):
    """For any forest the two shares depend neither on each other nor on the fronts above."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 80))
    parents = [int(rng.integers(i + 1, min(i + 12, count) + 1)) for i in range(count)]
    parents = np.array([-1 if parent == count else parent for parent in parents])
    sizes = rng.integers(1, 40, count)
    starts = np.cumsum([0, *sizes])
    empty = np.zeros(0, np.int64)
    factor = CholeskyFactor(
        empty, starts, parents, np.zeros(count + 1, np.int64), empty, np.zeros(0), np.zeros(0)
    )
    chosen = np.flatnonzero(rng.random(count) < rng.choice([0.3, 0.9, 1.0]))
    shares = factor.shared(chosen)
    assert (shares.fronts == chosen).all()
    share_of = np.full(count, -1)
    for number, own in enumerate((shares.first, shares.second, shares.above)):
        share_of[own] = number
    for front in chosen.tolist():
        above = parents[front]
        while above >= 0:
            if share_of[above] >= 0:
                assert share_of[above] in (share_of[front], 2)
            above = parents[above]
    weight = np.diff(factor.firsts)
    loads = [weight[own].sum() for own in (shares.first, shares.second, shares.above)]
    assert loads[2] + max(loads[:2]) <= weight[chosen].sum()


def test_a_balanced_tree_is_divided_in_two_halves():
    parents = np.array([2, 2, 6, 5, 5, 6, -1])
    starts, empty = np.arange(8) * 10, np.zeros(0, np.int64)
    factor = CholeskyFactor(
        empty, starts, parents, np.zeros(8, np.int64), empty, np.zeros(0), np.zeros(0)
    )
    shares = factor.everything
    assert sorted([shares.first.tolist(), shares.second.tolist()]) == [[0, 1, 2], [3, 4, 5]]
    assert shares.above.tolist() == [6]
