"""How recorded EMG and predicted activations agree, muscle by muscle."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.columns import ACTIVATION, family_column
from tkamb.geometry.frames import Array

if TYPE_CHECKING:
    from tkamb.inputs.emg import Envelopes

LAGS = np.arange(-40, 41) * 0.005
"""s: where the largest cross-correlation is sought, 0.2 s to either side."""
FLAT = 1e-6
"""By how much the largest correlation exceeds those at the ends, where it is a maximum."""
FEWEST = 8
"""Frames below which nothing is said of correlation and lag."""


def compare_emg(envelopes: "Envelopes", columns: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return how each muscle's activation a and envelope e agree over the computed frames.

    Pearson's r and RMSE of a(t) and e(t), and the lag L of the largest r of a(t) and e(t - L):
    positive where the activation comes after the envelope. The lag is that of frames whose
    envelope is known 0.2 s to either side; none is given where the largest r lies at an end.

    Args:
        envelopes: of the muscles.
        columns: of results.csv.
    """
    time = np.asarray(columns["time_s"])
    found = {}
    for muscle, channel in envelopes.channel_of.items():
        activation = np.asarray(
            columns.get(family_column(ACTIVATION, muscle), np.full_like(time, np.nan))
        )
        own = envelopes.at(muscle, time)
        both = np.isfinite(activation) & np.isfinite(own)
        error = activation[both] - own[both]
        found[muscle] = {
            "channel": channel,
            "frames_compared": int(both.sum()),
            "frames_left_out": int((~both).sum()),
            "pearson_r": _pearson(activation[both], own[both]),
            "rmse": float(np.sqrt((error**2).mean())) if both.any() else np.nan,
            "lag_s": _lag(envelopes, muscle, time[both], activation[both]),
        }
    return found


def _pearson(a: Array, b: Array) -> float:
    """Return Pearson's r; NaN where one of them does not vary or there are few values."""
    if len(a) < FEWEST or np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
        return np.nan
    return float(np.corrcoef(a, b)[0, 1])


def _lag(envelopes: "Envelopes", muscle: str, time: Array, activation: Array) -> float:
    """Return the lag (s) of the largest correlation; NaN where it has no maximum inside."""
    shifted = np.array([envelopes.at(muscle, time - lag) for lag in LAGS])
    known = np.isfinite(shifted).all(axis=0)
    r = np.array([_pearson(activation[known], row[known]) for row in shifted])
    if not r.max() > max(r[0], r[-1]) + FLAT:  # NaN too
        return np.nan
    return float(LAGS[r.argmax()])
