"""Jobs over worker processes, each of which prepares once what its jobs share.

A worker is a Python of its own that runs this module: it takes pickled jobs from its standard
input and puts pickled answers on its standard output until the input ends, which it also does
when the parent is killed. Nothing of the calling script is run again, as multiprocessing would.
"""

import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import IO, Any

from tkamb.errors import ComputationError, InputError

MOST_WORKERS = 256
Numbered = tuple[int, Any]
Progress = Callable[[Iterable[Numbered], int], Iterable[Numbered]]
ENDED = "a worker process ended before its job was done"
KEPT = "what is finished is kept: go on with --resume"


@dataclass(frozen=True)
class Task:
    """What every worker prepares, and then does job by job.

    Args:
        make: a class or function that can be imported; called once per worker with `arguments`,
            it returns what is called with the number and the content of each job.
        arguments: for it.
    """

    make: Callable[..., Callable[[int, Any], Any]]
    arguments: tuple[Any, ...] = ()

    def prepared(self) -> Callable[[int, Any], Any]:
        """Return what does the jobs."""
        return self.make(*self.arguments)


@dataclass(frozen=True)
class Crew:
    """Who does the jobs.

    Args:
        workers: processes; 1 computes in this one.
        dask: address of a Dask scheduler, or "local" for one with so many workers; None: without.

    Raises:
        InputError: too few workers, or too many.
    """

    workers: int = 1
    dask: str | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.workers <= MOST_WORKERS:
            raise InputError(f"{self.workers} is not within 1 to {MOST_WORKERS}", "--workers")

    def check(self) -> None:
        """Raise an InputError where a cluster that is asked for is not there."""
        if self.dask is not None:
            from tkamb.run.cluster import check_cluster

            check_cluster(self.dask)

    def answers(self, task: Task, wanted: Sequence[Numbered]) -> Iterator[Numbered]:
        """Yield answers with their numbers as they are finished, in any order.

        Args:
            task: what every worker prepares.
            wanted: numbers and contents of the jobs.

        Raises:
            ComputationError: a worker was killed, or the scheduler is gone.
        """
        if self.dask is not None and wanted:
            from tkamb.run.cluster import answers_of_cluster

            return answers_of_cluster(task, wanted, self.dask, self.workers)
        if self.workers == 1 or len(wanted) < 2:
            return _answers_here(task, wanted)
        return _answers_of_processes(task, wanted, self.workers)


def _answers_here(task: Task, wanted: Sequence[Numbered]) -> Iterator[Numbered]:
    work = task.prepared() if wanted else None
    for number, job in wanted if work else ():
        assert work is not None
        yield number, work(number, job)


def _answers_of_processes(
    task: Task, wanted: Sequence[Numbered], workers: int
) -> Iterator[Numbered]:
    jobs: queue.SimpleQueue[Numbered] = queue.SimpleQueue()
    answers: queue.SimpleQueue[Numbered | None] = queue.SimpleQueue()
    for job in wanted:
        jobs.put(job)
    processes = [_start() for _ in range(min(workers, len(wanted)))]
    for process in processes:
        threading.Thread(target=_attend, args=(process, task, jobs, answers), daemon=True).start()
    try:
        for _ in wanted:
            answer = answers.get()
            if answer is None:
                raise ComputationError(
                    ENDED, "--workers", f"is there memory for so many? {KEPT.capitalize()}"
                )
            yield answer
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _start() -> "subprocess.Popen[bytes]":
    # a session of its own: Ctrl-C is the parent's to handle
    return subprocess.Popen(
        [sys.executable, "-m", "tkamb.run.workers"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )


def _attend(
    process: "subprocess.Popen[bytes]",
    task: Task,
    jobs: "queue.SimpleQueue[Numbered]",
    answers: "queue.SimpleQueue[Numbered | None]",
) -> None:
    """Hand one worker its jobs; None among the answers says that it is gone."""
    assert process.stdin is not None and process.stdout is not None
    try:
        # as plain values: the worker's Task is that of the module it was started as
        _send(process.stdin, (task.make, task.arguments))
        while True:
            try:
                job = jobs.get_nowait()
            except queue.Empty:
                return
            _send(process.stdin, job)
            answers.put(pickle.load(process.stdout))
    except (OSError, EOFError, ValueError, pickle.UnpicklingError):
        answers.put(None)


def _send(stream: IO[bytes], value: object) -> None:
    pickle.dump(value, stream)
    stream.flush()


def serve() -> None:
    """Be a worker until the standard input ends; whatever else is printed goes to stderr."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    jobs = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    work = Task(*pickle.load(jobs)).prepared()
    while True:
        try:
            number, job = pickle.load(jobs)
        except EOFError:
            return
        _send(answers, (number, work(number, job)))


if __name__ == "__main__":
    serve()
