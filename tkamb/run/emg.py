"""How recorded EMG and predicted activations agree, muscle by muscle, and what scale fits."""

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


def fitted_normalisation(
    envelopes: "Envelopes", columns: Mapping[str, Any]
) -> dict[str, float | None]:
    """Return each channel's normalising value with which its envelope e fits the activations a.

    That is v / s, v the value that e is over, and s the scale of least Σ (a - s e)² over the
    computed frames and the muscles of the channel, Σ a e / Σ e². Without a maximal contraction
    no better one is known: it takes the course from the EMG, and how strong from the sharing.
    None where s is not above zero.

    Args:
        envelopes: of the muscles.
        columns: of results.csv of a run that the EMG did not guide.
    """
    time, found = np.asarray(columns["time_s"]), {}
    for channel, value in envelopes.normalised_by.items():
        own = [name for name, one in envelopes.channel_of.items() if one == channel]
        lost = np.full_like(time, np.nan)
        a = np.array([columns.get(family_column(ACTIVATION, name), lost) for name in own])
        e = np.array([envelopes.at(name, time) for name in own])
        both = np.isfinite(a) & np.isfinite(e)
        along = float(a[both] @ e[both])
        found[channel] = value * float(e[both] @ e[both]) / along if along > 0.0 else None
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
