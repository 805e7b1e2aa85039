"""Loops compiled by numba when they are first called, and kept on disk for the next process.

Import it only where a lattice is: it takes 0.4 s. The compiled code lies beside the module or,
where that folder cannot be written, in the user's cache (`NUMBA_CACHE_DIR` says where). Sums may
be taken in another order, as vector registers do; nothing else of IEEE arithmetic is given up.
Indices are not held against bounds.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return the function compiled; it lets other threads run."""
    compiler: Any = njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
    return cast(Function, compiler(function))
