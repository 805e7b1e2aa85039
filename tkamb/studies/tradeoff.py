"""Speed against accuracy: every contact model on every case, against converged references."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tkamb.contact.registry import contact_names
from tkamb.studies.cases import StudyCase, case_names, study_case
from tkamb.studies.front import on_front
from tkamb.studies.measures import Job, Measure, measure_apart
from tkamb.studies.quantities import errors, map_error, raster_of
from tkamb.studies.references import (
    STORED,
    Reference,
    compute_reference,
    read_references,
    reference_of,
    write_references,
)

QUICK_CASES = ("sphere", "two condyles")
FULL_GRIDS_MM = {"hertz": (1.0,), "lattice-source": (2.0,)}
GRIDS_MM = (2.0, 1.0)
QUICK_GRIDS_MM = (2.0,)
VARIANTS: dict[str, tuple[dict[str, Any], ...]] = {
    "lattice": ({}, {"tolerance": 1e-2}, {"tolerance": 1e-5}),
    "fe": ({}, {"newton": True}),
}
"""Options beside the default ones; the slow ones on the coarsest grid only."""
FRONT_ERRORS = ("approach", "force", "peak_pressure")
"""The largest of these errors is the one of the front."""
KEYS = ("approach", "force", "mean_pressure", "peak_pressure", "area")

Progress = Callable[[Sequence[Job]], Iterable[Job]]


@dataclass(frozen=True, eq=False)
class Row:
    """One model on one case.

    Args:
        job: what was measured.
        measure: times, memory, values.
        errors: relative, against the reference: `KEYS` and "map"; empty if it failed.
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
        for key in ("prepare_seconds", "cold_seconds", "warm_seconds", "peak_rss_MB"):
            value = getattr(measure, key)
            row[key] = value if value == value else None
        row |= {f"error_{key}": self.errors.get(key) for key in KEYS}
        return row | {"on_front": self.on_front}


def jobs(quick: bool, scene: Path | None = None) -> list[Job]:
    """Return what is measured, case by case."""
    cases = QUICK_CASES if quick else case_names(scene)
    given = None if scene is None else str(scene)
    found = []
    for case in cases:
        for contact in contact_names():
            grids = QUICK_GRIDS_MM if quick else FULL_GRIDS_MM.get(contact, GRIDS_MM)
            if quick and contact == "lattice-source":
                continue
            for grid in grids:
                for options in VARIANTS.get(contact, ({},)):
                    if not options or (grid == max(GRIDS_MM) and not quick):
                        found.append(Job(case, contact, grid, options, given))
    return found


def run_tradeoff(
    wanted: Sequence[Job],
    references: dict[str, Reference],
    progress: Progress = lambda jobs: jobs,
) -> list[Row]:
    """Measure and compare.

    Args:
        wanted: what to measure.
        references: case name -> converged answer.
        progress: wraps the jobs, a progress bar for example.
    """
    return with_fronts([_row(job, references[job.case]) for job in progress(wanted)])


def with_fronts(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with those marked that are on their case's Pareto front."""
    marked: list[Row] = []
    for case in dict.fromkeys(row.job.case for row in rows):
        some = [row for row in rows if row.job.case == case]
        front = on_front([(row.measure.warm_seconds, row.worst) for row in some if row.errors])
        marks = iter(front)
        marked += [replace(row, on_front=bool(row.errors) and next(marks)) for row in some]
    return marked


def _row(job: Job, reference: Reference) -> Row:
    found = measure_apart(job)
    floor = floor_of(reference)
    if found.status != "ok":
        return Row(job, found, {}, floor)
    compared = errors(found.values, reference.values)
    apart = map_error(raster_of(found.map), reference.raster)
    return Row(job, found, compared | {"map": apart}, floor)


def floor_of(reference: Reference) -> float:
    """Return the largest relative uncertainty of what the front goes by."""
    shifted = {k: v + reference.uncertainty[k] for k, v in reference.values.items()}
    apart = errors(shifted, reference.values)
    return max(apart[key] for key in FRONT_ERRORS)


def references_for(
    cases: Iterable[StudyCase], recompute: bool, announce: Callable[[str], None]
) -> dict[str, Reference]:
    """Return the references of the cases: stored, or computed and stored where asked for.

    References of a user's own scene are always computed.

    Raises:
        InputError: one is missing, or belongs to an earlier version of its case.
        ComputationError: one cannot be computed.
    """
    stored = read_references(STORED)
    found: dict[str, Reference] = {}
    for case in cases:
        own = case.name.startswith("scene")
        if own or recompute:
            announce(f"reference of case '{case.name}': {case.says}")
            found[case.name] = compute_reference(case)
            if not own:
                write_references(stored | {case.name: found[case.name]}, STORED)
                stored[case.name] = found[case.name]
        else:
            found[case.name] = reference_of(case, stored)
    return found


def cases_of(wanted: Sequence[Job]) -> list[StudyCase]:
    """Return the cases of some jobs."""
    names = {job.case: job.scene for job in wanted}
    return [study_case(name, Path(scene) if scene else None) for name, scene in names.items()]


def as_json(rows: Sequence[Row]) -> str:
    """Return the rows as the JSON text of `tkamb tradeoff --json`."""
    return json.dumps([row.as_dict() for row in rows], indent=1, allow_nan=False)
