"""One run of a cohort: its computation, and the part of its results that is stored."""

from collections.abc import Mapping
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
from tkamb.studies.cohort.plan import CohortRun, CohortWearTable


@dataclass(frozen=True, eq=False)
class PressureMap:
    """The pressure on the insert at one frame.

    Args:
        frame: number of the frame among the computed frames of the run.
        points: map points in the insert frame, m, shape (n, 3).
        triangles: point numbers of the triangles between them, shape (k, 3).
        pressure: contact pressure at the points, Pa, shape (n,).
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
        reason: reason why the whole run failed; "" if it did not.
        columns: name -> values (f,) of a modelled numeric column of results.csv, without computing
            times.
        status: status of each frame.
        chosen: pressure map of one frame; None without contact.
        wear: name -> wear result, such as "volume_mm3_per_Mc"; empty if wear was not computed.
        wear_problem: reason why the wear computation failed; "" if it did not.
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
        """Return the outcome in the form in which it is stored."""
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
        """Return the results of a run, as `tkamb run` computes them. A failed run has a reason."""
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
