"""Uncertainty of wear: samples of the simulation, and bands of the rows of its table.

Sampling and percentiles are those of `tkamb uncertainty`. The varied inputs are the wear factor,
the constants of creep, the modulus of the insert and the position of the whole cycle (the constant
part of each pose error). Noise over the frames averages out.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_coordinates, knee_pose
from tkamb.io.scene.uncertainty import UncertaintyTable
from tkamb.run.recorder import Shard, Shards, completed, stored
from tkamb.run.results import MIN_SAMPLES
from tkamb.run.workers import Numbered, PoolOptions, Task
from tkamb.studies.uncertainty.bands import percentiles
from tkamb.studies.uncertainty.inputs import Draw, VariedInput, correlation_root, normal_samples
from tkamb.studies.wear.engine import ContactEngine, SlidingHistory
from tkamb.studies.wear.laws import LogarithmicCreep, WearLaw
from tkamb.studies.wear.motion import CycleMotion
from tkamb.studies.wear.setup import WearSetup
from tkamb.studies.wear.simulation import WearCase, simulate_wear

BANDED = ("volume_mm3", "mass_mg", "max_depth_mm", "creep_depth_mm", "creep_volume_mm3")
"""Columns of wear.csv that have a band."""
POSES = {"ap": "mm", "ml": "mm", "adduction": "deg", "axial_rotation": "deg", "flexion": "deg"}
"""Knee coordinates that a motion prescribes -> unit. The load gives the remaining coordinate."""

Rows = Mapping[str, Array]


@dataclass(frozen=True)
class Scaled(WearLaw):
    """A wear law with a factor on the worn depth."""

    name: ClassVar[str] = "scaled"
    assumes: ClassVar[str] = "another law times a factor"

    law: WearLaw
    factor: float

    def depth(self, history: SlidingHistory) -> Array:
        """Return the factor times the depth of the law, m, shape (n,)."""
        return self.factor * self.law.depth(history)


def varied_wear_inputs(
    table: UncertaintyTable, motion: CycleMotion, creep: LogarithmicCreep | None, profile: bool
) -> tuple[VariedInput, ...]:
    """Return the varied inputs of a wear simulation.

    Args:
        motion: motion of the cycle. Coordinates in equilibrium have no error of their own.
        creep: creep law; None: creep is not modelled.
        profile: whether the motion is a simulator's profile. Its pose then varies only by stated
            deviations, because the defaults are those of recorded poses.
    """
    in_equilibrium = () if motion.drive is None else motion.drive.names
    if not profile:
        table = table.completed(from_markers=False)
    inputs = [
        VariedInput(name, getattr(table, f"{name}_{unit}"), unit)
        for name, unit in POSES.items()
        if name not in in_equilibrium and getattr(table, f"{name}_{unit}") is not None
    ]
    inputs.append(VariedInput("young_modulus", table.young_modulus, "relative"))
    inputs.append(VariedInput("wear_factor", table.wear_factor, "relative"))
    if creep is not None:
        inputs.append(VariedInput("creep", table.creep, "relative"))
    varied = tuple(candidate for candidate in inputs if candidate.deviation > 0)
    if not varied:
        raise InputError(
            "nothing of a wear simulation varies",
            "[uncertainty]",
            "give a standard deviation above 0, or --samples 0",
        )
    return varied


def moved_case(case: WearCase, draw: Draw) -> WearCase:
    """Return a case with the errors of a sample applied to its inputs."""
    errors = [draw.error(name) if name in POSES else 0.0 for name in KNEE_COORDINATES]
    offset = math.sqrt(draw.constant_share) * np.array(errors)
    motion, drive, engine, creep = case.motion, case.motion.drive, case.engine, case.creep
    if offset.any():
        poses = knee_pose(knee_coordinates(motion.poses) + offset)
        if drive is not None:
            drive = replace(drive, coordinates=drive.coordinates + offset)
        path = motion.path
        if path is not None:
            path = path._replace(poses=knee_pose(knee_coordinates(path.poses) + offset))
        motion = replace(motion, poses=poses, path=path, drive=drive)
    if (modulus_factor := draw.factor("young_modulus")) != 1.0:
        assert isinstance(engine, ContactEngine)
        material = engine.material
        material = replace(material, young_modulus=material.young_modulus * modulus_factor)
        engine = replace(engine, material=material)
    if creep is not None:
        creep = creep.times(draw.factor("creep"))
    law = Scaled(case.law, draw.factor("wear_factor"))
    return replace(case, engine=engine, motion=motion, law=law, creep=creep)


class WearSampler:
    """Computes samples of one wear simulation.

    Args:
        simulation: nominal case, number of cycles, and number of updates of the geometry.
        constant_share: share of the variance of a pose error that is constant over the frames.
    """

    def __init__(
        self,
        simulation: tuple[WearCase, int, int],
        inputs: tuple[VariedInput, ...],
        constant_share: float,
    ) -> None:
        self._simulation, self._inputs, self._share = simulation, inputs, constant_share

    def __call__(self, number: int, normal: Array) -> Rows:
        """Return the columns of the table of a sample; empty if it has no contact.

        Args:
            number: number of the sample. It has no effect.
            normal: errors of the inputs in standard deviations, shape (d,).
        """
        case, cycles, updates = self._simulation
        draw = Draw(self._inputs, normal, np.zeros((1, 0)), self._share)
        try:
            state, _ = simulate_wear(moved_case(case, draw), cycles, updates)
        except InputError:  # the displaced femoral component is beside the insert
            return {}
        return {key: np.array([row[key] for row in state.rows]) for key in ("cycles", *BANDED)}


@dataclass(frozen=True)
class WearBandSettings:
    """Bands of wear from samples."""

    samples: int = 32
    """Default number of samples. The 5th and 95th percentiles then lie between the
    smallest and the largest sample."""
    max_samples: int = 10_000
    """Largest number of samples that is accepted. More take too long."""


WEAR_BAND = WearBandSettings()

PRINTED_BANDS = (
    ("volume_mm3", "volume", "mm3"),
    ("max_depth_mm", "depth", "mm"),
    ("creep_depth_mm", "creep", "mm"),
)
"""Column, word and unit of the bands that are printed."""
NOT_VARIED = (
    "loads, the noise of the pose over the frames, the form of the wear law with its dependence on "
    "cross-shear and pressure, friction, the shape of the insert, and the error of the contact "
    "model"
)

Progress = Callable[[Iterable[Numbered], int], Iterable[Numbered]]


@dataclass(frozen=True, eq=False)
class WearBands:
    """5th, 50th and 95th percentile of the samples of a wear simulation.

    Args:
        failed: number of samples without contact. The bands exclude them.
        ended: number of samples that ended before the last cycle. Later bands exclude them.
        rows: for each row of the table "<column>_p05", "_p50" and "_p95" -> percentile; NaN with
            too few samples.
    """

    varied: tuple[VariedInput, ...]
    samples: int
    failed: int
    ended: int
    rows: tuple[dict[str, float], ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the varied inputs and the bands after the last cycle."""
        return {
            "samples": self.samples,
            "samples_without_contact": self.failed,
            "samples_that_ended_early": self.ended,
            "standard_deviations": {f"{v.name} ({v.unit})": v.deviation for v in self.varied},
            "not_varied": NOT_VARIED,
            **{k: v if math.isfinite(v) else None for k, v in self.rows[-1].items()},
        }

    def lines(self) -> list[str]:
        """Return the bands after the last cycle as lines of text."""
        last, result = self.rows[-1], []
        for name, what, unit in PRINTED_BANDS:
            low, high = last.get(f"{name}_p05", math.nan), last.get(f"{name}_p95", math.nan)
            if math.isfinite(low):
                result.append(f"{what} {low:.4g} to {high:.4g} {unit}")
        varied = ", ".join(f"{v.name} ± {v.deviation:g} {v.unit}" for v in self.varied)
        text = ", ".join(result) or "too few samples for a band"
        return [f"5 to 95 % of {self.samples} samples: {text}; varied: {varied}"]

    def questions(self) -> list[str]:
        """Return sentences on samples that the bands exclude."""
        questions = []
        if self.failed:
            questions.append(
                f"{self.failed} of {self.samples} samples have no contact; the bands exclude them"
            )
        if self.ended:
            questions.append(
                f"{self.ended} of {self.samples} samples wore through or lost their contact; the "
                "bands of later cycles exclude them"
            )
        return questions


@dataclass(frozen=True)
class Sampling:
    """The samples of a wear simulation. Sample n does not depend on the number of samples.

    Args:
        root: Cholesky factor of the correlation matrix, shape (d, d), see
            `tkamb.studies.uncertainty.inputs`.
        seed: seed of the random numbers.
        constant_share: share of the variance of a pose error that is constant over the frames.
    """

    inputs: tuple[VariedInput, ...]
    root: Array
    samples: int
    seed: int
    constant_share: float

    @classmethod
    def of(cls, setup: WearSetup, case: WearCase, samples: int) -> "Sampling":
        """Return the sampling with the table [uncertainty] of the scene, or its defaults.

        Raises:
            InputError: no input varies, or the correlations contradict each other.
        """
        table = setup.uncertainty or UncertaintyTable()
        inputs = varied_wear_inputs(table, case.motion, case.creep, setup.simulated)
        names = [varied.name for varied in inputs]
        pairs = [pair for pair in table.correlation if set(pair.between) <= set(names)]
        root = correlation_root(pairs, names)
        return cls(inputs, root, samples, table.seed, table.constant_share)

    def bands(
        self,
        simulation: tuple[WearCase, int, int],
        rows: Sequence[Mapping[str, float]],
        crew: PoolOptions | None = None,
        shards: Shards | None = None,
        progress: Progress = lambda samples, count: samples,
    ) -> WearBands:
        """Simulate the samples and return their bands at the rows of the nominal table.

        Args:
            simulation: nominal case, number of cycles, and number of updates of the geometry.
            crew: worker pool settings; default: this process.
            shards: store of the finished samples; None: they stay in memory.
            progress: wrapper of the iterator of the finished samples.

        Raises:
            KeyboardInterrupt: interrupted. The finished samples stay in `shards`.
        """
        count = self.samples
        normal = normal_samples("lhs", count, len(self.inputs), self.seed) @ self.root.T
        folders = [] if shards is None else [shards]
        done: dict[int, Rows] = stored(folders, range(count), lambda shard: shard.contact or {})
        remaining = [(n, normal[n]) for n in range(count) if n not in done]
        task = Task(WearSampler, (simulation, self.inputs, self.constant_share))
        answers = progress((crew or PoolOptions()).answers(task, remaining), len(remaining))

        def keep(number: int, sample: Rows) -> None:
            assert shards is not None
            shards.put(number, Shard({}, dict(sample)))

        completed(done, answers, keep if folders else None, f"{count} samples")
        return _bands(self.inputs, [done[n] for n in range(count)], rows, simulation[1])


def _bands(
    inputs: tuple[VariedInput, ...],
    samples: Sequence[Rows],
    rows: Sequence[Mapping[str, float]],
    cycles: int,
) -> WearBands:
    names = [name for name in BANDED if np.isfinite(rows[-1][name])]
    row_cycles = np.array([row["cycles"] for row in rows])
    values = np.full((len(samples), len(names), len(row_cycles)), np.nan)
    for sample, sample_values in zip(samples, values, strict=True):
        for column, name in zip(sample_values, names, strict=True):
            if sample:
                column[:] = np.interp(row_cycles, sample["cycles"], sample[name], right=np.nan)
    bands = percentiles(values, np.isnan(values[:, 0]))
    band_rows = [
        {
            f"{name}_{end}": float(limits[m, r])
            for m, name in enumerate(names)
            for end, limits in bands.items()
        }
        for r in range(len(row_cycles))
    ]
    failed = sum(not sample for sample in samples)
    ended = sum(bool(sample) and bool(sample["cycles"][-1] < cycles) for sample in samples)
    return WearBands(inputs, len(samples), failed, ended, tuple(band_rows))


def check_samples(samples: int) -> None:
    """Check the number of samples of a wear simulation; 0: no bands."""
    if samples and not MIN_SAMPLES <= samples <= WEAR_BAND.max_samples:
        raise InputError(
            f"cannot be {samples}",
            "--samples",
            f"give a number from {MIN_SAMPLES} to {WEAR_BAND.max_samples}, or 0 for no bands",
        )
