"""Bands of the results over the samples, and the share of each input in their variance.

`values` (n, m, f) are those of n samples, m columns of results.csv and f frames, NaN if missing.
`failed` (n, f) marks the failed frames of the samples, and `body_weight` is in N.
"""

import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tkamb.geometry.frames import SIDES, Array
from tkamb.run.discrepancy import (
    COLUMNS,
    QUANTILE_METHOD,
    band_with_discrepancy,
    coverage,
    discrepancy_of,
    load_of,
)
from tkamb.run.results import MAX_FAILED_SHARE, MIN_SAMPLES, PERCENTILES
from tkamb.run.status import out_of_equilibrium

ENDS = ("p05", "p95")
TOTALS_N = ("force_si_N", "force_total_N")
"""Columns of results.csv with the total force. The first one present is used."""
PATELLOFEMORAL = ("patellofemoral_tangential_N", "patellofemoral_N")
"""Columns with the force across the button's normal, and along it."""
ROUND_OFF = 1e-9
"""Ratio of standard deviation to magnitude below which a result counts as constant."""
SAMPLES_PER_INPUT = 6
"""Smallest number of samples per input for a joint regression. With fewer samples the shares are
mostly chance."""
NUMBER = re.compile(r"[-−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
MOST_CAUSES = 3


def varies(variance: float, square: float) -> bool:
    """Return whether a variance is above round-off, given the mean square of the values."""
    return variance > ROUND_OFF**2 * square


def percentiles(values: Array, failed: np.ndarray | None = None) -> dict[str, Array]:
    """Return p05, p50 and p95 over samples, each with the shape of one sample.

    The p quantile has the rank p (n + 1) among the n finite values, with linear interpolation. A
    new draw then lies between p05 and p95 with a probability of 0.90 for any n. The usual rank
    1 + p (n - 1) gives only 0.81 for 20 samples and 0.87 for 60.

    The result is NaN if fewer than `MIN_SAMPLES` values are finite, or if more
    than `MAX_FAILED_SHARE` of the samples failed.

    Args:
        values: values of the samples, (n, ...); NaN for a missing value.
        failed: whether each sample failed, with the shape of `values`; None: no failures.

    Reference: Hyndman & Fan, Am Stat 50:361 (1996), doi:10.1080/00031305.1996.10473566, their
    sixth definition.
    """
    with warnings.catch_warnings():
        # a column of NaN gives NaN, which is intended
        warnings.simplefilter("ignore", RuntimeWarning)
        limits = np.nanpercentile(
            values, list(PERCENTILES.values()), axis=0, method=QUANTILE_METHOD
        )
    hidden = np.isfinite(values).sum(axis=0) < MIN_SAMPLES
    if failed is not None:
        hidden = hidden | (failed.mean(axis=0) > MAX_FAILED_SHARE)
    limits[:, hidden] = np.nan
    return dict(zip(PERCENTILES, limits, strict=True))


def peak_band(nominal: Array, values: Array, failed: np.ndarray) -> dict[str, Any] | None:
    """Return the band of a result at the frame of its largest nominal value.

    Args:
        nominal: nominal values of the result, (f,); here `values` are (n, f).

    Returns:
        Frame, nominal value, number of samples and of failed samples, median, p05 and p95 (None:
        no band), per cent of the samples below the nominal value (with half of the equal ones), and
        a sentence. None if no nominal value is finite.
    """
    if not np.isfinite(nominal).any():
        return None
    frame = int(np.nanargmax(nominal))
    at_peak, level = values[:, frame], float(nominal[frame])
    finite = at_peak[np.isfinite(at_peak)]
    bands = percentiles(values[:, frame : frame + 1], failed[:, frame : frame + 1])
    low, middle, high = (float(bands[name][0]) for name in ("p05", "p50", "p95"))
    below = (finite < level).sum() + 0.5 * (finite == level).sum()
    limits = {
        "frame": frame,
        "nominal": level,
        "samples": len(at_peak),
        "failed_samples": int(failed[:, frame].sum()),
        "median": middle if np.isfinite(middle) else None,
        "p05": low if np.isfinite(low) else None,
        "p95": high if np.isfinite(high) else None,
        "nominal_percentile": 100.0 * float(below) / len(finite) if len(finite) else None,
    }
    return limits | {"words": _peak_words(limits)}


def _peak_words(peak: Mapping[str, Any]) -> str:
    share = peak["failed_samples"] / peak["samples"]
    failed = f"{peak['failed_samples']} of {peak['samples']} samples failed there ({share:.0%})"
    if peak["median"] is None:
        return failed
    outside = not peak["p05"] <= peak["nominal"] <= peak["p95"]
    return (
        f"{peak['nominal']:.2f} BW with the inputs as given, at the "
        f"{peak['nominal_percentile']:.0f}th "
        f"percentile of the samples{', outside the band' if outside else ''}; {failed}"
    )


def band_columns(
    time: Array, names: Sequence[str], values: Array, failed: np.ndarray
) -> dict[str, Array]:
    """Return the columns of bands.csv, (f,), for the m `names`.

    Args:
        time: s, (f,).
    """
    columns = {"time_s": time, "failed_share": failed.mean(axis=0)}
    solved = np.maximum((~failed).sum(axis=0), 1)
    for side in SIDES:
        if f"{side}_force_N" in names:
            force = values[:, list(names).index(f"{side}_force_N")]
            columns[f"{side}_unloaded_share"] = (force == 0.0).sum(axis=0) / solved
    for index, name in enumerate(names):
        for ending, limits in percentiles(values[:, index], failed).items():
            columns[f"{name}_{ending}"] = limits
    return columns


def unbalanced_patella(
    names: Sequence[str], values: Array, body_weight: float
) -> tuple[dict[str, Array], str]:
    """Return how often a recorded patella is not in equilibrium with its lines, by `status`.

    Args:
        body_weight: body weight, N.

    Returns:
        The column `patella_unbalanced_share` of bands.csv: the share of the samples with a force;
        and a sentence, "" if it is 0 in all frames.
    """
    across, normal = (np.abs(values[:, list(names).index(name)]) for name in PATELLOFEMORAL)
    unbalanced = out_of_equilibrium(across, normal, body_weight)
    share = unbalanced.sum(axis=0) / np.maximum(np.isfinite(normal).sum(axis=0), 1)
    words = ""
    if unbalanced.any():
        worst = (across[unbalanced] / normal[unbalanced]).max()
        words = (
            f"in up to {share.max():.0%} of the samples of a frame the recorded patella is not in "
            f"equilibrium with its lines: up to {worst:.0%} of the patellofemoral force acts "
            "across the button"
        )
    return {"patella_unbalanced_share": share}, words


def discrepancy_columns(
    names: Sequence[str], values: Array, summary: Mapping[str, Any], body_weight: float
) -> dict[str, Array]:
    """Return the columns `<name>_discrepancy_p05` and `_p95`: the band of inputs and discrepancy.

    There are none if the run's discrepancy is unknown. Values are NaN where the force or the total
    force has no band.
    """
    discrepancy = discrepancy_of(summary)
    totals = [name for name in TOTALS_N if name in names]
    if not totals:
        return {}
    load = load_of(values[:, list(names).index(totals[0])], body_weight)
    columns: dict[str, Array] = {}
    for index, name in enumerate(names):
        spread = discrepancy.get(COLUMNS.get(name, ""))
        if spread is None:
            continue
        unit = body_weight if name.endswith("_BW") else 1.0
        ends = band_with_discrepancy(values[:, index], spread, load / unit)
        ends[:, np.isnan(percentiles(values[:, index])["p50"])] = np.nan
        for end, limit in zip(ENDS, ends, strict=True):
            columns[f"{name}_discrepancy_{end}"] = limit
    return columns


def causes(problems: np.ndarray) -> dict[str, float]:
    """Return cause -> its share of the failed frames, for the most frequent causes.

    Args:
        problems: reason why each frame failed, "" if it did not. Its last clause is the cause,
            without numbers, because numbers differ from frame to frame.
    """
    clauses = [text.rsplit("; ", 1)[-1] for text in problems.ravel() if text]
    count = Counter(NUMBER.sub("…", text) for text in clauses)
    return {text: times / len(clauses) for text, times in count.most_common(MOST_CAUSES)}


def measured_inside(
    columns: Mapping[str, Any], bands: Mapping[str, Array], compared: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Return the share of frames with the measured force inside its band.

    Returns:
        Force -> number of frames with force and band, share of them inside the band of inputs (NaN
        without frames), and inside the band of inputs and discrepancy if that exists.
    """
    rows: dict[str, dict[str, Any]] = {}
    for name, comparison in compared.items():
        measured, column = columns[f"measured_{name}_N"], comparison["predicted"]
        missing = np.full(len(measured), np.nan)
        low, high = (bands.get(f"{column}_{end}", missing) for end in ENDS)
        frames, share = coverage(low, high, measured)
        rows[name] = {"frames": frames, "share": share}
        low, high = (bands.get(f"{column}_discrepancy_{end}", missing) for end in ENDS)
        frames, share = coverage(low, high, measured)
        if frames:
            rows[name]["share_with_discrepancy"] = share
    return rows


@dataclass(frozen=True)
class Influence:
    """Influence of one input on one result.

    Args:
    name: of the input, or "rest" for variance that no function of one input explains.
    share: in the variance of the result, summed over all frames.
    change: of the result per standard deviation of the input, linear, at the frame of the
        largest median; NaN for "rest".
    """

    result: str
    name: str
    share: float
    change: float


def influences(
    results: Sequence[str], inputs: Sequence[str], values: Array, errors: Array
) -> list[Influence]:
    """Return the tornado table: the share of each input in the variance of each result.

    Inputs are sorted by their share. The table comes from a least-squares fit of y = a + sum_i (b_i
    x_i + c_i x_i²) + e at each frame, where x_i are the errors of the inputs in standard
    deviations. The squares describe results that increase for errors of both signs.

    The part of an input in var(y) is cov(b_i x_i + c_i x_i², y). For independent inputs it is
    b_i² var(x_i) + c_i² var(x_i²). For correlated inputs it includes their joint effect and may be
    negative (Li et al. 2010). Parts and variances are summed over the frames. The rest of the
    variance is due to other nonlinearity, interactions and chance. A result that is constant apart
    from round-off has no rows.

    With fewer than `SAMPLES_PER_INPUT` samples per input, each input is regressed alone. In n
    samples chance explains 2/(n - 3) of the unexplained variance, which is subtracted.

    Args:
        results: names of the m results.
        errors: errors of the inputs in standard deviations, (n, f, d).

    Reference: Li et al., J Phys Chem A 114:6022 (2010), doi:10.1021/jp9096919.
    """
    influences: list[Influence] = []
    for index, result in enumerate(results):
        fits = [_regression(values[:, index, k], errors[:, k]) for k in range(errors.shape[1])]
        frames = [(k, *fit) for k, fit in enumerate(fits) if fit is not None]
        total = sum(variance for _, _, _, variance in frames)
        square = sum(float(np.nanmean(values[:, index, k] ** 2)) for k, *_ in frames)
        if not varies(total, square):
            continue
        explained = np.sum([parts for _, _, parts, _ in frames], axis=0) / total
        medians = [np.nanmedian(values[:, index, k]) for k, *_ in frames]
        slopes = frames[int(np.argmax(medians))][1]
        rows = [
            Influence(result, name, float(share), float(slope))
            for name, share, slope in zip(inputs, explained, slopes, strict=True)
        ]
        rows.sort(key=lambda row: -row.share)
        influences += [*rows, Influence(result, "rest", float(1.0 - explained.sum()), float("nan"))]
    return influences


def _regression(y: Array, errors: Array) -> tuple[Array, Array, float] | None:
    """Return the slopes (d,), the explained variance of each input (d,), and the variance of y.

    None if fewer than `MIN_SAMPLES` values are finite.
    """
    finite, count = np.isfinite(y), errors.shape[1]
    if finite.sum() < MIN_SAMPLES:
        return None
    y, x = y[finite], errors[finite]
    variance = float(y.var())
    if len(y) < SAMPLES_PER_INPUT * count:
        return _one_by_one(y, x)
    terms: Any = np.hstack([x, x**2])
    terms = terms - terms.mean(axis=0)
    slopes, *_ = np.linalg.lstsq(terms, y - y.mean(), rcond=None)
    parts = slopes * (terms.T @ (y - y.mean())) / len(y)
    return slopes[:count], parts[:count] + parts[count:], variance


def _one_by_one(y: Array, x: Array) -> tuple[Array, Array, float]:
    """Return `_regression` with each input alone."""
    variance, slopes, parts = float(y.var()), np.zeros(x.shape[1]), np.zeros(x.shape[1])
    for i, column in enumerate(x.T):
        terms: Any = np.column_stack([column, column**2])
        terms = terms - terms.mean(axis=0)
        slope, *_ = np.linalg.lstsq(terms, y - y.mean(), rcond=None)
        explained = float(slope @ (terms.T @ (y - y.mean()))) / len(y)
        by_chance = (variance - explained) * 2 / max(len(y) - 3, 1)
        slopes[i], parts[i] = float(slope[0]), explained - by_chance
    return slopes, parts, variance
