"""Times, memory and results of one contact model on one case.

Each job runs in a process of its own: `python -m tkamb.studies.measures` reads a `Job` as JSON from
standard input and prints the `Measure` as JSON. The peak memory is then that of the job alone, and
a crash or a hang gives a row too. The process uses one thread, so that times are repeatable.

`quantities`, `errors` and `map_error` are the numbers by which two contact results are compared.
"""

import json
import math
import os
import re
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
    """Return approach (m) and each condyle's force (N), mean and peak pressure (Pa), area (m²)."""
    values = {"approach": result.approach}
    for side in SIDES:
        condyle = getattr(result, side)
        for part in PARTS:
            values[f"{side}_{part}"] = 0.0 if condyle is None else float(getattr(condyle, part))
    return values


def are_quantities(values: Mapping[str, float]) -> bool:
    """Return whether values have all names of `quantities`, and are finite."""
    names = {"approach", *(f"{side}_{part}" for side in SIDES for part in PARTS)}
    return values.keys() == names and all(map(math.isfinite, values.values()))


def is_map(stored: Mapping[str, float]) -> bool:
    """Return whether a stored raster has places "i j" and finite pressures."""
    places = all(re.fullmatch(r"-?\d{1,6} -?\d{1,6}", place) for place in stored)
    return places and all(map(math.isfinite, stored.values()))


def errors(values: Mapping[str, float], reference: Mapping[str, float]) -> dict[str, float]:
    """Return relative errors: approach, force, mean_pressure, peak_pressure, area.

    Errors of force and area are relative to the sum over both condyles, errors of pressure to the
    higher one, so that a condyle that hardly touches does not dominate. The larger error of the two
    condyles is returned.
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
    own = np.array([values[name] for name in names])
    true = np.array([reference[name] for name in names])
    return float(np.abs(own - true).max() / scale(np.abs(true)))


Raster = dict[tuple[int, int], float]
"""Raster place (i along x, j along z) -> pressure (Pa), where there is any."""


def raster_of(stored: Mapping[str, float]) -> Raster:
    """Return a raster stored as "i j" -> Pa."""
    return {(int(i), int(j)): p for (i, j), p in ((k.split(), p) for k, p in stored.items())}


def raster_map(result: ContactResult) -> Raster:
    """Return the pressure map on the raster."""
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
    """Return the L2 norm of the maps' difference over that of the reference."""
    places = sorted(set(raster) | set(reference))
    own = np.array([raster.get(place, 0.0) for place in places])
    true = np.array([reference.get(place, 0.0) for place in places])
    return float(np.linalg.norm(own - true) / np.linalg.norm(true))


@dataclass(frozen=True)
class MeasureSettings:
    """How times of the trade-off study are measured."""

    longest_seconds: float = 300.0
    """s: a job that takes longer is stopped and says so. Chosen: the whole page takes minutes."""
    repeats: int = 3
    """Repeats of the preparation and the first press; also the smallest number of warm presses.
    Chosen: enough for a median."""
    warm_presses: int = 7
    """Presses from a neighbouring pose that are timed. Chosen: enough for a median."""
    enough_seconds: float = 3.0
    """s: no more repeats after this time of measurement, except `repeats` warm presses. Chosen: the
    whole page takes minutes."""


MEASURE = MeasureSettings()

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", threads.VARIABLE), "1"
)


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set variables of the environment for a while; processes started meanwhile keep them."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


@dataclass(frozen=True)
class Job:
    """What to measure.

    Args:
        case: name of the case.
        contact: name of the model.
        resolution_mm: spacing of its map points.
        options: options of the model.
        scene: a user's scene for the cases that need it.
    """

    case: str
    contact: str
    resolution_mm: float
    options: dict[str, Any] = field(default_factory=dict)
    scene: str | None = None

    @property
    def label(self) -> str:
        """The model with its options: "lattice[tolerance=0.01]"."""
        return setting_label(self.contact, self.options)


@dataclass(frozen=True)
class Measure:
    """What was measured.

    Args:
        status: "ok" or why not.
        prepare_seconds: median time of `prepare`, without anything from disk.
        cold_seconds: first press after it; median.
        warm_seconds: press at the next pose, from where the last one ended; median.
        peak_rss_MB: of the process.
        iterations: iterations of the first press.
        nodes: number of nodes that the model solves for.
        values: approach, forces, pressures, areas.
        map: "i j" -> Pa on a raster of 1 mm.
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


MOST_NODES = 10**9
"""No model has so many nodes, and no press so many iterations."""


def is_whole(measure: Measure) -> bool:
    """Return whether a kept measure has all numbers of its status."""
    if max(measure.iterations, measure.nodes) > MOST_NODES:
        return False
    if measure.status != "ok":
        return not measure.values and not measure.map
    return are_quantities(measure.values) and is_map(measure.map)


def measure_apart(job: Job, longest: float = MEASURE.longest_seconds) -> Measure:
    """Measure in a new process."""
    command = [sys.executable, "-m", "tkamb.studies.measures"]
    try:
        ran = subprocess.run(
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
    if ran.returncode:
        return Measure(f"failed: {(ran.stderr.strip().splitlines() or ['no message'])[-1]}")
    return Measure(**json.loads(ran.stdout))


def measure(job: Job) -> Measure:
    """Measure in this process."""
    model = _model(job)
    (prepare, cold), (case, state, result, start) = _first(model, job)
    if result.status is not ContactStatus.OK:
        return Measure(f"{result.status.value}: {'; '.join(result.flags)}", prepare, cold)
    return Measure(
        "ok",
        prepare,
        cold,
        _warm(model, state, case, start),
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
    return contact_model(job.contact, job.resolution_mm, **options)


def _first(
    model: ContactModel, job: Job
) -> tuple[tuple[float, float], tuple[StudyCase, Any, ContactResult, WarmStart]]:
    """Return the median seconds of prepare and first press, and what the last of both gave.

    The bodies are made again each time, so that no cached property of them saves time.
    """
    prepares: list[float] = []
    colds: list[float] = []
    state: Any
    while True:
        state = None
        case = study_case(job.case, Path(job.scene) if job.scene else None)
        prepare, state = _timed(model.prepare, case.pair)
        cold, (result, start) = _timed(model.press_from, state, case.load, case.pose)
        prepares.append(prepare)
        colds.append(cold)
        if len(colds) == MEASURE.repeats or sum(prepares) + sum(colds) > MEASURE.enough_seconds:
            return (median(prepares), median(colds)), (case, state, result, start)


def _warm(model: ContactModel, state: Any, case: StudyCase, start: WarmStart) -> float:
    seconds: list[float] = []
    while len(seconds) < MEASURE.repeats or (
        len(seconds) < MEASURE.warm_presses and sum(seconds) < MEASURE.enough_seconds
    ):
        pose = case.nearby(len(seconds) + 1)
        spent, (_, start) = _timed(model.press_from, state, case.load, pose, start)
        seconds.append(spent)
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
