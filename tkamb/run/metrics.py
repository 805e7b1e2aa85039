"""The few numbers that say what happened in a run."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import SIDES, Array
from tkamb.run.status import AGREEMENT
from tkamb.units import MILLIMETRE, STANDARD_GRAVITY

if TYPE_CHECKING:
    from tkamb.run.results import Results


@dataclass(frozen=True)
class MetricSettings:
    """What counts as a jump of a centre of pressure, and as an unloaded quadriceps."""

    jump: float = 8.0 * MILLIMETRE
    """m; a centre of pressure that moves farther between two frames may have jumped. Chosen: on one
    dish a contact point moves by less from frame to frame."""
    jump_steps: float = 5.0
    """Median steps: a centre of pressure that moves by more than these and by more than `jump` from
    a frame to the next has jumped. Chosen: a movement does not speed up as much."""
    least_tension: float = 1.0
    """N: below this quadriceps tension its ratios are not shown. Chosen: a quotient of small
    numbers says nothing."""


METRICS = MetricSettings()


@dataclass(frozen=True)
class Peak:
    """The largest value of a quantity.

    Args:
        value: in the column's unit.
        frame: where it occurs.
        side: "medial" or "lateral", or "" when it has no side.
    """

    value: float
    frame: int
    side: str = ""


def body_weight(results: "Results") -> float:
    """Return body weight, N: mass x 9.80665 m/s².

    Raises:
        InputError: the summary has no body mass.
    """
    mass = results.summary.get("body_mass_kg")
    if not mass:
        raise InputError("has no 'body_mass_kg'", "summary", "forces in BW need it")
    return float(mass) * STANDARD_GRAVITY


def peak(results: "Results", column: str) -> Peak | None:
    """Return the largest value of a column, or of its two sides for "<side>_..."."""
    sides = SIDES if column.startswith("<side>") else ("",)
    result = [
        Peak(float(np.nanmax(values)), int(np.nanargmax(values)), side)
        for side in sides
        if np.isfinite(values := results[column.replace("<side>", side)]).any()
    ]
    return max(result, key=lambda one: one.value, default=None)


def doubt_of_peak(results: "Results", side: str, frame: int) -> str:
    """Return in words why the peak pressure of a condyle at a frame is in doubt; "" if it is not.

    A run's status has the flags of each frame.
    """
    from tkamb.contact.flags import AT_EDGE, TOO_NARROW

    doubts = {
        AT_EDGE: AT_EDGE,
        TOO_NARROW: "contact is too narrow for the map, so that the peak is not resolved",
    }
    status = str(results.status[frame])
    words = [word for flag, word in doubts.items() if f"the {side} {flag}" in status]
    return " and ".join(words)


def peak_pressure(results: "Results") -> dict[str, Any] | None:
    """Return the largest peak pressure, where it is and what is in doubt; None without contact."""
    largest = peak(results, "<side>_peak_pressure_MPa")
    if largest is None:
        return None
    return {
        "MPa": largest.value,
        "side": largest.side,
        "frame": largest.frame,
        "time_s": float(results["time_s"][largest.frame]),
        "doubt": doubt_of_peak(results, largest.side, largest.frame),
    }


def medial_share(results: "Results", estimate: str) -> Array:
    """Return the medial share (f,) by "deformation" or by "equilibrium"."""
    if estimate == "equilibrium":
        return results["medial_share_equilibrium"]
    medial = results["medial_force_N"]
    lateral = results["lateral_force_N"]
    both = np.where(np.isnan(medial) & np.isnan(lateral), np.nan, 1.0)
    total = np.nan_to_num(medial) + np.nan_to_num(lateral)
    with np.errstate(invalid="ignore", divide="ignore"):
        return both * np.where(total > 0, np.nan_to_num(medial) / total, np.nan)


def split_undetermined(results: "Results") -> NDArray[np.bool_]:
    """Return in which frames (f,) the recorded adduction does not determine the split."""
    return np.asarray(results["split_determined"] == 0)


def moved_per_half_degree(results: "Results") -> Array:
    """Return the force (f,), N, that 0.5 deg of adduction moves between the condyles, by its slope.

    Never more than the whole load; NaN where one condyle carries all of it, since that slope
    holds only until the other touches.
    """
    share = medial_share(results, "deformation")
    shift = 0.5 * np.abs(results["medial_force_per_adduction_N_per_deg"])
    shift = np.minimum(shift, np.abs(results["force_si_N"]))
    return np.where(np.abs(share - 0.5) < 0.5 - AGREEMENT.unloaded_share, shift, np.nan)


def shares_apart(results: "Results") -> Array:
    """Return by how much (f,) the two estimates of the medial share differ."""
    return np.abs(medial_share(results, "deformation") - medial_share(results, "equilibrium"))


def tension_ratio(results: "Results", column: str) -> Array:
    """Return a force (f,) relative to the quadriceps tension."""
    quadriceps = results["quadriceps_N"]
    with np.errstate(invalid="ignore"):
        taut = np.where(quadriceps > METRICS.least_tension, quadriceps, np.nan)
    return results[column] / taut


def residual_force(results: "Results") -> Array:
    """Return the magnitude (f,) of the AP and ML residual forces, N."""
    return np.hypot(results["residual_ap_N"], results["residual_ml_N"])


def residual_share(results: "Results") -> Array:
    """Return that magnitude relative to the superior-inferior contact force (f,)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return residual_force(results) / np.abs(results["force_si_N"])


def residual_effect(results: "Results") -> Array:
    """Return how much the total force depends on where the residuals act (f,), same ratio.

    It is the change of the total by 10 mm higher or lower over the SI contact force.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return results["residual_sensitivity_N"] / np.abs(results["force_si_N"])


def failed(results: "Results") -> NDArray[np.bool_]:
    """Return which frames (f,) say that they failed, or are not ok and have no contact force."""
    marked = np.array([status.startswith("failed") for status in results.status], bool)
    return marked | (~_clean(results) & np.isnan(results["force_total_N"]))


def flagged(results: "Results") -> NDArray[np.bool_]:
    """Return which frames (f,) have numbers and a reason to look at them with care."""
    return ~_clean(results) & ~failed(results)


def _clean(results: "Results") -> NDArray[np.bool_]:
    return np.array([status == "ok" for status in results.status], bool)


def map_rows(results: "Results") -> dict[int, int]:
    """Return frame -> row of the maps of the same time, for every frame that has a map."""
    if results.maps is None:
        return {}
    whole = np.atleast_1d(np.isfinite(results.maps.pressure_Pa).all(axis=1))
    row_at = {float(t): row for row, t in enumerate(results.maps.time_s) if whole[row]}
    times = [float(time) for time in results["time_s"]]
    return {frame: row_at[time] for frame, time in enumerate(times) if time in row_at}


def stretches(points: Array) -> list[slice]:
    """Return the parts, of two points or more, of a path (n, k) m that neither lacks nor jumps."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    finite = steps[np.isfinite(steps)]
    longest = (
        max(METRICS.jump, METRICS.jump_steps * float(np.median(finite))) if len(finite) else 0.0
    )
    near = np.concatenate([[False], steps <= longest, [False]])
    ends = np.flatnonzero(np.diff(near.astype(int))).reshape(-1, 2)
    return [slice(int(first), int(last) + 1) for first, last in ends]


def lateral_axis_name(results: "Results") -> str:
    """Return what insert z points to: "lateral" unless the summary's `lateral_axis` is "-z"."""
    return "lateral" if results.summary.get("lateral_axis", "+z") == "+z" else "medial"
