"""The columns of the insert's bed that the femoral component may reach: the others are spared."""

import numpy as np

from tkamb.contact.samples import SampledContact, SurfaceSamples, gaps_and_facets
from tkamb.geometry.frames import Array, Index, Mask, transform

NEARBY = 1.5e-3
"""m; the columns nearer than this are looked at while the femur moves by less."""


class Neighbourhood:
    """The columns that the femoral component may reach while it moves by less than `NEARBY`.

    Args:
        state: what the model's `prepare` returned.
    """

    def __init__(self, state: SampledContact) -> None:
        self._bed, self._femoral = state.surface, state.pair.femoral
        self._corners = _corners(self._femoral.bounds)
        self._columns, self._centre = self._bed, np.full((4, 4), np.nan)

    def take(self, pose: Array, gap: Array) -> None:
        """Take what is near by at a pose (4, 4), by the gaps (n,) of the bed there."""
        self._columns, self._centre = self._bed.part(self._close(gap)), pose.copy()

    def at(self, pose: Array) -> tuple[SurfaceSamples, tuple[Array, Array, Index]]:
        """Return the columns near by at a pose (4, 4), and their gaps and facets."""
        if self._covers(pose):
            return self._columns, gaps_and_facets(self._columns, self._femoral, pose)
        gap, normals, faces = gaps_and_facets(self._bed, self._femoral, pose)
        self.take(pose, gap)
        near = self._close(gap)
        return self._columns, (gap[near], normals[near], faces[near])

    def _close(self, gap: Array) -> Mask:
        return np.asarray(gap < 2 * NEARBY)

    def _covers(self, pose: Array) -> bool:
        """Return whether no femoral point has come nearer than the chosen columns reach."""
        if np.isnan(self._centre).any():
            return False
        moved = transform(pose, self._corners) - transform(self._centre, self._corners)
        return bool(np.linalg.norm(moved, axis=1).max() < NEARBY)


def _corners(bounds: Array) -> Array:
    """Return the corners (8, 3) of a box."""
    return np.array([[x, y, z] for x in bounds[:, 0] for y in bounds[:, 1] for z in bounds[:, 2]])
