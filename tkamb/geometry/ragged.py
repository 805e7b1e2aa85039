"""Lists of different lengths, kept one after the other in flat arrays."""

from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Index


@dataclass(frozen=True, eq=False)
class Ragged:
    """Rows of different lengths: row r is `items[first[r] : first[r + 1]]`.

    Args:
        first: (n + 1,) where each row begins, and the end of the last.
        items: (m,).
    """

    first: Index
    items: Index

    @classmethod
    def by_key(cls, keys: Index, count: int) -> "Ragged":
        """Return for each key from 0 to `count` - 1 the places in `keys` (m,) that hold it."""
        order = np.argsort(keys, kind="stable")
        return cls(np.searchsorted(keys[order], np.arange(count + 1)), order)

    def of(self, rows: Index) -> tuple[Index, Index]:
        """Return for chosen rows (k,) each item's place in `rows`, and the items."""
        begin = self.first[rows]
        owner, rank = counted(self.first[rows + 1] - begin)
        return owner, self.items[begin[owner] + rank]


def counted(counts: Index) -> tuple[Index, Index]:
    """Return for groups of `counts` (k,) members: each member's group, and its rank there."""
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - (np.cumsum(counts) - counts)[group]
