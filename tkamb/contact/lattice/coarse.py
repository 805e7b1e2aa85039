"""Contacts too small for the cells: their peak is an average over more than the contact."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

FEWEST_NODES = 16
"""Nodes in contact from which a peak is right: on a sphere within 6 % for any place in a cell,
20 % too low at 12, half at 5, nine tenths at 1 (docs/lattice.md)."""


def coarse_flags(pressures: Mapping[str, NDArray[np.float64]]) -> Iterator[str]:
    """Yield a flag for each condyle whose contact has fewer than `FEWEST_NODES`.

    Args:
        pressures: side -> its nodes' pressures, Pa.
    """
    for side, pressure in pressures.items():
        if 0 < np.count_nonzero(pressure > 0) < FEWEST_NODES:
            yield (
                f"the {side} contact has fewer than {FEWEST_NODES} nodes: its peak pressure is too "
                "low; take finer cells"
            )
