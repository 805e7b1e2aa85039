"""Rows of the trade-off: a contact model on a case, its times and errors; their Pareto front."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tkamb.errors import InputError
from tkamb.studies.measures import Job, Measure
from tkamb.studies.quantities import errors, map_error, raster_of
from tkamb.studies.references import Reference

FRONT_ERRORS = ("approach", "force", "peak_pressure")
"""The largest of these errors is the one of the front."""
KEYS = ("approach", "force", "mean_pressure", "peak_pressure", "area", "map")
TIMES = ("prepare_seconds", "cold_seconds", "warm_seconds", "peak_rss_MB")


@dataclass(frozen=True)
class TimingSettings:
    """How times are compared."""

    equal_ratio: float = 1.2
    """Ratio: two medians of time within this factor count as equal. Chosen: repeated measurements
    vary by as much."""


TIMING = TimingSettings()


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


def compared(job: Job, measure: Measure, reference: Reference) -> Row:
    """Return the row of what was measured, with its errors."""
    floor = floor_of(reference)
    if measure.status != "ok":
        return Row(job, measure, {}, floor)
    apart = map_error(raster_of(measure.map), reference.raster) if measure.map else math.nan
    return Row(job, measure, errors(measure.values, reference.values) | {"map": apart}, floor)


def floor_of(reference: Reference) -> float:
    """Return the largest relative uncertainty among `FRONT_ERRORS`."""
    shifted = {k: v + reference.uncertainty[k] for k, v in reference.values.items()}
    apart = errors(shifted, reference.values)
    return max(apart[key] for key in FRONT_ERRORS)


def with_fronts(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with those marked that are on their case's Pareto front."""
    marked: list[Row] = []
    for case in dict.fromkeys(row.job.case for row in rows):
        some = [row for row in rows if row.job.case == case]
        front = on_front([(row.measure.warm_seconds, row.worst) for row in some if row.errors])
        marks = iter(front)
        marked += [replace(row, on_front=bool(row.errors) and next(marks)) for row in some]
    return marked


def on_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Say which (seconds, error) are beaten by no other.

    One beats another if it is no less accurate and clearly faster, or more accurate and not
    clearly slower; clearly means by more than the noise.
    """
    return [not any(beats(other, point) for other in points) for point in points]


def beats(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Say whether one (seconds, error) beats another; see `on_front`."""
    faster = one[0] * TIMING.equal_ratio < other[0]
    not_slower = one[0] <= other[0] * TIMING.equal_ratio
    return (one[1] <= other[1] and faster) or (one[1] < other[1] and not_slower)


def as_json(rows: Sequence[Row]) -> str:
    """Return the rows as the JSON text of `tkamb tradeoff --json`."""
    return json.dumps([row.as_dict() for row in rows], indent=1, allow_nan=False)


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a tradeoff.json.

    Raises:
        InputError: there is none, or it is something else.
    """
    try:
        return [row_of(content) for content in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"is not a table of a trade-off ({error})", path) from None
