"""Model discrepancy: the error of the method against measured knees, beyond its inputs.

A measured force is the predicted force, with the errors of its inputs, plus the discrepancy of the
model (Kennedy & O'Hagan 2001). Errors of lever arms, of co-contraction and of the medial-lateral
split are proportional to the load of the knee. The discrepancy of the total, medial and lateral
force is therefore d(t) G(t), with the total force F(t) in body weights and

    G = sqrt(F² + F0²),   d(t) = m + b + w(t),

    m ~ (0, S²/2),   b ~ (0, S²/2),   w ~ AR(1) of variance V

over the frames t of a trial of an activity.

m is common to all trials of an activity, b to all frames of a trial. w is correlated over about 0.1
s. S² is the mean square of the trials' biases, V the mean square of their scatters, over the trials
of the activity or, if it has none, over all trials. All trials are of one subject. To include the
differences between subjects, a published blind prediction of others counts as one more trial. Its
root mean square error in body weights is divided by G of walking. The square, bias² + scatter², is
split into S² and V in the ratio of the trials.

With n trials of the activity and their mean bias B, m has the mean n B/(n + 1) and the variance
S²/2/(n + 1). Then d has the variance

    A + V,   A = S²/2 (1 + 1/(n + 1)).

Variances from few trials are uncertain, so d follows Student's t distribution. A + V is a mean
over the trials i, with the terms A_i + V_i, and the published prediction, with the term T. A_i
has one degree of freedom, V_i the number ν_i of independent frames, and T the number n_T of
published errors. By Welch and Satterthwaite,

    ν = (T + Σ (A_i + V_i))² / (T²/n_T + Σ (A_i² + V_i²/ν_i)).

Biases and scatters include the errors of the inputs, whose variance is therefore subtracted from
that of d.

References: Kennedy & O'Hagan, J R Stat Soc B 63:425 (2001), doi:10.1111/1467-9868.00294;
Satterthwaite, Biometrics Bull 2:110 (1946), doi:10.2307/3002019; independent frames of an AR(1):
Bayley & Hammersley, Suppl J R Stat Soc 8:184 (1946), doi:10.2307/2983560.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import stdtrit

from tkamb.geometry.frames import Array
from tkamb.run.claims import FORCES, method_error

DATA = Path(__file__).with_suffix(".json")
QUANTILE_METHOD: Final = "weibull"
"""Quantile method of NumPy: the p quantile of n samples has rank p (n + 1)."""
COLUMNS = {
    "force_si_N": "total",
    "force_total_N": "total",
    "force_total_BW": "total",
    "medial_force_N": "medial",
    "medial_force_equilibrium_N": "medial",
    "lateral_force_N": "lateral",
    "lateral_force_equilibrium_N": "lateral",
}
"""Column of results.csv -> force whose discrepancy applies to it."""


# 1: numbers of quantiles that represent Student's t and the samples. More change the ends of a band
# by less than 1 %.
QUANTILES = 201
SAMPLE_QUANTILES = 60
# BW: F0, the load below which errors do not become smaller. The likelihood of the errors of open
# trials is flat from 0.3 to 0.5 BW.
LEAST_LOAD_BW = 0.5
# BW: root mean square of G over a gait cycle. It converts published errors in walking to shares of
# the load. Subject JW's measured trials og1 and og3 have 1.62 and 1.65.
WALKING_LOAD_BW = 1.6
# Least number of frames of a trial. A standard deviation of fewer values is uncertain by more than
# a third.
FEWEST_FRAMES = 5
PUBLISHED = {"total": (0.43, 1), "medial": (0.41, 4), "lateral": (0.43, 4)}
"""Force -> published root mean square error in walking (BW), and the number of published errors.

Total: a blind prediction, 281 N (parametric model, third Grand Challenge, PMC3627216), divided by
JW's weight. Medial and lateral: the middle of 229 to 312 N and of 238 to 326 N by the four winners
of the Grand Challenges (Kinney et al. 2013, doi:10.1115/1.4023255).
"""


@dataclass(frozen=True)
class TrialError:
    """Error of one predicted force in one trial: measured minus predicted, as a share of the load
    G.

    Args:
        inputs: root mean square over the frames of the standard deviation due to the inputs, as a
            share of G.
        correlation_s: time in which the autocorrelation of the error falls to 1/e, s.
    """

    trial: str
    subject: str
    activity: str
    force: str
    frames: int
    bias: float
    scatter: float
    independent_frames: float
    inputs: float
    correlation_s: float


@dataclass(frozen=True)
class Discrepancy:
    """Distribution of the discrepancy of one force.

    Args:
        deviation: scale of Student's t, as a share of G; the variance due to the inputs is
            subtracted.
        freedom: degrees of freedom of Student's t, in general not an integer.
    """

    mean: float
    deviation: float
    freedom: float
    own_trials: int
    trials: int


def load_of(total: Array, body_weight: float) -> Array:
    """Return the load G (f,) of which the discrepancy is a share, in the total's unit.

    Args:
        total: total force of each sample, (n, f); NaN in failed frames.
    """
    load = np.full(total.shape[1], np.nan)
    finite = np.isfinite(total).any(axis=0)
    load[finite] = np.nanmedian(total[:, finite], axis=0)
    return np.hypot(load, LEAST_LOAD_BW * body_weight)


def trial_error(
    names: tuple[str, str, str, str],
    time: Array,
    samples: Array,
    measured: Array,
    nominal: Array,
    load: Array,
) -> TrialError | None:
    """Return the error of a predicted force in a trial; None: too few frames.

    Args:
        time: times, s, (f,).
        samples: force with varied inputs, N, (n, f); NaN in failed frames.
        measured: force, N, (f,); NaN without a measurement.
        nominal: force of the nominal run, N, (f,).
        load: load G from `load_of`, N, (f,).
    """
    enough = np.isfinite(samples).sum(axis=0) > samples.shape[0] / 2
    compared = enough & np.isfinite(measured) & np.isfinite(nominal)
    if compared.sum() < FEWEST_FRAMES:
        return None
    shares = samples[:, compared] / load[compared]
    error = measured[compared] / load[compared] - np.nanmedian(shares, axis=0)
    rho = _frame_correlation(error - error.mean())
    return TrialError(
        *names,
        frames=int(compared.sum()),
        bias=float(error.mean()),
        scatter=float(error.std()),
        independent_frames=float(compared.sum()) * (1.0 - rho**2) / (1.0 + rho**2),
        inputs=float(np.sqrt(np.nanvar(shares, axis=0).mean())),
        correlation_s=-float(np.median(np.diff(time[compared]))) / float(np.log(rho)),
    )


def _frame_correlation(scatter: Array) -> float:
    """Return the correlation of successive frames (AR(1)), in (0, 1)."""
    product = float(scatter[1:] @ scatter[:-1])
    rho = product / max(float(scatter[1:] @ scatter[1:]), np.finfo(float).tiny)
    return float(np.clip(rho, 1e-3, 1.0 - 1e-3))


def fitted(errors: Sequence[TrialError], force: str, activity: str | None) -> Discrepancy | None:
    """Return the discrepancy of a force in an activity; None: no trial has its error.

    Args:
        activity: activity of the scene. Without trials of it (or None) the mean is 0.
    """
    chosen = [one for one in errors if one.force == force]
    if not chosen:
        return None
    own = [one for one in chosen if one.activity == activity]
    activity_biases = [one.bias for one in own]
    every, chosen = len(chosen), own or chosen
    biases = np.array([one.bias**2 for one in chosen])
    scatters = np.array([one.scatter**2 for one in chosen])
    share = float(biases.sum() / max((biases + scatters).sum(), np.finfo(float).tiny))
    published, numbers = PUBLISHED[force][0] / WALKING_LOAD_BW, PUBLISHED[force][1]
    weight = 0.5 * (1.0 + 1.0 / (len(activity_biases) + 1))  # of S² in A
    of_published = (weight * share + 1.0 - share) * published**2
    of_trials = weight * biases + scatters
    frames = np.array([max(1.0, one.independent_frames - 1.0) for one in chosen])
    uncertain = of_published**2 / numbers
    uncertain += float(((weight * biases) ** 2 + scatters**2 / frames).sum())
    total = of_published + float(of_trials.sum())
    inputs = float(np.mean([one.inputs**2 for one in chosen]))
    return Discrepancy(
        mean=sum(activity_biases) / (len(activity_biases) + 1),
        deviation=float(np.sqrt(max(0.0, total / (len(chosen) + 1) - inputs))),
        freedom=total**2 / max(uncertain, np.finfo(float).tiny),
        own_trials=len(activity_biases),
        trials=every,
    )


def band_with_discrepancy(
    samples: Array, discrepancy: Discrepancy, load: Array, percents: Sequence[float] = (5.0, 95.0)
) -> Array:
    """Return the band of inputs and discrepancy together, (percents, f), in the samples' unit.

    It is that of the sum of two independent variables, sampled force and discrepancy, above zero:
    contacts only push. It is asymmetric where the force is small.

    Args:
        samples: force, (n, f); NaN in failed frames.
        load: load G from `load_of` in the samples' unit, (f,).
    """
    added = stdtrit(discrepancy.freedom, _middles(QUANTILES))
    added = discrepancy.mean + discrepancy.deviation * added
    ends = np.full((len(percents), samples.shape[1]), np.nan)
    finite = np.isfinite(samples).any(axis=0) & np.isfinite(load)
    if not finite.any():
        return ends
    of_samples = np.nanpercentile(
        samples[:, finite],
        100.0 * _middles(SAMPLE_QUANTILES),
        axis=0,
        method=QUANTILE_METHOD,
    )
    every = of_samples[:, None, :] + added[:, None] * load[finite]
    every = np.sort(every.reshape(len(of_samples) * len(added), -1), axis=0)
    # The sums below zero come first. The quantiles are those of the remaining ones.
    below = (every < 0.0).sum(axis=0)
    for end, percent in zip(ends, percents, strict=True):
        rank = below + (len(every) - 1 - below) * percent / 100.0
        place = np.clip(np.round(rank).astype(int), 0, len(every) - 1)
        end[finite] = np.maximum(every[place, np.arange(every.shape[1])], 0.0)
    return ends


def _middles(count: int) -> Array:
    return (np.arange(count) + 0.5) / count


def coverage(low: Array, high: Array, measured: Array) -> tuple[int, float]:
    """Return the frames with band and measured force, and the share inside the band."""
    compared = np.isfinite(low) & np.isfinite(high) & np.isfinite(measured)
    inside = (low <= measured) & (measured <= high)
    share = float(inside[compared].mean()) if compared.any() else float("nan")
    return int(compared.sum()), share


@lru_cache(maxsize=1)
def known_errors() -> tuple[TrialError, ...]:
    """Return the errors of all compared trials from the package's data."""
    return tuple(TrialError(**row) for row in json.loads(DATA.read_text(encoding="utf-8")))


def write_errors(errors: Sequence[TrialError], path: Path = DATA) -> None:
    """Write the errors of all compared trials."""
    rows = [
        {key: round(v, 4) if isinstance(v, float) else v for key, v in asdict(one).items()}
        for one in errors
    ]
    path.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def discrepancy_of(summary: Mapping[str, Any]) -> dict[str, Discrepancy]:
    """Return force -> discrepancy of a run in its activity; empty without [muscles].

    All compared runs had [muscles].
    """
    if "muscles" not in (summary.get("scene_tables") or {}):
        return {}
    every = {force: fitted(known_errors(), force, summary.get("activity")) for force in FORCES}
    return {force: one for force, one in every.items() if one is not None}


def discrepancy_summary(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the summary's key `discrepancy`: the bands' discrepancy, and the measured error."""
    error = method_error(summary)
    return {
        "forces": {force: asdict(one) for force, one in discrepancy_of(summary).items()},
        "trials": [one.trial for one in error.trials],
        "rmse_BW": error.rmse(FORCES[0]),
        "subjects": len(error.subjects),
        "words": " ".join(error.sentences),
    }
