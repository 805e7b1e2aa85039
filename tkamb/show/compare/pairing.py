"""The place in one run that matches a frame of another: the same frame, or between two frames."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array, Index
from tkamb.show.axis import HorizontalAxis

if TYPE_CHECKING:
    from tkamb.run.results import Results


@dataclass(frozen=True)
class PairingSettings:
    """When frames of two runs are the same instant."""

    tolerance: float = 1e-6
    """deg, per cent or s: frames nearer on the axis are the same instant of one recording. Chosen:
    above the rounding of files."""


PAIRING = PairingSettings()


@dataclass(frozen=True, eq=False)
class Pairing:
    """Where the frames of a first run lie in another: f frames, those without a place among them.

    Args:
        lower: (f,) the other's frame at or before the place; -1 without a place.
        upper: (f,) the frame after it, or the same.
        weight: (f,) of the upper frame, 0 to 1.
        exact: every pair is one frame of each run at one time: nothing is interpolated.
    """

    lower: Index
    upper: Index
    weight: Array
    exact: bool

    def values(self, column: Array) -> Array:
        """Return the other run's column at the first one's frames (f,); NaN where there is none."""
        low, high = column[self.lower], column[self.upper]
        between = (1.0 - self.weight) * low + self.weight * high
        return np.where(self.lower < 0, np.nan, np.where(self.weight > 0, between, low))

    def nearest(self, frame: int) -> int | None:
        """Return the other run's frame nearest to a frame of the first; None without a place."""
        if self.lower[frame] < 0:
            return None
        return int((self.upper if self.weight[frame] > 0.5 else self.lower)[frame])


def pair_frames(
    first: "Results", first_axis: HorizontalAxis, other: "Results", other_axis: HorizontalAxis
) -> Pairing | None:
    """Pair the frames of two runs.

    If all frames of the shorter run have a match at the same time and place on the axis, the runs
    are of one recording and these frames are paired. Otherwise the other run is interpolated
    linearly between neighbouring frames, within its range. That needs axes that rise, or fall,
    throughout. None where they do not, because places are then not unique.
    """
    same = _same_frames(first["time_s"], first_axis.values, other["time_s"], other_axis.values)
    if same is not None:
        return Pairing(same, same, np.zeros(len(same)), True)
    x, known = first_axis.values, other_axis.values
    ways = [np.sign(np.diff(values)) for values in (x, known)]
    if len(known) < 2 or not all((way == ways[1][0]).all() and way.all() for way in ways):
        return None
    order = slice(None, None, int(ways[1][0]))
    rising = known[order]
    after = np.clip(np.searchsorted(rising, x, side="right"), 1, len(rising) - 1)
    weight = (x - rising[after - 1]) / (rising[after] - rising[after - 1])
    inside = (weight >= -1e-12) & (weight <= 1 + 1e-12)
    index = np.arange(len(known))[order]
    lower, upper = index[after - 1], index[after]
    lower, weight = np.where(weight >= 1.0, upper, lower), np.where(weight >= 1.0, 0.0, weight)
    return Pairing(np.where(inside, lower, -1), upper, np.clip(weight, 0.0, 1.0), False)


def _same_frames(
    first_time: Array, first_place: Array, other_time: Array, other_place: Array
) -> Index | None:
    """Return the other's frame of each frame (f,), -1 without one; None: not one recording."""
    at = {float(time): k for k, time in enumerate(other_time)}
    result = np.array([at.get(float(time), -1) for time in first_time], np.int64)
    paired = result >= 0
    if paired.sum() < min(len(first_time), len(other_time)):
        return None
    near = np.abs(first_place[paired] - other_place[result[paired]]) <= PAIRING.tolerance
    return result if near.all() else None
