"""Decorators for loops that numba compiles at the first call and stores on disk.

The import takes 0.1 to 0.4 s. The compiled code is stored beside the module, or in the user's cache
(`NUMBA_CACHE_DIR`) if that folder cannot be written. Indices are not checked against bounds.

A compiled function may call compiled functions of other files, because its stored name contains a
hash of these files. It uses no other name of them: Numba's cache detects changes of its own file
only.
"""

import hashlib
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
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


def compiled_for_microseconds(function: Function) -> Function:
    """Return the result of `compiled_as_written`, but other threads do not run during a call.

    Handing over Python's lock takes longer than such a call.
    """
    return _compiled(function, set(), error_model="numpy", nogil=False)


def _compiled(function: Function, fastmath: set[str], **more: Any) -> Function:
    options: dict[str, Any] = {"nogil": True, "fastmath": fastmath or False, **more}
    compiler: Any = njit
    try:
        _name_by_files(function)
        return cast(Function, compiler(cache=True, **options)(function))
    except (RuntimeError, OSError):  # numba has no folder for its cache, or a file is missing
        _say_once()
        return cast(Function, compiler(**options)(function))


def _name_by_files(function: Any) -> None:
    """Add a hash of called functions' files to the name of the stored code."""
    own, values = {function.__code__.co_filename}, function.__globals__
    called = [getattr(values.get(name), "py_func", None) for name in function.__code__.co_names]
    function.files = own.union(*(getattr(one, "files", ()) for one in called))
    if others := function.files - own:
        text = b"".join(Path(file).read_bytes() for file in sorted(others))
        function.__qualname__ += f"_{hashlib.sha256(text).hexdigest()[:16]}"


@cache
def _say_once() -> None:
    _log.warning(
        "compiled loops cannot be stored: every process compiles them again, in ten seconds or "
        "more; set NUMBA_CACHE_DIR to a folder that can be written to"
    )
