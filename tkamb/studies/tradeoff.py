"""Trade-off of speed and accuracy: every contact model on every case, against references.

A `Row` contains the times and errors of one model on one case. The rows of a case that no other row
beats are its Pareto front. By default, fine grids and solver options are measured only on some
cases. With `full` every setting is measured on every case.
"""

import json
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.contact.registry import contact_names
from tkamb.errors import InputError
from tkamb.run.decks import ELEMENT
from tkamb.run.identity import contact_code
from tkamb.studies.calculix import find_program, measure_by_calculix
from tkamb.studies.cases import StudyCase, case_names, study_case
from tkamb.studies.kept_rows import KeptRows, row_key
from tkamb.studies.measures import (
    Job,
    Measure,
    errors,
    map_error,
    measure_apart,
    raster_of,
)
from tkamb.studies.references import (
    STORED,
    Reference,
    compute_reference,
    read_references,
    reference_of,
    write_references,
)

FRONT_ERRORS = ("approach", "force", "peak_pressure")
"""Errors of which the largest is the error of a model on the Pareto front."""
KEYS = ("approach", "force", "mean_pressure", "peak_pressure", "area", "map")
TIMES = ("prepare_seconds", "cold_seconds", "warm_seconds", "peak_rss_MB")


# Ratio of two median times below which they count as equal. Repeated measurements
# vary by this factor.
EQUAL_RATIO = 1.2


@dataclass(frozen=True, eq=False)
class Row:
    """Cost and errors of one model on one case.

    Args:
        errors: name of `KEYS` -> error relative to the reference; empty if the job failed.
        floor: largest relative uncertainty of the reference among `FRONT_ERRORS`.
        on_front: whether the row is on the Pareto front of its case.
    """

    job: Job
    measure: Measure
    errors: dict[str, float]
    floor: float
    on_front: bool = False

    @property
    def worst(self) -> float:
        """The largest error of `FRONT_ERRORS`, but at least the uncertainty of the reference."""
        if not self.errors:
            return float("inf")
        return max(self.floor, *(self.errors[key] for key in FRONT_ERRORS))

    def as_dict(self) -> dict[str, Any]:
        """Return the row as in `tkamb tradeoff --json`. Missing numbers are None."""
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
    return float(f"{value:.6g}") if math.isfinite(value) else None


def row_of(content: dict[str, Any]) -> Row:
    """Return the row from the dictionary of `Row.as_dict`."""

    def number(key: str) -> float:
        return math.nan if content[key] is None else float(content[key])

    job = Job(content["case"], content["contact"], content["resolution_mm"])
    prepare, cold, warm, memory = map(number, TIMES)
    measure = Measure(content["status"], prepare, cold, warm, memory, values=content["values"])
    errors = {} if measure.status != "ok" else {key: number(f"error_{key}") for key in KEYS}
    return Row(job, measure, errors, content["reference_known"], content["on_front"])


def compared(job: Job, measure: Measure, reference: Reference) -> Row:
    """Return the row of a measure with its errors against a reference."""
    floor = floor_of(reference)
    if measure.status != "ok":
        return Row(job, measure, {}, floor)
    map_part = map_error(raster_of(measure.map), reference.raster) if measure.map else math.nan
    return Row(job, measure, errors(measure.values, reference.values) | {"map": map_part}, floor)


def floor_of(reference: Reference) -> float:
    """Return the largest relative uncertainty of a reference among `FRONT_ERRORS`."""
    shifted = {k: v + reference.uncertainty[k] for k, v in reference.values.items()}
    uncertainty = errors(shifted, reference.values)
    return max(uncertainty[key] for key in FRONT_ERRORS)


def with_fronts(rows: Sequence[Row]) -> list[Row]:
    """Return the rows, sorted by case, with `on_front` set."""
    marked: list[Row] = []
    for case in dict.fromkeys(row.job.case for row in rows):
        group = [row for row in rows if row.job.case == case]
        front = on_front([(row.measure.warm_seconds, row.worst) for row in group if row.errors])
        marks = iter(front)
        marked += [replace(row, on_front=bool(row.errors) and next(marks)) for row in group]
    return marked


def on_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Return for each point (seconds, error) whether no other point beats it."""
    return [not any(beats(other, point) for other in points) for point in points]


def beats(first: tuple[float, float], second: tuple[float, float]) -> bool:
    """Return whether the first point (seconds, error) beats the second.

    It is faster and at least as accurate, or more accurate and not slower. Times within
    `EQUAL_RATIO` count as equal.
    """
    faster = first[0] * EQUAL_RATIO < second[0]
    not_slower = first[0] <= second[0] * EQUAL_RATIO
    return (first[1] <= second[1] and faster) or (first[1] < second[1] and not_slower)


def as_json(rows: Sequence[Row]) -> str:
    """Return the rows as the JSON text of `tkamb tradeoff --json`."""
    return json.dumps([row.as_dict() for row in rows], indent=1, allow_nan=False)


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a tradeoff.json.

    Raises:
        InputError: the file is missing or has other content.
    """
    try:
        return [row_of(content) for content in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"is not a table of a trade-off ({error})", path) from None


QUICK_CASES = ("sphere", "two condyles")
QUICK_MODELS = ("hertz", "foundation", "lattice", "lattice-linear", "fe")
ONE_OF_EACH = ("sphere", "two condyles", "conforming", "knee 60 deg", "scene 60 deg")
"""Cases on which the fine grids are measured. The other cases have the same bodies at another
pose."""
TRIED_ON = ("two condyles", "conforming", "knee 60 deg")
"""Cases on which the options of the models are varied."""
PEER_GRIDS_MM: dict[str, tuple[float, ...]] = {"sphere": (2.0,), "two condyles": (2.0, 1.0)}
"""Case -> cell sizes for CalculiX, mm. The two condyles take minutes at 1 mm."""


@dataclass(frozen=True)
class Settings:
    """Settings at which a contact model is measured.

    Args:
        everywhere_mm: cell sizes for every case, mm.
        fine_mm: additional cell sizes for the cases `ONE_OF_EACH`, mm.
        variants: options other than the default, for the cases `TRIED_ON`.
        variant_mm: cell size of the variants, mm.
    """

    everywhere_mm: tuple[float, ...] = (2.0,)
    fine_mm: tuple[float, ...] = (1.0,)
    variants: tuple[dict[str, Any], ...] = field(default=())
    variant_mm: float = 2.0


SETTINGS = {
    "hertz": Settings((1.0,), ()),
    "foundation": Settings((2.0, 1.0), ()),
    "foundation-linear": Settings((2.0, 1.0), ()),
    "lattice": Settings(
        (3.0, 2.0),
        (1.5, 1.0),
        ({"tolerance": 1e-2}, {"tolerance": 1e-5}),
    ),
    "lattice-linear": Settings(),
    "lattice-source": Settings((2.0,), ()),
    "fe": Settings((2.0,), (1.5, 1.0), ({"newton": True},)),
}
"""Name of a built-in model -> its settings. Models of other packages use `Settings()`."""


def jobs(quick: bool = False, scene: Path | None = None, full: bool = False) -> list[Job]:
    """Return the jobs of the study, sorted by case.

    Args:
        quick: whether to measure only two cases at 2 mm with the default options.
        scene: scene file of a user. Its cases are the last ones.
        full: whether to measure every setting on every case.
    """
    scene_name = None if scene is None else str(scene)
    if quick:
        return [Job(case, model, 2.0) for case in QUICK_CASES for model in QUICK_MODELS]
    return [
        Job(case, model, grid, options, scene_name)
        for case in case_names(scene)
        for model in contact_names()
        for grid, options in _of(SETTINGS.get(model, Settings()), case, full)
    ]


def _of(settings: Settings, case: str, full: bool) -> list[tuple[float, dict[str, Any]]]:
    grids = settings.everywhere_mm
    if full or case in ONE_OF_EACH:
        grids += settings.fine_mm
    result: list[tuple[float, dict[str, Any]]] = [(grid, {}) for grid in grids]
    if full or case in TRIED_ON:
        result += [(settings.variant_mm, options) for options in settings.variants]
    return result


def expected_seconds(jobs: Sequence[Job], cases: Sequence[StudyCase]) -> list[float]:
    """Return the approximate time of each job, s, from its number of cells."""
    box = {c.name: float(np.prod(np.ptp(c.pair.insert.vertices, axis=0))) for c in cases}
    return [2.0 + _per_node(job) * box[job.case] / (job.resolution_mm * 1e-3) ** 3 for job in jobs]


def _per_node(job: Job) -> float:
    if not job.contact.startswith(("lattice", "fe")):
        return 0.0
    return 2e-3 if "newton" in job.options else 6e-4


def run_tradeoff(
    jobs: Sequence[Job], references: dict[str, Reference], rows: KeptRows | None = None
) -> Iterator[Row]:
    """Measure the jobs and yield one row per job. The Pareto fronts are not yet marked.

    Args:
        references: case name -> reference.
        rows: stored measures of earlier studies. They are not repeated; new ones are added.
    """
    for job in jobs:
        reference = references[job.case]
        code = contact_code(job.contact)
        key = row_key("tradeoff", asdict(job), code, reference.hash, reference.values)
        measured = _measured(rows, key, partial(measure_apart, job))
        yield compared(job, measured, reference)


def _measured(rows: KeptRows | None, key: str, measure: Callable[[], Measure]) -> Measure:
    result = rows.read(key, Measure) if rows else None
    if result is None:
        result = measure()
        if rows:
            rows.put(key, asdict(result))
    return result


def run_peer(
    cases: Iterable[StudyCase],
    references: dict[str, Reference],
    rows: KeptRows | None = None,
    sizes_mm: Collection[float] = (2.0,),
) -> Iterator[Row]:
    """Measure CalculiX and yield one row per case and cell size of `PEER_GRIDS_MM`.

    Args:
        cases: contact problems. Those without an entry in `PEER_GRIDS_MM` are skipped.
        references: case name -> reference.
        rows: stored measures of earlier studies. They are not repeated; new ones are added.
        sizes_mm: requested cell sizes, mm.

    Raises:
        InputError: CalculiX is not installed.
    """
    find_program()
    for case in cases:
        reference = references[case.name]
        for size in sizes_mm:
            if size not in PEER_GRIDS_MM.get(case.name, ()):
                continue
            key = row_key("calculix", case.hash, reference.values, size)
            measured = _measured(rows, key, partial(measure_by_calculix, case, size))
            yield compared(Job(case.name, f"calculix {ELEMENT}", size), measured, reference)


def references_for(
    cases: Iterable[StudyCase],
    recompute: bool,
    announce: Callable[[str], None],
    rows: KeptRows | None = None,
) -> dict[str, Reference]:
    """Return case name -> reference. Those of a user's scene are computed and stored in `rows`.

    Args:
        recompute: whether to compute and store the references again.
        announce: function that prints a line before a reference is computed.

    Raises:
        InputError: a stored reference is missing, or belongs to an earlier version of its case.
        ComputationError: a reference cannot be computed.
    """
    stored = read_references(STORED)
    result: dict[str, Reference] = {}
    for case in cases:
        if case.name.startswith("scene"):
            result[case.name] = _user_reference(case, announce, rows)
        elif recompute:
            announce(f"reference of case '{case.name}': {case.label}")
            stored[case.name] = result[case.name] = compute_reference(case)
            write_references(stored, STORED)
        else:
            result[case.name] = reference_of(case, stored)
    return result


def _user_reference(
    case: StudyCase, announce: Callable[[str], None], rows: KeptRows | None
) -> Reference:
    key = row_key("reference", case.hash)
    stored = rows.read(key, Reference) if rows else None
    if stored is not None:
        return stored
    announce(f"reference of case '{case.name}': {case.label}")
    result = compute_reference(case)
    if rows:
        rows.put(key, asdict(result))
    return result


def cases_of(jobs: Sequence[Job]) -> list[StudyCase]:
    """Return the cases of the jobs without duplicates."""
    names = {job.case: job.scene for job in jobs}
    return [study_case(name, Path(scene) if scene else None) for name, scene in names.items()]
