"""Jobs over worker processes or a Dask cluster; each process prepares once what its jobs share.

A worker is a Python process that runs this module. It reads pickled jobs from its standard input
and writes pickled answers to its standard output until the input ends, which it also does when the
parent is killed. Unlike with multiprocessing, nothing of the calling script runs again.

Dask is an extra (`pip install 'tkamb[cluster]'`) and imported only when asked for. If a worker of a
cluster dies, another one repeats its job. A job is a function of its number and content alone, so
that the answers are the same.
"""

import argparse
import logging
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import IO, Any

from tkamb.errors import ComputationError, InputError, TkambError, renamed
from tkamb.geometry import threads
from tkamb.run.guard import log_to_stderr, open_streams, unforeseen_words

LOCAL = "local"


@dataclass(frozen=True)
class ClusterSettings:
    """How long a Dask cluster is waited for."""

    answer_seconds: float = 10.0
    """s that a scheduler may take to answer. Chosen: an idle scheduler answers within one
    second."""
    most_deaths: int = 5
    """Workers that may die under one job. Chosen: after that the job is taken to be what kills
    them."""


CLUSTER = ClusterSettings()

LOST = "what is finished is kept: go on with resume=True"


def answers_of_cluster(
    task: "Task", tasks: Sequence["Numbered"], address: str, workers: int
) -> Iterator["Numbered"]:
    """Yield answers with their numbers as they are finished, in any order.

    Args:
        task: what each process of the cluster prepares.
        tasks: numbers and contents of the jobs.
        address: of the scheduler, "tcp://host:8786"; "local": one on this machine.
        workers: processes of a local one.

    Raises:
        InputError: Dask is not installed, or no scheduler answers there.
        ComputationError: the scheduler is gone, or a job killed one worker after the other.
    """
    distributed = _library()
    with ExitStack() as stack:
        place = address
        if address == LOCAL:
            place = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                    protocol="tls://",
                    security=_own_security(distributed),
                )
            )
        client = stack.enter_context(_connected(distributed, place, address))
        yield from _answers(distributed, client, task, tasks)


def _own_security(distributed: Any) -> Any:
    """Return certificates for this process alone.

    A scheduler without them takes work, which is code, from every user of the machine.
    """
    try:
        return distributed.Security.temporary()
    except ImportError:
        mend = "pip install 'tkamb[cluster]'"
        raise InputError("cryptography is not installed", "--dask local", mend) from None


def check_cluster(address: str) -> None:
    """Raise an InputError where Dask is not installed, or no scheduler answers."""
    distributed = _library()
    if address == LOCAL:
        _own_security(distributed)
    else:
        _connected(distributed, address, address).close()


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


def _connected(distributed: Any, place: Any, address: str) -> Any:
    """Return a client of the scheduler."""
    try:
        return distributed.Client(place, timeout=CLUSTER.answer_seconds)
    except (OSError, ValueError, TypeError) as error:  # no answer; no address
        raise InputError(
            f"no Dask scheduler answers at '{address}' ({type(error).__name__})",
            "--dask",
            "start one (`dask scheduler`), or give --dask local",
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
                raise ComputationError("the Dask scheduler is gone", "--dask", LOST)
            yield futures.pop(future), future.result()
    except distributed.KilledWorker:
        what = f"a job killed {CLUSTER.most_deaths} workers"
        raise ComputationError(
            what, "--dask", f"check that a worker has enough memory; {LOST}"
        ) from None
    except OSError as error:  # dask's CommClosedError among them
        raise ComputationError(f"the Dask scheduler is gone ({error})", "--dask", LOST) from None


_one_at_a_time = threading.Lock()
"""Held while a worker of many threads does a job: what its jobs share does not stand threads."""


def answer(packed: bytes, number: int, job: Any) -> Any:
    """Do one job on a worker of the cluster.

    Args:
        packed: pickled `make` and `arguments` of a `tkamb.run.workers.Task`.
        number: of the job.
        job: its content.
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
