"""A second thread, for compiled loops that release Python's interpreter lock.

The environment variable TKAMB_THREADS is the number of threads of a process, 1 or 2; default: 2 if
it has two processors. Results are equal to the last bit, because work is divided in the same way
for one thread or two.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Lock
from typing import TypeVar

from tkamb.errors import InputError

VARIABLE = "TKAMB_THREADS"

First = TypeVar("First")
Second = TypeVar("Second")


def both(first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Call two functions, at the same time if the second thread is free.

    `second` neither needs results of `first` nor changes its data; `first` runs in this thread. An
    error of `first` is raised after `second` has ended.
    """
    busy, thread = _second()
    if threads() == 1 or not busy.acquire(blocking=False):
        return first(), second()
    try:
        future = thread.submit(second)
        try:
            result = first()
        finally:
            future.exception()
        return result, future.result()
    finally:
        busy.release()


def in_halves(part: Callable[[slice], First], count: int) -> tuple[First, First]:
    """Return the results for the first and the second half of `count` items; see `both`."""
    half = count // 2
    return both(lambda: part(slice(0, half)), lambda: part(slice(half, count)))


@cache
def threads() -> int:
    """Return the number of threads that this process may use, 1 or 2.

    Raises:
        InputError: TKAMB_THREADS is neither 1 nor 2.
    """
    text = os.environ.get(VARIABLE, "")
    if text not in ("", "1", "2"):
        raise InputError(f"{text!r} is neither 1 nor 2", VARIABLE)
    if text:
        return int(text)
    affinity = getattr(os, "sched_getaffinity", None)  # Linux: processors of this process
    return min(2, len(affinity(0)) if affinity else os.cpu_count() or 1)


@cache
def _second() -> tuple[Lock, ThreadPoolExecutor]:
    """The lock is closed while the second thread works."""
    return Lock(), ThreadPoolExecutor(1, "tkamb")


os.register_at_fork(after_in_child=_second.cache_clear)  # a forked process has no second thread
