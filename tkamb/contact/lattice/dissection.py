"""Nested dissection of a lattice by planes of nodes: the elimination order.

A plane of lattice nodes separates the nodes on its two sides, since only neighbours are
joined. The insert is wide and thin, so planes across x and z leave small separators.
Reference: George, SIAM J Numer Anal 10:345 (1973), doi:10.1137/0710032.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Dissection:
    """A tree of separators in the order of elimination (children before parents).

    Args:
        own: nodes that each tree member eliminates.
        parent: index of the parent of each member, -1 for a root.
    """

    own: list[Indices]
    parent: list[int]


def dissect(index: Indices, joined: sparse.csr_matrix, leaf: int = 48) -> Dissection:
    """Return the dissection of the nodes with lattice index (n, 3).

    Args:
        index: lattice position of each node.
        joined: (n, n) pattern: which nodes are joined.
        leaf: parts of at most so many nodes are not cut further.
    """
    own: list[Indices] = []
    parent: list[int] = []

    def cut(part: Indices) -> int:
        """Append the members of a part; return the position of its topmost one."""
        halves = None if len(part) <= leaf else _halves(index, joined, part)
        if halves is None:
            own.append(_along_columns(index, part))
            parent.append(-1)
            return len(own) - 1
        low, high, separator = halves
        tops = [cut(low), cut(high)]
        own.append(_along_columns(index, separator))
        parent.append(-1)
        for top in tops:
            parent[top] = len(own) - 1
        return len(own) - 1

    if len(index):
        cut(np.arange(len(index)))
    return Dissection(own, parent)


def _halves(
    index: Indices, joined: sparse.csr_matrix, part: Indices
) -> tuple[Indices, Indices, Indices] | None:
    """Return (low, high, separator), or None if no plane leaves two sides."""
    position = index[part]
    for axis in np.argsort(-np.ptp(position, axis=0), kind="stable"):
        plane = int(np.median(position[:, axis]))
        low, high = position[:, axis] < plane, position[:, axis] > plane
        if low.any() and high.any():
            break
    else:
        return None
    across = joined[part[low]][:, part[high]]
    if across.nnz:
        low[np.flatnonzero(low)[np.unique(across.nonzero()[0])]] = False
        if not low.any():
            return None
    return part[low], part[high], part[~(low | high)]


def _along_columns(index: Indices, part: Indices) -> Indices:
    """Return the part sorted so that a stretch of columns is a stretch of the list."""
    i, j, k = index[part].T
    return part[np.lexsort((j, k, i)) if np.ptp(i) >= np.ptp(k) else np.lexsort((j, i, k))]
