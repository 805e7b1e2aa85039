"""Samples over worker processes, each of which reads the scene once.

A worker is a Python of its own that runs this module: it takes pickled jobs from its standard
input and puts pickled samples on its standard output until the input ends, which it also does
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
from typing import IO

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array
from tkamb.scene import Scene
from tkamb.uncertainty.sample import Sample, Sampler

Numbered = tuple[int, Sample]
Progress = Callable[[Iterable[Numbered], int], Iterable[Numbered]]


def finished_samples(
    arguments: tuple[Scene, range, Sequence[str]],
    wanted: Sequence[tuple[int, Array]],
    workers: int,
) -> Iterator[Numbered]:
    """Yield samples with their numbers as they are finished, in any order.

    Args:
        arguments: of `Sampler`.
        wanted: numbers with their standard normal inputs (d,).
        workers: processes; 1 computes in this one.

    Raises:
        ComputationError: a worker was killed.
    """
    if workers == 1 or len(wanted) < 2:
        sampler = Sampler(*arguments) if wanted else None
        for number, normal in wanted if sampler else ():
            assert sampler is not None
            yield number, sampler.sample(number, normal)
        return
    jobs: queue.SimpleQueue[tuple[int, Array]] = queue.SimpleQueue()
    answers: queue.SimpleQueue[Numbered | None] = queue.SimpleQueue()
    for job in wanted:
        jobs.put(job)
    processes = [_start() for _ in range(min(workers, len(wanted)))]
    for process in processes:
        threading.Thread(
            target=_attend, args=(process, arguments, jobs, answers), daemon=True
        ).start()
    try:
        for _ in wanted:
            answer = answers.get()
            if answer is None:
                raise ComputationError(
                    "a worker process ended before its sample was done",
                    "--workers",
                    "is there memory for so many? What is finished is kept: go on with --resume",
                )
            yield answer
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _start() -> "subprocess.Popen[bytes]":
    # a session of its own: Ctrl-C is the parent's to handle
    return subprocess.Popen(
        [sys.executable, "-m", "tkamb.uncertainty.workers"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )


def _attend(
    process: "subprocess.Popen[bytes]",
    arguments: tuple[Scene, range, Sequence[str]],
    jobs: "queue.SimpleQueue[tuple[int, Array]]",
    answers: "queue.SimpleQueue[Numbered | None]",
) -> None:
    """Hand one worker its jobs; None among the answers says that it is gone."""
    assert process.stdin is not None and process.stdout is not None
    try:
        _send(process.stdin, arguments)
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
    sampler = Sampler(*pickle.load(jobs))
    while True:
        try:
            number, normal = pickle.load(jobs)
        except EOFError:
            return
        _send(answers, (number, sampler.sample(number, normal)))


if __name__ == "__main__":
    serve()
