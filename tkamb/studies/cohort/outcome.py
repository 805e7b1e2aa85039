"""Runs of a cohort: what is stored of one, and statistics of groups in bins of the motion.

The frames of a run in a bin are averaged first, so that every run has the same weight.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import TkambError
from tkamb.geometry.frames import Array
from tkamb.geometry.memory import give_back
from tkamb.run.columns import KINDS, SECONDS
from tkamb.run.metrics import lateral_axis_name, map_rows
from tkamb.run.recorder import Shard
from tkamb.run.results import Results
from tkamb.run.simulation import simulate
from tkamb.run.status import FAILED
from tkamb.studies.cohort.plan import Cohort, CohortRun, CohortWearTable


@dataclass(frozen=True, eq=False)
class PressureMap:
    """The pressure on the insert at one frame.

    Args:
        frame: number of the frame among the computed frames of the run.
        points: map points in the insert frame, m, (n, 3).
        triangles: point numbers of the triangles between them, (k, 3).
        pressure: contact pressure at the points, Pa, (n,).
        side: side of the knee, "right" or "left".
        lateral: direction of the insert's z axis, "lateral" or "medial".
    """

    frame: int
    points: Array
    triangles: NDArray[np.int64]
    pressure: Array
    side: str
    lateral: str


@dataclass(frozen=True, eq=False)
class Outcome:
    """Results of one run.

    Args:
        columns: name -> values (f,) of a modelled numeric column of results.csv, without computing
            times.
        chosen: pressure map of one frame; None without contact.
        wear_problem: reason why the wear computation failed, as `reason` for the whole run; "" if
            it did not.
    """

    reason: str
    columns: dict[str, Array]
    status: list[str]
    chosen: PressureMap | None = None
    wear: Mapping[str, float] = field(default_factory=dict)
    wear_problem: str = ""

    @property
    def failed_frames(self) -> int:
        """Return the number of failed frames."""
        return sum(status.startswith(FAILED) for status in self.status)

    @property
    def flagged_frames(self) -> int:
        """Return the number of frames that have numbers and a status other than "ok"."""
        return sum(status != "ok" for status in self.status) - self.failed_frames

    def shard(self) -> Shard:
        """Return the outcome as it is stored."""
        row: dict[str, Any] = {"reason": self.reason, "status": self.status}
        row |= {"wear": dict(self.wear), "wear_problem": self.wear_problem}
        arrays: dict[str, Any] = {f"column {name}": values for name, values in self.columns.items()}
        if self.chosen is not None:
            chosen = self.chosen
            row |= {"frame": chosen.frame, "side": chosen.side, "lateral": chosen.lateral}
            arrays |= {"points": chosen.points, "triangles": chosen.triangles}
            arrays["pressure"] = chosen.pressure
        return Shard(row, arrays or None)

    @classmethod
    def of(cls, shard: Shard) -> "Outcome":
        """Return the outcome that a shard stores."""
        row, arrays = shard.row, shard.contact or {}
        columns = {
            name.removeprefix("column "): values
            for name, values in arrays.items()
            if name.startswith("column ")
        }
        chosen = None
        if "points" in arrays:
            triangles = np.asarray(arrays["triangles"], np.int64)
            chosen = PressureMap(
                row["frame"],
                arrays["points"],
                triangles,
                arrays["pressure"],
                row["side"],
                row["lateral"],
            )
        return cls(row["reason"], columns, row["status"], chosen, row["wear"], row["wear_problem"])


class CohortWorker:
    """Computes runs of a cohort.

    Args:
        frames: slice of the frames of every trial that are computed.
        map_flexion: flexion of the frame that gives the pressure map, deg; None: the frame of the
            largest force.
        wear: settings of the wear computation; None: no wear.
    """

    def __init__(
        self, frames: slice, map_flexion: float | None, wear: CohortWearTable | None = None
    ) -> None:
        self._frames, self._map_flexion, self._wear = frames, map_flexion, wear

    def __call__(self, number: int, run: CohortRun) -> Outcome:
        """Return the results of a run, as `tkamb run` computes them, or why it failed."""
        try:
            return self._outcome(run)
        finally:
            give_back()

    def _outcome(self, run: CohortRun) -> Outcome:
        try:
            results = simulate(run.scene, frames=self._frames, scene_path=run.scene_path)
        except TkambError as error:
            return Outcome(str(error), {}, [])
        if all(status.startswith(FAILED) for status in results.status):
            return Outcome(f"every frame failed, the first: {results.status[0]}", {}, [])
        columns = {
            name: values
            for name, values in results.columns.items()
            if KINDS.get(name) != "text"
            and not name.endswith(SECONDS)
            and name not in results.not_modelled
        }
        result = Outcome("", columns, results.status, chosen_map(results, self._map_flexion))
        return result if self._wear is None else self._worn(run, results, result, self._wear)

    def _worn(
        self, run: CohortRun, results: Results, outcome: Outcome, wear: CohortWearTable
    ) -> Outcome:
        from tkamb.studies.wear.run import wear_of_results

        try:
            report = wear_of_results(
                run.scene,
                run.scene_path,
                results,
                cycles=wear.cycles,
                updates=wear.updates,
                frames=wear.frames_per_cycle,
            ).as_dict()
        except TkambError as error:
            return replace(outcome, wear_problem=str(error))
        low, high = report["volume_mm3_per_Mc_range"]
        values = {
            "volume_mm3_per_Mc": report["volume_mm3_per_Mc"],
            "volume_mm3_per_Mc_low": low,
            "volume_mm3_per_Mc_high": high,
            "max_depth_mm": report["max_depth_mm"],
            "frames_change": report["frames_change"],
        }
        for law in report["laws_side_by_side"]:
            values[f"first_{law['law']}_mm3_per_Mc"] = law["first_volume_mm3_per_Mc"]
        return replace(outcome, wear={k: v for k, v in values.items() if v is not None})


def chosen_map(results: Results, flexion: float | None) -> PressureMap | None:
    """Return the map of the frame nearest to a flexion, deg; None: of the largest force."""
    if results.maps is None:
        return None
    rows = {k: row for k, row in map_rows(results).items() if not _failed(results, k)}
    if not rows:
        return None
    frames = np.array(sorted(rows))
    if flexion is None:
        best = int(np.nanargmax(results["force_total_BW"][frames]))
    else:
        best = int(np.argmin(np.abs(results["flexion_deg"][frames] - flexion)))
    frame = int(frames[best])
    return PressureMap(
        frame,
        results.maps.points_m,
        results.maps.triangles,
        results.maps.rows("pressure_Pa", [rows[frame]])[0],
        str(results.summary.get("side", "right")),
        lateral_axis_name(results),
    )


def _failed(results: Results, frame: int) -> bool:
    return results.status[frame].startswith(FAILED)


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
        edges: edges of the b bins, in the unit of the axis, (b + 1,).
        bins: column -> mean of each run in each bin, (r, b); NaN for a bin without frames.
        peaks: column -> largest value of each run, (r,).
        wear: name -> wear result of each run, (r,); empty if wear was not computed.
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
    """Statistics of a quantity over the runs of a group, in the quantity's shape.

    Args:
        sd: standard deviation with n - 1; NaN for fewer than two runs.
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

    A failed frame's recorded motion must not be averaged with a solved one.
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


def group_rows(groups: Sequence[Group], group_by: Sequence[str]) -> list[list[Any]]:
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


def _cells(statistics: Spread, index: int) -> list[Any]:
    numbers = (statistics.mean, statistics.sd, statistics.low, statistics.high)
    return [int(statistics.runs[index]), *(values[index] for values in numbers)]
