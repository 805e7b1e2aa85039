"""The sagittal J-curve: circular arcs with common tangents, parametrised by the normal's angle."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from tkamb.errors import InputError
from tkamb.geometry.frames import Array


def normal(phi: ArrayLike) -> Array:
    """Return outward normals (..., 2) as (anterior, superior): phi = 0 distal, pi/2 posterior."""
    angle = np.asarray(phi, float)
    return np.stack([-np.sin(angle), -np.cos(angle)], axis=-1)


class SagittalProfile:
    """A chain of circular arcs that meet with a common tangent.

    Their centres are c_{i+1} = c_i + (R_i - R_{i+1}) n(phi_i), where phi_i is the angle of the
    normal at which arcs i and i + 1 meet.

    Args:
        arcs: (from deg, to deg, radius mm) in turn, each starting where the last one ends.
        origin: (anterior, superior) mm of the first arc's centre.

    Raises:
        InputError: arcs that leave a gap, turn back or have no radius.
    """

    def __init__(self, arcs: ArrayLike, origin: Sequence[float] = (0.0, 0.0)) -> None:
        table = np.asarray(arcs, float)
        if table.ndim != 2 or table.shape[1] != 3 or not (table[:, 2] > 0.0).all():
            raise InputError("sagittal arcs are not (from, to, radius)", "sagittal_arcs_deg_mm")
        if (table[:-1, 1] != table[1:, 0]).any() or (table[:, 1] <= table[:, 0]).any():
            raise InputError(
                "sagittal arcs do not follow each other",
                "sagittal_arcs_deg_mm",
                "let each arc start at the angle at which the one before it ends",
            )
        self.radii = table[:, 2]
        self.joints = np.radians(table[:-1, 1])
        self.range = np.radians([table[0, 0], table[-1, 1]])
        self.centres = np.zeros((len(table), 2))
        self.centres[0] = origin
        for i, joint in enumerate(self.joints):
            shift = self.radii[i] - self.radii[i + 1]
            self.centres[i + 1] = self.centres[i] + shift * normal(joint)

    def moved(self, offset: ArrayLike) -> "SagittalProfile":
        """Return the same profile moved by offset (2,) mm."""
        ends = np.concatenate([self.range[:1], self.joints, self.range[1:]])
        arcs = np.column_stack([np.degrees(ends[:-1]), np.degrees(ends[1:]), self.radii])
        return SagittalProfile(arcs, self.centres[0] + np.asarray(offset))

    def centre_at(self, phi: float) -> Array:
        """Return the centre (2,) of the arc that holds the normal phi (rad)."""
        return np.asarray(self.centres[np.searchsorted(self.joints, phi)])

    def point(self, phi: ArrayLike, depth: ArrayLike = 0.0) -> Array:
        """Return points (..., 2) at `depth` mm below the profile along the inward normal."""
        arc = np.searchsorted(self.joints, phi)
        reach = np.asarray(self.radii[arc] - depth)
        return np.asarray(self.centres[arc] + reach[..., None] * normal(phi))

    def nodes(self, spacings: Sequence[Sequence[float]]) -> Array:
        """Return normals (rad) that divide the profile; spacings: (from deg, to deg, mm)."""
        pieces = []
        joints = np.degrees(self.joints)
        for start, end, spacing in spacings:
            ends = [start, *[j for j in joints if start + 1e-9 < j < end - 1e-9], end]
            for a, b in pairwise(ends):
                radius = self.radii[np.searchsorted(self.joints, np.radians((a + b) / 2))]
                count = max(1, int(np.ceil(np.radians(b - a) * radius / spacing)))
                pieces.append(np.radians(np.linspace(a, b, count, endpoint=False)))
        pieces.append(np.radians([spacings[-1][1]]))
        return np.concatenate(pieces)
