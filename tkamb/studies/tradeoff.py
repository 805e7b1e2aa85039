"""Speed against accuracy: every contact model on every case, against converged references."""

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from tkamb.errors import InputError
from tkamb.studies.calculix import peer_rows
from tkamb.studies.cases import StudyCase, study_case
from tkamb.studies.front import on_front
from tkamb.studies.kept_rows import KeptRows, row_key
from tkamb.studies.measures import Job, Measure, measure_apart
from tkamb.studies.references import (
    STORED,
    Reference,
    compute_reference,
    read_references,
    reference_of,
    write_references,
)
from tkamb.studies.row import Row, compared, row_of


def run_tradeoff(
    wanted: Sequence[Job], references: dict[str, Reference], kept: KeptRows | None = None
) -> Iterator[Row]:
    """Measure and compare; yield the rows as they come, no front marked yet.

    Args:
        wanted: what to measure.
        references: case name -> converged answer.
        kept: rows of an earlier study that are taken as they are; new ones are added.
    """
    for job in wanted:
        reference = references[job.case]
        key = row_key("tradeoff", asdict(job), reference.hash, reference.values)
        found = kept.get(key) if kept else None
        measured = Measure(**found) if found else measure_apart(job)
        if kept and not found:
            kept.put(key, asdict(measured))
        yield compared(job, measured, reference)


def with_fronts(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with those marked that are on their case's Pareto front."""
    marked: list[Row] = []
    for case in dict.fromkeys(row.job.case for row in rows):
        some = [row for row in rows if row.job.case == case]
        front = on_front([(row.measure.warm_seconds, row.worst) for row in some if row.errors])
        marks = iter(front)
        marked += [replace(row, on_front=bool(row.errors) and next(marks)) for row in some]
    return marked


def run_peer(
    cases: Iterable[StudyCase],
    references: dict[str, Reference],
    kept: KeptRows | None = None,
    sizes_mm: Collection[float] = (2.0,),
) -> Iterator[Row]:
    """Yield CalculiX's rows on the cases that it can do; one that fails is a row too.

    Args:
        cases: that may be pressed.
        references: case name -> converged answer.
        kept: rows of an earlier study that are taken as they are; new ones are added.
        sizes_mm: cell sizes that are wanted.

    Raises:
        InputError: CalculiX is not installed.
    """
    for case in cases:
        reference = references[case.name]
        key = row_key("calculix", case.hash, reference.values, sorted(sizes_mm))
        found = kept.get(key) if kept else None
        if found is None:
            rows = peer_rows([case], references, sizes_mm)
            found = {"rows": [[asdict(row.job), asdict(row.measure)] for row in rows]}
            if kept:
                kept.put(key, found)
        for job, measured in found["rows"]:
            yield compared(Job(**job), Measure(**measured), reference)


def references_for(
    cases: Iterable[StudyCase],
    recompute: bool,
    announce: Callable[[str], None],
    kept: KeptRows | None = None,
) -> dict[str, Reference]:
    """Return the references of the cases: stored, or computed and stored where asked for.

    References of a user's own scene are computed, and kept with the study's rows.

    Raises:
        InputError: one is missing, or belongs to an earlier version of its case.
        ComputationError: one cannot be computed.
    """
    stored = read_references(STORED)
    found: dict[str, Reference] = {}
    for case in cases:
        if case.name.startswith("scene"):
            found[case.name] = _own_reference(case, announce, kept)
        elif recompute:
            announce(f"reference of case '{case.name}': {case.says}")
            stored[case.name] = found[case.name] = compute_reference(case)
            write_references(stored, STORED)
        else:
            found[case.name] = reference_of(case, stored)
    return found


def _own_reference(
    case: StudyCase, announce: Callable[[str], None], kept: KeptRows | None
) -> Reference:
    key = row_key("reference", case.hash)
    row = kept.get(key) if kept else None
    if row is not None:
        return Reference(**row | {"grids_mm": tuple(row["grids_mm"])})
    announce(f"reference of case '{case.name}': {case.says}")
    found = compute_reference(case)
    if kept:
        kept.put(key, asdict(found))
    return found


def cases_of(wanted: Sequence[Job]) -> list[StudyCase]:
    """Return the cases of some jobs."""
    names = {job.case: job.scene for job in wanted}
    return [study_case(name, Path(scene) if scene else None) for name, scene in names.items()]


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
        raise InputError(f"is no table of a trade-off ({error})", path) from None
