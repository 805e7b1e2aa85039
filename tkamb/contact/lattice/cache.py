"""Prepared operators on disk, found again by what they were made of.

The key is the SHA-256 of everything that the operator depends on: nodes, cells, held unknowns,
contact nodes, elastic constants, kind of solid, and this format's number. Files are written
beside their place and moved there in one step, so that two processes at once see a whole file
or none; the least recently used go when the folder outgrows its limit. A file that is not
whole counts as absent.

The folder is $TKAMB_CACHE_DIR, else $XDG_CACHE_HOME/tkamb, else ~/.cache/tkamb. Operators that
are made again in about a second are not kept.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.multifrontal import CholeskyFactor, Front
from tkamb.contact.lattice.operator import ElasticOperator
from tkamb.contact.lattice.response import Block, HalfResponse
from tkamb.contact.lattice.solid import Solid
from tkamb.geometry.frames import Array

FORMAT = 2
"""Counted up when an operator's content or the meaning of a key changes."""
LEAST_UNKNOWNS = 20_000
"""Smaller operators are not kept."""
SIZE_LIMIT = 6e9
"""Bytes that the folder may hold."""


def cache_folder() -> Path:
    """Return the folder of prepared operators."""
    own = os.environ.get("TKAMB_CACHE_DIR")
    if own:
        return Path(own)
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "tkamb"


def operator_key(solid: Solid, held: NDArray[Any], contact_nodes: NDArray[Any]) -> str:
    """Return the content hash of an operator."""
    material = solid.material
    words = (FORMAT, type(solid).__name__, material.young_modulus, material.poisson_ratio)
    digest = hashlib.sha256(repr(words).encode())
    for array in (solid.nodes, solid.spacing, solid.cells, held, contact_nodes):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def cached_operator(
    key: str, make: Callable[[], ElasticOperator], unknowns: int, limit: float = SIZE_LIMIT
) -> ElasticOperator:
    """Return the operator of that key, from disk or newly made and kept.

    A folder that cannot be written to only costs the time to make the operator again.

    Args:
        key: from `operator_key`.
        make: makes the operator.
        unknowns: how many it has; few are not worth a file.
        limit: bytes that the folder may hold; a larger operator is not kept.
    """
    if unknowns < LEAST_UNKNOWNS:
        return make()
    path = cache_folder() / f"{key}.operator"
    found = _read(path)
    if found is not None:
        return found
    made = make()
    if sum(block.nbytes for block in _floats(made)) <= limit:
        try:
            _write(path, made)
            _prune(path.parent, limit)
        except OSError:
            return made
    return made


def _write(path: Path, operator: ElasticOperator) -> None:
    """Write beside the path, then move there in one step."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            for array in _integers(operator):
                np.save(file, array, allow_pickle=False)
            for block in _floats(operator):
                file.write(np.ascontiguousarray(block).data)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _integers(operator: ElasticOperator) -> list[NDArray[Any]]:
    fronts, blocks = operator.factor.fronts, operator.half.blocks
    sizes = [[f.start, f.stop, f.parent, len(f.boundary)] for f in fronts]
    rows = [[b.start, b.stop, b.first, b.last] for b in blocks]
    return [
        operator.free,
        operator.contact_nodes,
        operator.factor.order,
        np.array(sizes, np.int64).reshape(-1, 4),
        np.concatenate([np.zeros(0, np.int64), *(f.boundary for f in fronts)]),
        operator.half.rank,
        np.array(rows, np.int64).reshape(-1, 4),
        np.zeros(0, fronts[0].block.dtype),
    ]


def _floats(operator: ElasticOperator) -> list[Array]:
    return [f.block for f in operator.factor.fronts] + [b.values for b in operator.half.blocks]


def _read(path: Path) -> ElasticOperator | None:
    """Return the operator in a file, or None if there is no whole one."""
    try:
        with path.open("rb") as file:
            parts = [np.load(file, allow_pickle=False) for _ in range(8)]
            numbers = np.fromfile(file, parts[-1].dtype)
        os.utime(path)
    except (OSError, ValueError, EOFError):
        return None
    free, contact_nodes, order, sizes, boundaries, rank, rows, _ = parts
    own = sizes[:, 1] - sizes[:, 0]
    wanted = int(((own + sizes[:, 3]) * own).sum())
    wanted += int(((rows[:, 1] - rows[:, 0]) * (rows[:, 3] - rows[:, 2])).sum())
    if len(numbers) != wanted:
        return None
    at, edge, fronts = 0, 0, []
    for start, stop, parent, touched in sizes.tolist():
        k = stop - start
        block = numbers[at : at + (k + touched) * k].reshape(k + touched, k)
        fronts.append(Front(start, stop, boundaries[edge : edge + touched], parent, block))
        at, edge = at + block.size, edge + touched
    blocks = []
    for start, stop, first, last in rows.tolist():
        values = numbers[at : at + (stop - start) * (last - first)].reshape(stop - start, -1)
        blocks.append(Block(start, stop, first, last, values))
        at += values.size
    factor = CholeskyFactor(order, fronts)
    return ElasticOperator(free, factor, contact_nodes, HalfResponse(rank, blocks))


def _prune(folder: Path, limit: float) -> None:
    """Delete the least recently used operators until the folder keeps to its limit."""
    entries = []
    for path in folder.glob("*.operator"):
        try:
            status = path.stat()
        except FileNotFoundError:
            continue
        entries.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries, key=lambda entry: entry[0]):
        if total <= limit:
            return
        path.unlink(missing_ok=True)
        total -= size
