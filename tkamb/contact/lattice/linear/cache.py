"""Prepared operators on disk, found by a hash of everything that they depend on.

The key is the SHA-256 of everything that the operator depends on: nodes, cells, held unknowns,
contact nodes, elastic constants, kind of solid, and the code that makes it. A file is

    magic (16 bytes) | two sums (16) | length of the header (8) | header (JSON) | arrays

The two sums are over all 64-bit words that follow: of the words, and of each word times its
position, modulo 2^64. They detect any changed bit, and words that changed places, in an eighth of
the time of CRC-32. A file is written beside its place and moved there in one step, so that another
process sees a whole file or none. A file is used only if it is a regular one of the user's own that
nobody else may write, its size is what its header says, its sums and key are right, and its
operator inverts the stiffness that is assembled anew (`operator_error`). Otherwise the operator is
made again, with one notice. The files used longest ago are removed when the folder exceeds its
limit, and with them files that a killed process left half written.

The folder is $TKAMB_CACHE_DIR, else $XDG_CACHE_HOME/tkamb, else ~/.cache/tkamb. Operators that
can be made in about a second are not kept.
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
    """Bytes: a file whose header claims more is not one of ours. Chosen: a real header has some
    hundreds."""
    least_unknowns: int = 20_000
    """Unknowns: smaller operators are not stored. Chosen: factorising them is faster than
    reading."""
    size_limit: float = 6e9
    """Bytes that the folder may hold; the files used longest ago are removed first. Chosen: a small
    part of a usual disk."""
    largest_error: float = 2e-3
    """1: largest relative error of an operator that is read (`operator_error`). Chosen: storage in
    16 bits leaves 5e-4 (random displacement) for every Poisson's ratio and bearing; four times that
    is a damaged file."""
    orphan_seconds: float = 60.0
    """s: age from which a half-written file that nobody has locked is removed. Chosen: writing a
    file takes less."""


FACTOR_CACHE = FactorCacheSettings()


_log = logging.getLogger("tkamb")


def cache_folder() -> Path:
    """Return the folder of prepared operators."""
    own = os.environ.get("TKAMB_CACHE_DIR")
    if own:
        return Path(own)
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "tkamb"


def operator_key(
    solid: Solid, fixed: NDArray[Any], contact_nodes: NDArray[Any], coarse: bool = True
) -> str:
    """Return the hash of an operator: of everything that it depends on, and of the code."""
    material = solid.material
    made_by = code_identity("contact/lattice")
    kind = (type(solid).__name__, "16 bits" if coarse else "single")
    words = (made_by, *kind, material.young_modulus, material.poisson_ratio)
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
    """Return a solid's operator, from disk or newly made and kept.

    A folder that cannot be written to only costs the time to make the operator again.

    Args:
        solid: cells and material.
        fixed: (3n,) unknowns held by the boundary.
        contact_nodes: (c,) nodes that can be touched.
        make: makes the operator.
        coarse: whether that has a factor of 16-bit integers.
        limit: bytes that the folder may hold; a larger operator is not kept.
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
        _log.warning("%s: %s; the operator is made again", path, damage)
    fresh = make()
    if sum(part.nbytes for part in _parts(fresh)) <= limit:
        try:
            write_operator(path, key, fresh)
            prune(path.parent, limit)
        except OSError as error:
            _log.warning("%s: not kept (%s)", path, error.strerror or error)
    return fresh


class DamagedOperator(Exception):
    """The file exists, but does not hold the operator that was asked for."""


def check_operator(
    operator: ElasticOperator,
    mapped: mmap.mmap,
    solid: Solid,
    fixed: Mask,
    contact_nodes: Index,
) -> None:
    """Check an operator that was read against the solid that it should belong to.

    The memory of its file is released as soon as it has been checked: a motion reads only a
    small part of the response. Pages that are read again come from the system's file cache.

    Raises:
        DamagedOperator: it is of other unknowns, or does not invert the solid's stiffness.
    """
    same = np.array_equal(operator.free, ~fixed)
    if not same or not np.array_equal(operator.contact_nodes, contact_nodes):
        raise DamagedOperator("is of another boundary")
    try:
        error = operator_error(operator, solid, lambda: mapped.madvise(mmap.MADV_DONTNEED))
    except (ValueError, IndexError) as broken:  # indices that lead nowhere
        raise DamagedOperator(f"is not an operator ({broken})") from None
    if not error <= FACTOR_CACHE.largest_error:
        raise DamagedOperator(f"is off the assembled stiffness by {100 * error:.2g} %")


def write_operator(path: Path, key: str, operator: ElasticOperator) -> None:
    """Write beside the path, then move there in one step."""
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
        whole = len(content) // BOUNDARY * BOUNDARY
        rest = content[whole:].tobytes()
        parts += [content[:whole].view(np.uint64), _words(rest + bytes(_padding(len(rest))))]
    sums, count = np.zeros(2, np.uint64), 0
    for words in parts:
        _add_sums(words, count, sums)
        count += len(words)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".tkamb-", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # says that somebody is at it, until he closes or dies
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
    """Return the operator in a file, and the file in memory; None if there is no file.

    Raises:
        DamagedOperator: the file is not one that this user wrote whole, or of another key.
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
        # Records when it was last used. Another process may have removed it, or writing is
        # forbidden.
        with suppress(OSError):
            os.utime(file.fileno())
    return operator, mapped


def _arrays(file: BinaryIO, size: int, key: str) -> tuple[mmap.mmap, list[NDArray[Any]]]:
    """Return a file of that size, mapped, and its arrays, after key and sums were checked."""
    start = file.read(PREFIX)
    length = int.from_bytes(start[-8:], "little")
    if len(start) < PREFIX or start[: len(MAGIC)] != MAGIC or length > FACTOR_CACHE.longest_header:
        raise ValueError("no such header")
    text = file.read(length)
    header = json.loads(text)
    if header["key"] != key or header["code"] != code_identity("contact/lattice"):
        raise ValueError("another key or code")
    shapes = [(np.dtype(kind), tuple(map(int, shape))) for kind, shape in header["arrays"]]
    sizes = [kind.itemsize * int(np.prod(shape, dtype=object)) for kind, shape in shapes]
    firsts = np.cumsum([len(start) + length, *(n + _padding(n) for n in sizes)]).tolist()
    if any(n < 0 for n in sizes) or firsts[-1] != size:
        raise ValueError("another size than its header says")
    # Mapped, not read: nothing is copied, and processes share it. A file is never written in
    # place; what is written to a mapped array stays this process's own.
    mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    content, sums = memoryview(mapped), np.zeros(2, np.uint64)
    _add_sums(_words(content[len(MAGIC) + SUMS :]), 0, sums)
    mapped.madvise(mmap.MADV_DONTNEED)
    if sums.tobytes() != start[len(MAGIC) : -8]:
        raise ValueError("other sums")
    return mapped, [
        np.frombuffer(content[first : first + n], kind).reshape(shape)
        for (kind, shape), first, n in zip(shapes, firsts, sizes, strict=False)
    ]


def _words(content: bytes | memoryview) -> NDArray[np.uint64]:
    """Return content as 64-bit words."""
    return np.frombuffer(content, np.uint64) if len(content) else np.zeros(0, np.uint64)


@compiled
def _add_sums(words: NDArray[np.uint64], first: int, sums: NDArray[np.uint64]) -> None:
    """Add 64-bit words to one sum, and times their position to another; `first` is the first's."""
    plain, weighted, number = sums[0], sums[1], np.uint64(first)
    for i in range(len(words)):
        plain += words[i]
        weighted += words[i] * (np.uint64(i) + number)
    sums[0], sums[1] = plain, weighted


def _padding(length: int) -> int:
    """Return how many bytes are missing to the next boundary, at which an array may begin."""
    return -length % BOUNDARY


def _operator_of(arrays: list[NDArray[Any]]) -> ElasticOperator:
    """Return the operator of the arrays of `_parts`.

    Compiled code does not check bounds, so every index is checked here.
    """
    free, contact_nodes, *of_factor, rank, blocks, columns = arrays
    factor = CholeskyFactor(*of_factor)
    unknowns, fronts = len(factor.order), len(factor.parents)
    _check(factor.order, 0, unknowns)
    _check(factor.boundary, 0, unknowns)
    _check(factor.parents, -1, fronts)
    for edges, count in (factor.starts, unknowns), (factor.edges, len(factor.boundary)):
        if len(edges) != fronts + 1 or edges[0] != 0 or edges[-1] != count:
            raise ValueError("fronts that do not follow each other")
        _check(np.diff(edges), 0, count + 1)
    if (
        len(factor.scale) != unknowns + len(factor.boundary)
        or len(factor.values) != factor.firsts[-1]
    ):
        raise ValueError("rows of another number or length")
    if factor.parents.size and not (factor.parents > np.arange(fronts))[factor.parents >= 0].all():
        raise ValueError("a front that is not below its parent")
    half = HalfResponse.of(rank, blocks, columns)
    for edges, count in (blocks[:, :2], unknowns), (blocks[:, 2:], half.columns):
        _check(edges, 0, count + 1)
        _check(np.diff(edges), 0, count + 1)
    _check(rank, -1, half.columns)
    if len(columns) != (np.diff(blocks[:, :2]) * np.diff(blocks[:, 2:])).sum():
        raise ValueError("columns of another number or length")
    return ElasticOperator(free, factor, contact_nodes, half)


def _check(indices: Index, least: int, end: int) -> None:
    """Raise ValueError unless all indices lie in [least, end)."""
    if len(indices) and not (indices.min() >= least and indices.max() < end):
        raise ValueError("an index that leads nowhere")


def prune(folder: Path, limit: float) -> None:
    """Delete orphans, then the least recently used operators beyond the folder's limit."""
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
    """Remove files that killed processes left half written; return the bytes of the others."""
    stays = removed = freed = 0
    for path in [*folder.glob(".tkamb-*.part"), *folder.glob("tmp*.part")]:  # the latter: 0.1.0
        try:
            with os.fdopen(open_regular(path, float("inf"), follow=False), "rb") as file:
                status = os.fstat(file.fileno())
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if clock.time() - status.st_mtime < FACTOR_CACHE.orphan_seconds:
                    raise BlockingIOError
                path.unlink(missing_ok=True)
            removed, freed = removed + 1, freed + status.st_size
        except BlockingIOError:
            stays += status.st_size
        except InputError:
            continue
    if removed:
        _log.warning("%s: %d unfinished file(s) removed, %.0f MB", folder, removed, freed / 1e6)
    return stays
