"""What a run may be said to show.

A claim is decided here once, for report, terminal, viewer, `compare` and summary. It uses the run's
numbers and the measured knees of docs/truth.md, so that no output contradicts another one or a
measurement.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.geometry.frames import Array, Mask
from tkamb.io import texts
from tkamb.run.status import AGREEMENT

if TYPE_CHECKING:
    from tkamb.run.results import Results

DATA = Path(__file__).with_name("measured_trials.json")
FORCES = ("total", "medial", "lateral")
ESTIMATES = {"deformation": "<side>_force_N", "equilibrium": "<side>_force_equilibrium_N"}
"""Estimate of the split between the condyles -> its columns."""
ENDS = {"median": "p50", "p05": "p05", "p95": "p95"} | {
    f"discrepancy_{end}": f"discrepancy_{end}" for end in ("p05", "p95")
}
"""Key of a peak force -> ending of its column in bands.csv."""


@dataclass(frozen=True, eq=False)
class Split:
    """The split of the load between the condyles that a run may state.

    Args:
        estimate: "equilibrium" or "deformation"; "": the run has no split.
        undetermined: mask (f,) of frames in which the recorded adduction does not determine the
            split by deformation.
        contradicted: mask (f,) of other frames in which the two estimates differ.
    """

    estimate: str
    undetermined: Mask
    contradicted: Mask

    def column(self, force: str) -> str:
        """Return the column of a force: "total", "medial" or "lateral"."""
        if force == "total":
            return "force_si_N"
        return ESTIMATES[self.estimate or "deformation"].replace("<side>", force)

    @property
    def reason(self) -> str:
        """Why the estimate was chosen, in words; "" without a split."""
        if not self.estimate:
            return ""
        if self.undetermined.any():
            return (
                "by equilibrium of moments, because half a degree of adduction would change the "
                "split by deformation strongly"
            )
        how = {"deformation": "deformation of the insert", "equilibrium": "equilibrium of moments"}
        return f"by {how[self.estimate]}"


def split_of(columns: Mapping[str, Any]) -> Split:
    """Return the split that a run may state: by deformation if the pose determines it in all
    frames, else by equilibrium.

    The estimates differ if their medial shares are more than `AGREEMENT.share_difference` apart.
    """
    frames = len(columns["status"])
    shares = {name: _share(columns, name) for name in ESTIMATES}
    determined = np.asarray(columns.get("split_determined", np.full(frames, np.nan)), float)
    with_numbers = [name for name, share in shares.items() if np.isfinite(share).any()]
    undetermined = determined == 0
    if "equilibrium" in with_numbers and (undetermined.any() or "deformation" not in with_numbers):
        estimate = "equilibrium"
    else:
        estimate = next(iter(with_numbers), "")
    apart = np.abs(shares["deformation"] - shares["equilibrium"]) > AGREEMENT.share_difference
    return Split(estimate, undetermined, apart & ~undetermined)


def _share(columns: Mapping[str, Any], estimate: str) -> Array:
    """Return medial / (medial + lateral) (f,); NaN without load."""
    names = [ESTIMATES[estimate].replace("<side>", side) for side in FORCES[1:]]
    nothing = np.full(len(columns["status"]), np.nan)  # a knee of one condyle has one column
    medial, lateral = (np.asarray(columns.get(name, nothing), float) for name in names)
    unknown = np.isnan(medial) & np.isnan(lateral)
    medial, lateral = np.nan_to_num(medial), np.nan_to_num(lateral)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(unknown | (medial + lateral <= 0), np.nan, medial / (medial + lateral))


def peaks(
    columns: Mapping[str, Any], bands: Mapping[str, Array], body_weight: float
) -> dict[str, dict[str, Any]]:
    """Return force -> its largest value with its bands at that frame, BW.

    Args:
        bands: columns of bands.csv; empty: no input was varied.
        body_weight: body weight, N.

    Returns:
        Force -> column, nominal, frame, time_s, flexion_deg, supported (False: the two estimates of
        the split differ at this frame) and, with bands, median, p05, p95, discrepancy_p05 and
        discrepancy_p95. Bands that do not exist at the frame are None.
    """
    split = split_of(columns)
    result = {}
    for force in FORCES:
        name = split.column(force)
        values = np.asarray(columns.get(name, [np.nan]), float)
        if not np.isfinite(values).any():
            continue
        frame = int(np.nanargmax(values))
        result[force] = {
            "column": name,
            "nominal": float(values[frame]) / body_weight,
            "frame": frame,
            "time_s": float(columns["time_s"][frame]),
            "flexion_deg": float(columns["flexion_deg"][frame]),
            "supported": force == "total" or not bool(split.contradicted[frame]),
        }
        for key, ending in ENDS.items() if bands else ():
            band = bands.get(f"{name}_{ending}")
            known = band is not None and np.isfinite(band[frame])
            result[force][key] = float(band[frame]) / body_weight if known else None  # type: ignore[index]
    return result


@dataclass(frozen=True)
class MeasuredTrial:
    """Error of tkamb in a trial with measured forces; docs/truth.md has the same numbers.

    Args:
        muscles: True: all muscles of the leg; False: the quadriceps alone.
        rmse_BW: force -> root mean square error, BW.
        bias_BW: mean error of the total force, predicted minus measured, BW.
        peak_BW: predicted peak of the total force, BW; `measured_peak_BW` is the measured one.
    """

    trial: str
    subject: str
    activity: str
    muscles: bool
    rmse_BW: Mapping[str, float]
    bias_BW: float
    peak_BW: float
    measured_peak_BW: float


@lru_cache(maxsize=1)
def measured_trials() -> tuple[MeasuredTrial, ...]:
    """Return the trials with measured forces."""
    return tuple(MeasuredTrial(**row) for row in json.loads(DATA.read_text(encoding="utf-8")))


@dataclass(frozen=True)
class MethodError:
    """The measured error of the method, as far as it applies to a run.

    Args:
        trials: measured trials with these muscles in this activity; if there are none, of all
            activities.
    """

    activity: str | None
    muscles: bool
    trials: tuple[MeasuredTrial, ...]
    same_activity: bool

    @property
    def subjects(self) -> list[str]:
        """Names of the measured subjects."""
        return list(dict.fromkeys(one.subject for one in self.trials))

    def rmse(self, force: str, trials: Sequence[MeasuredTrial] = ()) -> float:
        """Return the root mean square error of a force over trials (default: all), BW."""
        squares = [one.rmse_BW[force] ** 2 for one in trials or self.trials]
        return float(np.sqrt(np.mean(squares)))

    @property
    def peak_error(self) -> float:
        """Largest difference between the computed and the measured peak, with its sign, BW."""
        errors = [one.peak_BW - one.measured_peak_BW for one in self.trials]
        return max(errors, key=abs)

    @property
    def headline(self) -> str:
        """Errors of the peak and RMS error of the total force, if the activity was measured."""
        if not self.same_activity:
            return "not measured"
        return f"peak {abs(self.peak_error):.2f}, RMS {self.rmse('total'):.2f} BW"

    @property
    def sentences(self) -> list[str]:
        """Sentences on the errors, first on an activity without a measurement."""
        return texts.lines("tkamb.run", "error.txt", error=self, groups=self.groups)

    @property
    def groups(self) -> list[tuple[str, tuple[MeasuredTrial, ...], str]]:
        """Activity, its trials, and the direction of their error in words."""
        names = dict.fromkeys(one.activity for one in self.trials)
        chosen = {name: tuple(o for o in self.trials if o.activity == name) for name in names}
        return [(name, trials, bias_words(trials)) for name, trials in chosen.items()]


def bias_words(trials: Sequence[MeasuredTrial]) -> str:
    """Return the mean error of the total force in some trials, with its direction."""
    low, high = min(one.bias_BW for one in trials), max(one.bias_BW for one in trials)
    if low < 0 < high:
        return f"{-low:.2f} BW too low to {high:.2f} BW too high on average"
    ends = sorted({f"{abs(low):.2f}", f"{abs(high):.2f}"})
    direction = "low" if high <= 0 else "high"
    return f"{' to '.join(ends)} BW too {direction} on average"


def method_error(summary: Mapping[str, Any]) -> MethodError:
    """Return the measured error of the method that applies to a run.

    Args:
        summary: content of summary.json; `activity` and `scene_tables` are used.
    """
    activity = summary.get("activity")
    muscles = bool((summary.get("scene_tables") or {}).get("muscles"))
    alike = tuple(one for one in measured_trials() if one.muscles is muscles)
    same = tuple(one for one in alike if one.activity == activity)
    return MethodError(activity, muscles, same or alike, bool(same))


def compared_forces(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return measured force -> its comparison with this run, if frames were compared."""
    measured = summary.get("measured") or {}
    return {name: one for name, one in measured.items() if one["frames_compared"]}


def claims_summary(columns: Mapping[str, Any], body_weight: float) -> dict[str, Any]:
    """Return the summary's keys `peaks_BW` and `split`."""
    split = split_of(columns)
    counts = {
        "estimate": split.estimate,
        "undetermined_frames": int(split.undetermined.sum()),
        "contradicted_frames": int(split.contradicted.sum()),
    }
    return {"peaks_BW": peaks(columns, {}, body_weight), "split": counts}


def peaks_of(results: "Results") -> dict[str, dict[str, Any]]:
    """Return the peak forces of a run with their bands (`peaks`)."""
    from tkamb.run.metrics import body_weight

    return peaks(results.columns, results.bands, body_weight(results))
