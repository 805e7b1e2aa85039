"""Contacts too narrow for the cells: their peak is an average over more than the contact."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

FEWEST_WITHIN = 5
"""Nodes with contact all around from which a peak is right within 8 %, wherever the contact lies
in its cells: a sphere's with about 17 nodes in contact, three rows of nodes under a cylinder. With
none it is 5 to 96 % too low (docs/lattice.md)."""


def coarse_flags(
    triangles: NDArray[np.int64],
    touched: NDArray[np.bool_],
    sides: Mapping[str, NDArray[np.bool_]],
) -> Iterator[str]:
    """Yield a flag for each condyle whose contact has fewer than `FEWEST_WITHIN`.

    Args:
        triangles: (k, 3) of the contact surface.
        touched: (n,) which of its nodes are in contact.
        sides: side -> (n,) which nodes are under it.
    """
    within = surrounded(triangles, touched)
    for side, own in sides.items():
        if touched[own].any() and np.count_nonzero(within & own) < FEWEST_WITHIN:
            yield (
                f"the {side} contact is too narrow for the cells: its peak pressure cannot be "
                "relied on and is mostly too low; take finer cells"
            )


def surrounded(triangles: NDArray[np.int64], touched: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which nodes (n,) have contact all around: at every corner of their triangles."""
    a, b, c = touched[triangles.T]
    edge = triangles[(a | b | c) & ~(a & b & c)]
    within = touched.copy()
    within[edge] = False
    return within


def beside(triangles: NDArray[np.int64], touched: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which nodes (n,) share a triangle with one in contact and are not in contact."""
    found = np.zeros_like(touched)
    found[triangles[touched[triangles].any(axis=1)]] = True
    return found & ~touched
