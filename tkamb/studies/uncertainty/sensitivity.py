"""Sensitivity of the results to the inputs: Sobol' indices by Saltelli's design, and screening by
one input at a time, plus and minus one standard deviation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.io.scene import Scene
from tkamb.io.scene.case import load_case
from tkamb.run.results import MIN_SAMPLES
from tkamb.run.simulation import chosen_frames
from tkamb.run.workers import PoolOptions, Progress, Task
from tkamb.studies.uncertainty.bands import varies
from tkamb.studies.uncertainty.inputs import VariedInput, one_at_a_time, varied_inputs
from tkamb.studies.uncertainty.sample import Sample, Sampler

RESAMPLED = 200
"""Number of bootstrap samples for the standard errors."""


@dataclass(frozen=True)
class SobolIndex:
    """Share of an input in the variance of a result.

    Args:
        first: first-order index, the share of the input alone: Var(E(y | x_i)) / Var(y).
        total: total index, which includes all interactions: E(Var(y | all but x_i)) / Var(y). Both
            have standard errors.
        rows: number of rows of the design that were used.
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
    """Return the indices of every input for every result, with the largest total index first.

    y_A and y_B are the results at A and B, and y_AB those at A with the column of the input from B.
    The mean of y_A and y_B is subtracted from all. With sums over the rows the indices are

        first = sum y_B (y_AB - y_A) / sum y²      (Saltelli et al. 2010)
        total = sum (y_A - y_AB)² / (2 sum y²)     (Jansen 1999)

    where sum y² is the mean over A and B. Numerators and denominators are summed over the frames
    (Gamboa et al. 2014). Rows with a failed sample are omitted. Standard errors come from a
    bootstrap over the rows. A result has no indices if it does not vary, or if fewer than
    `MIN_SAMPLES` rows remain.

    Args:
        results: names of the m results.
        values: values of the samples, (n (d + 2), m, f), in the order of
            `tkamb.studies.uncertainty.inputs.crossed_points`.
        count: number n of rows of the design.

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
        indices += sorted(rows, key=lambda row: -row.total)
    return indices


def _index(
    result: str, name: str, a: Array, b: Array, crossed: Array, weights: Array
) -> SobolIndex | None:
    finite = np.isfinite(a) & np.isfinite(b) & np.isfinite(crossed)
    enough = finite.sum(axis=0) >= MIN_SAMPLES
    if not enough.any():
        return None
    finite = finite[:, enough]
    square = np.where(finite, 0.5 * (a[:, enough] ** 2 + b[:, enough] ** 2), 0.0).sum()
    middle = np.where(finite, a[:, enough] + b[:, enough], 0.0).sum(axis=0) / (
        2 * finite.sum(axis=0)
    )
    a, b, crossed = (np.where(finite, y[:, enough] - middle, 0.0) for y in (a, b, crossed))
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


# Share of the largest change of a result. Inputs with smaller changes are counted, but not listed.
LEAST_SHARE = 0.01


@dataclass(frozen=True)
class Screened:
    """Effect of one input on one result at the frame where the result is largest.

    Args:
        nominal: largest nominal value of the result.
        flexion: flexion of the frame with this value, deg.
        minus: change at this frame for minus one standard deviation; NaN if the frame failed.
    """

    result: str
    nominal: float
    flexion: float
    varied: VariedInput
    minus: float
    plus: float

    @property
    def slope(self) -> float:
        """Change per standard deviation, from the central difference."""
        return 0.5 * (self.plus - self.minus)


def screen(
    scene: Scene,
    *,
    frames: slice | None = None,
    crew: PoolOptions | None = None,
    progress: Progress = lambda samples, count: samples,
) -> list[Screened]:
    """Vary one input at a time by one standard deviation and return the changes of the results.

    With d inputs 2 d + 1 samples are computed. Pose errors are constant over the frames.
    Interactions of inputs are not included; `estimate_uncertainty` includes them.

    Args:
        frames: slice of the frames; default: all.
        crew: worker pool settings; default: this process.
        progress: wrapper of the iterator of the finished samples.

    Returns:
        The inputs of each result, with the largest change first. A result without a nominal value
        in any frame is omitted.

    Raises:
        InputError: the input is invalid.
        ComputationError: a worker process ended during a sample.
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
    changes = values[1:] - values[0]
    rows = [
        Screened(result, float(values[0]), float(flexion), varied, float(minus), float(plus))
        for varied, (minus, plus) in zip(inputs, changes.reshape(-1, 2), strict=True)
    ]
    # An input that makes the frame fail counts as the largest change.
    return sorted(
        rows, key=lambda row: -max(np.nan_to_num(abs(np.array([row.minus, row.plus])), nan=np.inf))
    )


def screen_lines(rows: Sequence[Screened], width: int = 20) -> list[str]:
    """Return the lines of the printed tornado table, with a bar for each input.

    Inputs below `LEAST_SHARE` of the largest change are counted in one line. `rows` come from
    `screen`; the longest bar has `width` characters.
    """
    lines: list[str] = []
    names = max((len(_named(row)) for row in rows), default=0)
    for result in dict.fromkeys(row.result for row in rows):
        group = [row for row in rows if row.result == result]
        lines.append(f"{result}: {group[0].nominal:.4g} at {group[0].flexion:.0f} deg")
        sizes = np.abs([[row.minus, row.plus] for row in group])
        largest = np.nanmax(sizes) if np.isfinite(sizes).any() else 0.0
        # NaN of a failed frame is not small, so its input is listed
        small = (sizes < LEAST_SHARE * largest).all(axis=1) | (sizes == 0.0).all(axis=1)
        for row in (row for row, hidden in zip(group, small, strict=True) if not hidden):
            bar = _bar(row, largest, width)
            lines.append(
                f"  {_named(row):<{names}} {_change(row.minus)} {_change(row.plus)}  {bar}"
            )
        if small.any():
            share = f"{LEAST_SHARE:.0%}"
            lines.append(
                f"  {small.sum()} more inputs: each less than {share} of the largest change"
            )
    if any(not np.isfinite([row.minus, row.plus]).all() for row in rows):
        lines.append(
            "failed: with this error of the input the frame has no result, often because the pose "
            "has no equilibrium; the change is unknown, so the input is listed first"
        )
    return lines


def _named(row: Screened) -> str:
    unit = "" if row.varied.unit == "1" else f" {row.varied.unit}"
    return f"{row.varied.name} ± {row.varied.deviation:g}{unit}"


def _change(value: float) -> str:
    return f"{value:>+10.4g}" if np.isfinite(value) else f"{'failed':>10}"


def _bar(row: Screened, largest: float, width: int) -> str:
    changes = [change for change in (row.minus, row.plus) if np.isfinite(change)]
    scale = width / largest if largest > 0 else 0.0
    below, above = (round(scale * max([0.0, *(sign * c for c in changes)])) for sign in (-1, 1))
    return f"{'#' * below:>{width}}|{'#' * above}".rstrip()
