"""What was measured in a knee held against what a run predicts."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.run.status import FAILED

PREDICTED = {
    "total": ("force_si_N",),
    "medial": ("medial_force_N", "medial_force_equilibrium_N"),
    "lateral": ("lateral_force_N", "lateral_force_equilibrium_N"),
}
"""What is measured -> the columns that predict it, the first that holds a number."""


def measured_column(name: str) -> str:
    """Return the column of results.csv that holds what was measured of a force."""
    return f"measured_{name}_N"


def compare_measured(columns: Mapping[str, Any], body_weight: float) -> dict[str, dict[str, Any]]:
    """Return how far a run is from what was measured, of each force that was.

    Over the n frames that have both, with predicted p and measured m,

        RMSE = sqrt(mean((p - m)²)),  bias = mean(p - m),  R² = 1 - Σ(p - m)²/Σ(m - mean(m))²,

    Pearson's r and the peaks. Every frame is counted: compared, failed, without measurement or
    (not failed, but NaN) without prediction.

    Args:
        columns: of results.csv, `measured_<name>_N` among them.
        body_weight: N.
    """
    failed = np.array([status.startswith(FAILED) for status in columns["status"]], bool)
    found = {}
    for name, candidates in PREDICTED.items():
        measured = columns.get(measured_column(name))
        if measured is None or not np.isfinite(measured).any():
            continue
        column = next((c for c in candidates if np.isfinite(columns[c]).any()), candidates[0])
        counted = _counts(columns[column], measured, failed)
        error = _errors(columns["time_s"], columns[column], measured, body_weight)
        found[name] = {"predicted": column} | counted | error
    return found


def _counts(predicted: Array, measured: Array, failed: NDArray[np.bool_]) -> dict[str, Any]:
    """Return how many frames are compared, why others are not, and what was measured there."""
    both = np.isfinite(predicted) & np.isfinite(measured)
    without = np.isnan(measured) & ~failed
    left_out = measured[np.isfinite(measured) & ~both]
    return {
        "frames_compared": int(both.sum()),
        "frames_failed": int((failed & ~both).sum()),
        "frames_without_measurement": int(without.sum()),
        "frames_without_prediction": int((~both & ~failed & ~without).sum()),
        "measured_where_not_compared_N": [left_out.min(), left_out.max()] if len(left_out) else [],
    }


def _errors(time: Array, predicted: Array, measured: Array, body_weight: float) -> dict[str, float]:
    """Return the errors over the frames that have both; NaN where they say nothing."""
    both = np.isfinite(predicted) & np.isfinite(measured)
    if not both.any():
        return {}
    p, m, t = predicted[both], measured[both], time[both]
    error = p - m
    rmse, bias = float(np.sqrt((error**2).mean())), float(error.mean())
    spread = m - m.mean()
    varied = len(m) > 2 and np.ptp(m) > 0 and np.ptp(p) > 0
    return {
        "rmse_N": rmse,
        "rmse_BW": rmse / body_weight,
        "bias_N": bias,
        "bias_BW": bias / body_weight,
        "r_squared": 1.0 - float(error @ error / (spread @ spread)) if varied else np.nan,
        "pearson_r": float(np.corrcoef(m, p)[0, 1]) if varied else np.nan,
        "peak_predicted_N": float(p.max()),
        "peak_predicted_time_s": float(t[p.argmax()]),
        "peak_measured_N": float(m.max()),
        "peak_measured_time_s": float(t[m.argmax()]),
    }
