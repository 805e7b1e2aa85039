"""The memory that a factorisation will need, computed before it begins.

The fronts' sizes follow from the dissection and the pattern alone (symbolic factorisation, on
nodes instead of unknowns). Of the machine only the memory that is left is used.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from tkamb.contact.lattice.linear.multifrontal import Dissection
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Index, Mask
from tkamb.geometry.memory import available_memory
from tkamb.units import MILLIMETRE


@dataclass(frozen=True)
class MemoryNeedSettings:
    """The estimate of a lattice's memory before it is made."""

    unknowns_per_node: int = 3
    """Unknowns of a node. By definition: each boundary is counted as if all of its displacements
    were free."""
    cell_bytes: int = 20_000
    """Bytes of a cell while its stiffness is put into the global matrix. Measured: 9 to 22 kB."""
    entry_bytes: int = 36
    """Bytes of an entry of the global matrix: 20 for itself and its lower half in elimination
    order; the rest stands for the arrays of the compliance at that time. Measured: without
    it the estimate is 12 % low."""
    safety_factor: float = 1.1
    """1: factor for what the estimate leaves out. Chosen: a proposal that fits is better than one
    that nearly fits."""
    memory_exponent: float = 3.0
    """1: memory falls at least with this power of the cell size. Measured: 3.7."""
    cell_size_step: float = 0.05e-3
    """m: proposed cell sizes are multiples of it. Chosen: proposals are round numbers."""
    largest_cell_size: float = 5e-3
    """m: larger cells are not proposed. Chosen: a condyle's contact would be two cells wide."""


MEMORY_NEED = MemoryNeedSettings()


class TooLittleMemoryError(ComputationError):
    """What is to be computed does not fit into the available memory.

    Args:
        need: bytes that the next step needs.
        available: bytes that are available.
        likely: bytes that the whole computation is expected to need; 0: as many as `need`.
    """

    def __init__(self, need: float, available: float, likely: float) -> None:
        self.left, self.likely = available, max(need, likely)
        what = (
            f"{need / 1e9:.2g} GB of memory are needed, {max(available, 0) / 1e9:.2g} GB are left"
        )
        super().__init__(what, "lattice", "take a coarser resolution")

    def advice(self, size: float) -> str:
        """Return the advice: the cell size that fits instead of a size (m) that does not."""
        fits = size * (self.likely / max(self.left, 1.0)) ** (1.0 / MEMORY_NEED.memory_exponent)
        if fits > MEMORY_NEED.largest_cell_size:
            return "free some memory"
        step = MEMORY_NEED.cell_size_step
        # Rounded up, so that the proposed size fits; 1e-9 keeps a size that is a multiple already.
        proposal = np.ceil(fits / step * (1.0 - 1e-9)) * step
        return f"take {proposal / MILLIMETRE:g} mm or coarser"


def check_memory(need: float, likely: float = 0.0) -> None:
    """Raise unless a number of bytes is left.

    Args:
        need: bytes.
        likely: bytes that the whole computation is expected to need, for the advice.

    Raises:
        TooLittleMemoryError: they are not left.
    """
    available = available_memory()
    if MEMORY_NEED.safety_factor * need > available:
        raise TooLittleMemoryError(
            MEMORY_NEED.safety_factor * need, available, MEMORY_NEED.safety_factor * likely
        )


def check_assembly_memory(cells: int) -> None:
    """Raise unless the stiffness of a number of cells can be assembled.

    Raises:
        TooLittleMemoryError: the memory is not left.
    """
    need = MEMORY_NEED.cell_bytes * cells
    # The factor grows as cells^1.25; from about 3,000 cells it needs more memory than the assembly
    # (measured on inserts).
    check_memory(need, likely=1.5 * need * max(cells / 3000, 1.0) ** 0.25)


def factor_memory(
    tree: Dissection, joined: sparse.csr_matrix, touched: Mask, itemsize: int
) -> float:
    """Return the bytes that factor and half response take at their peak.

    Args:
        tree: dissection of n nodes.
        joined: (n, n) pattern: which nodes are joined.
        touched: (n,) nodes whose response is wanted.
        itemsize: bytes of a number that is kept; the factor is computed with 8.
    """
    rank = np.empty(joined.shape[0], np.int64)
    rank[np.concatenate(tree.own)] = np.arange(len(rank))
    stored = live = peak = response = 0.0
    columns = np.zeros(len(tree.own))
    below: dict[int, list[Index]] = {}
    start = 0
    for member, own in enumerate(tree.own):
        stop, parent = start + len(own), tree.parent[member]
        children = below.pop(member, [])
        later = np.unique(np.concatenate([rank[joined[own].indices], *children]))
        boundary = later[later >= stop]
        k, m = (
            MEMORY_NEED.unknowns_per_node * len(own),
            MEMORY_NEED.unknowns_per_node * len(boundary),
        )
        # W in 8 bytes and as it is kept, the update (m, m), and updates that no parent has added
        # yet.
        block = float(k + m) * k
        stored += block
        peak = max(peak, itemsize * stored + 8.0 * (live + block + float(m) * m))
        live += float(m) * m - sum(
            (MEMORY_NEED.unknowns_per_node * len(child)) ** 2.0 for child in children
        )
        columns[member] += MEMORY_NEED.unknowns_per_node * touched[own].sum()
        response += k * columns[member]
        if parent >= 0:
            columns[parent] += columns[member]
            if len(boundary):
                below.setdefault(parent, []).append(boundary)
        start = stop
    entries = MEMORY_NEED.unknowns_per_node**2 * joined.nnz
    return MEMORY_NEED.entry_bytes * entries + max(peak, itemsize * (stored + response))
