"""The columns of the insert's bed that the femoral component may reach; others are skipped."""

import numpy as np

from tkamb.contact.samples import SampledContact, SurfaceSamples, gaps_and_facets
from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index, inverse, transform

NEAR = 3e-4
"""m: every column with a smaller gap is evaluated."""
OBLIQUE = 2.0
"""1: largest ratio of the change of a gap, along the column, to the femoral displacement."""
FARTHEST = 3e-3
"""m: a greater gap counts as this, because another part of the femoral component may come from
the side."""


class Neighbourhood:
    """The columns that the femoral component may reach, from their last evaluation.

    A column had the gap g when it was evaluated last, and the femoral component has moved past
    it by m since. Its gap is then at least g - 2 m, as long as the column and the femoral normal
    are less than 60 deg apart. Where that is above `NEAR` the column is skipped.

    Args:
        state: what the model's `prepare` returned.
    """

    def __init__(self, state: SampledContact) -> None:
        self._bed, self._femoral = state.surface, state.pair.femoral
        self._gap = np.full(len(self._bed.points), -np.inf)
        self._seen_at = np.zeros_like(self._bed.points)
        """(n, 3) m, femoral frame: position of the columns at their last evaluation."""

    def take(self, pose: Array, gap: Array) -> None:
        """Take the gaps (n,) of the whole bed at a pose (4, 4)."""
        self._gap, self._seen_at = np.minimum(gap, FARTHEST), self._places(pose)

    def at(self, pose: Array) -> tuple[SurfaceSamples, tuple[Array, Array, Index]]:
        """Return the near columns at a pose (4, 4), and their gaps and facets."""
        near, places = np.empty(len(self._gap), np.int64), np.empty_like(self._seen_at)
        number = _near(self._bed.points, inverse(pose), self._seen_at, self._gap, near, places)
        near = near[:number]
        columns = self._bed.part(near)
        facing = gaps_and_facets(columns, self._femoral, pose)
        self._gap[near], self._seen_at[near] = np.minimum(facing[0], FARTHEST), places[:number]
        return columns, facing

    def _places(self, pose: Array) -> Array:
        return transform(inverse(pose), self._bed.points)


@compiled_as_written
def _near(
    points: Array, pose: Array, seen_at: Array, gap: Array, near: Index, places: Array
) -> int:
    """Write the columns that the femoral component may reach, and return how many.

    Args:
        points: (n, 3) m, insert frame.
        pose: (4, 4) of the insert in the femoral frame.
        seen_at: (n, 3) m, femoral frame, position of the columns at their last evaluation.
        gap: (n,) m, gap at that time.
        near: (n,) output: numbers of the columns.
        places: (n, 3) m, output: their positions in the femoral frame.
    """
    number = 0
    for n in range(len(points)):
        square = 0.0
        for i in range(3):
            places[number, i] = pose[i, 3]
            for j in range(3):
                places[number, i] += pose[i, j] * points[n, j]
            square += (places[number, i] - seen_at[n, i]) ** 2
        if gap[n] - OBLIQUE * np.sqrt(square) < NEAR:
            near[number] = n
            number += 1
    return number
