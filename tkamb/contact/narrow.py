"""Contact that is too narrow for the points of the map: its peak pressure is not resolved.

A map knows the pressure at its points only. Where contact is a few points wide, its highest point
lies between them, and the sum over them is not the integral over the contact.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Index, Mask

TOO_NARROW = "contact is too narrow"
"""Words of the flag, after "the <side> "."""


@dataclass(frozen=True)
class NarrowContactSettings:
    """When a contact is too narrow for the map's points."""

    least_inner_points: int = 5
    """Points with contact all around, from which a peak is right within 8 %, wherever the
    contact lies among the points. That is a sphere's contact with about 17 points, or three
    rows of points under a cylinder. With no such point a lattice's peak is 5 to 96 % too
    low (docs/lattice.md)."""


NARROW_CONTACT = NarrowContactSettings()


def narrow_flags(
    triangles: Index,
    touched: Mask,
    sides: Mapping[str, Mask],
    points: str = "cells",
) -> Iterator[str]:
    """Yield a flag for each condyle with fewer than `NARROW_CONTACT.least_inner_points`.

    An inner point has contact all around.

    Args:
        triangles: (k, 3) of the contact surface.
        touched: (n,) which of its points are in contact.
        sides: side -> (n,) which points are under it.
        points: what a user makes finer, in a word.
    """
    within = surrounded(triangles, touched)
    for side, own in sides.items():
        if (
            touched[own].any()
            and np.count_nonzero(within & own) < NARROW_CONTACT.least_inner_points
        ):
            yield (
                f"the {side} {TOO_NARROW} for the {points}: its peak pressure cannot be "
                f"relied on and is mostly too low; take finer {points}"
            )


def surrounded(triangles: Index, touched: Mask) -> Mask:
    """Return which points (n,) have contact all around: at every corner of their triangles."""
    a, b, c = touched[triangles.T]
    edge = triangles[(a | b | c) & ~(a & b & c)]
    within = touched.copy()
    within[edge] = False
    return within
