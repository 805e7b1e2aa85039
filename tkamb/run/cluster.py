"""Jobs over a Dask cluster: the same answers as those of worker processes.

Dask is an extra (`pip install 'tkamb[cluster]'`) and imported only when asked for. Each process
of the cluster prepares once what the jobs share. A job whose worker dies is done again by
another one; a job is a function of its number and content alone, so that changes no answer.
"""

import logging
import pickle
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from tkamb.errors import ComputationError, InputError

if TYPE_CHECKING:
    from tkamb.run.workers import Numbered, Task

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
        return _prepared(packed)(number, job)


@lru_cache(maxsize=1)
def _prepared(packed: bytes) -> Callable[[int, Any], Any]:
    make, arguments = pickle.loads(packed)
    prepared: Callable[[int, Any], Any] = make(*arguments)
    return prepared
