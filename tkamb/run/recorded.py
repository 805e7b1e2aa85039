"""Comparison of a run with measured forces and EMG."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.io.scene.case import Case
from tkamb.run.claims import split_of
from tkamb.run.columns import ACTIVATION, ENVELOPE, family_column
from tkamb.run.status import FAILED

if TYPE_CHECKING:
    from tkamb.io.recordings.measured import Envelopes


LAGS = np.arange(-40, 41) * 0.005
"""s: lags of the cross-correlation."""


# 1: least difference between the largest correlation and those at the first and last lag. With a
# smaller difference no lag is given. Rounding errors are smaller.
LEAST_CORRELATION_RISE = 1e-6
# 1: least number of frames for correlation and lag. A correlation of fewer values
# means little.
FEWEST_FRAMES = 8


def recorded_row(case: Case, k: int) -> dict[str, float]:
    """Return column -> measured value in frame k."""
    row: dict[str, float] = {}
    time = case.motion.time[k : k + 1]
    if case.measured is not None:
        forces = case.measured.at(time)
        row |= {measured_column(name): float(force[0]) for name, force in forces.items()}
    if case.emg is not None:
        for name in case.emg.channel_of:
            row[family_column(ENVELOPE, name)] = float(case.emg.at(name, time)[0])
    return row


def compare_recorded(case: Case, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Return the summary's keys `measured` and `emg`; a scene without such data lacks them."""
    result: dict[str, Any] = {}
    if case.measured is not None:
        result["measured"] = compare_measured(columns, case.measured.force, case.body_weight)
    if case.emg is not None:
        assert case.scene.muscles is not None and case.scene.muscles.emg is not None
        table = case.scene.muscles.emg
        result["emg"] = {
            "settings": table.model_dump(mode="json", exclude_none=True),
            "muscles": compare_emg(case.emg, columns),
        }
        if table.use == "report":
            result["emg"]["fitted_normalised_by"] = fitted_normalisation(case.emg, columns)
    return result


def measured_column(name: str) -> str:
    """Return the column of results.csv with a measured force."""
    return f"measured_{name}_N"


def compare_measured(
    columns: Mapping[str, Any], names: Iterable[str], body_weight: float
) -> dict[str, dict[str, Any]]:
    """Return measured force -> errors of the run.

    The errors are, over the frames with predicted p and measured m,

        RMSE = sqrt(mean((p - m)²)),  bias = mean(p - m),  R² = 1 - Σ(p - m)²/Σ(m - mean(m))²,

    Pearson's r and the peaks. The frames are counted as compared, failed, without measurement, or
    without prediction (not failed, but NaN).

    Args:
        body_weight: body weight, N.
    """
    failed = np.array([status.startswith(FAILED) for status in columns["status"]], bool)
    missing = np.full(len(failed), np.nan)
    result, split = {}, split_of(columns)
    for name in names:
        column, measured = split.column(name), columns[measured_column(name)]
        predicted = columns.get(column, missing)
        counted = _frame_counts(predicted, measured, failed)
        error = _force_errors(columns["time_s"], predicted, measured, body_weight)
        result[name] = {"predicted": column} | counted | error
    return result


def _frame_counts(predicted: Array, measured: Array, failed: NDArray[np.bool_]) -> dict[str, Any]:
    compared = np.isfinite(predicted) & np.isfinite(measured)
    unmeasured = np.isnan(measured) & ~failed
    left_out = measured[np.isfinite(measured) & ~compared]
    return {
        "frames_compared": int(compared.sum()),
        "frames_failed": int((failed & ~compared).sum()),
        "frames_without_measurement": int(unmeasured.sum()),
        "frames_without_prediction": int((~compared & ~failed & ~unmeasured).sum()),
        "measured_where_not_compared_N": [left_out.min(), left_out.max()] if len(left_out) else [],
    }


def _force_errors(
    time: Array, predicted: Array, measured: Array, body_weight: float
) -> dict[str, float]:
    """R² and r are NaN for constant forces."""
    compared = np.isfinite(predicted) & np.isfinite(measured)
    if not compared.any():
        return {}
    p, m, t = predicted[compared], measured[compared], time[compared]
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


def compare_emg(envelopes: "Envelopes", columns: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return muscle -> agreement of its activation a with its EMG envelope e.

    The agreement is Pearson's r and RMSE of a(t) and e(t), and the lag L with the largest r of a(t)
    and e(t - L). The lag is positive if the activation is later than the envelope. It uses frames
    with an envelope for all `LAGS`, and is NaN if r is largest at the first or last lag.
    """
    time = np.asarray(columns["time_s"])
    result = {}
    for muscle, channel in envelopes.channel_of.items():
        activation = np.asarray(
            columns.get(family_column(ACTIVATION, muscle), np.full_like(time, np.nan))
        )
        envelope = envelopes.at(muscle, time)
        compared = np.isfinite(activation) & np.isfinite(envelope)
        error = activation[compared] - envelope[compared]
        result[muscle] = {
            "channel": channel,
            "frames_compared": int(compared.sum()),
            "frames_left_out": int((~compared).sum()),
            "pearson_r": _pearson(activation[compared], envelope[compared]),
            "rmse": float(np.sqrt((error**2).mean())) if compared.any() else np.nan,
            "lag_s": _lag(envelopes, muscle, time[compared], activation[compared]),
        }
    return result


def fitted_normalisation(
    envelopes: "Envelopes", columns: Mapping[str, Any]
) -> dict[str, float | None]:
    """Return EMG channel -> normalising value for which its envelope fits the activations best.

    It is v / s with the current value v. The scale s = Σ a e / Σ e² minimises Σ (a - s e)² over
    frames and muscles of the channel. None: s is not positive.

    Args:
        columns: columns of results.csv of a run without guidance by EMG.
    """
    time, result = np.asarray(columns["time_s"]), {}
    for channel, value in envelopes.normalised_by.items():
        names = [name for name, one in envelopes.channel_of.items() if one == channel]
        missing = np.full_like(time, np.nan)
        a = np.array([columns.get(family_column(ACTIVATION, name), missing) for name in names])
        e = np.array([envelopes.at(name, time) for name in names])
        finite = np.isfinite(a) & np.isfinite(e)
        product = float(a[finite] @ e[finite])
        result[channel] = value * float(e[finite] @ e[finite]) / product if product > 0.0 else None
    return result


def _pearson(a: Array, b: Array) -> float:
    """Return Pearson's r; NaN for constant or few values."""
    return float(_correlations(a, b[None])[0])


def _correlations(a: Array, rows: Array) -> Array:
    """Return Pearson's r (m,) of a (n,) and each row (m, n); NaN as in `_pearson`."""
    if len(a) < FEWEST_FRAMES:
        return np.full(len(rows), np.nan)
    varied = (np.ptp(rows, axis=1) > 0.0) & (np.ptp(a) > 0.0)
    deviation, deviations = a - a.mean(), rows - rows.mean(axis=1, keepdims=True)
    size = np.sqrt((deviation @ deviation) * (deviations**2).sum(axis=1))
    return np.divide(deviations @ deviation, size, out=np.full(len(rows), np.nan), where=varied)


def _lag(envelopes: "Envelopes", muscle: str, time: Array, activation: Array) -> float:
    """Return the lag, s, of the largest correlation; NaN without a maximum inside the range."""
    shifted = envelopes.at(muscle, time - LAGS[:, None])
    finite = np.isfinite(shifted).all(axis=0)
    r = _correlations(activation[finite], shifted[:, finite])
    if not r.max() > max(r[0], r[-1]) + LEAST_CORRELATION_RISE:  # NaN too
        return np.nan
    return float(LAGS[r.argmax()])


WHY_NOT = {
    "frames_failed": "failed",
    "frames_without_measurement": "without measurement",
    "frames_without_prediction": "without prediction",
}


def comparison_words(comparison: Mapping[str, Mapping[str, Any]]) -> tuple[str, str, bool]:
    """Return the RMSE of the first force, all errors in words, and whether frames are left out.

    Args:
        comparison: force -> errors from `compare_measured`.
    """
    (_, one), *others = comparison.items()
    counts = [_count_words(one)]
    counts += [f"{n}: {words}" for n, o in others if (words := _count_words(o)) != counts[0]]
    if low_high := one["measured_where_not_compared_N"]:
        counts[0] += f", where {low_high[0]:.0f} to {low_high[1]:.0f} N were measured"
    details = "; ".join([*(error_words(n, o) for n, o in comparison.items()), *counts])
    incomplete = any(o[key] for o in comparison.values() for key in WHY_NOT)
    if not one["frames_compared"]:
        return "no frame to compare", details, True
    return f"RMSE {one['rmse_BW']:.2f} BW", details, incomplete


def error_words(name: str, one: Mapping[str, Any]) -> str:
    """Return the errors of one force in words."""
    if not one["frames_compared"]:
        return f"{name}: no frame"
    shares = "".join(
        f", {sign} {one[key]:.2f}"
        for sign, key in (("R²", "r_squared"), ("r", "pearson_r"))
        if one[key] is not None and one[key] == one[key]
    )
    return (
        f"{name} RMSE {one['rmse_N']:.0f} N ({one['rmse_BW']:.2f} BW), "
        f"bias {one['bias_N']:+.0f} N{shares}, peak {one['peak_predicted_N']:.0f} N at "
        f"{one['peak_predicted_time_s']:.2f} s for {one['peak_measured_N']:.0f} N at "
        f"{one['peak_measured_time_s']:.2f} s"
    )


def _count_words(one: Mapping[str, Any]) -> str:
    total = one["frames_compared"] + sum(one[key] for key in WHY_NOT)
    why = [f"{one[key]} {words}" for key, words in WHY_NOT.items() if one[key]]
    return ", ".join([f"{one['frames_compared']} of {total} frames compared", *why])
