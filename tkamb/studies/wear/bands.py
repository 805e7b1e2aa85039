"""Uncertainty of a worn volume: samples of the simulation, and bands of its rows.

Sampling, inputs and percentiles are those of `tkamb uncertainty`.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.scene.uncertainty import UncertaintyTable
from tkamb.run.guard import interrupt_as_such
from tkamb.run.recorder import Shard, Shards
from tkamb.run.results import STATISTICS_LIMITS
from tkamb.run.workers import Numbered, PoolOptions, Task
from tkamb.studies.uncertainty.bands import percentiles
from tkamb.studies.uncertainty.correlation import correlation_root
from tkamb.studies.uncertainty.inputs import VariedInput
from tkamb.studies.uncertainty.sampling import normal_samples
from tkamb.studies.wear.sample import BANDED, Rows, WearSampler, varied_wear_inputs
from tkamb.studies.wear.setup import WearSetup
from tkamb.studies.wear.simulation import WearCase


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
        failed: of them found no contact before the first cycle; they are in no band.
        ended: of them ended before the last cycle; they are in no band after it.
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
        inputs: that vary.
        root: (d, d) makes independent errors correlated, see
        `tkamb.studies.uncertainty.correlation`.
        samples: how many.
        seed: of all draws.
        constant_share: of a pose error's variance.
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
            rows: of that case.
            crew: who computes; default: this process.
            shards: where samples are kept.
            progress: wraps the samples as they come.

        Raises:
            KeyboardInterrupt: saying how many samples are kept.
        """
        count = self.samples
        normal = normal_samples("lhs", count, len(self.inputs), self.seed) @ self.root.T
        shard_of = {n: shards.get(n) for n in range(count)} if shards and shards.resumed else {}
        done: dict[int, Rows] = {n: shard.contact or {} for n, shard in shard_of.items() if shard}
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
            what = f"{len(done)} of {count} samples are kept; go on with --resume"
            raise KeyboardInterrupt(what) from None
        return _bands(self.inputs, [done[n] for n in range(count)], rows, simulation[1])


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
