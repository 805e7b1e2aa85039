"""Decorators for loops that numba compiles at the first call and stores on disk.

The import takes 0.1 to 0.4 s. The compiled code is stored beside the module, or in the user's cache
(`NUMBA_CACHE_DIR`) if that folder cannot be written. Indices are not checked against bounds. A
compiled function uses no name of another file, because numba's cache does not detect changes of
other files.
"""

import logging
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])

_log = logging.getLogger("tkamb")


def compiled(function: Function) -> Function:
    """Return the compiled function; other threads run during a call.

    Sums may be reordered for vector registers, and a product and a sum may be rounded together.
    """
    return _compiled(function, {"reassoc", "contract", "nsz"})


def compiled_as_written(function: Function) -> Function:
    """Return the compiled function with all operations in the written order.

    A division by zero gives inf or NaN, as in numpy.
    """
    return _compiled(function, set(), error_model="numpy")


def _compiled(function: Function, fastmath: set[str], **more: str) -> Function:
    options: dict[str, Any] = {"nogil": True, "fastmath": fastmath or False, **more}
    compiler: Any = njit
    try:
        return cast(Function, compiler(cache=True, **options)(function))
    except RuntimeError:  # numba has no folder for its cache
        _say_once()
        return cast(Function, compiler(**options)(function))


@cache
def _say_once() -> None:
    _log.warning(
        "compiled loops cannot be stored: every process compiles them again, in ten seconds or "
        "more; set NUMBA_CACHE_DIR to a folder that can be written to"
    )
