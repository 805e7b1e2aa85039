"""One row of the trade-off: a contact model on a case, with its times and errors."""

import math
from dataclasses import dataclass
from typing import Any

from tkamb.studies.measures import Job, Measure
from tkamb.studies.quantities import errors, map_error, raster_of
from tkamb.studies.references import Reference

FRONT_ERRORS = ("approach", "force", "peak_pressure")
"""The largest of these errors is the one of the front."""
KEYS = ("approach", "force", "mean_pressure", "peak_pressure", "area", "map")
TIMES = ("prepare_seconds", "cold_seconds", "warm_seconds", "peak_rss_MB")


@dataclass(frozen=True, eq=False)
class Row:
    """One model on one case.

    Args:
        job: what was measured.
        measure: times, memory, values.
        errors: relative, against the reference: `KEYS`; empty if it failed.
        floor: largest relative uncertainty of the reference among `FRONT_ERRORS`.
        on_front: no other model of the case beats it.
    """

    job: Job
    measure: Measure
    errors: dict[str, float]
    floor: float
    on_front: bool = False

    @property
    def worst(self) -> float:
        """The largest error of `FRONT_ERRORS`, at least the reference's own uncertainty."""
        if not self.errors:
            return float("inf")
        return max(self.floor, *(self.errors[key] for key in FRONT_ERRORS))

    def as_dict(self) -> dict[str, Any]:
        """Return the row of `tradeoff --json`; None where nothing was found."""
        measure = self.measure
        row: dict[str, Any] = {
            "case": self.job.case,
            "contact": self.job.label,
            "resolution_mm": self.job.resolution_mm,
        }
        for key in TIMES:
            row[key] = _rounded(getattr(measure, key))
        for key in KEYS:
            row[f"error_{key}"] = _rounded(self.errors.get(key, math.nan))
        row |= {"on_front": self.on_front, "status": measure.status}
        row["reference_known"] = _rounded(self.floor)
        return row | {"values": {key: _rounded(value) for key, value in measure.values.items()}}


def _rounded(value: float) -> float | None:
    """Return a number to six digits for JSON, None for what is none."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


def row_of(content: dict[str, Any]) -> Row:
    """Return the row that `as_dict` made."""

    def number(key: str) -> float:
        return math.nan if content[key] is None else float(content[key])

    job = Job(content["case"], content["contact"], content["resolution_mm"])
    prepare, cold, warm, memory = map(number, TIMES)
    measure = Measure(content["status"], prepare, cold, warm, memory, values=content["values"])
    errors = {} if measure.status != "ok" else {key: number(f"error_{key}") for key in KEYS}
    return Row(job, measure, errors, content["reference_known"], content["on_front"])


def compared(job: Job, found: Measure, reference: Reference) -> Row:
    """Return the row of what was measured, with its errors."""
    floor = floor_of(reference)
    if found.status != "ok":
        return Row(job, found, {}, floor)
    apart = map_error(raster_of(found.map), reference.raster) if found.map else math.nan
    return Row(job, found, errors(found.values, reference.values) | {"map": apart}, floor)


def floor_of(reference: Reference) -> float:
    """Return the largest relative uncertainty of what the front goes by."""
    shifted = {k: v + reference.uncertainty[k] for k, v in reference.values.items()}
    apart = errors(shifted, reference.values)
    return max(apart[key] for key in FRONT_ERRORS)
