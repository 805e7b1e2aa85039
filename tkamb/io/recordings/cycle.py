"""A cycle recorded over its per cent, laid on an interval of time."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class Cycle:
    """A cycle recorded over its per cent, laid on an interval of time.

    Args:
        start: s.
        period: s.
        offset_percent: per cent of the cycle at `start`.
        closed: 0 and 100 % were recorded and agree.
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
        """Return the scene's cycle.

        It is closed if 100 % was recorded too and no coordinate differs there from 0 % by
        more than its largest step between neighbouring samples.

        Args:
            percent: (n,) the recorded per cents.
            knee: (n, 6) knee coordinates there.
            interval: s, on which the cycle lies.
            offset_percent: per cent of the cycle at the interval's start.
            path: of the file, for messages.

        Raises:
            InputError: not per cent, not an interval, or an offset into an open cycle.
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
        whole = percent[-1] - percent[0] > 100 - 1e-9
        steps = np.abs(np.diff(knee, axis=0)).max(axis=0)
        closed = bool(whole and np.all(np.abs(knee[-1] - knee[0]) <= steps))
        if offset_percent and not closed:
            raise InputError(
                "is not a closed cycle, so it has no frame before or after its ends",
                path,
                "set cycle_offset_percent to 0",
            )
        return Cycle(start, end - start, offset_percent, closed)

    def seconds(self, percent: Array) -> Array:
        """Return the times of per cents, not wrapped into the interval."""
        return self.start + (percent - self.offset_percent) / 100.0 * self.period

    def percent(self, time: Array) -> Array:
        """Return per cent of the cycle, rising from the offset."""
        return self.offset_percent + (time - self.start) / self.period * 100.0

    def frames(self, sampled: Array, count: int | None) -> Array:
        """Return the times of the frames: evenly `count`, or those recorded."""
        if not self.closed:
            return np.linspace(sampled[0], sampled[-1], count) if count else sampled
        if count:
            return np.linspace(self.start, self.start + self.period, count)
        if not self.offset_percent:
            return sampled
        turn = np.mod(sampled[:-1] - self.start, self.period)
        return self.start + np.append(np.unique(np.round(turn, 12)), self.period)

    def wrapped(self, at: Array, sampled: Array) -> Array:
        """Return times inside the recorded cycle, whole periods away from `at`."""
        if not self.closed or not self.offset_percent:
            return np.clip(at, sampled[0], sampled[-1])
        return np.clip(sampled[0] + np.mod(at - sampled[0], self.period), sampled[0], sampled[-1])
