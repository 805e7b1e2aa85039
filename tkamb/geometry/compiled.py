"""Loops compiled by numba when they are first called, and kept on disk for the next process.

Import it only where meshes or a lattice are needed: it takes 0.1 to 0.4 s. The compiled code lies
beside the module or, where that folder cannot be written, in the user's cache (`NUMBA_CACHE_DIR`
names it). Indices are not checked against bounds. A compiled function uses nothing of another
file, because the cache would not notice a change there.
"""

import logging
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])

_log = logging.getLogger("tkamb")


def compiled(function: Function) -> Function:
    """Return the function compiled; it lets other threads run.

    Sums may be taken in another order, for vector registers; all other IEEE arithmetic holds.
    """
    return _compiled(function, {"reassoc", "contract", "nsz"})


def compiled_as_written(function: Function) -> Function:
    """Return the function compiled without that freedom: equal numbers stay equal.

    A division by zero gives inf or NaN, as in numpy.
    """
    return _compiled(function, set(), error_model="numpy")


def _compiled(function: Function, fastmath: set[str], **more: str) -> Function:
    options: dict[str, Any] = {"nogil": True, "fastmath": fastmath or False, **more}
    compiler: Any = njit
    try:
        return cast(Function, compiler(cache=True, **options)(function))
    except RuntimeError:  # numba finds no folder that it may write to
        _say_once()
        return cast(Function, compiler(**options)(function))


@cache
def _say_once() -> None:
    _log.warning(
        "compiled loops cannot be stored: every process compiles them again, in ten seconds or "
        "more; "
        "set NUMBA_CACHE_DIR to a folder that can be written to"
    )
