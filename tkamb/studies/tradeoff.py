"""Trade-off of speed and accuracy: contact models on every case, and multibody settings.

A `Row` has the times and errors of one model on one case. The rows that no other row beats are the
case's Pareto front. Fine grids and solver options are measured on some cases only, unless `full`.

A multibody run changes one setting of the shipped knee bend and is compared with the run as shipped
at the same instants. A lower frame rate removes rows of the recordings, so the derivatives come
from the remaining ones.
"""

import json
import math
import tempfile
import time as clock
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.registry import contact_names
from tkamb.errors import InputError, TkambError
from tkamb.geometry.frames import Array
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.decks import ELEMENT
from tkamb.run.identity import contact_code
from tkamb.run.simulation import simulate
from tkamb.studies.calculix import find_program, measure_by_calculix
from tkamb.studies.cases import StudyCase, case_names, copied_scene, study_case, thin_out
from tkamb.studies.kept_rows import KeptRows, row_key
from tkamb.studies.measures import Job, Measure, errors, map_error, measure_apart, raster_of
from tkamb.studies.references import (
    STORED,
    Reference,
    compute_reference,
    read_references,
    reference_of,
    write_references,
)

if TYPE_CHECKING:
    from tkamb.run.results import Results


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
    """Return the largest relative uncertainty among `FRONT_ERRORS`."""
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
    """Return the rows of a tradeoff.json."""
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
"""Built-in model -> its settings; models of other packages use `Settings()`."""


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
    """Measure the jobs; yield one row per job, without marks of the Pareto fronts.

    Args:
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
        rows: stored measures, as in `run_tradeoff`.
        sizes_mm: requested cell sizes, mm.
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
    """Return case name -> reference; those of a user's scene are stored in `rows`.

    Args:
        recompute: whether to compute and store the references again.
        announce: function that prints a line before a reference is computed.

    Raises:
        InputError: a stored reference is missing, or is of an earlier version of its case.
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


# Recorded frames from one compared frame to the next. Every frame rate of the study
# contains these frames.
STRIDE = 10


@dataclass(frozen=True)
class Change:
    """One change of the shipped scene.

    Args:
        keys: dotted key of the scene -> new value.
    """

    keys: dict[str, Any] = field(default_factory=dict)
    every: int = 1


CHANGES: dict[str, Change] = {
    "as shipped": Change(),
    "coupled: points": Change({"contact.coupling": "points"}),
    "released: adduction": Change({"contact.released": ["adduction"]}),
    "filtered at 6 Hz": Change({"motion.cutoff_Hz": 6.0}),
    "filtered at 2 Hz": Change({"motion.cutoff_Hz": 2.0}),
    "filtered at 1 Hz": Change({"motion.cutoff_Hz": 1.0}),
    "every 2nd frame": Change(every=2),
    "every 5th frame": Change(every=5),
    "every 10th frame": Change(every=10),
    "patella solved": Change({"patella.motion": "solved"}),
    "no wrapping": Change({"quadriceps.wrap": False, "patellar_ligament.wrap": False}),
    "no friction": Change({"contact.friction": 0.0}),
    "femoral adjustment": Change({"contact.adjust": True}),
}
COMPARED = ("force_total_N", "quadriceps_N", "medial_force_N", "medial_peak_pressure_MPa")
DERIVATIVES = ("velocity", "acceleration")
HEADS = {
    "force_total_N": "force",
    "peak_force": "peak force",
    "quadriceps_N": "quadriceps",
    "medial_force_N": "medial",
    "medial_peak_pressure_MPa": "peak p",
    "velocity": "velocity",
    "acceleration": "acceleration",
}
CLOCKS = ("query_seconds", "body_seconds", "contact_seconds")


@dataclass(frozen=True)
class BodyRow:
    """Cost and effect of one change.

    Args:
        status: "ok", the error, or the number of failed frames.
        prepare_seconds: time of the run outside its frames, s.
        frame_seconds: median time per frame, s.
        changed: column, "peak_force", or derivative of flexion -> largest change over the
            frames, relative to the largest value as shipped.
    """

    name: str
    status: str
    prepare_seconds: float = float("nan")
    frame_seconds: float = float("nan")
    changed: dict[str, float] | None = None


def run_body_trade(rows: KeptRows | None = None) -> Iterator[BodyRow]:
    """Run the shipped knee bend with each change alone that `rows` does not store."""
    base: _Run | None = None
    for name, change in CHANGES.items():
        key = row_key("body", name, asdict(change))
        row = rows.read(key, BodyRow) if rows else None
        if row is None:
            base = base or _run(CHANGES["as shipped"])
            row = _row(name, change, base)
            if rows:
                rows.put(key, asdict(row))
        yield row


@dataclass(frozen=True, eq=False)
class _Run:
    results: "Results"
    derivatives: dict[str, Array]
    seconds: float


def _run(change: Change) -> _Run:
    with tempfile.TemporaryDirectory() as folder:
        path = copied_scene(Path(folder))
        if change.every > 1:
            thin_out(Path(folder), change.every)
        frames = slice(0, None, STRIDE // change.every)
        start = clock.perf_counter()
        scene = load_scene(path, change.keys)
        results = simulate(scene, frames=frames)
        seconds = clock.perf_counter() - start
        motion = load_case(scene).motion
        derivatives = {name: getattr(motion, name)[frames, 5] for name in DERIVATIVES}
    return _Run(results, derivatives, seconds)


def _row(name: str, change: Change, base: _Run) -> BodyRow:
    try:
        run = base if change == Change() else _run(change)
    except TkambError as error:
        return BodyRow(name, str(error))
    result = run.results
    frame_seconds = sum(np.nan_to_num(result[column]) for column in CLOCKS)
    failed = sum(status.startswith("failed") for status in result.status)
    status = f"{failed} of {len(result)} frames failed" if failed else "ok"
    outside = run.seconds - float(np.sum(frame_seconds))
    return BodyRow(name, status, outside, float(np.median(frame_seconds)), _changed(run, base))


def _changed(run: _Run, base: _Run) -> dict[str, float]:
    result, before = run.results, base.results
    changed = {column: _change(result[column], before[column]) for column in COMPARED}
    peaks = [float(np.nanmax(results["force_total_N"])) for results in (result, before)]
    changed["peak_force"] = abs(peaks[0] / peaks[1] - 1)
    for name in DERIVATIVES:
        changed[name] = _change(run.derivatives[name], base.derivatives[name])
    return changed


def _change(values: Array, base: Array) -> float:
    finite = np.isfinite(values) & np.isfinite(base)
    if not finite.any():
        return float("nan")
    return float(np.abs(values - base)[finite].max() / np.abs(base[finite]).max())


def body_json(rows: Sequence[BodyRow]) -> str:
    """Return the rows as JSON text."""
    return json.dumps([asdict(row) for row in rows], indent=1) + "\n"


def body_table(rows: Sequence[BodyRow]) -> list[str]:
    """Return the lines of the printed table."""
    head = " ".join(f"{text:>12s}" for text in HEADS.values())
    lines = [f"{'knee bend':20s} {'ms per frame':>12s} {'prep s':>6s} {head}"]
    for row in rows:
        times = f"{row.name:20s} {1e3 * row.frame_seconds:12.1f} {row.prepare_seconds:6.2f}"
        if row.changed is None:
            lines.append(f"{row.name:20s} {row.status}")
            continue
        shares = " ".join(f"{100 * row.changed[name]:10.2f} %" for name in HEADS)
        lines.append(f"{times} {shares}" + ("" if row.status == "ok" else f"  {row.status}"))
    return [
        *lines,
        "largest change over the frames, relative to the largest value as shipped; velocity and"
        " acceleration are of flexion",
    ]


def read_body_rows(path: Path) -> list[BodyRow]:
    """Return the rows of a body.json."""
    try:
        return [BodyRow(**row) for row in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"is not a table of the body's trade-off ({error})", path) from None
