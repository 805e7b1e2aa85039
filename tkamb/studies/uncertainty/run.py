"""An uncertainty analysis, from a scene to the written bands.

Workers compute the samples, each of which is stored at once, so that an interrupted analysis can be
resumed. The samples give bands, tornado table and optional Sobol' indices.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tkamb.errors import InputError
from tkamb.files import write_rows
from tkamb.geometry.frames import Array
from tkamb.io.claim import claimed_directory
from tkamb.io.scene import Scene, load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.run.claims import peaks
from tkamb.run.columns import KINDS
from tkamb.run.maps import new_hdf5
from tkamb.run.recorder import Shard, Shards, completed, stored
from tkamb.run.results import MIN_SAMPLES, Results
from tkamb.run.results_folder import (
    BANDS_NAME,
    INDICES_NAME,
    SAMPLES_NAME,
    TORNADO_NAME,
    write_results,
)
from tkamb.run.simulation import chosen_frames, simulate
from tkamb.run.workers import PoolOptions, Progress, Task, WorkerPool
from tkamb.studies.uncertainty.bands import (
    Influence,
    band_columns,
    causes,
    discrepancy_columns,
    influences,
    measured_inside,
    peak_band,
    unbalanced_patella,
)
from tkamb.studies.uncertainty.inputs import (
    Point,
    VariedInput,
    correlation_root,
    crossed_points,
    held_inputs,
    normal_samples,
    uncertainty_of,
    varied_inputs,
)
from tkamb.studies.uncertainty.sample import BandWorker, Sample
from tkamb.studies.uncertainty.sensitivity import SobolIndex, sobol_indices


def write_uncertainty(
    uncertainty: "Uncertainty", folder: Path, report: Callable[[Results], str] | None = None
) -> None:
    """Write nominal results, bands, tornado table, samples and indices together."""

    def write_samples(path: Path) -> None:
        with new_hdf5(path) as file:
            file["result_names"] = uncertainty.names
            inputs, samples = uncertainty.inputs, uncertainty.samples
            file["input_names"] = [varied.name for varied in inputs]
            file["input_units"] = [varied.unit for varied in inputs]
            file["input_standard_deviations"] = [varied.deviation for varied in inputs]
            file["time_s"] = uncertainty.results["time_s"]
            for name, dtype in (("values", float), ("failed", bool), ("errors", float)):
                content = np.array([getattr(sample, name) for sample in samples], dtype)
                file.create_dataset(name, data=content, compression="gzip")
            problems = [sample.problems.tolist() for sample in samples]
            text = h5py.string_dtype()
            file.create_dataset("problems", data=problems, dtype=text, compression="gzip")

    more = {
        BANDS_NAME: lambda path: write_rows(path, _band_rows(uncertainty.bands)),
        TORNADO_NAME: lambda path: write_rows(path, _tornado_rows(uncertainty)),
        SAMPLES_NAME: write_samples,
    }
    if uncertainty.indices:
        more[INDICES_NAME] = lambda path: write_rows(path, _index_rows(uncertainty.indices))
    write_results(uncertainty.results, folder, more=more, report=report)


def _band_rows(columns: Mapping[str, Any]) -> list[Sequence[object]]:
    rows = zip(*columns.values(), strict=True)
    return [list(columns), *rows]


def _tornado_rows(uncertainty: "Uncertainty") -> list[Sequence[object]]:
    by_name = {varied.name: varied for varied in uncertainty.inputs}
    rows: list[Sequence[object]] = [
        ("result", "input", "standard_deviation", "unit", "variance_share", "change_per_sd")
    ]
    for row in uncertainty.tornado:
        varied = by_name.get(row.name)
        deviation, unit = (varied.deviation, varied.unit) if varied else ("", "")
        rows.append((row.result, row.name, deviation, unit, row.share, row.change))
    return rows


def _index_rows(indices: "Sequence[SobolIndex]") -> list[Sequence[object]]:
    head = ("result", "input", "first_order", "first_order_se", "total", "total_se", "rows")
    rows: list[Sequence[object]] = [head]
    for index in indices:
        numbers = (index.first, index.first_error, index.total, index.total_error)
        rows.append((index.result, index.name, *numbers, index.rows))
    return rows


SAMPLES = 256
MOST_SAMPLES = 100_000
TORNADO_RESULTS = (
    *("force_total_N", "medial_force_N", "lateral_force_N", "medial_share_equilibrium"),
    *("medial_peak_pressure_MPa", "lateral_peak_pressure_MPa", "quadriceps_N"),
)
PEAK = "force_total_BW"
"""Column whose peak and band the summary gives."""
NO_BAND = (
    *("time_s", "cycle_percent", "iterations", "coupling_iterations", "coupling_change_N"),
    *("coupling_change_mm", "contact_trials", "split_determined", "condition_number"),
    *("medial_force_per_adduction_N_per_deg", "adjust_restored"),
)
"""Columns without a band: they do not describe the knee, or samples do not compute them."""
NOT_SAMPLED = ("_seconds", "_slip_mm", "_velocity_mm_per_s")
"""Endings of columns without a band: computing times, and values that depend on frames that a
sample does not compute."""
RECORDED = ("measured_", "envelope_")
"""Beginnings of columns with recorded data, which have no band."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Result of `estimate_uncertainty`.

    Args:
        bands: name -> column of bands.csv.
        tornado: influence of each input on each result.
        samples: samples in the order of their numbers. Those of Saltelli's design that are not
            independent come last.
        indices: Sobol' indices; empty if they were not requested.
    """

    results: Results
    bands: dict[str, Array]
    tornado: list[Influence]
    names: list[str]
    inputs: tuple[VariedInput, ...]
    samples: list[Sample]
    indices: list[SobolIndex] = field(default_factory=list)


def estimate_uncertainty(
    scene: Scene | str | Path,
    *,
    samples: int = SAMPLES,
    workers: int = 1,
    dask: str | None = None,
    method: str = "lhs",
    indices: bool = False,
    frames: slice | None = None,
    directory: str | Path | None = None,
    scene_path: str | Path | None = None,
    resume: bool = False,
    force: bool = False,
    progress: Progress = lambda samples, count: samples,
    report: Callable[[Results], str] | None = None,
) -> Uncertainty:
    """Vary the inputs of a scene as described in its table [uncertainty] and return bands.

    The results do not depend on the number of workers. A larger number of samples includes the
    samples of a smaller one.

    Args:
        samples: number of samples, at least 20.
        workers: number of processes; 1: compute in this process.
        dask: address of a Dask scheduler, or "local" for worker processes on this computer,
            `workers` processes.
        method: "lhs" or "sobol", see `tkamb.studies.uncertainty.inputs`.
        indices: whether to compute Sobol' indices with Saltelli's design. With d inputs
            `samples` (d + 2) samples are computed, and the bands use 2 `samples` of them.
        frames: slice of the frames; default: all.
        directory: folder for all results; None: results stay in memory.
        resume: whether to use the samples that an interrupted run stored in the folder.
        force: whether to write into a folder that contains files of other programs.
        progress: wrapper of the iterator of the finished samples.
        report: function that returns the page report.html; None: the folder has no report.

    Raises:
        InputError: the input is invalid, or the folder holds another run or is in use.
        ComputationError: a worker process ended during a sample.
        KeyboardInterrupt: interrupted. The finished samples stay in the folder.
    """
    if isinstance(scene, str | Path):
        scene_path, scene = scene, load_scene(scene)
    crew = PoolOptions(workers, dask)
    if not MIN_SAMPLES <= samples <= MOST_SAMPLES:
        raise InputError(
            f"cannot be {samples}",
            "samples",
            f"give a number from {MIN_SAMPLES} to {MOST_SAMPLES}",
        )
    if directory is None and resume:
        raise InputError("needs the folder of the earlier run", "resume", "give a directory")
    crew.check()
    case = load_case(scene)
    chosen = chosen_frames(frames, len(case.motion.time))
    inputs = varied_inputs(case)
    _check_correlation(case, inputs, indices)
    points = _points(method, samples, len(inputs), uncertainty_of(case).seed, indices)
    crossed = samples if indices else 0
    with ExitStack() as stack:
        folder = None
        if directory is not None:
            claim = claimed_directory(directory, force, "uncertainty")
            folder = stack.enter_context(claim)
        task = Task(BandWorker, (case.scene, chosen))
        # the workers prepare the scene during the nominal run
        team = stack.enter_context(crew.team(task, len(points)))
        nominal = simulate(scene, frames=frames, scene_path=scene_path)
        job = _Job(case, nominal, inputs, points, crossed, method, team, progress)
        if folder is None:
            return job.run(None)
        identity = nominal.summary["identity"] | {"method of sampling": job.design}
        uncertainty = job.run(Shards(folder, identity, resume))
        write_uncertainty(uncertainty, folder, report)
    return uncertainty


def _check_correlation(case: Case, inputs: Sequence[VariedInput], indices: bool) -> None:
    tables = uncertainty_of(case).correlation
    correlation_root(tables, [one.name for one in inputs])
    if tables and indices:
        raise InputError(
            "Sobol' indices need independent inputs",
            "--indices with [[uncertainty.correlation]]",
            "leave out one of the two; tornado.csv has shares of correlated inputs",
        )


def _points(method: str, samples: int, dimensions: int, seed: int, crossed: bool) -> list[Point]:
    if not crossed:
        normal = normal_samples(method, samples, dimensions, seed)
        return [Point.of(number, row) for number, row in enumerate(normal)]
    pairs = normal_samples(method, samples, 2 * dimensions, seed)
    return crossed_points(pairs[:, :dimensions], pairs[:, dimensions:])


@dataclass(frozen=True, eq=False)
class _Job:
    """The samples of one scene, with `crossed` rows of Saltelli's design, or 0."""

    case: Case
    nominal: Results
    inputs: tuple[VariedInput, ...]
    points: list[Point]
    crossed: int
    method: str
    team: WorkerPool
    progress: Progress

    @property
    def design(self) -> str:
        """Return the sampling method. With Saltelli's design it includes the number of rows."""
        return (
            f"{self.method}, Saltelli's design of {self.crossed}" if self.crossed else self.method
        )

    def run(self, shards: Shards | None) -> Uncertainty:
        names = banded_names(self.nominal)
        count = len(self.points)
        folders = [] if shards is None else [shards]
        samples = stored(folders, range(count), lambda shard: Sample(**shard.contact or {}))
        remaining = [n for n in range(count) if n not in samples]
        new = self.team.answers([(n, (self.points[n], names)) for n in remaining])

        def keep(number: int, sample: Sample) -> None:
            assert shards is not None
            shards.put(number, Shard({}, dict(vars(sample))))

        progress = self.progress(new, len(remaining))
        completed(samples, progress, keep if folders else None, f"{count} samples")
        return self._evaluate(names, [samples[n] for n in range(count)])

    def _evaluate(self, names: list[str], samples: list[Sample]) -> Uncertainty:
        results = [name for name in TORNADO_RESULTS if name in names]
        rows = [names.index(name) for name in results]
        input_names = [varied.name for varied in self.inputs]
        indices: list[SobolIndex] = []
        if self.crossed:
            design_values = np.array([sample.values[rows] for sample in samples])
            seed = uncertainty_of(self.case).seed
            indices = sobol_indices(results, input_names, design_values, self.crossed, seed)
        independent = samples[: 2 * self.crossed or len(samples)]
        values = np.array([sample.values for sample in independent])
        problems = np.array([sample.problems for sample in independent])
        failed = problems != ""
        errors = np.array([sample.errors for sample in independent])
        bands = band_columns(self.nominal["time_s"], names, values, failed)
        tornado = influences(results, input_names, values[:, rows], errors)
        summary, weight = self.nominal.summary, self.case.body_weight
        bands |= discrepancy_columns(names, values, summary, weight)
        summary["uncertainty"] = self._summary(problems, tornado)
        patella = self.case.scene.patella
        if patella is not None and patella.motion == "recorded":
            columns, words = unbalanced_patella(names, values, weight)
            bands |= columns
            summary["uncertainty"]["unbalanced_patella"] = words
        if PEAK in names:
            peak = peak_band(self.nominal[PEAK], values[:, names.index(PEAK)], failed)
            summary["uncertainty"]["peak_force_total_BW"] = peak
        summary["uncertainty"]["peaks_BW"] = peaks(self.nominal.columns, bands, weight)
        if summary.get("measured"):
            inside = measured_inside(self.nominal.columns, bands, summary["measured"])
            summary["uncertainty"]["measured_inside"] = inside
        nominal = replace(self.nominal, bands=bands)
        return Uncertainty(nominal, bands, tornado, names, self.inputs, samples, indices)

    def _summary(self, problems: np.ndarray, tornado: list[Influence]) -> dict[str, Any]:
        failed = problems != ""
        return {
            "samples": len(failed),
            "method": self.method,
            "table": uncertainty_of(self.case).model_dump(mode="json"),
            "varied": [varied.name for varied in self.inputs],
            "not_varied": held_inputs(self.case),
            "failed_share": float(failed.mean()),
            "largest_failed_share": float(failed.mean(axis=0).max()),
            "causes_of_failure": causes(problems),
            "shares_of_variance": shares_of_variance(tornado),
        }


def shares_of_variance(tornado: Sequence[Influence]) -> dict[str, dict[str, float]]:
    """Return result -> input -> its share of the variance, largest first."""
    rows: dict[str, dict[str, float]] = {}
    for row in tornado:
        rows.setdefault(row.result, {})[row.name] = row.share
    return rows


def banded_names(results: Results) -> list[str]:
    """Return the numeric columns that have a band."""
    return [
        name
        for name in results.columns
        if KINDS.get(name) != "text"
        and name not in (*NO_BAND, *results.not_modelled)
        and not name.endswith(NOT_SAMPLED)
        and not name.startswith(RECORDED)
    ]
