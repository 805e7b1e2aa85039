"""Cache of prepared operators on disk.

The key of a file is the SHA-256 of everything that its operator depends on: nodes, cells, held
unknowns, contact nodes, elastic constants, kind of solid, and tkamb's own code. A file is a NumPy
archive (.npz, not compressed) of the key and the operator's arrays. Each array has a CRC-32. A file
is written under a temporary name and then renamed, so that other processes never read half a file.
It is read into memory: one that is cut short in use does no harm.

A file is used only if
- it is a regular file of this user, and nobody else may write it;
- key and checksums are right;
- its operator inverts the stiffness of the solid (`operator_error`).
Otherwise the operator is computed again, with one notice. After a write, half-written files of
killed processes are removed, and, if the folder exceeds its limit, the least recently used files.

The folder is $TKAMB_CACHE_DIR, else $XDG_CACHE_HOME/tkamb, else ~/.cache/tkamb.
"""

import hashlib
import logging
import os
import stat
import tempfile
import time as clock
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tkamb import code_identity
from tkamb.contact.lattice.linear.compliance import HalfResponse
from tkamb.contact.lattice.linear.multifrontal import CholeskyFactor
from tkamb.contact.lattice.linear.operator import ElasticOperator, operator_error
from tkamb.contact.lattice.solid import Solid
from tkamb.errors import InputError
from tkamb.files import open_regular, undamaged
from tkamb.geometry.frames import Index, Mask


@dataclass(frozen=True)
class FactorCacheSettings:
    """The folder of factorised lattices on disk."""

    least_unknowns: int = 20_000
    """Unknowns: smaller operators are not stored. Factorising them takes two seconds
    or less."""
    size_limit: float = 6e9
    """Bytes: largest size of the folder, a small part of a usual disk."""
    largest_error: float = 2e-3
    """1: largest relative error of a stored operator (`operator_error`). Rounding to
    16 bits causes 5e-4 for every Poisson's ratio and bearing; four times as much means a damaged
    file."""
    orphan_seconds: float = 600.0
    """s: age from which a half-written file is removed. Writing 6 GB takes less."""


FACTOR_CACHE = FactorCacheSettings()


_log = logging.getLogger("tkamb")


def cache_folder() -> Path:
    """Return the folder of prepared operators."""
    folder = os.environ.get("TKAMB_CACHE_DIR")
    if folder:
        return Path(folder)
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "tkamb"


def operator_key(
    solid: Solid, fixed: NDArray[Any], contact_nodes: NDArray[Any], coarse: bool = True
) -> str:
    """Return the hash of everything that an operator depends on, the code included."""
    material = solid.material
    code = code_identity("contact/lattice")
    kind = (type(solid).__name__, "16 bits" if coarse else "single")
    words = (code, *kind, material.young_modulus, material.poisson_ratio)
    digest = hashlib.sha256(repr(words).encode())
    for array in (solid.nodes, solid.spacing, solid.cells, fixed, contact_nodes):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def cached_operator(
    solid: Solid,
    fixed: Mask,
    contact_nodes: Index,
    make: Callable[[], ElasticOperator],
    coarse: bool = True,
    limit: float = FACTOR_CACHE.size_limit,
) -> ElasticOperator:
    """Return a solid's operator, from disk or newly computed and stored.

    If the folder cannot be written, the operator is computed each time.

    Args:
        fixed: mask of the held unknowns, (3n,).
        contact_nodes: nodes of the contact surface, (c,).
        coarse: whether its factor is stored in 16-bit integers.
        limit: largest size of the folder, bytes; a larger operator is not stored.
    """
    if int((~fixed).sum()) < FACTOR_CACHE.least_unknowns:
        return make()
    key = operator_key(solid, fixed, contact_nodes, coarse)
    path = cache_folder() / f"{key}.operator"
    try:
        stored = read_operator(path, key, limit)
        if stored is not None:
            check_operator(stored, solid, fixed, contact_nodes)
            return stored
    except InputError as damage:
        _log.warning("%s: %s; the operator is computed again", path, damage.what)
    fresh = make()
    if sum(part.nbytes for part in _parts(fresh)) <= limit:
        try:
            write_operator(path, key, fresh)
            prune(path.parent, limit)
        except OSError as error:
            _log.warning("%s: the operator is not stored (%s)", path, error.strerror or error)
    return fresh


def check_operator(
    operator: ElasticOperator, solid: Solid, fixed: Mask, contact_nodes: Index
) -> None:
    """Check that a stored operator belongs to the solid.

    Args:
        fixed: mask of the held unknowns, (3n,).
        contact_nodes: nodes of the contact surface, (c,).

    Raises:
        InputError: the operator has other unknowns, or does not invert the stiffness.
    """
    same_unknowns = np.array_equal(operator.free, ~fixed)
    if not same_unknowns or not np.array_equal(operator.contact_nodes, contact_nodes):
        raise InputError("has other held unknowns or contact nodes")
    error = operator_error(operator, solid)
    if not error <= FACTOR_CACHE.largest_error:
        raise InputError(f"differs from the solid's stiffness by {100 * error:.2g} %")


def write_operator(path: Path, key: str, operator: ElasticOperator) -> None:
    """Write a file under a temporary name, then rename it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".tkamb-", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, np.array(key), *_parts(operator))
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _parts(operator: ElasticOperator) -> list[NDArray[Any]]:
    factor, half = operator.factor, operator.half
    return [
        operator.free,
        operator.contact_nodes,
        factor.order,
        factor.starts,
        factor.parents,
        factor.edges,
        factor.boundary,
        factor.values,
        factor.scale,
        half.rank,
        half.blocks,
        half.values,
    ]


def read_operator(
    path: Path, key: str, limit: float = FACTOR_CACHE.size_limit
) -> ElasticOperator | None:
    """Return the operator in a file; None if there is no file.

    Raises:
        InputError: the file is damaged, not this user's, or has another key.
    """
    if not os.path.lexists(path):
        return None
    with os.fdopen(open_regular(path, 1.5 * limit, follow=False), "rb") as file, undamaged(path):
        status = os.fstat(file.fileno())
        if status.st_uid != os.geteuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise InputError("is not the user's own", path)
        with np.load(file, allow_pickle=False) as arrays:
            stored, *parts = (arrays[name] for name in arrays)
        if str(stored) != key:
            raise ValueError("it has another key")
        free, contact_nodes, *factor, rank, blocks, columns = parts
        half = HalfResponse.of(rank, blocks, columns)
        operator = ElasticOperator(free, CholeskyFactor(*factor), contact_nodes, half)
        # Record the time of use for `prune`. This fails if writing is forbidden.
        with suppress(OSError):
            os.utime(file.fileno())
    return operator


def prune(folder: Path, limit: float) -> None:
    """Delete half-written files, then the least recently used operators above the limit, bytes."""
    entries = []
    for path in folder.glob("*.operator"):
        try:
            status = path.lstat()
        except FileNotFoundError:
            continue
        entries.append((status.st_mtime, status.st_size, path))
    now = clock.time()
    for path in folder.glob(".tkamb-*.part"):
        with suppress(FileNotFoundError):
            if now - path.lstat().st_mtime > FACTOR_CACHE.orphan_seconds:
                path.unlink()
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries, key=lambda entry: entry[0]):
        if total <= limit:
            return
        path.unlink(missing_ok=True)
        total -= size
