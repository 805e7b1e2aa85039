"""How far the method was off when it was compared with measured knees: the model discrepancy.

A measured force is the predicted one, with whatever its inputs err by, plus the discrepancy of
what the model leaves out (Kennedy & O'Hagan 2001). What it leaves out are lever arms, muscles that
pull against each other and how condyles share a load: all of that errs by a share of the load that
the knee carries, and by little where it carries little. So the discrepancy of the total, medial
and lateral force is d(t) G(t), with the total force F(t) in body weights and

    G = sqrt(F² + F0²),   d(t) = m + b + w(t),

    m ~ (0, S²/2),   b ~ (0, S²/2),   w ~ AR(1) of variance V

over the frames t of a trial of an activity.

m is common to all trials of an activity, b to all frames of a trial, and w is correlated over a
time of some 0.1 s. S² is the mean square of the trials' biases, V the mean of their scatter's
squares. The trials are of one subject; what others add is not in them, so that a published blind
prediction of other subjects counts as one more trial. What is published is a root mean square
error in body weights: it is divided by G of walking, and its square, bias² + scatter², is shared
between S² and V as the trials' own is.

With n trials of the activity and their mean bias B, m has the mean n B/(n + 1) and the variance
S²/2/(n + 1); with n = 0 the activity is like any other. Then d has the variance

    A + V,   A = S²/2 (1 + 1/(n + 1)).

Variances from few trials are not well known themselves, so that d is Student's t. A + V is a mean
over the trials i and what was published, each with its part A_i + V_i. A_i is one number; V_i is
known from the frames ν_i that are independent of each other; what was published, T, from as many
numbers n_T as there are. The degrees of freedom are those of Welch and Satterthwaite,

    ν = (T + Σ (A_i + V_i))² / (T²/n_T + Σ (A_i² + V_i²/ν_i)).

Biases and scatters hold what the inputs err by as well, so that the square of the inputs'
deviation is taken off the variance. A share of the load says something of another subject, whose
weight is another.

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

DATA = Path(__file__).with_suffix(".json")
QUANTILE_METHOD: Final = "weibull"
"""Of numpy: the p quantile of n samples is at place p (n + 1), see `uncertainty.bands`."""
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
    """Quantiles of Student's t that are added to each of those of the samples; more changes the
    ends of a band by less than 1 %."""
    sample_quantiles: int = 100
    """Quantiles by which the samples stand for their distribution; likewise."""
    least_load_BW: float = 0.5
    """BW: F0, the load below which errors do not become smaller. The likelihood of the open trials'
    errors is flat from 0.3 to 0.5 BW."""
    walking_load_BW: float = 1.6
    """BW: root mean square of G over a gait cycle (JW's og1 and og3, measured: 1.62 and 1.65), by
    which published errors in walking become shares of the load."""
    published_total_BW: float = 0.43
    """BW: root mean square error of a published blind prediction of the total force in walking,
    281 N (parametric model, third Grand Challenge, PMC3627216), over JW's weight."""
    published_medial_BW: float = 0.41
    """BW: likewise of the medial force: the middle of 229 to 312 N by the four winners of the
    Grand Challenges (Kinney et al. 2013, doi:10.1115/1.4023255)."""
    published_lateral_BW: float = 0.43
    """BW: likewise of the lateral force: the middle of 238 to 326 N."""
    published_total_numbers: int = 1
    """Errors that were published of the total force: of one model."""
    published_medial_numbers: int = 4
    """Likewise of the medial force: of four winners."""
    published_lateral_numbers: int = 4
    """Likewise of the lateral force."""
    fewest_frames: int = 5
    """Frames of a trial below which its bias and scatter say too little. Chosen: a standard
    deviation of fewer is itself uncertain by more than a third."""


DISCREPANCY = DiscrepancySettings()


@dataclass(frozen=True)
class TrialError:
    """How far the prediction of one force was off in one trial, measured minus predicted.

    Bias, scatter and inputs are shares of the load G.

    Args:
        trial: name of the trial.
        subject: name of the subject.
        activity: as in [output] activity.
        force: total, medial or lateral.
        frames: how many are compared.
        bias: mean over the frames of the error over G.
        scatter: its standard deviation.
        independent_frames: frames that are independent of each other, as many as say as much of
            the scatter's variance.
        inputs: root mean square of the band of inputs' standard deviation over G.
        correlation_s: time over which the scatter's correlation falls to 1/e.
        nominal_rmse_BW: root mean square error of the run with the inputs as given.
        nominal_bias_BW: its mean error, predicted minus measured.
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
    nominal_rmse_BW: float
    nominal_bias_BW: float


@dataclass(frozen=True)
class Discrepancy:
    """What is to be added to the prediction of one force.

    Args:
        mean: of the discrepancy, as a share of the load G.
        deviation: its standard deviation without that of the inputs, likewise.
        freedom: degrees of freedom of Student's t, no whole number.
        own_trials: of the activity.
        trials: of all activities.
    """

    mean: float
    deviation: float
    freedom: float
    own_trials: int
    trials: int


def load_of(total: Array, body_weight: float) -> Array:
    """Return the load G (f,) of which the discrepancy is a share, in the total's unit.

    Args:
        total: (n, f) total force of each sample; NaN where one has none.
        body_weight: in that unit.
    """
    load = np.full(total.shape[1], np.nan)
    there = np.isfinite(total).any(axis=0)
    load[there] = np.nanmedian(total[:, there], axis=0)
    return np.hypot(load, DISCREPANCY.least_load_BW * body_weight)


def trial_error(
    names: tuple[str, str, str, str],
    time: Array,
    samples: Array,
    measured: Array,
    nominal: Array,
    load: Array,
    body_weight: float,
) -> TrialError | None:
    """Return how far samples with varied inputs are off in a trial; None: too few frames.

    Args:
        names: trial, subject, activity, force.
        time: (f,) s.
        samples: (n, f) N; NaN where a sample has none.
        measured: (f,) N; NaN where nothing was measured.
        nominal: (f,) N, of the run as the inputs stand.
        load: (f,) N, as `load_of` returns it.
        body_weight: N.
    """
    enough = np.isfinite(samples).sum(axis=0) > samples.shape[0] / 2
    both = enough & np.isfinite(measured) & np.isfinite(nominal)
    if both.sum() < DISCREPANCY.fewest_frames:
        return None
    chosen = samples[:, both] / load[both]
    error = measured[both] / load[both] - np.nanmedian(chosen, axis=0)
    rho = _neighbours_correlation(error - error.mean())
    own = (nominal - measured)[both] / body_weight
    return TrialError(
        *names,
        frames=int(both.sum()),
        bias=float(error.mean()),
        scatter=float(error.std()),
        independent_frames=float(both.sum()) * (1.0 - rho**2) / (1.0 + rho**2),
        inputs=float(np.sqrt(np.nanvar(chosen, axis=0).mean())),
        correlation_s=-float(np.median(np.diff(time[both]))) / float(np.log(rho)),
        nominal_rmse_BW=float(np.sqrt((own**2).mean())),
        nominal_bias_BW=float(own.mean()),
    )


def _neighbours_correlation(scatter: Array) -> float:
    """Return the correlation of an AR(1)'s neighbouring frames, above 0 and below 1."""
    product = float(scatter[1:] @ scatter[:-1])
    rho = product / max(float(scatter[1:] @ scatter[1:]), np.finfo(float).tiny)
    return float(np.clip(rho, 1e-3, 1.0 - 1e-3))


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
    own = [one.bias for one in chosen if one.activity == activity]
    biases = np.array([one.bias**2 for one in chosen])
    scatters = np.array([one.scatter**2 for one in chosen])
    share = float(biases.sum() / max((biases + scatters).sum(), np.finfo(float).tiny))
    published = float(getattr(DISCREPANCY, f"published_{force}_BW")) / DISCREPANCY.walking_load_BW
    weight = 0.5 * (1.0 + 1.0 / (len(own) + 1))  # of S² in A
    of_published = (weight * share + 1.0 - share) * published**2
    of_trials = weight * biases + scatters
    frames = np.array([max(1.0, one.independent_frames - 1.0) for one in chosen])
    numbers = float(getattr(DISCREPANCY, f"published_{force}_numbers"))
    uncertain = of_published**2 / numbers
    uncertain += float(((weight * biases) ** 2 + scatters**2 / frames).sum())
    total = of_published + float(of_trials.sum())
    inputs = float(np.mean([one.inputs**2 for one in chosen]))
    return Discrepancy(
        mean=sum(own) / (len(own) + 1),
        deviation=float(np.sqrt(max(0.0, total / (len(chosen) + 1) - inputs))),
        freedom=total**2 / max(uncertain, np.finfo(float).tiny),
        own_trials=len(own),
        trials=len(chosen),
    )


def band_with_discrepancy(
    samples: Array, discrepancy: Discrepancy, load: Array, percents: Sequence[float] = (5.0, 95.0)
) -> Array:
    """Return the band of inputs and discrepancy together, (percents, f), of the samples' unit.

    The distribution is that of the sum of two independent ones: the samples', by its quantiles,
    and the discrepancy's. A force is never below zero.

    Args:
        samples: (n, f) NaN where a sample has no number.
        discrepancy: of the model, as `fitted` returns it.
        load: (f,) in the samples' unit, as `load_of` returns it.
        percents: of the distribution below the ends of the band.
    """
    added = stdtrit(discrepancy.freedom, _middles(DISCREPANCY.quantiles))
    added = discrepancy.mean + discrepancy.deviation * added
    ends = np.full((len(percents), samples.shape[1]), np.nan)
    finite = np.isfinite(samples).any(axis=0) & np.isfinite(load)
    if not finite.any():
        return ends
    of_samples = np.nanpercentile(
        samples[:, finite],
        100.0 * _middles(DISCREPANCY.sample_quantiles),
        axis=0,
        method=QUANTILE_METHOD,
    )
    every = np.maximum(of_samples[:, None, :] + added[:, None] * load[finite], 0.0)
    ends[:, finite] = np.percentile(
        every.reshape(len(of_samples) * len(added), -1), list(percents), axis=0
    )
    return ends


def _middles(count: int) -> Array:
    """Return the middles of so many equal parts of 0 to 1."""
    return (np.arange(count) + 0.5) / count


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
    reason = "those runs had all muscles, so this run, without [muscles], may be farther off"
    return f"{words}; {reason}"
