"""Implausible samples, and odd samples, which do not fit their neighbours, like typing mistakes.

The deviation of a sample is its distance from the cubic through its two neighbours on either side.
A sample is odd if its deviation exceeds `floor` and many times the median deviation around it.
Noise is therefore not odd: it raises the median, which a single odd sample hardly changes.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import Array

# Number of samples on either side for the median deviation. Not studied.
NEIGHBOURS = 12
# 1: smallest ratio of an odd sample's deviation to the median. Normal noise exceeds
# it once in 10 million samples.
OUTLIER_FACTOR = 8.0
# s: largest median step between samples. Slower samples record no movement.
MAX_STEP = 5.0
# 1: factor on `OUTLIER_FACTOR` at the ends of a recording. Extrapolation of a cubic
# has larger errors than interpolation.
END_FACTOR = 4.0


@dataclass(frozen=True)
class OddSample:
    """A sample off its neighbours' curve.

    Args:
        what: the quantity, like "flexion".
        time: s, time of the sample.
        away: distance from the curve, in `unit`.
        unit: unit of `away`, like "mm".
    """

    path: Path
    what: str
    time: float
    away: float
    unit: str


def odd_samples(
    path: Path, what: str, time: Array, values: Array, floor: float, scale: float, unit: str
) -> tuple[OddSample, ...]:
    """Return the odd samples of one quantity.

    Args:
        time: (n,) s, rising.
        values: (n,) SI.
        floor: smallest deviation of an odd sample, SI.
        scale: SI per `unit`.
        unit: unit of the deviation in messages.
    """
    if len(time) < 6:
        return ()
    away = np.abs(values - neighbours_curve(time, values))
    ends = np.ones(len(time))
    ends[[0, 1, -2, -1]] = END_FACTOR
    limit = np.maximum(floor, OUTLIER_FACTOR * _running_median(away / ends)) * ends
    # An odd sample also shifts the curves of its four neighbours, by 2/3 and 1/6 of its deviation.
    odd = [k for k in np.flatnonzero(away > limit) if away[k] >= away[max(k - 2, 0) : k + 3].max()]
    return tuple(OddSample(path, what, float(time[k]), float(away[k] / scale), unit) for k in odd)


def neighbours_curve(time: Array, values: Array) -> Array:
    """Return, at each sample, the cubic (n,) through its four neighbours (two on either side)."""
    n = len(time)
    first = np.clip(np.arange(n) - 2, 0, n - 5)
    others = first[:, None] + np.arange(5)
    others = others[others != np.arange(n)[:, None]].reshape(n, 4)
    t, sample_time = time[others], time[:, None]
    weights = np.ones((n, 4))
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[:, i] *= (sample_time[:, 0] - t[:, j]) / (t[:, i] - t[:, j])
    return np.asarray((weights * values[others]).sum(axis=1))


def _running_median(away: Array) -> Array:
    width = min(2 * NEIGHBOURS + 1, len(away))
    windows = np.lib.stride_tricks.sliding_window_view(away, width)
    start = np.clip(np.arange(len(away)) - width // 2, 0, len(windows) - 1)
    return np.asarray(np.median(windows, axis=1)[start])


def check_spacing(path: Path, time: Array) -> None:
    """Raise an InputError if samples at times (n,) s are no movement: one, or too far apart."""
    if len(time) == 1:
        what = f"has one row, at {time[0]:g} s, which is no movement"
        raise InputError(what, path, "give a recording of several rows")
    spacing = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if spacing > MAX_STEP:
        raise InputError(
            f"samples are {spacing:g} s apart, too far to be a movement",
            path,
            "the time must be in seconds: rewrite the column if it is in another unit",
        )


def check_overlap(path: Path, clock: Array, time: Array, table: str) -> None:
    """Raise an InputError if a measurement and the motion have no common time.

    Args:
        clock: (n,) s, times of the file's samples on the motion's clock.
        time: (f,) s, times of the motion.
        table: the scene's table that names the file, like "[measured]".
    """
    if clock[-1] < time[0] or clock[0] > time[-1]:
        raise InputError(
            f"was measured from {clock[0]:g} to {clock[-1]:g} s, but the motion lasts from "
            f"{time[0]:g} to {time[-1]:g} s",
            path,
            f"correct {table} offset_s, or use another file",
        )


def check_steps(
    path: Path, what: str, time: Array, values: Array, fastest: float, scale: float, unit: str
) -> None:
    """Raise an InputError if a quantity (n,) changes faster than `fastest` (SI per second)."""
    if len(time) < 2:
        return
    rate = np.abs(np.diff(values)) / np.diff(time)
    k = int(np.argmax(rate))
    if rate[k] > fastest:
        raise InputError(
            f"{what} steps from {values[k] / scale:.4g} to {values[k + 1] / scale:.4g} {unit} "
            f"between {time[k]:g} and {time[k + 1]:g} s, which is impossible",
            path,
            "check whether a cell is mistyped, and whether the time is in seconds",
        )


def check_range(
    path: Path, what: str, values: Array, limits: tuple[float, float], unit: str, hint: str
) -> None:
    """Raise an InputError with a hint if values (n,) are outside `limits`, both in `unit`.

    `what` is the part of the body and the quantity, like "knee: flexion".
    """
    low, high = limits
    outside: NDArray[np.bool_] = ~((values >= low) & (values <= high))
    if outside.any():
        body, _, quantity = what.partition(": ")
        raise InputError(
            f"{quantity} runs from {values.min():.4g} to {values.max():.4g} {unit}, which no "
            f"{body} does ({low:g} to {high:g}; first in data row {int(np.argmax(outside)) + 1})",
            path,
            hint,
        )
