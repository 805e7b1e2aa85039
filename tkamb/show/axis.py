"""The report's horizontal axis, and a choice of frames that represent the motion."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import Array

if TYPE_CHECKING:
    from tkamb.run.results import Results

EVENLY_SHOWN = 300
"""1: frames that a page shows evenly over a longer recording. A plot has 700 pixels; at 300 frames
the page of the shipped knee has 4 MB."""
LABELS = {"flexion": "flexion (deg)", "cycle": "cycle (%)", "time": "time (s)"}
UNITS = {"flexion": "°", "cycle": " %", "time": " s"}


@dataclass(frozen=True, eq=False)
class HorizontalAxis:
    """Horizontal axis of the plots, in time order; it need not be monotonic.

    Args:
        kind: "flexion", "cycle" or "time".
        values: (f,) positions of the frames, deg, % or s.
        stances: begin and end of each stance on the axis; empty if the axis is flexion.
    """

    kind: str
    values: Array
    stances: tuple[tuple[float, float], ...] = ()

    @property
    def label(self) -> str:
        """Return the axis label with its unit."""
        return LABELS[self.kind]

    def at(self, frame: int) -> str:
        """Return the position of a frame on the axis as text with its unit."""
        digits = 2 if self.kind == "time" else 0
        return f"{self.values[frame]:.{digits}f}{UNITS[self.kind]}"

    def broken(self, values: Array) -> tuple[Array, Array]:
        """Return x and y for drawing, interrupted where a new cycle starts."""
        x = self.values
        if self.kind != "cycle":
            return x, values
        cuts = np.flatnonzero(np.diff(x) < -50) + 1
        return np.insert(x, cuts, np.nan), np.insert(values, cuts, np.nan)

    def stops(self, count: int) -> NDArray[np.int64]:
        """Return about `count` frames spread evenly over the motion, in time order.

        They are the nearest to round values of the axis, or evenly spaced in time on a flexion axis
        that is not monotonic.
        """
        x = self.values
        steps = np.diff(x)
        if self.kind == "flexion" and not (np.all(steps > 0) or np.all(steps < 0)):
            return np.unique(np.linspace(0, len(x) - 1, count).round().astype(np.int64))
        if not np.isfinite(x).any():
            return np.zeros(0, np.int64)
        low, high = float(np.nanmin(x)), float(np.nanmax(x))
        step = round_step((high - low) / max(count - 1, 1))
        ticks = np.arange(np.ceil(low / step - 0.3), np.floor(high / step + 0.3) + 1) * step
        return self.nearest(ticks)

    def nearest(self, values: Iterable[float]) -> NDArray[np.int64]:
        """Return the frames nearest to these values of the axis, in time order, each once."""
        return np.unique([int(np.argmin(np.abs(self.values - place))) for place in values])


def round_step(step: float) -> float:
    """Return the smallest 1, 1.5, 2, 3 or 5 x 10^k that is not below a step."""
    if not step > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(step))
    choices = np.array([1.0, 1.5, 2.0, 3.0, 5.0, 10.0]) * power
    return float(choices[choices >= step * (1 - 1e-9)][0])


def horizontal_axis(results: "Results", kind: str | None = None) -> HorizontalAxis:
    """Return the horizontal axis of kind `kind`; None: the kind in the summary, else flexion.

    A cycle axis uses `cycle_percent`, or the summary's `cycle_percent_s`, or the ends of the motion
    as 0 and 100 %.
    """
    kind = kind or results.summary.get("axis") or "flexion"
    if kind == "flexion":
        return HorizontalAxis(kind, results["flexion_deg"])
    time = results["time_s"]
    if kind == "time":
        return HorizontalAxis(kind, time, _stances(results, float(time[0]), float(time[-1])))
    if kind != "cycle":
        raise InputError(f"there is no axis '{kind}'", "axis", f"one of {', '.join(LABELS)}")
    percent = results["cycle_percent"]
    if np.isfinite(percent).all():
        return HorizontalAxis(kind, percent, _stances_in_cycle(results))
    start, end = results.summary.get("cycle_percent_s") or (time[0], time[-1])
    percent = 100 * (time - start) / (end - start) if end > start else np.zeros(len(time))
    if percent.max() > 100 + 1e-6 or percent.min() < -1e-6:
        percent = percent % 100
    return HorizontalAxis(kind, percent, _stances_in_cycle(results))


def _stances(results: "Results", start: float, end: float) -> tuple[tuple[float, float], ...]:
    """Return begin and end of the measured stances, limited to `start` and `end`, s."""
    stance = (results.summary.get("gait") or {}).get("stance_s") or ()
    cut = [(max(float(on), start), min(float(off), end)) for on, off in stance]
    return tuple((on, off) for on, off in cut if on < off)


def _stances_in_cycle(results: "Results") -> tuple[tuple[float, float], ...]:
    """Return begin and end of the stances in the cycle, %."""
    cycle = results.summary.get("cycle_percent_s")
    if cycle is None:
        return ()
    start, end = (float(time) for time in cycle)
    scale = 100.0 / (end - start)
    spans = _stances(results, start, end)
    return tuple((scale * (on - start), scale * (off - start)) for on, off in spans)


def shown_frames(results: "Results") -> NDArray[np.int64]:
    """Return the frames that a page shows: all, or `EVENLY_SHOWN` and those of every column's
    largest absolute value.
    """
    count = len(results)
    if count <= EVENLY_SHOWN:
        return np.arange(count)
    columns = [values for name, values in results.columns.items() if name != "status"]
    peaks = [np.nanargmax(np.abs(one)) for one in columns if np.isfinite(one).any()]
    even = np.round(np.linspace(0, count - 1, EVENLY_SHOWN)).astype(int)
    return np.unique([*even, *peaks])


def results_at(results: "Results", frames: NDArray[np.int64]) -> "Results":
    """Return the results of some frames with the summary and the maps of all."""
    if len(frames) == len(results):
        return results
    columns = {
        name: [values[k] for k in frames] if isinstance(values, list) else values[frames]
        for name, values in results.columns.items()
    }
    bands = {name: values[frames] for name, values in results.bands.items()}
    return replace(results, columns=columns, bands=bands)
