"""How far the method was off when it was compared with measured knees: the model discrepancy.

A measured force is the predicted one, with whatever its inputs err by, plus the discrepancy d of
what the model leaves out (Kennedy & O'Hagan 2001). Over the frames t of a trial of an activity

    d(t) = m + b + w(t),   m ~ (0, S²/2),   b ~ (0, S²/2),   w ~ AR(1) of variance V,

m is common to all trials of an activity, b to all frames of a trial, and w is correlated over a
time of some 0.1 s. S² is the mean square of the trials' biases, V the mean of their scatter's
squares. The trials are of one subject; what others add is not in them, so that published blind
predictions of other subjects count as one more trial in S². Variances from few trials are not
well known themselves: d is Student's t, with as many degrees of freedom as trials are in S².
With n trials of the activity and their mean bias B, m has the mean n B/(n + 1) and the
variance S²/2/(n + 1); with n = 0 the activity is like any other. Biases and scatters hold what
the inputs err by as well, so that the square of the inputs' deviation is taken off the variance.

Forces are in body weights, so that a trial says something of another subject.

Reference: Kennedy & O'Hagan, J R Stat Soc B 63:425 (2001), doi:10.1111/1467-9868.00294.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from tkamb.geometry.frames import Array

DATA = Path(__file__).with_suffix(".json")
FORCES = ("total", "medial", "lateral")
COLUMNS = {
    "force_si_N": "total",
    "force_total_N": "total",
    "force_total_BW": "total",
    "medial_force_N": "medial",
    "medial_force_equilibrium_N": "medial",
    "lateral_force_N": "lateral",
    "lateral_force_equilibrium_N": "lateral",
}
"""Column of results.csv -> the measured force that says how far it may be off."""


@dataclass(frozen=True)
class DiscrepancySettings:
    """How the discrepancy is fitted and added to the samples."""

    quantiles: int = 41
    """Values of Student's t that are added to each sample; more changes the ends of a band by less
    than 1 %."""
    published_total_BW: float = 0.43
    """BW: error of a published blind prediction of the total force in walking, 281 N (parametric
    model, third Grand Challenge, PMC3627216), over JW's weight."""
    published_medial_BW: float = 0.41
    """BW: likewise of the medial force: the middle of 229 to 312 N by the four winners of the
    Grand Challenges (Kinney et al. 2013, doi:10.1115/1.4023255)."""
    published_lateral_BW: float = 0.43
    """BW: likewise of the lateral force: the middle of 238 to 326 N."""
    fewest_frames: int = 5
    """Frames of a trial below which its bias and scatter say too little."""


DISCREPANCY = DiscrepancySettings()


@dataclass(frozen=True)
class TrialError:
    """How far the prediction of one force was off in one trial, measured minus predicted.

    Args:
        trial: name of the trial.
        subject: name of the subject.
        activity: as in [output] activity.
        force: total, medial or lateral.
        frames: how many are compared.
        bias_BW: mean over the frames.
        scatter_BW: standard deviation about it.
        inputs_BW: root mean square of the band of inputs' standard deviation.
        correlation_s: time over which the scatter's correlation falls to 1/e.
        nominal_rmse_BW: root mean square error of the run as the inputs stand.
        nominal_bias_BW: its mean error, predicted minus measured.
    """

    trial: str
    subject: str
    activity: str
    force: str
    frames: int
    bias_BW: float
    scatter_BW: float
    inputs_BW: float
    correlation_s: float
    nominal_rmse_BW: float
    nominal_bias_BW: float


@dataclass(frozen=True)
class Discrepancy:
    """What is to be added to the prediction of one force.

    Args:
        mean: of the discrepancy, body weights.
        deviation: its standard deviation without that of the inputs, body weights.
        freedom: degrees of freedom of Student's t.
        own_trials: of the activity.
        trials: of all activities.
    """

    mean: float
    deviation: float
    freedom: int
    own_trials: int
    trials: int


def trial_error(
    names: tuple[str, str, str, str],
    time: Array,
    samples: Array,
    measured: Array,
    nominal: Array,
    body_weight: float,
) -> TrialError | None:
    """Return how far samples with varied inputs are off in a trial; None: too few frames.

    Args:
        names: trial, subject, activity, force.
        time: (f,) s.
        samples: (n, f) N; NaN where a sample has none.
        measured: (f,) N; NaN where nothing was measured.
        nominal: (f,) N, of the run as the inputs stand.
        body_weight: N.
    """
    enough = np.isfinite(samples).sum(axis=0) > samples.shape[0] / 2
    both = enough & np.isfinite(measured) & np.isfinite(nominal)
    if both.sum() < DISCREPANCY.fewest_frames:
        return None
    chosen = samples[:, both] / body_weight
    error = measured[both] / body_weight - np.nanmedian(chosen, axis=0)
    own = (nominal - measured)[both] / body_weight
    return TrialError(
        *names,
        frames=int(both.sum()),
        bias_BW=float(error.mean()),
        scatter_BW=float(error.std()),
        inputs_BW=float(np.sqrt(np.nanvar(chosen, axis=0).mean())),
        correlation_s=_correlation_time(time[both], error - error.mean()),
        nominal_rmse_BW=float(np.sqrt((own**2).mean())),
        nominal_bias_BW=float(own.mean()),
    )


def _correlation_time(time: Array, scatter: Array) -> float:
    """Return the correlation time of an AR(1), by the correlation of neighbouring frames."""
    product = float(scatter[1:] @ scatter[:-1])
    rho = product / max(float(scatter[1:] @ scatter[1:]), np.finfo(float).tiny)
    step = float(np.median(np.diff(time)))
    return -step / float(np.log(np.clip(rho, 1e-3, 1.0 - 1e-3)))


def fitted(errors: Sequence[TrialError], force: str, activity: str | None) -> Discrepancy | None:
    """Return the discrepancy of a force in an activity; None: nothing was compared.

    Args:
        errors: of all trials that were compared.
        force: total, medial or lateral.
        activity: of the scene; None or one without a trial has no bias of its own.
    """
    chosen = [one for one in errors if one.force == force]
    if not chosen:
        return None
    own = [one.bias_BW for one in chosen if one.activity == activity]
    published = float(getattr(DISCREPANCY, f"published_{force}_BW"))
    offset = float(np.mean([published**2, *(one.bias_BW**2 for one in chosen)]))
    scatter = float(np.mean([one.scatter_BW**2 for one in chosen]))
    inputs = float(np.mean([one.inputs_BW**2 for one in chosen]))
    mean = sum(own) / (len(own) + 1)
    variance = offset / 2 * (1 + 1 / (len(own) + 1)) + scatter - inputs
    deviation = float(np.sqrt(max(0.0, variance)))
    return Discrepancy(mean, deviation, len(chosen) + 1, len(own), len(chosen))


def band_with_discrepancy(
    samples: Array,
    discrepancy: Discrepancy,
    body_weight: float,
    percents: Sequence[float] = (5.0, 95.0),
) -> Array:
    """Return the band of inputs and discrepancy together, (percents, f), of the samples' unit.

    Each sample stands for a distribution about itself. A force is never below zero.

    Args:
        samples: (n, f) NaN where a sample has no number.
        discrepancy: root mean square error of the method against measured knees.
        body_weight: in the samples' unit; 1 for body weights.
        percents: of the distribution below the ends of the band.
    """
    steps = (np.arange(DISCREPANCY.quantiles) + 0.5) / DISCREPANCY.quantiles
    added = (
        discrepancy.mean + discrepancy.deviation * stdtrit(discrepancy.freedom, steps)
    ) * body_weight
    spread = samples[:, None, :] + added[:, None]
    every = np.maximum(spread.reshape(-1, samples.shape[1]), 0.0)
    every[np.isnan(spread.reshape(-1, samples.shape[1]))] = np.nan
    ends = np.full((len(percents), samples.shape[1]), np.nan)
    finite = np.isfinite(every).any(axis=0)
    ends[:, finite] = np.nanpercentile(every[:, finite], list(percents), axis=0)
    return ends


def coverage(low: Array, high: Array, measured: Array) -> tuple[int, float]:
    """Return how many frames have a band and a measured force, and the share of them inside."""
    both = np.isfinite(low) & np.isfinite(high) & np.isfinite(measured)
    inside = (low <= measured) & (measured <= high)
    return int(both.sum()), float(inside[both].mean()) if both.any() else float("nan")


@lru_cache(maxsize=1)
def known_errors() -> tuple[TrialError, ...]:
    """Return the errors of all trials that were compared, as the package holds them."""
    return tuple(TrialError(**row) for row in json.loads(DATA.read_text(encoding="utf-8")))


def write_errors(errors: Sequence[TrialError], path: Path = DATA) -> None:
    """Write the errors of all trials that were compared."""
    rows = [
        {key: round(v, 4) if isinstance(v, float) else v for key, v in asdict(one).items()}
        for one in errors
    ]
    path.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def discrepancy_of(summary: Mapping[str, Any]) -> dict[str, Discrepancy]:
    """Return force -> discrepancy of a run, by its activity; empty without [muscles].

    What was compared are runs with all muscles: of others nothing is known.
    """
    if "muscles" not in (summary.get("scene_tables") or {}):
        return {}
    every = {force: fitted(known_errors(), force, summary.get("activity")) for force in FORCES}
    return {force: one for force, one in every.items() if one is not None}


def discrepancy_summary(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the summary's key `discrepancy`: numbers per force, and all that in words."""
    discrepancy = discrepancy_of(summary)
    return {
        "forces": {force: asdict(one) for force, one in discrepancy.items()},
        "trials": [one.trial for one in known_errors() if one.force == FORCES[0]],
        "rmse_BW": rms_error(known_errors(), FORCES[0], summary.get("activity")),
        "subjects": len({one.subject for one in known_errors()}),
        "words": discrepancy_words(summary),
    }


def _of_activity(errors: Sequence[TrialError], activity: str | None) -> Sequence[TrialError]:
    """Return the trials of an activity; of one that was not compared, all."""
    return [one for one in errors if one.activity == activity] or errors


def rms_error(errors: Sequence[TrialError], force: str, activity: str | None) -> float:
    """Return the root mean square over trials of the nominal runs' errors (body weights)."""
    rms = [one.nominal_rmse_BW for one in _of_activity(errors, activity) if one.force == force]
    return float(np.sqrt(np.mean(np.square(rms))))


def discrepancy_words(summary: Mapping[str, Any]) -> str:
    """Return in a sentence how far the method was off when it was compared with measured knees."""
    errors, activity = known_errors(), summary.get("activity")
    own = _of_activity(errors, activity)
    of_what = f"in {activity}" if any(one.activity == activity for one in errors) else "in all"
    parts = []
    for force in FORCES:
        if any(one.force == force for one in own):
            parts.append(f"{rms_error(errors, force, activity):.2f} BW ({force})")
    trials = len({one.trial for one in own})
    subjects = len({one.subject for one in own})
    words = (
        f"when this method was compared with measured knees, it was off by {', '.join(parts)} RMS "
        f"{of_what}: {trials} trial{'s' * (trials != 1)}, "
        f"{subjects} subject{'s' * (subjects != 1)}"
    )
    if "muscles" in (summary.get("scene_tables") or {}):
        return words
    return f"{words}; those runs had all muscles, so of this run, without [muscles], it says less"
