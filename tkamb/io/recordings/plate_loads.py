"""When a force plate is loaded, and its reading while nobody stands on it.

Amplifiers drift. A plate that nobody stands on then adds a false moment about the knee, with its
distance from the knee as lever arm. Therefore a plate counts only while it is loaded, and its
unloaded level is reported.
"""

import math
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class PlateLoadSettings:
    """When a force plate counts as loaded, and which force is drift."""

    load_N: float = 20.0
    """N; force beyond the unloaded level that is a load. Chosen: filters of ground reactions mostly
    use 20 N."""
    margin_s: float = 0.05
    """s; the wrench counts from this much before a load to this much after it. Chosen: a foot comes
    down and leaves within 0.02 s."""
    quiet_share: float = 0.1
    """Share of the samples, those of the smallest force, that show the unloaded level. Chosen: a
    plate is unloaded for longer in a usual recording."""
    quiet_spread_N: float = 2.0
    """N; these samples show the level if they lie within this of each other. Chosen: no foot is so
    steady."""
    most_drift_N: float = 60.0
    """N; largest unloaded level that is drift. Chosen: a larger force is that of a foot."""
    drift_N: float = 2.0
    """N; a larger unloaded level gets a note. Chosen: the median of noise is zero, and 2 N change
    the force of the knee by less than 0.5 % of a body weight."""
    unloaded_s: float = 0.1
    """s; a plate that is unloaded for less shows no drift. Chosen: a foot that swings leaves the
    plate for longer."""


PLATE_LOAD = PlateLoadSettings()


def around_load(force: Array, time: Array) -> np.ndarray:
    """Return (k,) whether a plate is loaded, or was or will be within the margin.

    Args:
        force: (k,) N, size of the force on the plate.
        time: (k,) s.
    """
    forces = np.sort(force[np.isfinite(force)])
    quiet = forces[: math.ceil(PLATE_LOAD.quiet_share * len(forces))]
    steady = (
        len(quiet)
        and np.ptp(quiet) <= PLATE_LOAD.quiet_spread_N
        and quiet[-1] <= PLATE_LOAD.most_drift_N
    )
    loaded = np.flatnonzero(
        force >= PLATE_LOAD.load_N + (float(np.median(quiet)) if steady else 0.0)
    )
    if not len(loaded):
        return np.zeros(len(force), bool)
    after = np.searchsorted(loaded, np.arange(len(force)))
    nearest = np.minimum(
        np.abs(time[loaded[np.minimum(after, len(loaded) - 1)]] - time),
        np.abs(time - time[loaded[np.maximum(after - 1, 0)]]),
    )
    return np.asarray(nearest <= PLATE_LOAD.margin_s)


def unloaded_level(vertical: Array, on: np.ndarray, time: Array) -> float:
    """Return the median (N) of a plate's vertical force while nobody stands on it; else zero."""
    free = vertical[~on & np.isfinite(vertical)]
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    return float(np.median(free)) if len(free) * step >= PLATE_LOAD.unloaded_s else 0.0
