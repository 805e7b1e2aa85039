"""Distribution of jobs over worker processes or a Dask cluster.

A worker is a Python process that runs this module. It prepares the task once, reads pickled jobs
from its standard input, and writes pickled answers to its standard output. It ends when the input
ends, even if the parent was killed. Unlike multiprocessing, it does not import the calling script.

Dask is an extra (`pip install 'tkamb[cluster]'`). If a worker of a cluster dies, another one
repeats its job. The answers do not depend on the worker, since a job is a function of its number
and content only.
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
from functools import lru_cache
from typing import IO, Any

from tkamb.errors import ComputationError, InputError, TkambError
from tkamb.geometry import threads
from tkamb.run.guard import log_to_stderr, open_streams, unforeseen_words

LOCAL = "local"


@dataclass(frozen=True)
class ClusterSettings:
    """Limits for a Dask cluster."""

    answer_seconds: float = 10.0
    """s: time limit for the answer of a scheduler. Chosen because an idle scheduler answers within
    one second."""
    most_deaths: int = 5
    """1: workers that may die in one job before the run fails. Chosen because the job is then the
    likely cause."""


CLUSTER = ClusterSettings()

FINISHED_KEPT = "what is finished is kept: go on with resume=True"


def answers_of_cluster(
    task: "Task", tasks: Sequence["Numbered"], address: str
) -> Iterator["Numbered"]:
    """Yield the numbers and answers of jobs in the order in which they finish.

    Args:
        task: task of the workers.
        tasks: numbers and contents of the jobs.
        address: address of the scheduler, such as "tcp://host:8786".

    Raises:
        InputError: Dask is not installed, or no scheduler answers.
        ComputationError: the scheduler has ended, or a job killed too many workers.
    """
    distributed = _library()
    with _connected(distributed, address) as client:
        yield from _answers(distributed, client, task, tasks)


def check_cluster(address: str) -> None:
    """Raise an InputError if Dask is not installed, or no scheduler answers."""
    _connected(_library(), address).close()


def _library() -> Any:
    """Return Dask's `distributed`, with the options that tkamb needs."""
    try:
        import dask
        import distributed
    except ImportError:
        hint = "pip install 'tkamb[cluster]'"
        raise InputError("Dask is not installed", "--dask", hint) from None
    dask.config.set({"distributed.scheduler.allowed-failures": CLUSTER.most_deaths})
    return distributed


def _connected(distributed: Any, address: str) -> Any:
    """Return a client of the scheduler."""
    try:
        return distributed.Client(address, timeout=CLUSTER.answer_seconds)
    except (OSError, ValueError, TypeError) as error:  # no answer, or an invalid address
        raise InputError(
            f"no Dask scheduler answers at '{address}' ({type(error).__name__})",
            "--dask",
            "start one (`dask scheduler`), or give --workers N",
        ) from None


def _answers(
    distributed: Any, client: Any, task: "Task", tasks: Sequence["Numbered"]
) -> Iterator["Numbered"]:
    packed = pickle.dumps((task.make, task.arguments))
    try:
        futures = {
            client.submit(answer, packed, number, job, pure=False): number for number, job in tasks
        }
        for future in distributed.as_completed(futures):
            if future.cancelled():
                raise ComputationError("the Dask scheduler has ended", "--dask", FINISHED_KEPT)
            yield futures.pop(future), future.result()
    except distributed.KilledWorker:
        what = f"a job killed {CLUSTER.most_deaths} workers"
        raise ComputationError(
            what, "--dask", f"check that a worker has enough memory; {FINISHED_KEPT}"
        ) from None
    except OSError as error:  # includes Dask's CommClosedError
        raise ComputationError(
            f"the Dask scheduler has ended ({error})", "--dask", FINISHED_KEPT
        ) from None


_one_at_a_time = threading.Lock()
"""Lock for the jobs of a worker with several threads, since their shared state is not
thread-safe."""


def answer(packed: bytes, number: int, job: Any) -> Any:
    """Return the answer to a job on a worker of the cluster.

    Args:
        packed: pickled `make` and `arguments` of a `Task`.
        number: number of the job.
        job: content of the job.
    """
    with _one_at_a_time:
        return _unpacked(packed)(number, job)


@lru_cache(maxsize=1)
def _unpacked(packed: bytes) -> Callable[[int, Any], Any]:
    make, arguments = pickle.loads(packed)
    prepared: Callable[[int, Any], Any] = make(*arguments)
    return prepared


@dataclass(frozen=True)
class WorkerLimitSettings:
    """Limits of worker processes."""

    max_workers: int = 256
    """1: largest number of worker processes. Chosen because usual machines have fewer cores."""


WORKER_LIMITS = WorkerLimitSettings()

Numbered = tuple[int, Any]
Progress = Callable[[Iterable[Numbered], int], Iterable[Numbered]]
ENDED = "a worker process ended before its job was done"


@dataclass(frozen=True)
class Task:
    """The task of a worker: a preparation, and a function for each job.

    Args:
        make: importable class or function that prepares a worker. It returns the function of the
            jobs, which takes number and content of a job.
        arguments: arguments of `make`.
    """

    make: Callable[..., Callable[[int, Any], Any]]
    arguments: tuple[Any, ...] = ()

    def prepared(self) -> Callable[[int, Any], Any]:
        """Prepare the task, and return the function of the jobs."""
        return self.make(*self.arguments)


@dataclass(frozen=True)
class PoolOptions:
    """Where jobs are computed: in this process, in worker processes, or on a Dask cluster.

    Args:
        workers: number of worker processes; 1: the jobs are computed in this process.
        dask: address of a Dask scheduler; None or "local": the worker processes. They have no
            scheduler, and no port that others could reach.

    Raises:
        InputError: too few or too many workers.
    """

    workers: int = 1
    dask: str | None = None

    def __post_init__(self) -> None:
        if self.dask == LOCAL:
            object.__setattr__(self, "dask", None)
        if not 1 <= self.workers <= WORKER_LIMITS.max_workers:
            raise InputError(
                f"cannot be {self.workers}",
                "workers",
                f"give a number from 1 to {WORKER_LIMITS.max_workers}",
            )

    def check(self) -> None:
        """Raise an InputError if the cluster of `dask` does not answer."""
        if self.dask is not None:
            check_cluster(self.dask)

    def answers(self, task: Task, tasks: Sequence[Numbered]) -> Iterator[Numbered]:
        """Yield the numbers and answers of jobs in the order in which they finish.

        Args:
            task: task of the workers.
            tasks: numbers and contents of the jobs.

        Raises:
            ComputationError: a worker was killed, or the scheduler has ended.
        """
        with self.team(task, len(tasks)) as team:
            yield from team.answers(tasks)

    @contextmanager
    def team(self, task: Task, count: int) -> Iterator["WorkerPool"]:
        """Provide a pool of workers, which begin to prepare at once in the background.

        Args:
            task: task of the workers.
            count: largest number of jobs.
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
        crew: options of the pool.
        task: task of the workers.
        count: number of worker processes; 0: the jobs are computed on the cluster of `crew`, or in
            this process.

    Attributes:
        processes: the worker processes.
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
        """Yield the numbers and answers of jobs in the order in which they finish.

        Args:
            tasks: numbers and contents of the jobs.

        Raises:
            InputError: the preparation of a worker fails.
            ComputationError: a worker was killed, or the scheduler has ended.
        """
        if self._crew.dask is not None and tasks:
            yield from answers_of_cluster(self._task, tasks, self._crew.dask)
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
        """Kill the worker processes."""
        for process in self.processes:
            self._jobs.put(None)
            process.kill()
            process.wait()


def _start() -> "subprocess.Popen[bytes]":
    # a new session: only the parent receives Ctrl-C; one thread: the workers share the cores
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
    """Send jobs to a worker, and collect its answers, until the job is None or the worker ends."""
    assert process.stdin is not None and process.stdout is not None
    try:
        # not the Task itself: the worker has its own class Task, in the module __main__
        _send(process.stdin, (task.make, task.arguments))
        while (job := jobs.get()) is not None:
            _send(process.stdin, job)
            answers.put(pickle.load(process.stdout))
    except (OSError, EOFError, ValueError, pickle.UnpicklingError):
        hint = f"check that there is enough memory; {FINISHED_KEPT}"
        answers.put(ComputationError(ENDED, "workers", hint))


def _send(stream: IO[bytes], value: object) -> None:
    pickle.dump(value, stream)
    stream.flush()


def serve() -> None:
    """Answer jobs from standard input until it ends. Printed text goes to standard error."""
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
    except (EOFError, ConnectionError, pickle.UnpicklingError):  # the parent has ended
        # buffered output has no reader: a normal exit would print an error
        os._exit(0)


def _answer(work: Callable[[int, Any], Any], number: int, job: Any) -> Numbered | TkambError:
    """Return number and answer of a job, or the error, which the parent raises."""
    try:
        return number, work(number, job)
    except TkambError as error:
        return error
    except Exception as error:
        return ComputationError(unforeseen_words(error, argparse.Namespace()))


def _prepared(task: Task) -> Callable[[int, Any], Any]:
    """Return the function of the jobs. If the preparation fails, each job raises its error."""
    try:
        return task.prepared()
    except TkambError as error:
        wrong: TkambError = error
    except Exception as error:
        wrong = ComputationError(unforeseen_words(error, argparse.Namespace()))

    def refuse(number: int, job: object) -> None:
        raise wrong

    return refuse


if __name__ == "__main__":
    serve()
