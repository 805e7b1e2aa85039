"""Jobs over worker processes, each of which prepares once what its jobs share.

A worker is a Python of its own that runs this module: it takes pickled jobs from its standard
input and puts pickled answers on its standard output until the input ends, which it also does
when the parent is killed. Nothing of the calling script is run again, as multiprocessing would.
"""

import argparse
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, Any

from tkamb.errors import ComputationError, InputError, TkambError, renamed
from tkamb.geometry import threads
from tkamb.run.guard import log_to_stderr, open_streams, unforeseen_words


@dataclass(frozen=True)
class WorkerLimitSettings:
    """How many processes a run may start."""

    max_workers: int = 256
    """Number of worker processes. Chosen: no machine for which tkamb is meant has more cores."""


WORKER_LIMITS = WorkerLimitSettings()

Numbered = tuple[int, Any]
Progress = Callable[[Iterable[Numbered], int], Iterable[Numbered]]
ENDED = "a worker process ended before its job was done"
KEPT = "what is finished is kept: go on with resume=True"


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
class PoolOptions:
    """Where jobs are computed: in this process, in worker processes, or on a Dask cluster.

    Args:
        workers: number of processes; with 1 the jobs are computed in this process.
        dask: address of a Dask scheduler, or "local" to start one with `workers` workers. None:
            no cluster.

    Raises:
        InputError: too few workers, or too many.
    """

    workers: int = 1
    dask: str | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.workers <= WORKER_LIMITS.max_workers:
            raise InputError(
                f"{self.workers} is not within 1 to {WORKER_LIMITS.max_workers}", "workers"
            )

    def check(self) -> None:
        """Raise an InputError where a cluster that is asked for is not there."""
        if self.dask is not None:
            from tkamb.run.cluster import check_cluster

            check_cluster(self.dask)

    def answers(self, task: Task, tasks: Sequence[Numbered]) -> Iterator[Numbered]:
        """Yield answers with their numbers as they are finished, in any order.

        Args:
            task: what every worker prepares.
            tasks: numbers and contents of the jobs.

        Raises:
            ComputationError: a worker was killed, or the scheduler is gone.
        """
        with self.team(task, len(tasks)) as team:
            yield from team.answers(tasks)

    @contextmanager
    def team(self, task: Task, count: int) -> Iterator["WorkerPool"]:
        """Give who answers; processes begin to prepare at once, while the caller does other things.

        Args:
            task: what every worker prepares.
            count: of the jobs, at most.
        """
        processes = self.dask is None and self.workers > 1 and count > 1
        team = WorkerPool(self, task, min(self.workers, count) if processes else 0)
        try:
            yield team
        finally:
            team.stop()


def _answers_here(task: Task, tasks: Sequence[Numbered]) -> Iterator[Numbered]:
    work = task.prepared() if tasks else None
    for number, job in tasks if work else ():
        assert work is not None
        yield number, work(number, job)


class WorkerPool:
    """Worker processes that compute the jobs of one task.

    Args:
        crew: options that the pool is made with.
        task: prepared once by every worker, before its first job.
        count: number of processes to start. 0: none; the jobs are computed on the cluster of
            `crew`, or in this process.

    Attributes:
        processes: the processes that were started.
    """

    def __init__(self, crew: PoolOptions, task: Task, count: int) -> None:
        self._crew, self._task = crew, task
        self._jobs: queue.SimpleQueue[Numbered | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Numbered | TkambError] = queue.SimpleQueue()
        self.processes = [_start() for _ in range(count)]
        for process in self.processes:
            threading.Thread(
                target=_attend, args=(process, task, self._jobs, self._answers), daemon=True
            ).start()

    def answers(self, tasks: Sequence[Numbered]) -> Iterator[Numbered]:
        """Yield answers with their numbers as they are finished, in any order.

        See `PoolOptions.answers`.

        Args:
            tasks: numbers and contents of the jobs.

        Raises:
            InputError: what the workers prepare cannot be used.
            ComputationError: a worker was killed, or the scheduler is gone.
        """
        if self._crew.dask is not None and tasks:
            from tkamb.run.cluster import answers_of_cluster

            yield from answers_of_cluster(self._task, tasks, self._crew.dask, self._crew.workers)
            return
        if not self.processes:
            yield from _answers_here(self._task, tasks)
            return
        for job in tasks:
            self._jobs.put(job)
        for _ in tasks:
            answer = self._answers.get()
            if isinstance(answer, TkambError):
                raise answer
            yield answer

    def stop(self) -> None:
        """End the processes."""
        for process in self.processes:
            self._jobs.put(None)
            process.kill()
            process.wait()


def _start() -> "subprocess.Popen[bytes]":
    # a session of its own: Ctrl-C is the parent's to handle; one thread: others share the cores
    return subprocess.Popen(
        [sys.executable, "-m", "tkamb.run.workers"],
        env=os.environ | {threads.VARIABLE: "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )


def _attend(
    process: "subprocess.Popen[bytes]",
    task: Task,
    jobs: "queue.SimpleQueue[Numbered | None]",
    answers: "queue.SimpleQueue[Numbered | TkambError]",
) -> None:
    """Hand one worker its jobs until None comes; an error among the answers ends it."""
    assert process.stdin is not None and process.stdout is not None
    try:
        # as plain values: the worker's Task is that of the module it was started as
        _send(process.stdin, (task.make, task.arguments))
        while (job := jobs.get()) is not None:
            _send(process.stdin, job)
            answers.put(pickle.load(process.stdout))
    except (OSError, EOFError, ValueError, pickle.UnpicklingError):
        again = f"is there memory for so many? {KEPT.capitalize()}"
        answers.put(ComputationError(ENDED, "workers", again))


def _send(stream: IO[bytes], value: object) -> None:
    pickle.dump(value, stream)
    stream.flush()


def serve() -> None:
    """Be a worker until the standard input ends; whatever else is printed goes to stderr."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    open_streams()
    log_to_stderr()
    jobs = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        work = _prepared(Task(*pickle.load(jobs)))
        while True:
            number, job = pickle.load(jobs)
            _send(answers, _answer(work, number, job))
    except (EOFError, ConnectionError, pickle.UnpicklingError):  # the parent has gone
        # what is buffered has no reader, and the interpreter would say so at its end
        os._exit(0)


def _answer(work: Callable[[int, Any], Any], number: int, job: Any) -> Numbered | TkambError:
    """Return the answer to a job, or why there is none, which is the parent's to tell."""
    try:
        return number, work(number, job)
    except TkambError as error:
        return error
    except Exception as error:
        return ComputationError(unforeseen_words(error, argparse.Namespace()))


def _prepared(task: Task) -> Callable[[int, Any], Any]:
    """Return what does the jobs; it refuses them all where the preparation fails."""
    try:
        return task.prepared()
    except TkambError as error:
        wrong: TkambError = error
    except Exception as error:
        wrong = ComputationError(unforeseen_words(error, argparse.Namespace()))

    def refuse(number: int, job: object) -> None:
        raise wrong

    return refuse


def __getattr__(name: str) -> Any:
    """Return a class by its former name, with a warning; until release 0.3."""
    return renamed(__name__, name, {"Crew": PoolOptions, "Team": WorkerPool})


if __name__ == "__main__":
    serve()
