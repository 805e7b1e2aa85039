"""Foot strikes and toe-offs from a force plate, and the gait cycle between two strikes.

A foot is on the ground while the vertical ground reaction is at least `contact_force_N`. The
moment at which the force crosses this threshold is interpolated linearly between two samples.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tkamb.geometry.frames import Array, Mask


@dataclass(frozen=True)
class GaitSettings:
    """When a foot counts as on the ground."""

    contact_force_N: float = 20.0
    """N, vertical: Zeni et al., Gait & Posture 27:710 (2008); above a plate's noise, reached within
    some milliseconds of the strike."""
    shortest_phase_s: float = 0.1
    """s: a shorter contact or gap is noise. Chosen: stance and swing of walking last 0.6 and 0.4
    s."""


GAIT = GaitSettings()


@dataclass(frozen=True, eq=False)
class Gait:
    """What a foot's force plates show of gait.

    Args:
        stances: (n, 2) s, foot strike and toe-off of each stance; NaN where the recording begins or
            ends within the stance, or has no force there.
        recorded: s, first and last sample.
    """

    stances: Array
    recorded: tuple[float, float]

    @property
    def foot_strikes(self) -> list[float]:
        """Return the times (s) of the strikes that were recorded."""
        return [float(time) for time in self.stances[:, 0] if np.isfinite(time)]

    @property
    def toe_offs(self) -> list[float]:
        """Return the times (s) of the toe-offs that were recorded."""
        return [float(time) for time in self.stances[:, 1] if np.isfinite(time)]

    def spans(self) -> list[tuple[float, float]]:
        """Return the stances (s), cut at the ends of the recording."""
        start, end = self.recorded
        return [
            (float(np.nan_to_num(on, nan=start)), float(np.nan_to_num(off, nan=end)))
            for on, off in self.stances
        ]

    def cycle(self, start: float, end: float) -> tuple[float, float] | None:
        """Return the cycle (s) between two strikes that holds most of start to end, s.

        None where no two strikes follow each other.
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
    on = vertical >= GAIT.contact_force_N
    for state in (False, True):  # gaps within a stance first, then contacts that are noise
        for first, last in uninterrupted_runs(on == state):
            inside = first > 0 and last < len(on) - 1
            if inside and time[last] - time[first] < GAIT.shortest_phase_s:
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
    """Return per cent of a cycle (...,) at times (...,) s; NaN outside it."""
    start, end = cycle
    percent = 100.0 * (time - start) / (end - start)
    return np.where((percent >= 0.0) & (percent <= 100.0), percent, np.nan)


def uninterrupted_runs(chosen: Mask) -> list[tuple[int, int]]:
    """Return first and last index of each uninterrupted run of a mask (k,)."""
    steps = np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]]))
    firsts, after = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    return [(int(a), int(b) - 1) for a, b in zip(firsts, after, strict=True)]


def _crossing(time: Array, vertical: Array, after: int) -> float:
    """Return when the force crosses the threshold between a sample and the one before."""
    low, high = vertical[after - 1], vertical[after]
    share = (GAIT.contact_force_N - low) / (high - low) if high != low else 1.0
    share = float(np.clip(share, 0.0, 1.0))
    return float(time[after - 1] + share * (time[after] - time[after - 1]))
