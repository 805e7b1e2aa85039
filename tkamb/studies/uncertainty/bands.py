"""From samples to bands, and to each input's share in the variance of each result."""

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
from tkamb.run.results import PERCENTILES, STATISTICS_LIMITS

ENDS = ("p05", "p95")
TOTALS_N = ("force_si_N", "force_total_N")
"""Columns of results.csv with the total force, of which the first that is there is taken."""
ROUND_OFF = 1e-9
"""1: a result with a smaller standard deviation over magnitude counts as constant."""
SAMPLES_PER_INPUT = 6
"""Smallest number of samples per input for a regression; with fewer its shares would be random."""
NUMBER = re.compile(r"[-−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
MOST_CAUSES = 3


def varies(variance: float, square: float) -> bool:
    """Say whether a variance is more than round-off of values of this mean square."""
    return variance > ROUND_OFF**2 * square


def percentiles(values: Array, failed: np.ndarray | None = None) -> dict[str, Array]:
    """Return p05, p50 and p95 over samples, each of the shape of one sample.

    Of the n samples that have a number the p quantile is at place p (n + 1) of the ordered ones,
    linear between them: a value that is drawn like the samples then lies between p05 and p95 with
    a probability of 0.90 whatever n is. At place 1 + p (n - 1), which is usual for describing a
    sample, it would be 0.81 of 20 samples and 0.87 of 60. NaN where fewer than
    `STATISTICS_LIMITS.min_samples` have a number, or where more than
    `STATISTICS_LIMITS.max_failed_share` of all failed.

    Args:
        values: (n, ...) NaN where a sample has no number.
        failed: (n, ...) of the last axes of `values`, which samples failed; None: none.

    Reference: Hyndman & Fan, Am Stat 50:361 (1996), doi:10.1080/00031305.1996.10473566, their
    sixth definition.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # nothing but NaN, hidden below
        limits = np.nanpercentile(
            values, list(PERCENTILES.values()), axis=0, method=QUANTILE_METHOD
        )
    hidden = np.isfinite(values).sum(axis=0) < STATISTICS_LIMITS.min_samples
    if failed is not None:
        hidden = hidden | (failed.mean(axis=0) > STATISTICS_LIMITS.max_failed_share)
    limits[:, hidden] = np.nan
    return dict(zip(PERCENTILES, limits, strict=True))


def peak_band(nominal: Array, values: Array, failed: np.ndarray) -> dict[str, Any] | None:
    """Return how the nominal peak lies among its samples; None: no frame has a number.

    Args:
        nominal: (f,) of the run with the inputs as given; the frame of its largest value counts.
        values: (n, f) of the samples, NaN where one has none.
        failed: (n, f) which frames of which samples failed.

    Returns:
        frame, nominal, samples, failed_samples (at that frame), median, p05, p95 (None: no band),
        nominal_percentile (per cent of the samples below the nominal value; equal ones count half),
        and the same in words.
    """
    if not np.isfinite(nominal).any():
        return None
    frame = int(np.nanargmax(nominal))
    there, level = values[:, frame], float(nominal[frame])
    finite = there[np.isfinite(there)]
    bands = percentiles(values[:, frame : frame + 1], failed[:, frame : frame + 1])
    low, middle, high = (float(bands[name][0]) for name in ("p05", "p50", "p95"))
    below = (finite < level).sum() + 0.5 * (finite == level).sum()
    limits = {
        "frame": frame,
        "nominal": level,
        "samples": len(there),
        "failed_samples": int(failed[:, frame].sum()),
        "median": middle if np.isfinite(middle) else None,
        "p05": low if np.isfinite(low) else None,
        "p95": high if np.isfinite(high) else None,
        "nominal_percentile": 100.0 * float(below) / len(finite) if len(finite) else None,
    }
    return limits | {"words": _peak_words(limits)}


def _peak_words(peak: Mapping[str, Any]) -> str:
    """Return where the nominal peak lies among its samples, and how many failed, in words."""
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
    """Return the columns of bands.csv, one entry per frame.

    Args:
        time: (f,) s.
        names: (m,) columns of results.csv.
        values: (n, m, f) of each sample.
        failed: (n, f) which frames of which samples failed.
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


def discrepancy_columns(
    names: Sequence[str], values: Array, summary: Mapping[str, Any], body_weight: float
) -> dict[str, Array]:
    """Return the columns `<name>_discrepancy_p05`, `_p95`: band of inputs and discrepancy.

    Empty where nothing is known of the run's discrepancy; NaN where a force, or the total force of
    which the discrepancy is a share, has no band.

    Args:
        names: (m,) columns of results.csv.
        values: (n, m, f) of each sample.
        summary: summary of the run.
        body_weight: N.
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
        columns |= {f"{name}_discrepancy_{end}": one for end, one in zip(ENDS, ends, strict=True)}
    return columns


def peak_bands(
    columns: Mapping[str, Any],
    bands: Mapping[str, Array],
    compared: Mapping[str, str],
    body_weight: float,
) -> dict[str, dict[str, Any]]:
    """Return force -> its nominal peak with its bands at that frame, in body weights.

    Args:
        columns: columns of results.csv.
        bands: columns of bands.csv.
        compared: force -> column of results.csv, in N.
        body_weight: N.

    Returns:
        Force -> frame, nominal, median, p05, p95, discrepancy_p05, discrepancy_p95, of which
        those are None that have no band.
    """
    rows: dict[str, dict[str, Any]] = {}
    for force, name in compared.items():
        if not np.isfinite(columns[name]).any():
            continue
        frame = int(np.nanargmax(columns[name]))
        row: dict[str, Any] = {"frame": frame, "nominal": float(columns[name][frame]) / body_weight}
        ends = {"median": "p50"} | {end: end for end in ENDS}
        ends |= {f"discrepancy_{end}": f"discrepancy_{end}" for end in ENDS}
        for key, ending in ends.items():
            band = bands.get(f"{name}_{ending}")
            has_band = band is not None and np.isfinite(band[frame])
            row[key] = float(band[frame]) / body_weight if has_band and band is not None else None
        rows[force] = row
    return rows


def causes(problems: np.ndarray) -> dict[str, float]:
    """Return why frames failed: cause -> its share of those that did, the most frequent first.

    Args:
        problems: text, why a frame failed; empty where it did not. Only the last clause of a text
        is used, without the numbers in it, which differ from frame to frame.
    """
    last = [text.rsplit("; ", 1)[-1] for text in problems.ravel() if text]
    count = Counter(NUMBER.sub("…", text) for text in last)
    return {text: times / len(last) for text, times in count.most_common(MOST_CAUSES)}


def measured_inside(
    columns: Mapping[str, Any], bands: Mapping[str, Array], compared: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Return, for each measured force, the share of frames in which it lies within the band.

    Args:
        columns: columns of results.csv, `measured_<name>_N` among them.
        bands: columns of bands.csv.
        compared: force -> what it is compared with, as in the summary's `measured`.

    Returns:
        Force -> frames that have both, and the share of them inside, NaN of none: in the band of
        inputs, and, where there is one, in that of inputs and discrepancy.
    """
    rows: dict[str, dict[str, Any]] = {}
    for name, one in compared.items():
        measured, column = columns[f"measured_{name}_N"], one["predicted"]
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
        result: column of results.csv.
        name: the input, or "rest": the variance that no function of one input explains.
        share: share of the result's variance over samples, all frames together.
        change: of the result per standard deviation of the input, its linear part, where the
            result's median is largest; NaN for the rest.
    """

    result: str
    name: str
    share: float
    change: float


def influences(
    results: Sequence[str], inputs: Sequence[str], values: Array, errors: Array
) -> list[Influence]:
    """Return the tornado table: each input's share in each result's variance, largest first.

    Regression: at each frame y = a + sum_i (b_i x_i + c_i x_i²) + e by least squares, x_i the
    errors in standard deviations. The square covers results that rise in both directions, as a
    force does on either flank. An input's part of var(y) is cov(b_i x_i + c_i x_i², y), which for
    independent inputs is b_i² var(x_i) + c_i² var(x_i²). For correlated inputs it includes their
    joint effect and may be negative (Li et al. 2010). Parts and variances are summed over the
    frames. The rest is due to kinks, interactions and chance. A result that varies by round-off
    only has no rows. With fewer than `SAMPLES_PER_INPUT` samples per input, each input is
    regressed alone, and the share that chance explains in n samples, 2/(n - 1) of the variance, is
    subtracted from its part.

    Args:
        results: (m,) names.
        inputs: (d,) names.
        values: (n, m, f) NaN where a sample has no number.
        errors: (n, f, d) in standard deviations.

    Reference: Li et al., J Phys Chem A 114:6022 (2010), doi:10.1021/jp9096919.
    """
    influences: list[Influence] = []
    for index, result in enumerate(results):
        of_frames = [_regression(values[:, index, k], errors[:, k]) for k in range(errors.shape[1])]
        frames = [(k, *one) for k, one in enumerate(of_frames) if one is not None]
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
        rows.sort(key=lambda one: -one.share)
        influences += [*rows, Influence(result, "rest", float(1.0 - explained.sum()), float("nan"))]
    return influences


def _regression(y: Array, errors: Array) -> tuple[Array, Array, float] | None:
    """Return slopes (d,), the variance that each explains (d,), and y's; None: too few."""
    finite, count = np.isfinite(y), errors.shape[1]
    if finite.sum() < STATISTICS_LIMITS.min_samples:
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
    """Return the same for each input alone, if there are too few samples for a joint regression."""
    variance, slopes, parts = float(y.var()), np.zeros(x.shape[1]), np.zeros(x.shape[1])
    for i, column in enumerate(x.T):
        terms: Any = np.column_stack([column, column**2])
        terms = terms - terms.mean(axis=0)
        slope, *_ = np.linalg.lstsq(terms, y - y.mean(), rcond=None)
        explained = float(slope @ (terms.T @ (y - y.mean()))) / len(y)
        by_chance = (variance - explained) * 2 / max(len(y) - 3, 1)
        slopes[i], parts[i] = float(slope[0]), explained - by_chance
    return slopes, parts, variance
