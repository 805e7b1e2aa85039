"""Groups of a cohort: mean, standard deviation and range over runs in each bin of the motion.

The frames of a run in a bin are averaged first, so that every run has the same weight.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.run.status import FAILED
from tkamb.studies.cohort.outcome import Outcome
from tkamb.studies.cohort.plan import Cohort

PEAK = "largest of the run"
WEAR = "wear of the run"
UNITS = ("_N", "_BW", "_MPa", "_mm2", "_mm", "_deg", "_Nm", "_equilibrium", "_yield")
"""Endings of the columns that are averaged."""
CYCLE = "cycle_percent"
CYCLE_BIN, WHOLE_CYCLE = 10.0, 100.0
"""%: width of a bin, and length of the cycle."""
AXES = ("flexion_deg", CYCLE)


# Distance from the upper edge of a bin, relative to its width, within which a value belongs to the
# next bin. Above round-off: 60 deg converted from radians is 59.99999999999999.
BIN_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Group:
    """Runs with the same labels.

    Args:
        labels: axis of the cohort -> label that the runs share.
        axis: column that is divided into bins, "flexion_deg" or "cycle_percent".
        edges: edges of the b bins, in the unit of the axis, shape (b + 1,).
        bins: column -> mean of each run in each bin, shape (r, b); NaN for a bin without frames.
        peaks: column -> largest value of each run, shape (r,).
        wear: name -> wear result of each run, shape (r,); empty if wear was not computed.
    """

    labels: dict[str, str]
    numbers: tuple[int, ...]
    failed: int
    axis: str
    edges: Array
    bins: dict[str, Array]
    peaks: dict[str, Array]
    wear: dict[str, Array] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Return the labels in one line."""
        return self.name_without("")

    def name_without(self, axis: str) -> str:
        """Return the labels except that of one axis in one line."""
        labels = (label for name, label in self.labels.items() if name != axis)
        return ", ".join(filter(None, labels)) or "all runs"


@dataclass(frozen=True, eq=False)
class Spread:
    """Statistics of a quantity over the runs of a group. The arrays have the shape of the quantity.

    Args:
        sd: standard deviation with n - 1; NaN for fewer than two runs.
        low: smallest value.
        high: largest value.
    """

    runs: Array
    mean: Array
    sd: Array
    low: Array
    high: Array


def spread(values: Array) -> Spread:
    """Return mean, standard deviation and range over the first axis of (r, ...), ignoring NaN."""
    count = np.isfinite(values).sum(axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # an empty bin gives NaN, as intended
        sd = np.nanstd(values, axis=0, ddof=1)
        mean, low, high = (f(values, axis=0) for f in (np.nanmean, np.nanmin, np.nanmax))
    return Spread(count, mean, np.where(count > 1, sd, np.nan), low, high)


def groups_of(cohort: Cohort, outcomes: Mapping[int, Outcome]) -> list[Group]:
    """Return the cohort's groups, in the order of its file."""
    members: dict[tuple[str, ...], list[int]] = {}
    for run in cohort.runs:
        if run.number in outcomes:
            key = tuple(run.labels[axis] for axis in cohort.group_by)
            members.setdefault(key, []).append(run.number)
    width = cohort.table.bin_deg
    return [
        _group(dict(zip(cohort.group_by, key, strict=True)), numbers, outcomes, width)
        for key, numbers in members.items()
    ]


def _group(
    labels: dict[str, str], numbers: list[int], outcomes: Mapping[int, Outcome], width: float
) -> Group:
    successful = [n for n in numbers if not outcomes[n].reason]
    columns = [_computed(outcomes[n]) for n in successful]
    cycle = bool(columns) and all(CYCLE in run for run in columns)
    axis, width = (CYCLE, CYCLE_BIN) if cycle else ("flexion_deg", width)
    # cycle_percent is NaN in the frames outside the gait cycle
    finite = [np.isfinite(run[axis]) for run in columns]
    indices = [
        _bin_indices(run[axis][mask], axis, width)
        for run, mask in zip(columns, finite, strict=True)
    ]
    first, last = (
        (min(i.min() for i in indices), max(i.max() for i in indices)) if indices else (0, -1)
    )
    edges = width * np.arange(first, last + 2)
    names = list(dict.fromkeys(n for run in columns for n in run if n.endswith(UNITS)))
    bins, peaks = {}, {}
    for name in names:
        values = [run.get(name, np.full(len(run["time_s"]), np.nan)) for run in columns]
        parts = zip(values, finite, indices, strict=True)
        bins[name] = np.array([_means(v[mask], i - first, len(edges) - 1) for v, mask, i in parts])
        peaks[name] = np.array([np.nanmax(v) if np.isfinite(v).any() else np.nan for v in values])
    wear_names = dict.fromkeys(name for n in successful for name in outcomes[n].wear)
    wear = {
        name: np.array([outcomes[n].wear.get(name, np.nan) for n in successful], float)
        for name in wear_names
    }
    failed = len(numbers) - len(successful)
    return Group(labels, tuple(successful), failed, axis, edges, bins, peaks, wear)


def _computed(outcome: Outcome) -> dict[str, Array]:
    """Return the columns of a run with NaN in failed frames, except for time and the bin axes.

    The recorded motion of a failed frame must not be averaged with a solved one.
    """
    failures = np.array([status.startswith(FAILED) for status in outcome.status], bool)
    return {
        name: values if name in ("time_s", *AXES) else np.where(failures, np.nan, values)
        for name, values in outcome.columns.items()
    }


def _bin_indices(values: Array, axis: str, width: float) -> NDArray[np.int64]:
    """Return the bin number of each frame. 100 % of the cycle belongs to the last bin."""
    result = np.floor(values / width + BIN_TOLERANCE).astype(int)
    end = axis == CYCLE and np.isclose(values, WHOLE_CYCLE, rtol=0, atol=BIN_TOLERANCE * width)
    return np.where(end, result - 1, result)


def _means(values: Array, index: Array, count: int) -> Array:
    finite = np.isfinite(values)
    total = np.bincount(index[finite], values[finite], minlength=count)
    number = np.bincount(index[finite], minlength=count)
    return np.divide(total, number, out=np.full(count, np.nan), where=number > 0)


def group_rows(groups: Sequence[Group], group_by: Sequence[str]) -> list[list[str]]:
    """Return the rows of groups.csv: the header, then bins, peaks and wear of each group."""
    head = [*group_by, "axis", "from", "to", "column", "runs", "mean", "sd", "min", "max"]
    rows = [head]
    for group in groups:
        labels = [group.labels[axis] for axis in group_by]
        for name, values in group.bins.items():
            statistics = spread(values)
            for b, (low, high) in enumerate(zip(group.edges[:-1], group.edges[1:], strict=True)):
                if statistics.runs[b]:
                    limits = [group.axis, f"{low:g}", f"{high:g}"]
                    rows.append([*labels, *limits, name, *_cells(statistics, b)])
            statistics = spread(group.peaks[name][:, None])
            if statistics.runs[0]:
                rows.append([*labels, PEAK, "", "", name, *_cells(statistics, 0)])
        for name, wear in group.wear.items():
            rows.append([*labels, WEAR, "", "", name, *_cells(spread(wear[:, None]), 0)])
    return rows


def _cells(statistics: Spread, index: int) -> list[str]:
    numbers = (statistics.mean, statistics.sd, statistics.low, statistics.high)
    texts = ["" if np.isnan(values[index]) else repr(float(values[index])) for values in numbers]
    return [str(int(statistics.runs[index])), *texts]
