"""Cache of prepared operators on disk.

The key of a file is the SHA-256 of everything that its operator depends on: nodes, cells, held
unknowns, contact nodes, elastic constants, kind of solid, and tkamb's own code. A file is

    magic (16 bytes) | two sums (16) | length of the header (8) | header (JSON) | arrays

The first sum adds all 64-bit words that follow, modulo 2^64. The second adds each word times its
position. Together they detect changed bits and exchanged words in an eighth of the time of CRC-32.
A file is written under a temporary name and then renamed, so that other processes never read half
a file.

A file is used only if
- it is a regular file of this user, and nobody else may write it;
- size, sums and key are right;
- its operator inverts the stiffness of the solid (`operator_error`).
Otherwise the operator is computed again, with one notice. After a file is written, half-written
files of killed processes are removed. If the folder then exceeds its limit, the least recently used
files are removed too.

The folder is $TKAMB_CACHE_DIR, else $XDG_CACHE_HOME/tkamb, else ~/.cache/tkamb. Small operators,
which take two seconds or less, are not stored.
"""

import fcntl
import hashlib
import json
import logging
import mmap
import os
import stat
import tempfile
import time as clock
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from tkamb import code_identity
from tkamb.contact.lattice.linear.compliance import HalfResponse
from tkamb.contact.lattice.linear.multifrontal import CholeskyFactor
from tkamb.contact.lattice.linear.operator import ElasticOperator, operator_error
from tkamb.contact.lattice.solid import Solid
from tkamb.errors import InputError
from tkamb.files import open_regular
from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Index, Mask

MAGIC = b"tkamb operator 9"
SUMS = 16
"""Bytes of the two sums."""
PREFIX = len(MAGIC) + SUMS + 8
"""Bytes before the header."""
BOUNDARY = 64
"""Bytes; every array begins at a multiple of it."""


@dataclass(frozen=True)
class FactorCacheSettings:
    """The folder of factorised lattices on disk."""

    longest_header: int = 1_000_000
    """Bytes: a file with a longer header is rejected. Chosen because a real header has some
    hundreds."""
    least_unknowns: int = 20_000
    """Unknowns: smaller operators are not stored. Chosen because factorising them takes two seconds
    or less."""
    size_limit: float = 6e9
    """Bytes: largest size of the folder. The least recently used files are removed first. Chosen
    because it is a small part of a usual disk."""
    largest_error: float = 2e-3
    """1: largest relative error of a stored operator (`operator_error`). Chosen because rounding to
    16 bits causes 5e-4 for every Poisson's ratio and bearing; four times as much means a damaged
    file."""
    orphan_seconds: float = 60.0
    """s: age from which an unlocked, half-written file is removed. Chosen because writing a file
    takes less."""


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
        solid: cells and material.
        fixed: mask of the held unknowns, shape (3n,).
        contact_nodes: nodes of the contact surface, shape (c,).
        make: function that computes the operator.
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
            check_operator(*stored, solid, fixed, contact_nodes)
            return stored[0]
    except DamagedOperator as damage:
        _log.warning("%s: %s; the operator is computed again", path, damage)
    fresh = make()
    if sum(part.nbytes for part in _parts(fresh)) <= limit:
        try:
            write_operator(path, key, fresh)
            prune(path.parent, limit)
        except OSError as error:
            _log.warning("%s: the operator is not stored (%s)", path, error.strerror or error)
    return fresh


class DamagedOperator(Exception):
    """The file exists, but does not contain the requested operator."""


def check_operator(
    operator: ElasticOperator,
    mapped: mmap.mmap,
    solid: Solid,
    fixed: Mask,
    contact_nodes: Index,
) -> None:
    """Check that a stored operator belongs to the solid.

    The mapped memory is released after the check, because a motion reads only a small part of the
    response. Pages that are read again come from the system's file cache.

    Args:
        operator: the stored operator.
        mapped: its file in memory.
        solid: cells and material.
        fixed: mask of the held unknowns, shape (3n,).
        contact_nodes: nodes of the contact surface, shape (c,).

    Raises:
        DamagedOperator: the operator has other unknowns, or does not invert the stiffness.
    """
    same_unknowns = np.array_equal(operator.free, ~fixed)
    if not same_unknowns or not np.array_equal(operator.contact_nodes, contact_nodes):
        raise DamagedOperator("has other held unknowns or contact nodes")
    try:
        error = operator_error(operator, solid, lambda: mapped.madvise(mmap.MADV_DONTNEED))
    except (ValueError, IndexError) as broken:  # indices out of range
        raise DamagedOperator(f"is not an operator ({broken})") from None
    if not error <= FACTOR_CACHE.largest_error:
        raise DamagedOperator(f"differs from the solid's stiffness by {100 * error:.2g} %")


def write_operator(path: Path, key: str, operator: ElasticOperator) -> None:
    """Write a file under a temporary name, then rename it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = _parts(operator)
    header = json.dumps(
        {
            "key": key,
            "code": code_identity("contact/lattice"),
            "arrays": [[array.dtype.str, list(array.shape)] for array in arrays],
        }
    ).encode()
    header += b" " * _padding(PREFIX + len(header))
    parts = [_words(len(header).to_bytes(8, "little") + header)]
    for array in arrays:
        content = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        end = len(content) // BOUNDARY * BOUNDARY
        remainder = content[end:].tobytes()
        padded = remainder + bytes(_padding(len(remainder)))
        parts += [content[:end].view(np.uint64), _words(padded)]
    sums, count = np.zeros(2, np.uint64), 0
    for words in parts:
        _add_sums(words, count, sums)
        count += len(words)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".tkamb-", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # keeps other processes from removing it as an orphan
            file.write(MAGIC + sums.tobytes())
            for words in parts:
                file.write(words.data)
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
) -> tuple[ElasticOperator, mmap.mmap] | None:
    """Return the operator in a file, and the mapped file; None if there is no file.

    Raises:
        DamagedOperator: the file is incomplete, not this user's, or has another key.
    """
    try:
        descriptor = open_regular(path, 1.5 * limit, follow=False)
    except InputError as error:
        if not os.path.lexists(path):
            return None
        raise DamagedOperator(error.what) from None
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(file.fileno())
        if status.st_uid != os.geteuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise DamagedOperator("is not the user's own")
        try:
            mapped, arrays = _arrays(file, status.st_size, key)
            operator = _operator_of(arrays)
        except (OSError, ValueError, KeyError, TypeError, IndexError, MemoryError) as error:
            raise DamagedOperator(f"is damaged ({error})") from None
        # Record the time of use for `prune`. This fails if another process has removed the file, or
        # if writing is forbidden.
        with suppress(OSError):
            os.utime(file.fileno())
    return operator, mapped


def _arrays(file: BinaryIO, size: int, key: str) -> tuple[mmap.mmap, list[NDArray[Any]]]:
    """Map a file of `size` bytes and return its arrays, after checking key and sums."""
    start = file.read(PREFIX)
    length = int.from_bytes(start[-8:], "little")
    if len(start) < PREFIX or start[: len(MAGIC)] != MAGIC or length > FACTOR_CACHE.longest_header:
        raise ValueError("it has no valid header")
    text = file.read(length)
    header = json.loads(text)
    if header["key"] != key or header["code"] != code_identity("contact/lattice"):
        raise ValueError("it has another key or code")
    shapes = [(np.dtype(kind), tuple(map(int, shape))) for kind, shape in header["arrays"]]
    sizes = [kind.itemsize * int(np.prod(shape, dtype=object)) for kind, shape in shapes]
    firsts = np.cumsum([len(start) + length, *(n + _padding(n) for n in sizes)]).tolist()
    if any(n < 0 for n in sizes) or firsts[-1] != size:
        raise ValueError("its size differs from its header")
    # A mapped file is not copied, and processes share it. Changes of a mapped array stay in this
    # process.
    mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    content, sums = memoryview(mapped), np.zeros(2, np.uint64)
    _add_sums(_words(content[len(MAGIC) + SUMS :]), 0, sums)
    mapped.madvise(mmap.MADV_DONTNEED)
    if sums.tobytes() != start[len(MAGIC) : -8]:
        raise ValueError("its sums differ")
    return mapped, [
        np.frombuffer(content[first : first + n], kind).reshape(shape)
        for (kind, shape), first, n in zip(shapes, firsts, sizes, strict=False)
    ]


def _words(content: bytes | memoryview) -> NDArray[np.uint64]:
    """Return content as 64-bit words."""
    return np.frombuffer(content, np.uint64) if len(content) else np.zeros(0, np.uint64)


@compiled
def _add_sums(words: NDArray[np.uint64], first: int, sums: NDArray[np.uint64]) -> None:
    """Add 64-bit words to `sums[0]`, and words times positions to `sums[1]`.

    `first` is the position of the first word.
    """
    plain, weighted, offset = sums[0], sums[1], np.uint64(first)
    for i in range(len(words)):
        plain += words[i]
        weighted += words[i] * (np.uint64(i) + offset)
    sums[0], sums[1] = plain, weighted


def _padding(length: int) -> int:
    """Return the number of bytes from `length` to the next boundary."""
    return -length % BOUNDARY


def _operator_of(arrays: list[NDArray[Any]]) -> ElasticOperator:
    """Return the operator from its arrays, in the order of `_parts`.

    Compiled code does not check bounds, so every index is checked here.
    """
    free, contact_nodes, *factor_arrays, rank, blocks, columns = arrays
    factor = CholeskyFactor(*factor_arrays)
    unknowns, fronts = len(factor.order), len(factor.parents)
    _check(factor.order, 0, unknowns)
    _check(factor.boundary, 0, unknowns)
    _check(factor.parents, -1, fronts)
    for edges, count in (factor.starts, unknowns), (factor.edges, len(factor.boundary)):
        if len(edges) != fronts + 1 or edges[0] != 0 or edges[-1] != count:
            raise ValueError("the fronts are not contiguous")
        _check(np.diff(edges), 0, count + 1)
    if (
        len(factor.scale) != unknowns + len(factor.boundary)
        or len(factor.values) != factor.firsts[-1]
    ):
        raise ValueError("the factor has a wrong number or length of rows")
    if factor.parents.size and not (factor.parents > np.arange(fronts))[factor.parents >= 0].all():
        raise ValueError("a front is not below its parent")
    half = HalfResponse.of(rank, blocks, columns)
    for edges, count in (blocks[:, :2], unknowns), (blocks[:, 2:], half.columns):
        _check(edges, 0, count + 1)
        _check(np.diff(edges), 0, count + 1)
    _check(rank, -1, half.columns)
    if len(columns) != (np.diff(blocks[:, :2]) * np.diff(blocks[:, 2:])).sum():
        raise ValueError("the response has a wrong number or length of columns")
    return ElasticOperator(free, factor, contact_nodes, half)


def _check(indices: Index, least: int, end: int) -> None:
    """Raise ValueError unless all indices lie in [least, end)."""
    if len(indices) and not (indices.min() >= least and indices.max() < end):
        raise ValueError("an index is out of range")


def prune(folder: Path, limit: float) -> None:
    """Delete half-written files, then the least recently used operators above the limit, bytes."""
    entries = []
    for path in folder.glob("*.operator"):
        try:
            status = path.lstat()
        except FileNotFoundError:
            continue
        entries.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in entries) + _remove_orphans(folder)
    for _, size, path in sorted(entries, key=lambda entry: entry[0]):
        if total <= limit:
            return
        path.unlink(missing_ok=True)
        total -= size


def _remove_orphans(folder: Path) -> int:
    """Remove half-written files of killed processes; return the bytes of young or locked ones."""
    remaining = removed = freed = 0
    # Release 0.1.0 wrote tmp*.part.
    for path in [*folder.glob(".tkamb-*.part"), *folder.glob("tmp*.part")]:
        try:
            with os.fdopen(open_regular(path, float("inf"), follow=False), "rb") as file:
                status = os.fstat(file.fileno())
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if clock.time() - status.st_mtime < FACTOR_CACHE.orphan_seconds:
                    raise BlockingIOError
                path.unlink(missing_ok=True)
            removed, freed = removed + 1, freed + status.st_size
        except BlockingIOError:
            remaining += status.st_size
        except InputError:
            continue
    if removed:
        _log.warning("%s: %d unfinished file(s) removed, %.0f MB", folder, removed, freed / 1e6)
    return remaining
