"""Global matrices from those of cells or springs: one cached pattern of 3×3 node blocks."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from tkamb.geometry.frames import Array

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Pattern:
    """Where the node pairs of each member (cell or spring) go in the global matrix.

    Args:
        indptr: (n + 1,) start of each node's row.
        indices: (b,) column node of each block.
        slot: (c, p²) block of each ordered node pair of each member of p nodes.
    """

    indptr: Indices
    indices: Indices
    slot: Indices

    @classmethod
    def of(cls, members: Indices, nodes: int) -> "Pattern":
        """Return the pattern of members (c, p) on so many nodes."""
        count = members.shape[1]
        rows = np.repeat(members, count, axis=1).ravel().astype(np.int64)
        columns = np.tile(members, (1, count)).ravel()
        keys, slot = np.unique(rows * nodes + columns, return_inverse=True)
        indptr = np.searchsorted(keys, np.arange(nodes + 1) * nodes)
        return cls(indptr, keys % nodes, slot.reshape(len(members), count**2))

    @property
    def nodes(self) -> int:
        """How many nodes."""
        return len(self.indptr) - 1

    def assemble(self, matrices: Array, shape: Indices | None = None) -> sparse.csr_matrix:
        """Return the sum (3n, 3n) of the members' matrices.

        Args:
            matrices: (c, 3p, 3p), or (s, 3p, 3p) with `shape`.
            shape: (c,) which matrix each member takes.
        """
        count = matrices.shape[1] // 3
        blocks = matrices.reshape(-1, count, 3, count, 3).transpose(2, 4, 0, 1, 3)
        blocks = blocks.reshape(9, -1, count**2)
        data = np.empty((len(self.indices), 9))
        flat = self.slot.ravel()
        for entry in range(9):
            values = blocks[entry] if shape is None else blocks[entry][shape]
            data[:, entry] = np.bincount(flat, values.ravel(), len(self.indices))
        return sparse.bsr_matrix(
            (data.reshape(-1, 3, 3), self.indices, self.indptr), (3 * self.nodes, 3 * self.nodes)
        ).tocsr()


@dataclass(frozen=True, eq=False)
class Scatter:
    """Sums the members' nodal vectors into global ones.

    Args:
        members: (c, p) nodes of each member (cell or spring).
        nodes: how many nodes.
    """

    members: Indices
    nodes: int

    def gather(self, displacement: Array, chosen: Indices | None = None) -> Array:
        """Return (k, 3p) of the chosen members, by default of all, from nodal (n, 3)."""
        members = self.members if chosen is None else self.members[chosen]
        return displacement[members].reshape(len(members), 3 * members.shape[1])

    def sum(self, forces: Array, chosen: Indices | None = None) -> Array:
        """Return nodal (n, 3) from (k, 3p) of the chosen members, by default of all."""
        flat = (self.members if chosen is None else self.members[chosen]).ravel()
        parts = forces.reshape(-1, 3)
        total = np.zeros((self.nodes, 3))
        for axis in range(3) if len(flat) else ():
            total[:, axis] = np.bincount(flat, parts[:, axis], self.nodes)
        return total
