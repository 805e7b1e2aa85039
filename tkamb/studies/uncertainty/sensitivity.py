"""Sensitivity of the results to the inputs: Sobol' indices, and screening.

Indices come from Saltelli's design. Screening changes one input at a time by one standard deviation
up and down.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.io.scene import Scene
from tkamb.io.scene.case import load_case
from tkamb.run.results import STATISTICS_LIMITS
from tkamb.run.simulation import chosen_frames
from tkamb.run.workers import PoolOptions, Progress, Task
from tkamb.studies.uncertainty.bands import varies
from tkamb.studies.uncertainty.inputs import VariedInput, varied_inputs
from tkamb.studies.uncertainty.sample import Sample, Sampler
from tkamb.studies.uncertainty.sampling import one_at_a_time

RESAMPLED = 200
"""Bootstrap samples for the standard errors."""


@dataclass(frozen=True)
class SobolIndex:
    """Share of an input in a result's variance.

    Args:
        result: column of results.csv.
        name: of the input.
        first: by itself: Var(E(y | x_i)) / Var(y).
        first_error: its standard error.
        total: with all its interactions: E(Var(y | all but x_i)) / Var(y).
        total_error: its standard error.
        rows: of the design in which every needed sample has a number.
    """

    result: str
    name: str
    first: float
    first_error: float
    total: float
    total_error: float
    rows: int


def sobol_indices(
    results: Sequence[str], inputs: Sequence[str], values: Array, count: int, seed: int
) -> list[SobolIndex]:
    """Return the indices of every input on every result, largest total first.

    With y_A, y_B and y_AB the results at A, at B, and at A with the input's column from B, less
    their mean, sums over the rows of the design:

        first = sum y_B (y_AB - y_A) / sum y²      (Saltelli et al. 2010)
        total = sum (y_A - y_AB)² / (2 sum y²)     (Jansen 1999)

    sum y² the mean over A and B. Of a result with many frames, numerators and denominators are
    summed over the frames (Gamboa et al. 2014): a frame counts with its variance. Rows where a
    needed sample failed are left out; the indices are then those among possible poses. Standard
    errors by bootstrap over the rows. A result without variance, or of fewer than
    `STATISTICS_LIMITS.min_samples` rows, has none.

    Args:
        results: (m,) names.
        inputs: (d,) names.
        values: (n (d + 2), m, f) in the order of
        `tkamb.studies.uncertainty.sampling.crossed_points`.
        count: n.
        seed: of the bootstrap.

    References:
        Saltelli et al., Comput Phys Commun 181:259 (2010), doi:10.1016/j.cpc.2009.09.018;
        Jansen, Comput Phys Commun 117:35 (1999), doi:10.1016/S0010-4655(98)00154-4;
        Gamboa, Janon, Klein & Lagnoux, Electron J Stat 8:575 (2014), doi:10.1214/14-EJS895.
    """
    indices: list[SobolIndex] = []
    picks = np.random.default_rng([seed, count]).integers(0, count, (RESAMPLED, count))
    weights = np.stack([np.bincount(pick, minlength=count) for pick in picks]).astype(float)
    weights = np.vstack([np.ones(count), weights])
    for m, result in enumerate(results):
        blocks = values[:, m].reshape(len(inputs) + 2, count, -1)
        rows = [
            row
            for i, name in enumerate(inputs)
            if (row := _index(result, name, blocks[0], blocks[1], blocks[2 + i], weights))
        ]
        indices += sorted(rows, key=lambda one: -one.total)
    return indices


def _index(
    result: str, name: str, a: Array, b: Array, crossed: Array, weights: Array
) -> SobolIndex | None:
    """Return one input's indices from (n, f) values; None where nothing can be said."""
    finite = np.isfinite(a) & np.isfinite(b) & np.isfinite(crossed)
    enough = finite.sum(axis=0) >= STATISTICS_LIMITS.min_samples
    if not enough.any():
        return None
    finite = finite[:, enough]
    square = np.where(finite, 0.5 * (a[:, enough] ** 2 + b[:, enough] ** 2), 0.0).sum()
    middle = np.where(finite, a[:, enough] + b[:, enough], 0.0).sum(axis=0) / (
        2 * finite.sum(axis=0)
    )
    a, b, crossed = (np.where(finite, one[:, enough] - middle, 0.0) for one in (a, b, crossed))
    variance = weights @ (0.5 * (a**2 + b**2)).sum(axis=1)
    if not varies(variance[0], square):
        return None
    first = weights @ (b * (crossed - a)).sum(axis=1) / variance
    total = weights @ (0.5 * (a - crossed) ** 2).sum(axis=1) / variance
    return SobolIndex(
        result,
        name,
        float(first[0]),
        float(first[1:].std(ddof=1)),
        float(total[0]),
        float(total[1:].std(ddof=1)),
        int(finite.any(axis=1).sum()),
    )


SCREENED = (
    *("force_total_BW", "medial_force_N", "lateral_force_N", "medial_peak_pressure_MPa"),
    *("lateral_peak_pressure_MPa", "quadriceps_N"),
)


@dataclass(frozen=True)
class ScreeningSettings:
    """What a screening prints."""

    least_share: float = 0.01
    """Share of the largest change of a result; inputs that change it less are only counted."""


SCREENING = ScreeningSettings()


@dataclass(frozen=True)
class Screened:
    """Effect of one input on one result at the frame where the result is largest.

    Args:
        result: column of results.csv.
        nominal: its largest value, of the scene as it stands.
        flexion: deg, where that is.
        varied: the input.
        minus: change of the result there by minus one deviation; NaN where the frame failed.
        plus: likewise by plus one.
    """

    result: str
    nominal: float
    flexion: float
    varied: VariedInput
    minus: float
    plus: float

    @property
    def slope(self) -> float:
        """Central difference: change per deviation."""
        return 0.5 * (self.plus - self.minus)


def screen(
    scene: Scene,
    *,
    frames: slice | None = None,
    crew: PoolOptions | None = None,
    progress: Progress = lambda samples, count: samples,
) -> list[Screened]:
    """Move one input at a time by one standard deviation and return what that changes.

    2 d + 1 samples of d inputs. A pose is moved as a whole, without noise per frame. Interactions
    of inputs do not show; `estimate_uncertainty` includes them.

    Args:
        scene: the scene.
        frames: which frames; default all.
        crew: who computes; default: this process.
        progress: wraps the samples as they come.

    Returns:
        Of each result the inputs, largest change first. A result that the scene does not model
        or that failed in every frame as it stands is left out.

    Raises:
        InputError: bad input.
        ComputationError: a worker ended before its sample.
    """
    crew = crew or PoolOptions()
    crew.check()
    case = load_case(scene)
    chosen = chosen_frames(frames, len(case.motion.time))
    inputs = varied_inputs(case)
    task = Task(Sampler, (scene, chosen, ("flexion_deg", *SCREENED)))
    points = list(enumerate(one_at_a_time(len(inputs))))
    answers = crew.answers(task, points)
    samples: dict[int, Sample] = dict(progress(answers, len(points)))
    values = np.array([samples[n].values for n in range(len(points))])
    screened: list[Screened] = []
    for m, result in enumerate(SCREENED, start=1):
        if np.isfinite(values[0, m]).any():
            frame = int(np.nanargmax(values[0, m]))
            screened += _of_result(result, values[:, m, frame], values[0, 0, frame], inputs)
    return screened


def _of_result(
    result: str, values: Array, flexion: float, inputs: Sequence[VariedInput]
) -> list[Screened]:
    """Return the inputs' changes of a result at a frame (1 + 2 d,), the largest first."""
    changes = values[1:] - values[0]
    rows = [
        Screened(result, float(values[0]), float(flexion), one, float(minus), float(plus))
        for one, (minus, plus) in zip(inputs, changes.reshape(-1, 2), strict=True)
    ]
    # An input that makes the frame fail counts as the largest change.
    return sorted(
        rows, key=lambda row: -max(np.nan_to_num(abs(np.array([row.minus, row.plus])), nan=np.inf))
    )


def screen_lines(rows: Sequence[Screened], width: int = 20) -> list[str]:
    """Return the tornado as text: a bar either way per input that moves the result notably.

    Inputs that move it by less than `SCREENING.least_share` of the largest change are counted.

    Args:
        rows: of `screen`.
        width: of a bar, characters.
    """
    lines: list[str] = []
    names = max((len(_named(row)) for row in rows), default=0)
    for result in dict.fromkeys(row.result for row in rows):
        own = [row for row in rows if row.result == result]
        lines.append(f"{result}: {own[0].nominal:.4g} at {own[0].flexion:.0f} deg")
        sizes = np.abs([[row.minus, row.plus] for row in own])
        largest = np.nanmax(sizes) if np.isfinite(sizes).any() else 0.0
        # an input whose frame failed is NaN here, and not below
        small = (sizes < SCREENING.least_share * largest).all(axis=1) | (sizes == 0.0).all(axis=1)
        for row in (row for row, hidden in zip(own, small, strict=True) if not hidden):
            bar = _bar(row, largest, width)
            lines.append(
                f"  {_named(row):<{names}} {_change(row.minus)} {_change(row.plus)}  {bar}"
            )
        if small.any():
            share = f"{SCREENING.least_share:.0%}"
            lines.append(
                f"  {small.sum()} more inputs: each less than {share} of the largest change"
            )
    if any(not np.isfinite([row.minus, row.plus]).all() for row in rows):
        lines.append(
            "failed: with this error of the input the frame has no result, often because no load "
            "balances the pose; the change is not known, so the input is listed first"
        )
    return lines


def _named(row: Screened) -> str:
    unit = "" if row.varied.unit == "1" else f" {row.varied.unit}"
    return f"{row.varied.name} ± {row.varied.deviation:g}{unit}"


def _change(value: float) -> str:
    return f"{value:>+10.4g}" if np.isfinite(value) else f"{'failed':>10}"


def _bar(row: Screened, largest: float, width: int) -> str:
    """Return the bar to both sides of the nominal value."""
    changes = [one for one in (row.minus, row.plus) if np.isfinite(one)]
    scale = width / largest if largest > 0 else 0.0
    below, above = (round(scale * max([0.0, *(sign * c for c in changes)])) for sign in (-1, 1))
    return f"{'#' * below:>{width}}|{'#' * above}".rstrip()
