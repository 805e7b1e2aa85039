"""Speed against accuracy: every contact model on every case, against converged references.

The default matrix is reduced: fine grids and the solver's variants are measured on one case of
each pair of bodies, not at every pose. `full` measures every setting on every case.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.contact.registry import contact_names
from tkamb.run.decks import ELEMENT
from tkamb.run.identity import contact_code
from tkamb.studies.calculix import find_program
from tkamb.studies.cases import StudyCase, case_names, study_case
from tkamb.studies.kept_rows import KeptRows, row_key
from tkamb.studies.measures import Job, Measure, measure_apart
from tkamb.studies.peer import measure_by_calculix
from tkamb.studies.references import (
    STORED,
    Reference,
    compute_reference,
    read_references,
    reference_of,
    write_references,
)
from tkamb.studies.row import Row, compared

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
        result = rows.get(key) if rows else None
        measured = Measure(**result) if result else measure_apart(job)
        if rows and not result:
            rows.put(key, asdict(measured))
        yield compared(job, measured, reference)


def run_peer(
    cases: Iterable[StudyCase],
    references: dict[str, Reference],
    rows: KeptRows | None = None,
    sizes_mm: Collection[float] = (2.0,),
) -> Iterator[Row]:
    """Yield CalculiX's rows on the cases that it can do; one that fails is a row too.

    Args:
        cases: that may be pressed.
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
            result = rows.get(key) if rows else None
            measured = Measure(**result) if result else measure_by_calculix(case, size)
            if rows and not result:
                rows.put(key, asdict(measured))
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
    row = rows.get(key) if rows else None
    if row is not None:
        return Reference(**row | {"grids_mm": tuple(row["grids_mm"])})
    announce(f"reference of case '{case.name}': {case.label}")
    result = compute_reference(case)
    if rows:
        rows.put(key, asdict(result))
    return result


def cases_of(jobs: Sequence[Job]) -> list[StudyCase]:
    """Return the cases of some jobs."""
    names = {job.case: job.scene for job in jobs}
    return [study_case(name, Path(scene) if scene else None) for name, scene in names.items()]
