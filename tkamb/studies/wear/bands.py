"""Uncertainty of a worn volume: samples of the simulation, and bands of its rows.

Sampling, inputs and percentiles are those of `tkamb uncertainty`. These inputs vary: the wear
factor, the constants of creep, the modulus of the insert, and the place of the whole cycle (the
constant part of each pose error). Noise that differs from frame to frame averages out over millions
of cycles. Loads do not vary.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_coordinates, knee_pose
from tkamb.io.scene.uncertainty import UncertaintyTable
from tkamb.run.guard import interrupt_as_such
from tkamb.run.recorder import Shard, Shards, have
from tkamb.run.results import STATISTICS_LIMITS
from tkamb.run.workers import Numbered, PoolOptions, Task
from tkamb.studies.uncertainty.bands import percentiles
from tkamb.studies.uncertainty.inputs import Draw, VariedInput
from tkamb.studies.uncertainty.sampling import correlation_root, normal_samples
from tkamb.studies.wear.engine import ContactEngine
from tkamb.studies.wear.laws import WearLaw
from tkamb.studies.wear.materials import LogarithmicCreep
from tkamb.studies.wear.motion import CycleMotion
from tkamb.studies.wear.setup import WearSetup
from tkamb.studies.wear.simulation import WearCase, simulate_wear
from tkamb.studies.wear.sliding import SlidingHistory

BANDED = ("volume_mm3", "mass_mg", "max_depth_mm", "creep_depth_mm", "creep_volume_mm3")
"""Columns of wear.csv that have a band."""
POSES = {"ap": "mm", "ml": "mm", "adduction": "deg", "axial_rotation": "deg", "flexion": "deg"}
"""Knee coordinates that a pressed motion prescribes."""

Rows = Mapping[str, Array]


@dataclass(frozen=True)
class Scaled(WearLaw):
    """Another law times a factor.

    Args:
        law: wear law.
        factor: factor on every depth.
    """

    name: ClassVar[str] = "scaled"
    assumes: ClassVar[str] = "another law times a factor"

    law: WearLaw
    factor: float

    def depth(self, history: SlidingHistory) -> Array:
        """Return the depth of the other law times the factor, (n,) m."""
        return self.factor * self.law.depth(history)


def varied_wear_inputs(
    table: UncertaintyTable, motion: CycleMotion, creep: LogarithmicCreep | None, profile: bool
) -> tuple[VariedInput, ...]:
    """Return the inputs of a wear simulation that vary.

    Args:
        table: the scene's [uncertainty].
        motion: what its drive finds has no error of its own.
        creep: None: not modelled.
        profile: the motion is a simulator's. Its place varies only by what the table states: the
            defaults are those of a recorded pose.

    Raises:
        InputError: none varies.
    """
    result = () if motion.drive is None else motion.drive.names
    if not profile:
        table = table.completed(from_markers=False)
    inputs = [
        VariedInput(name, getattr(table, f"{name}_{unit}"), unit)
        for name, unit in POSES.items()
        if name not in result and getattr(table, f"{name}_{unit}") is not None
    ]
    inputs.append(VariedInput("young_modulus", table.young_modulus, "relative"))
    inputs.append(VariedInput("wear_factor", table.wear_factor, "relative"))
    if creep is not None:
        inputs.append(VariedInput("creep", table.creep, "relative"))
    varied = tuple(one for one in inputs if one.deviation > 0)
    if not varied:
        raise InputError("nothing of a wear simulation varies", "[uncertainty]", "--samples 0")
    return varied


def moved_case(case: WearCase, draw: Draw) -> WearCase:
    """Return a case with its inputs moved as a sample has them."""
    place = [draw.error(name) if name in POSES else 0.0 for name in KNEE_COORDINATES]
    offset = math.sqrt(draw.constant_share) * np.array(place)
    motion, drive, engine, creep = case.motion, case.motion.drive, case.engine, case.creep
    if offset.any():
        poses = knee_pose(knee_coordinates(motion.poses) + offset)
        if drive is not None:
            drive = replace(drive, coordinates=drive.coordinates + offset)
        path = motion.path
        if path is not None:
            path = path._replace(poses=knee_pose(knee_coordinates(path.poses) + offset))
        motion = replace(motion, poses=poses, path=path, drive=drive)
    if (stiffer := draw.factor("young_modulus")) != 1.0:
        assert isinstance(engine, ContactEngine)
        material = engine.material
        material = replace(material, young_modulus=material.young_modulus * stiffer)
        engine = replace(engine, material=material)
    if creep is not None:
        creep = creep.times(draw.factor("creep"))
    law = Scaled(case.law, draw.factor("wear_factor"))
    return replace(case, engine=engine, motion=motion, law=law, creep=creep)


class WearSampler:
    """Computes samples of one wear simulation.

    Args:
        simulation: the case as it stands, cycles, and updates of the geometry.
        inputs: inputs that vary.
        constant_share: share of a pose error's variance that is the same in all frames.
    """

    def __init__(
        self,
        simulation: tuple[WearCase, int, int],
        inputs: tuple[VariedInput, ...],
        constant_share: float,
    ) -> None:
        self._simulation, self._inputs, self._share = simulation, inputs, constant_share

    def __call__(self, number: int, normal: Array) -> Rows:
        """Return the columns of a sample's table; none where it has no contact.

        Args:
            number: number of the sample; it does not change the sample.
            normal: (d,) errors of the inputs in standard deviations.
        """
        case, cycles, updates = self._simulation
        draw = Draw(self._inputs, normal, np.zeros((1, 0)), self._share)
        try:
            state, _ = simulate_wear(moved_case(case, draw), cycles, updates)
        except InputError:  # the displaced femur lies beside the insert
            return {}
        return {key: np.array([row[key] for row in state.rows]) for key in ("cycles", *BANDED)}


@dataclass(frozen=True)
class WearBandSettings:
    """Bands of wear from samples."""

    samples: int = 32
    """Number of samples unless the user asks for another. Chosen: the 5th and 95th percentiles are
    then inside the sample."""
    max_samples: int = 10_000
    """Largest number of samples that is accepted. Chosen: more take too long."""


WEAR_BAND = WearBandSettings()

SAID = (
    ("volume_mm3", "volume", "mm3"),
    ("max_depth_mm", "depth", "mm"),
    ("creep_depth_mm", "creep", "mm"),
)
"""Column, word and unit of the bands that are printed."""
NOT_VARIED = (
    "loads, what of a pose's error differs from frame to frame, the law's form and its cross-shear "
    "and pressure dependence, friction, the insert's shape, and the contact model's own error"
)

Progress = Callable[[Iterable[Numbered], int], Iterable[Numbered]]


@dataclass(frozen=True, eq=False)
class WearBands:
    """5 to 95 % of the samples, and their median.

    Args:
        varied: what varied, by how much.
        samples: how many.
        failed: number of samples without contact before the first cycle; they are in no band.
        ended: number of samples that ended before the last cycle; they are in no later band.
        rows: one per row of the table, "<column>_p05", "_p50" and "_p95"; NaN: too few samples.
    """

    varied: tuple[VariedInput, ...]
    samples: int
    failed: int
    ended: int
    rows: tuple[dict[str, float], ...]

    def as_dict(self) -> dict[str, Any]:
        """Return what varied, and the bands after the last cycle."""
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
        for name, what, unit in SAID:
            low, high = last.get(f"{name}_p05", math.nan), last.get(f"{name}_p95", math.nan)
            if math.isfinite(low):
                result.append(f"{what} {low:.4g} to {high:.4g} {unit}")
        varied = ", ".join(f"{v.name} ± {v.deviation:g} {v.unit}" for v in self.varied)
        text = ", ".join(result) or "too few samples for a band"
        return [f"5 to 95 % of {self.samples} samples: {text}; varied: {varied}"]

    def questions(self) -> list[str]:
        """Return what a reader must know before using the bands."""
        questions = []
        if self.failed:
            questions.append(f"{self.failed} of {self.samples} samples have no contact: in no band")
        if self.ended:
            questions.append(
                f"{self.ended} of {self.samples} samples wore through or lost their contact: from "
                "there on the bands are those of the others"
            )
        return questions


@dataclass(frozen=True)
class Sampling:
    """The samples of a simulation; sample n does not depend on their number or on the worker.

    Args:
        inputs: inputs that vary.
        root: (d, d) makes independent errors correlated, see
        `tkamb.studies.uncertainty.sampling`.
        samples: how many.
        seed: seed of all draws.
        constant_share: share of a pose error's variance that is the same in all frames.
    """

    inputs: tuple[VariedInput, ...]
    root: Array
    samples: int
    seed: int
    constant_share: float

    @classmethod
    def of(cls, setup: WearSetup, case: WearCase, samples: int) -> "Sampling":
        """Return the samples that a scene's [uncertainty], or its defaults, ask for.

        Raises:
            InputError: nothing varies, or inputs cannot err together so.
        """
        table = setup.uncertainty or UncertaintyTable()
        inputs = varied_wear_inputs(table, case.motion, case.creep, setup.simulated)
        names = [one.name for one in inputs]
        pairs = [one for one in table.correlation if set(one.between) <= set(names)]
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
        """Simulate with varied inputs and return bands at the rows of a table.

        Args:
            simulation: the case as given, cycles, and updates of the geometry.
            rows: rows of the table of the case as given.
            crew: who computes; default: this process.
            shards: where samples are kept.
            progress: wraps the samples as they come.

        Raises:
            KeyboardInterrupt: saying how many samples are kept.
        """
        count = self.samples
        normal = normal_samples("lhs", count, len(self.inputs), self.seed) @ self.root.T
        done: dict[int, Rows] = {}
        for n in range(count) if shards and shards.resumed else ():
            if shards and (shard := shards.get(n, _is_sample)):
                done[n] = shard.contact or {}
        remaining = [(n, normal[n]) for n in range(count) if n not in done]
        task = Task(WearSampler, (simulation, self.inputs, self.constant_share))
        try:
            with interrupt_as_such():
                for number, sample in progress(
                    (crew or PoolOptions()).answers(task, remaining), len(remaining)
                ):
                    done[number] = sample
                    if shards is not None:
                        shards.put(number, Shard({}, dict(sample)))
        except KeyboardInterrupt:
            if shards is None or not done:
                raise
            what = f"{len(done)} of {count} samples are kept; go on with resume=True"
            raise KeyboardInterrupt(what) from None
        return _bands(self.inputs, [done[n] for n in range(count)], rows, simulation[1])


def _is_sample(shard: Shard) -> bool:
    """Return whether a kept shard has the columns that a `WearSampler` returns."""
    columns = shard.contact or {}
    if not columns:
        return True
    rows = columns["cycles"].size if "cycles" in columns else 0
    if not rows or not have(columns, dict.fromkeys(("cycles", *BANDED), ("f", (rows,)))):
        return False
    cycles = columns["cycles"]
    finite = np.isfinite(cycles).all() and np.isfinite(columns["volume_mm3"]).all()
    return bool(finite and (np.diff(cycles) >= 0).all())


def _bands(
    inputs: tuple[VariedInput, ...],
    samples: Sequence[Rows],
    rows: Sequence[Mapping[str, float]],
    cycles: int,
) -> WearBands:
    """Return bands at the table's cycles; between the blocks of a sample its columns are linear."""
    names = [name for name in BANDED if np.isfinite(rows[-1][name])]
    at = np.array([row["cycles"] for row in rows])
    values = np.full((len(samples), len(names), len(at)), np.nan)
    for sample, result in zip(samples, values, strict=True):
        for column, name in zip(result, names, strict=True):
            if sample:
                column[:] = np.interp(at, sample["cycles"], sample[name], right=np.nan)
    bands = percentiles(values, np.isnan(values[:, 0]))
    made = [
        {
            f"{name}_{end}": float(result[m, r])
            for m, name in enumerate(names)
            for end, result in bands.items()
        }
        for r in range(len(at))
    ]
    failed = sum(not sample for sample in samples)
    ended = sum(bool(sample) and bool(sample["cycles"][-1] < cycles) for sample in samples)
    return WearBands(inputs, len(samples), failed, ended, tuple(made))


def check_samples(samples: int) -> None:
    """Raise an InputError for a number of samples that gives no band; 0: none is wanted."""
    if samples and not STATISTICS_LIMITS.min_samples <= samples <= WEAR_BAND.max_samples:
        hint = "or 0, for no bands"
        raise InputError(
            f"{samples} is not within {STATISTICS_LIMITS.min_samples} to {WEAR_BAND.max_samples}",
            "--samples",
            hint,
        )
