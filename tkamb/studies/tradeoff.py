"""Speed against accuracy: every contact model on every case, against converged references.

A `Row` holds the times and errors of one model on one case; the rows that no other row of the case
beats form its Pareto front. The default matrix is reduced: fine grids and solver options are
measured on one case of each pair of bodies, not at every pose. `full` measures every setting on
every case.
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
    is_whole,
    map_error,
    measure_apart,
    raster_of,
)
from tkamb.studies.references import (
    STORED,
    Reference,
    compute_reference,
    is_reference,
    read_references,
    reference_of,
    write_references,
)

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


QUICK_CASES = ("sphere", "two condyles")
QUICK_MODELS = ("hertz", "foundation", "lattice", "lattice-linear", "fe")
ONE_OF_EACH = ("sphere", "two condyles", "conforming", "knee 60 deg", "scene 60 deg")
"""Cases on which the fine grids are measured; the others repeat their bodies at another pose."""
TRIED_ON = ("two condyles", "conforming", "knee 60 deg")
"""Cases on which the variants are measured."""
PEER_GRIDS_MM: dict[str, tuple[float, ...]] = {"sphere": (2.0,), "two condyles": (2.0, 1.0)}
"""mm: cell sizes of the cases for CalculiX; two condyles at 1 mm take minutes."""


@dataclass(frozen=True)
class Settings:
    """Settings at which a contact model is measured.

    Args:
        everywhere_mm: cell sizes on every case.
        fine_mm: further ones on one case of each pair of bodies.
        variants: options beside the default ones, at `variant_mm`.
        variant_mm: cell size of the variants.
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
"""Of the built-in models; another package's model is measured at `Settings()`."""


def jobs(quick: bool = False, scene: Path | None = None, full: bool = False) -> list[Job]:
    """Return what is measured, case by case.

    Args:
        quick: two cases, 2 mm, the default options.
        scene: a user's scene, whose cases come last.
        full: every setting on every case.
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
    """Return the approximate time of each job, from the number of cells, to show the time left."""
    box = {c.name: float(np.prod(np.ptp(c.pair.insert.vertices, axis=0))) for c in cases}
    return [2.0 + _per_node(job) * box[job.case] / (job.resolution_mm * 1e-3) ** 3 for job in jobs]


def _per_node(job: Job) -> float:
    if not job.contact.startswith(("lattice", "fe")):
        return 0.0
    return 2e-3 if "newton" in job.options else 6e-4


def run_tradeoff(
    jobs: Sequence[Job], references: dict[str, Reference], rows: KeptRows | None = None
) -> Iterator[Row]:
    """Measure and compare; yield the rows as they come, no front marked yet.

    Args:
        jobs: what to measure.
        references: case name -> converged answer.
        rows: rows of an earlier study, which are not computed again; new ones are added.
    """
    for job in jobs:
        reference = references[job.case]
        code = contact_code(job.contact)
        key = row_key("tradeoff", asdict(job), code, reference.hash, reference.values)
        measured = _measured(rows, key, partial(measure_apart, job))
        yield compared(job, measured, reference)


def _measured(rows: KeptRows | None, key: str, measure: Callable[[], Measure]) -> Measure:
    """Return the kept measure; measure and keep it where there is none."""
    result = rows.read(key, Measure, is_whole) if rows else None
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
    """Yield CalculiX's rows on the cases that it can do; one that fails is a row too.

    Args:
        cases: cases that may be pressed.
        references: case name -> converged answer.
        rows: rows of an earlier study, which are not computed again; new ones are added.
        sizes_mm: cell sizes that are wanted.

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
    """Return the references of the cases: stored, or computed and stored where asked for.

    References of a user's own scene are computed, and kept with the study's rows.

    Raises:
        InputError: one is missing, or belongs to an earlier version of its case.
        ComputationError: one cannot be computed.
    """
    stored = read_references(STORED)
    result: dict[str, Reference] = {}
    for case in cases:
        if case.name.startswith("scene"):
            result[case.name] = _own_reference(case, announce, rows)
        elif recompute:
            announce(f"reference of case '{case.name}': {case.label}")
            stored[case.name] = result[case.name] = compute_reference(case)
            write_references(stored, STORED)
        else:
            result[case.name] = reference_of(case, stored)
    return result


def _own_reference(
    case: StudyCase, announce: Callable[[str], None], rows: KeptRows | None
) -> Reference:
    key = row_key("reference", case.hash)
    kept = rows.read(key, Reference, lambda one: is_reference(one, case)) if rows else None
    if kept is not None:
        return kept
    announce(f"reference of case '{case.name}': {case.label}")
    result = compute_reference(case)
    if rows:
        rows.put(key, asdict(result))
    return result


def cases_of(jobs: Sequence[Job]) -> list[StudyCase]:
    """Return the cases of some jobs."""
    names = {job.case: job.scene for job in jobs}
    return [study_case(name, Path(scene) if scene else None) for name, scene in names.items()]
