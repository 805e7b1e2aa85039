"""Groups of a cohort: mean, standard deviation and range over runs, bin by bin.

Every run counts once: its frames in a bin are averaged first, so that long recordings and slow
parts of a motion weigh no more than others.
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
AXES = ("flexion_deg", CYCLE)


@dataclass(frozen=True)
class CohortStatisticsSettings:
    """Statistics over the runs of a cohort."""

    bin_tolerance: float = 1e-9
    """Share of a bin. Chosen: 60 deg, which radians make 59.99999999999999, begins the bin from 60
    on."""


COHORT_STATISTICS = CohortStatisticsSettings()


@dataclass(frozen=True, eq=False)
class Group:
    """Runs with the same labels of grouping.

    Args:
        labels: what they have in common.
        numbers: numbers of the runs that gave results.
        failed: how many gave none.
        axis: quantity that its bins divide: "flexion_deg", or "cycle_percent" of a cycle.
        edges: (b + 1,) of the bins, in the axis's unit.
        bins: column -> (r, b) mean of each run in each bin; NaN where it has none there.
        peaks: column -> (r,) the largest of each run.
        wear: name -> (r,) of each run; empty: not computed.
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
        """Return the labels but one in one line."""
        named = (label for own, label in self.labels.items() if own != axis)
        return ", ".join(filter(None, named)) or "all runs"


@dataclass(frozen=True, eq=False)
class Spread:
    """A number over the runs of a group, each (...,) of the shape of one run's.

    Args:
        runs: number of runs that have the value.
        mean: over them.
        sd: standard deviation with n - 1; NaN of fewer than two.
        low: smallest.
        high: largest.
    """

    runs: Array
    mean: Array
    sd: Array
    low: Array
    high: Array


def spread(values: Array) -> Spread:
    """Return mean, standard deviation and range over runs (r, ...), without their NaN."""
    count = np.isfinite(values).sum(axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # bins that no run reaches: NaN, as wanted
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
    good = [n for n in numbers if not outcomes[n].reason]
    columns = [_computed(outcomes[n]) for n in good]
    cycle = bool(columns) and all(CYCLE in one for one in columns)
    axis, width = (CYCLE, CYCLE_BIN) if cycle else ("flexion_deg", width)
    finite = [np.isfinite(one[axis]) for one in columns]  # frames outside the gait cycle are not
    places = [_places(one[axis][on], axis, width) for one, on in zip(columns, finite, strict=True)]
    first, last = (
        (min(p.min() for p in places), max(p.max() for p in places)) if places else (0, -1)
    )
    edges = width * np.arange(first, last + 2)
    names = list(dict.fromkeys(n for one in columns for n in one if n.endswith(UNITS)))
    bins, peaks = {}, {}
    for name in names:
        missing = [one.get(name, np.full(len(one["time_s"]), np.nan)) for one in columns]
        parts = zip(missing, finite, places, strict=True)
        bins[name] = np.array([_means(v[on], p - first, len(edges) - 1) for v, on, p in parts])
        peaks[name] = np.array([np.nanmax(v) if np.isfinite(v).any() else np.nan for v in missing])
    worn = dict.fromkeys(name for n in good for name in outcomes[n].wear)
    wear = {
        name: np.array([outcomes[n].wear.get(name, np.nan) for n in good], float) for name in worn
    }
    return Group(labels, tuple(good), len(numbers) - len(good), axis, edges, bins, peaks, wear)


def _computed(outcome: Outcome) -> dict[str, Array]:
    """Return a run's columns; NaN in frames that failed, but for the bins' axes.

    A failed frame has only its recorded motion, while that of other frames may be solved.
    """
    failures = np.array([status.startswith(FAILED) for status in outcome.status], bool)
    return {
        name: values if name in ("time_s", *AXES) else np.where(failures, np.nan, values)
        for name, values in outcome.columns.items()
    }


def _places(values: Array, axis: str, width: float) -> NDArray[np.int64]:
    """Return the bin of each frame; a cycle's last moment, 100 %, is in its last bin."""
    result = np.floor(values / width + COHORT_STATISTICS.bin_tolerance).astype(int)
    end = axis == CYCLE and np.isclose(
        values, WHOLE_CYCLE, rtol=0, atol=COHORT_STATISTICS.bin_tolerance * width
    )
    return np.where(end, result - 1, result)


def _means(values: Array, place: Array, count: int) -> Array:
    """Return the mean (count,) of what falls into each bin; NaN where nothing does."""
    finite = np.isfinite(values)
    total = np.bincount(place[finite], values[finite], minlength=count)
    number = np.bincount(place[finite], minlength=count)
    return np.divide(total, number, out=np.full(count, np.nan), where=number > 0)


def group_rows(groups: Sequence[Group], group_by: Sequence[str]) -> list[list[str]]:
    """Return groups.csv: a header, then per group and column its bins and its peak."""
    head = [*group_by, "axis", "from", "to", "column", "runs", "mean", "sd", "min", "max"]
    rows = [head]
    for group in groups:
        labels = [group.labels[axis] for axis in group_by]
        for name, values in group.bins.items():
            over = spread(values)
            for b, (low, high) in enumerate(zip(group.edges[:-1], group.edges[1:], strict=True)):
                if over.runs[b]:
                    place = [group.axis, f"{low:g}", f"{high:g}"]
                    rows.append([*labels, *place, name, *_cells(over, b)])
            over = spread(group.peaks[name][:, None])
            if over.runs[0]:
                rows.append([*labels, PEAK, "", "", name, *_cells(over, 0)])
        for name, wear in group.wear.items():
            rows.append([*labels, WEAR, "", "", name, *_cells(spread(wear[:, None]), 0)])
    return rows


def _cells(over: Spread, place: int) -> list[str]:
    numbers = (over.mean, over.sd, over.low, over.high)
    texts = ["" if np.isnan(one[place]) else repr(float(one[place])) for one in numbers]
    return [str(int(over.runs[place])), *texts]
