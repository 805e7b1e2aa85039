"""Times, memory and results of one contact model on one case.

Each job runs in a process of its own: `python -m tkamb.studies.measures` reads a `Job` as JSON from
standard input and prints the `Measure` as JSON. So the peak memory is that of the job, and a crash
or a hang is recorded. One thread gives repeatable times.

`quantities`, `errors` and `map_error` compare two contact results.
"""

import json
import os
import subprocess
import sys
import time as clock
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator

from tkamb.contact.model import ContactModel
from tkamb.contact.registry import contact_class, contact_model
from tkamb.contact.result import ContactResult, ContactStatus, WarmStart
from tkamb.errors import TkambError
from tkamb.geometry import threads
from tkamb.geometry.frames import SIDES
from tkamb.geometry.memory import peak_rss
from tkamb.run.known_errors import setting_label
from tkamb.studies.cases import StudyCase, study_case
from tkamb.units import MILLIMETRE

PARTS = ("force", "mean_pressure", "peak_pressure", "area")
RASTER = MILLIMETRE
"""m: spacing of the raster on which pressure maps are compared."""

Quantities = dict[str, float]


def quantities(result: ContactResult) -> Quantities:
    """Return the approach, m, and force, N, pressures, Pa, and area, m², of each condyle."""
    values = {"approach": result.approach}
    for side in SIDES:
        condyle = getattr(result, side)
        for part in PARTS:
            values[f"{side}_{part}"] = 0.0 if condyle is None else float(getattr(condyle, part))
    return values


def errors(values: Mapping[str, float], reference: Mapping[str, float]) -> dict[str, float]:
    """Return the relative errors of approach, force, mean_pressure, peak_pressure and area.

    Errors of force and area are relative to the sum of both condyles, errors of pressure to the
    higher pressure, so that a condyle with little load does not dominate. The larger error of the
    two condyles is returned.
    """
    result = {"approach": _relative(values, reference, ["approach"], np.max)}
    for part in PARTS:
        names = [f"{side}_{part}" for side in SIDES]
        scale = np.sum if part in ("force", "area") else np.max
        result[part] = _relative(values, reference, names, scale)
    return result


def _relative(
    values: Mapping[str, float], reference: Mapping[str, float], names: list[str], scale: object
) -> float:
    assert callable(scale)
    computed = np.array([values[name] for name in names])
    true = np.array([reference[name] for name in names])
    return float(np.abs(computed - true).max() / scale(np.abs(true)))


Raster = dict[tuple[int, int], float]
"""Raster point (i along x, j along z) -> pressure, Pa. Points without pressure are omitted."""


def raster_of(stored: Mapping[str, float]) -> Raster:
    """Return the raster stored as "i j" -> pressure, Pa."""
    return {(int(i), int(j)): p for (i, j), p in ((k.split(), p) for k, p in stored.items())}


def raster_map(result: ContactResult) -> Raster:
    """Return the pressure map of a result, interpolated to the raster."""
    loaded = result.pressure > 0
    if not loaded.any():
        return {}
    across = result.points[:, [0, 2]]
    low = np.floor(across[loaded].min(axis=0) / RASTER).astype(int) - 1
    high = np.ceil(across[loaded].max(axis=0) / RASTER).astype(int) + 1
    near = (
        (across > (low - 3) * RASTER)
        & (across < (high + 3) * RASTER)
        & (result.normals[:, 1:2] > 0)
    ).all(axis=1)
    i, j = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True)))
    value = LinearNDInterpolator(across[near], result.pressure[near])
    p = np.nan_to_num(value(i * RASTER, j * RASTER))
    return {
        (int(a), int(b)): float(v)
        for a, b, v in zip(i.ravel(), j.ravel(), p.ravel(), strict=True)
        if v > 0
    }


def map_error(raster: Raster, reference: Raster) -> float:
    """Return the L2 norm of the difference of two maps over the norm of the reference."""
    points = sorted(set(raster) | set(reference))
    computed = np.array([raster.get(point, 0.0) for point in points])
    true = np.array([reference.get(point, 0.0) for point in points])
    return float(np.linalg.norm(computed - true) / np.linalg.norm(true))


# s: time limit of a job. A longer job is stopped and has no result. The study
# should take minutes.
LONGEST_SECONDS = 300.0
# Largest number of timed preparations and first presses, and smallest number of timed warm
# presses. The median of three ignores one slow press.
REPEATS = 3
# Largest number of timed warm presses. Their median ignores slow ones.
WARM_PRESSES = 7
# s: measured time after which only warm presses are repeated, up to `REPEATS`. The
# study should take minutes.
ENOUGH_SECONDS = 3.0


ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", threads.VARIABLE), "1"
)


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables inside a `with` block. Processes started in it inherit them."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


@dataclass(frozen=True)
class Job:
    """A contact model and a case to measure.

    Args:
        resolution_mm: spacing of the model's map points, mm.
        scene: path of a user's scene, for the cases of that scene.
    """

    case: str
    contact: str
    resolution_mm: float
    options: dict[str, Any] = field(default_factory=dict)
    scene: str | None = None

    @property
    def label(self) -> str:
        """Name of the model with its options, as "lattice[tolerance=0.01]"."""
        return setting_label(self.contact, self.options)


@dataclass(frozen=True)
class Measure:
    """Cost and results of a job.

    Args:
        status: "ok", or the reason why there is no result.
        prepare_seconds: median time of `prepare` without the cache on disk, s.
        cold_seconds: median time of a first press without a warm start, s.
        warm_seconds: median time of a press at the next pose with a warm start, s.
        values: quantities of the first press, see `quantities`.
        map: "i j" -> pressure, Pa, on a raster of 1 mm.
    """

    status: str
    prepare_seconds: float = float("nan")
    cold_seconds: float = float("nan")
    warm_seconds: float = float("nan")
    peak_rss_MB: float = float("nan")
    iterations: int = 0
    nodes: int = 0
    values: Quantities = field(default_factory=dict)
    map: dict[str, float] = field(default_factory=dict)


def measure_apart(job: Job, longest: float = LONGEST_SECONDS) -> Measure:
    """Measure a job in a new process with a time limit, s."""
    command = [sys.executable, "-m", "tkamb.studies.measures"]
    try:
        process = subprocess.run(
            command,
            input=json.dumps(asdict(job)),
            capture_output=True,
            text=True,
            timeout=longest,
            check=False,
            env=os.environ | ONE_THREAD,
            start_new_session=True,
        )
    except subprocess.TimeoutExpired:
        return Measure(f"stopped after {longest:g} s")
    if process.returncode:
        return Measure(f"failed: {(process.stderr.strip().splitlines() or ['no message'])[-1]}")
    return Measure(**json.loads(process.stdout))


def measure(job: Job) -> Measure:
    """Measure a job in this process."""
    model = _model(job)
    (prepare, cold), (case, state, result, warm_start) = _first(model, job)
    if result.status is not ContactStatus.OK:
        return Measure(f"{result.status.value}: {'; '.join(result.flags)}", prepare, cold)
    return Measure(
        "ok",
        prepare,
        cold,
        _warm(model, state, case, warm_start),
        peak_rss(),
        result.iterations,
        state.node_count,
        quantities(result),
        {f"{i} {j}": p for (i, j), p in raster_map(result).items()},
    )


def _model(job: Job) -> ContactModel:
    options = dict(job.options)
    if "cache" in getattr(contact_class(job.contact), "__dataclass_fields__", {}):
        options.setdefault("cache", False)
    return contact_model(job.contact, resolution=job.resolution_mm * MILLIMETRE, **options)


def _first(
    model: ContactModel, job: Job
) -> tuple[tuple[float, float], tuple[StudyCase, Any, ContactResult, WarmStart]]:
    """Return the median times of preparation and first press, s, and their last results.

    The bodies are new for each repeat, so that no cached property shortens the time.
    """
    prepares: list[float] = []
    colds: list[float] = []
    state: Any
    while True:
        state = None
        case = study_case(job.case, Path(job.scene) if job.scene else None)
        prepare, state = _timed(model.prepare, case.pair)
        cold, (result, warm_start) = _timed(model.press_from, state, case.load, case.pose)
        prepares.append(prepare)
        colds.append(cold)
        if len(colds) == REPEATS or sum(prepares) + sum(colds) > ENOUGH_SECONDS:
            return (median(prepares), median(colds)), (case, state, result, warm_start)


def _warm(model: ContactModel, state: Any, case: StudyCase, warm_start: WarmStart) -> float:
    seconds: list[float] = []
    while len(seconds) < REPEATS or (len(seconds) < WARM_PRESSES and sum(seconds) < ENOUGH_SECONDS):
        pose = case.nearby(len(seconds) + 1)
        duration, (_, warm_start) = _timed(model.press_from, state, case.load, pose, warm_start)
        seconds.append(duration)
    return median(seconds)


def _timed(call: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    start = clock.perf_counter()
    result = call(*arguments)
    return clock.perf_counter() - start, result


def _main() -> int:
    try:
        print(json.dumps(asdict(measure(Job(**json.load(sys.stdin))))))
    except TkambError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    return 0


if __name__ == "__main__":
    raise SystemExit(_main())
