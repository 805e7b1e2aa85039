"""Screening of the inputs: one input at a time, changed by one standard deviation either way."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.io.scene import Scene
from tkamb.io.scene.case import load_case
from tkamb.run.simulation import chosen_frames
from tkamb.run.workers import PoolOptions, Progress, Task
from tkamb.studies.uncertainty.inputs import VariedInput, varied_inputs
from tkamb.studies.uncertainty.sample import Sample, Sampler
from tkamb.studies.uncertainty.sampling import one_at_a_time

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
