"""Distribution of jobs over worker processes or a Dask cluster.

A worker is a Python process that runs this module. It prepares the task once, then reads pickled
jobs from standard input and writes pickled answers to standard output. It ends when the input ends,
even if the parent was killed. Unlike multiprocessing, it does not import the calling script.

Dask is an extra (`pip install 'tkamb[cluster]'`). If a cluster's worker dies, another one repeats
its job, which is a function of its number and content only.
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
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import IO, Any

from tkamb.errors import ComputationError, InputError, TkambError
from tkamb.geometry import threads
from tkamb.run.guard import log_to_stderr, open_streams, unforeseen_words

LOCAL = "local"


# s: time limit for the answer of a scheduler. An idle scheduler answers within one second.
ANSWER_SECONDS = 10.0
# 1: workers that may die in one job before the run fails. The job is then the likely cause.
MOST_DEATHS = 5


FINISHED_KEPT = "what is finished is kept: go on with resume=True"


def check_cluster(address: str) -> None:
    """Raise an InputError if Dask is not installed, or no scheduler answers."""
    _connected(_library(), address).close()


def _library() -> Any:
    try:
        import dask
        import distributed
    except ImportError:
        hint = "pip install 'tkamb[cluster]'"
        raise InputError("Dask is not installed", "--dask", hint) from None
    dask.config.set({"distributed.scheduler.allowed-failures": MOST_DEATHS})
    return distributed


def _connected(distributed: Any, address: str) -> Any:
    try:
        return distributed.Client(address, timeout=ANSWER_SECONDS)
    except (OSError, ValueError, TypeError) as error:  # no answer, or an invalid address
        raise InputError(
            f"no Dask scheduler answers at '{address}' ({type(error).__name__})",
            "--dask",
            "start one (`dask scheduler`), or give --workers N",
        ) from None


def _cluster_answers(
    task: "Task", tasks: Sequence["Numbered"], address: str
) -> Iterator["Numbered"]:
    distributed = _library()
    packed = pickle.dumps((task.make, task.arguments))
    try:
        with _connected(distributed, address) as client:
            futures = {
                client.submit(answer, packed, number, job, pure=False): number
                for number, job in tasks
            }
            for future in distributed.as_completed(futures):
                if future.cancelled():
                    raise ComputationError("the Dask scheduler has ended", "--dask", FINISHED_KEPT)
                yield futures.pop(future), future.result()
    except distributed.KilledWorker:
        what = f"a job killed {MOST_DEATHS} workers"
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
    """Answer a job on a worker of the cluster."""
    with _one_at_a_time:
        return _unpacked(packed)(number, job)


@lru_cache(maxsize=1)
def _unpacked(packed: bytes) -> Callable[[int, Any], Any]:
    make, arguments = pickle.loads(packed)
    prepared: Callable[[int, Any], Any] = make(*arguments)
    return prepared


# 1: largest number of worker processes. Usual machines have fewer cores.
MAX_WORKERS = 256


Numbered = tuple[int, Any]
Progress = Callable[[Iterable[Numbered], int], Iterable[Numbered]]
ENDED = "a worker process ended before its job was done"


@dataclass(frozen=True)
class Task:
    """The task of a worker: a preparation, and a function for each job.

    Args:
        make: importable class or function that prepares a worker and returns the function of a
            job's number and content.
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
    """

    workers: int = 1
    dask: str | None = None

    def __post_init__(self) -> None:
        if self.dask == LOCAL:
            object.__setattr__(self, "dask", None)
        if not 1 <= self.workers <= MAX_WORKERS:
            raise InputError(
                f"cannot be {self.workers}",
                "workers",
                f"give a number from 1 to {MAX_WORKERS}",
            )

    def check(self) -> None:
        """Raise an InputError if the cluster of `dask` does not answer."""
        if self.dask is not None:
            check_cluster(self.dask)

    def answers(self, task: Task, tasks: Sequence[Numbered]) -> Iterator[Numbered]:
        """Yield numbers and answers in the order in which the jobs finish.

        Raises:
            ComputationError: a worker was killed, or the scheduler has ended.
        """
        with self.team(task, len(tasks)) as team:
            yield from team.answers(tasks)

    @contextmanager
    def team(self, task: Task, count: int) -> Iterator["WorkerPool"]:
        """Provide a pool of workers, which prepare at once in the background."""
        processes = self.dask is None and self.workers > 1 and count > 1
        team = WorkerPool(self, task, min(self.workers, count) if processes else 0)
        try:
            yield team
        finally:
            team.stop()


class WorkerPool:
    """Worker processes that compute the jobs of one task.

    Args:
        count: number of worker processes; 0: the jobs are computed on the cluster of `options`, or
            in this process.
    """

    def __init__(self, options: PoolOptions, task: Task, count: int) -> None:
        self._options, self._task = options, task
        self._free: queue.SimpleQueue[subprocess.Popen[bytes]] = queue.SimpleQueue()
        self._threads = ThreadPoolExecutor(max(count, 1))
        self.processes = [_start() for _ in range(count)]
        for process in self.processes:  # a thread sends the task, since a pipe holds only 64 kB
            self._threads.submit(self._prepare, process)

    def _prepare(self, process: "subprocess.Popen[bytes]") -> None:
        assert process.stdin is not None
        with suppress(OSError):  # the worker has ended, as its first job will report
            # not the Task itself: the worker has its own class Task, in the module __main__
            _send(process.stdin, (self._task.make, self._task.arguments))
        self._free.put(process)

    def _answer(self, job: Numbered) -> Numbered:
        process = self._free.get()
        assert process.stdin is not None and process.stdout is not None
        try:
            _send(process.stdin, job)
            answer: Numbered | TkambError = pickle.load(process.stdout)
        except (OSError, EOFError, ValueError, pickle.UnpicklingError):
            hint = f"check that there is enough memory; {FINISHED_KEPT}"
            raise ComputationError(ENDED, "workers", hint) from None
        finally:
            self._free.put(process)
        if isinstance(answer, TkambError):
            raise answer
        return answer

    def answers(self, tasks: Sequence[Numbered]) -> Iterator[Numbered]:
        """Yield numbers and answers in the order in which the jobs finish.

        Raises:
            InputError: the preparation of a worker fails.
            ComputationError: a worker was killed, or the scheduler has ended.
        """
        if not tasks:
            return
        if self._options.dask is not None:
            yield from _cluster_answers(self._task, tasks, self._options.dask)
        elif not self.processes:
            work = self._task.prepared()
            yield from ((number, work(number, job)) for number, job in tasks)
        else:
            for future in as_completed([self._threads.submit(self._answer, job) for job in tasks]):
                yield future.result()

    def stop(self) -> None:
        """Kill the worker processes."""
        for process in self.processes:
            process.kill()
            process.wait()
        self._threads.shutdown(cancel_futures=True)


def _start() -> "subprocess.Popen[bytes]":
    # a new session: only the parent receives Ctrl-C; one thread: the workers share the cores
    return subprocess.Popen(
        [sys.executable, "-m", "tkamb.run.workers"],
        env=os.environ | {threads.VARIABLE: "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )


def _send(stream: IO[bytes], value: object) -> None:
    pickle.dump(value, stream)
    stream.flush()


def serve() -> None:
    """Answer jobs from standard input; printed text goes to standard error."""
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
    try:
        return number, work(number, job)
    except Exception as error:
        return _known(error)


def _known(error: Exception) -> TkambError:
    if isinstance(error, TkambError):
        return error
    return ComputationError(unforeseen_words(error, argparse.Namespace()))


def _prepared(task: Task) -> Callable[[int, Any], Any]:
    """If the preparation fails, each job raises its error."""
    try:
        return task.prepared()
    except Exception as error:
        wrong = _known(error)

    def refuse(number: int, job: object) -> None:
        raise wrong

    return refuse


if __name__ == "__main__":
    serve()
