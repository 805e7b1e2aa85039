"""A second thread, for compiled loops that release Python's interpreter lock.

TKAMB_THREADS says how many threads a process may use, 1 or 2; without it 2, where the machine
gives it two processors. What is computed does not depend on it, to the last bit: work is divided
in the same way whether one thread does it or two.
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
    """Call two functions, at the same time if the other thread has nothing to do.

    Args:
        first: called in this thread.
        second: must not need what `first` makes, nor write to what it reads.

    Returns:
        What they return. An error of `first` is raised when `second` has ended.
    """
    busy, thread = _second()
    if threads() == 1 or not busy.acquire(blocking=False):
        return first(), second()
    try:
        other = thread.submit(second)
        try:
            result = first()
        finally:
            other.exception()
        return result, other.result()
    finally:
        busy.release()


def in_halves(part: Callable[[slice], First], count: int) -> tuple[First, First]:
    """Return the results for the first and the second half of `count` items; see `both`."""
    half = count // 2
    return both(lambda: part(slice(0, half)), lambda: part(slice(half, count)))


@cache
def threads() -> int:
    """Return how many threads this process may use: 1 or 2.

    Raises:
        InputError: TKAMB_THREADS is neither.
    """
    text = os.environ.get(VARIABLE, "")
    if text not in ("", "1", "2"):
        raise InputError(f"{text!r} is neither 1 nor 2", VARIABLE)
    if text:
        return int(text)
    own = getattr(os, "sched_getaffinity", None)  # Linux: what this process was given
    return min(2, len(own(0)) if own else os.cpu_count() or 1)


@cache
def _second() -> tuple[Lock, ThreadPoolExecutor]:
    """The second thread, and the lock that is held while it works."""
    return Lock(), ThreadPoolExecutor(1, "tkamb")


os.register_at_fork(after_in_child=_second.cache_clear)  # a forked process does not have it
