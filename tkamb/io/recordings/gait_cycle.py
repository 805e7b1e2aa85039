"""The gait cycle: from foot strikes on a force plate, or from a motion over per cent of a cycle.

A foot is on the ground while the vertical ground reaction is at least `contact_force_N`. The
time at which the force crosses this threshold is interpolated linearly between two samples.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Mask

# N: smallest vertical force of a foot on the ground; Zeni et al., Gait & Posture 27:710 (2008). It
# is above a plate's noise, and reached within some milliseconds of the strike.
CONTACT_FORCE_N = 20.0
# s: shortest stance or swing; a shorter one is noise. Stance and swing of walking
# last 0.6 and 0.4 s.
SHORTEST_PHASE_S = 0.1


@dataclass(frozen=True, eq=False)
class Gait:
    """Stances of one foot, from its ground reaction.

    Args:
        stances: (n, 2) s, foot strike and toe-off of each stance; NaN if the recording begins or
            ends within the stance, or the force is NaN there.
        recorded: times of the first and the last sample, s.
    """

    stances: Array
    recorded: tuple[float, float]

    @property
    def foot_strikes(self) -> list[float]:
        """Times (s) of the recorded foot strikes."""
        return [float(time) for time in self.stances[:, 0] if np.isfinite(time)]

    @property
    def toe_offs(self) -> list[float]:
        """Times (s) of the recorded toe-offs."""
        return [float(time) for time in self.stances[:, 1] if np.isfinite(time)]

    def spans(self) -> list[tuple[float, float]]:
        """Return start and end (s) of each stance within the recording."""
        start, end = self.recorded
        return [
            (float(np.nan_to_num(on, nan=start)), float(np.nan_to_num(off, nan=end)))
            for on, off in self.stances
        ]

    def cycle(self, start: float, end: float) -> tuple[float, float] | None:
        """Return start and end (s) of the cycle that overlaps most with `start` to `end`, s.

        A cycle lasts from a foot strike to the next. None: no cycle overlaps.
        """
        strikes = self.foot_strikes
        cycles = list(pairwise(strikes))
        overlaps = [min(b, end) - max(a, start) for a, b in cycles]
        if not overlaps or max(overlaps) <= 0.0:
            return None
        return cycles[int(np.argmax(overlaps))]


def find_gait(time: Array, vertical: Array) -> Gait:
    """Return the stances of a foot.

    Args:
        time: (k,) s, rising.
        vertical: (k,) N, upward ground reaction of the foot, unfiltered.
    """
    on = vertical >= CONTACT_FORCE_N
    for state in (False, True):  # first short gaps in a stance, then short contacts
        for first, last in uninterrupted_runs(on == state):
            inside = first > 0 and last < len(on) - 1
            if inside and time[last] - time[first] < SHORTEST_PHASE_S:
                on[first : last + 1] = not state
    stances = [
        (
            _crossing(time, vertical, first) if first > 0 else np.nan,
            _crossing(time, vertical, last + 1) if last < len(on) - 1 else np.nan,
        )
        for first, last in uninterrupted_runs(on)
    ]
    ends = float(time[0]), float(time[-1])
    return Gait(np.array(stances, float).reshape(-1, 2), ends)


def cycle_percent(time: Array, cycle: tuple[float, float]) -> Array:
    """Return per cent of a cycle (...,) at times (...,), s; NaN outside."""
    start, end = cycle
    percent = 100.0 * (time - start) / (end - start)
    return np.where((percent >= 0.0) & (percent <= 100.0), percent, np.nan)


def uninterrupted_runs(chosen: Mask) -> list[tuple[int, int]]:
    """Return first and last index of each uninterrupted run of a mask (k,)."""
    steps = np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]]))
    firsts, after = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    return [(int(a), int(b) - 1) for a, b in zip(firsts, after, strict=True)]


def _crossing(time: Array, vertical: Array, after: int) -> float:
    low, high = vertical[after - 1], vertical[after]
    share = (CONTACT_FORCE_N - low) / (high - low) if high != low else 1.0
    share = float(np.clip(share, 0.0, 1.0))
    return float(time[after - 1] + share * (time[after] - time[after - 1]))


@dataclass(frozen=True)
class Cycle:
    """A motion over per cent of a gait cycle, assigned to an interval of time.

    Args:
        start: start of the interval of length `period`, s.
        offset_percent: per cent of the cycle at `start`.
        closed: whether 0 and 100 % were recorded and agree.
    """

    start: float
    period: float
    offset_percent: float
    closed: bool

    @staticmethod
    def of(
        percent: Array,
        knee: Array,
        interval: tuple[float, float],
        offset_percent: float,
        path: Path,
    ) -> "Cycle":
        """Return the cycle of a recorded motion.

        The cycle is closed if it was recorded from 0 to 100 %, and the coordinates at its ends
        differ by no more than their largest step between neighbouring samples.

        Args:
            percent: (n,) recorded per cent of the cycle.
            knee: (n, 6) knee coordinates at `percent`.
            interval: start and end of the cycle, s.
            offset_percent: per cent of the cycle at the interval's start.

        Raises:
            InputError: `percent` is outside 0 to 100 or spans less than 2, the interval does not
                rise, or a cycle with an offset is not closed.
        """
        start, end = interval
        if not start < end:
            raise InputError("[motion] cycle_s does not rise", path)
        if percent[0] < -1e-9 or percent[-1] > 100 + 1e-9 or percent[-1] - percent[0] < 2:
            raise InputError(
                f"time runs from {percent[0]:g} to {percent[-1]:g}, which is not per cent",
                path,
                "drop cycle_s, or give per cent of the cycle",
            )
        complete = percent[-1] - percent[0] > 100 - 1e-9
        steps = np.abs(np.diff(knee, axis=0)).max(axis=0)
        closed = bool(complete and np.all(np.abs(knee[-1] - knee[0]) <= steps))
        if offset_percent and not closed:
            raise InputError(
                "is not a closed cycle, so it has no frame before or after its ends",
                path,
                "set cycle_offset_percent to 0",
            )
        return Cycle(start, end - start, offset_percent, closed)

    def seconds(self, percent: Array) -> Array:
        """Return the times (n,) s at per cent (n,) of the cycle, possibly outside the interval."""
        return self.start + (percent - self.offset_percent) / 100.0 * self.period

    def percent(self, time: Array) -> Array:
        """Return per cent (n,) of the cycle at times (n,) s; not wrapped at 100 %."""
        return self.offset_percent + (time - self.start) / self.period * 100.0

    def frames(self, sampled: Array, count: int | None) -> Array:
        """Return the times (f,) s of the frames.

        Args:
            sampled: (n,) s, recorded times.
            count: number of evenly spaced frames; None: the frames are the recorded times.
        """
        if not self.closed:
            return np.linspace(sampled[0], sampled[-1], count) if count else sampled
        if count:
            return np.linspace(self.start, self.start + self.period, count)
        if not self.offset_percent:
            return sampled
        elapsed = np.mod(sampled[:-1] - self.start, self.period)
        return self.start + np.append(np.unique(np.round(elapsed, 12)), self.period)

    def wrapped(self, at: Array, sampled: Array) -> Array:
        """Return times inside the recorded cycle that differ from `at` by whole periods.

        Unless the cycle is closed and has an offset, times outside are moved to its ends.
        """
        if not self.closed or not self.offset_percent:
            return np.clip(at, sampled[0], sampled[-1])
        return np.clip(sampled[0] + np.mod(at - sampled[0], self.period), sampled[0], sampled[-1])
