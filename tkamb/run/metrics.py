"""Metrics of a run that reports and summaries use."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import SIDES, Array
from tkamb.run.status import AGREEMENT
from tkamb.units import MILLIMETRE, STANDARD_GRAVITY

if TYPE_CHECKING:
    from tkamb.run.maps import ContactMaps
    from tkamb.run.results import Results


# m: least travel of a centre of pressure in a frame that counts as a jump. A
# contact point on one dish moves less in a frame.
JUMP = 8.0 * MILLIMETRE
# 1: a jump is also larger than this multiple of the median travel. No movement
# accelerates as much.
JUMP_STEPS = 5.0
# N: quadriceps tension below which ratios to it are not shown. Ratios of small
# numbers are meaningless.
LEAST_TENSION = 1.0


@dataclass(frozen=True)
class Peak:
    """The largest value of a quantity.

    Args:
        side: "medial" or "lateral"; "" for a column without sides.
    """

    value: float
    frame: int
    side: str = ""


def body_weight(results: "Results") -> float:
    """Return body weight, N: mass x 9.80665 m/s²."""
    mass = results.summary.get("body_mass_kg")
    if not mass:
        raise InputError("has no 'body_mass_kg'", "summary", "forces in BW need it")
    return float(mass) * STANDARD_GRAVITY


def peak(results: "Results", column: str) -> Peak | None:
    """Return the largest value of a column, or of the two columns of a name "<side>_..."."""
    sides = SIDES if column.startswith("<side>") else ("",)
    peaks = [
        Peak(float(np.nanmax(values)), int(np.nanargmax(values)), side)
        for side in sides
        if np.isfinite(values := results[column.replace("<side>", side)]).any()
    ]
    return max(peaks, key=lambda peak: peak.value, default=None)


def doubt_of_peak(results: "Results", side: str, frame: int) -> str:
    """Return why a condyle's peak pressure is uncertain, by the frame's flags; "" if it is not."""
    from tkamb.contact.flags import AT_EDGE, TOO_NARROW

    doubts = {
        AT_EDGE: AT_EDGE,
        TOO_NARROW: "contact is too narrow for the map, so that the peak is not resolved",
    }
    status = str(results.status[frame])
    words = [word for flag, word in doubts.items() if f"the {side} {flag}" in status]
    return " and ".join(words)


def peak_pressure(results: "Results") -> dict[str, Any] | None:
    """Return the largest peak pressure, its condyle, frame and doubt; None without contact."""
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
    """Return the medial share of the load (f,) by "deformation" or by "equilibrium"."""
    if estimate == "equilibrium":
        return results["medial_share_equilibrium"]
    medial = results["medial_force_N"]
    lateral = results["lateral_force_N"]
    valid = np.where(np.isnan(medial) & np.isnan(lateral), np.nan, 1.0)
    total = np.nan_to_num(medial) + np.nan_to_num(lateral)
    with np.errstate(invalid="ignore", divide="ignore"):
        return valid * np.where(total > 0, np.nan_to_num(medial) / total, np.nan)


def split_undetermined(results: "Results") -> NDArray[np.bool_]:
    """Return a mask (f,) of frames in which the recorded adduction does not determine the split."""
    return np.asarray(results["split_determined"] == 0)


def moved_per_half_degree(results: "Results") -> Array:
    """Return the force (f,), N, that 0.5 deg of adduction shifts between the condyles.

    It is linear in the angle, and at most the force of the more loaded condyle. It is NaN if only
    one condyle is loaded, because the slope changes when the other touches.
    """
    share = medial_share(results, "deformation")
    shift = 0.5 * np.abs(results["medial_force_per_adduction_N_per_deg"])
    shift = np.minimum(shift, np.fmax(results["medial_force_N"], results["lateral_force_N"]))
    return np.where(np.abs(share - 0.5) < 0.5 - AGREEMENT.unloaded_share, shift, np.nan)


def shares_apart(results: "Results") -> Array:
    """Return the difference (f,) of the two estimates of the medial share."""
    return np.abs(medial_share(results, "deformation") - medial_share(results, "equilibrium"))


def tension_ratio(results: "Results", column: str) -> Array:
    """Return a force (f,) relative to the quadriceps tension."""
    quadriceps = results["quadriceps_N"]
    with np.errstate(invalid="ignore"):
        taut = np.where(quadriceps > LEAST_TENSION, quadriceps, np.nan)
    return results[column] / taut


def residual_force(results: "Results") -> Array:
    """Return the magnitude (f,) of the AP and ML residual forces, N."""
    return np.hypot(results["residual_ap_N"], results["residual_ml_N"])


def residual_share(results: "Results") -> Array:
    """Return `residual_force` over the superior-inferior contact force (f,)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return residual_force(results) / np.abs(results["force_si_N"])


def residual_effect(results: "Results") -> Array:
    """Return the change (f,) of the total force if the residuals act 10 mm higher or lower, over
    the superior-inferior contact force.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return results["residual_sensitivity_N"] / np.abs(results["force_si_N"])


def failed(results: "Results") -> NDArray[np.bool_]:
    """Return a mask (f,) of failed frames: status "failed", or not "ok" and no contact force."""
    marked = np.array([status.startswith("failed") for status in results.status], bool)
    return marked | (~_clean(results) & np.isnan(results["force_total_N"]))


def flagged(results: "Results") -> NDArray[np.bool_]:
    """Return a mask (f,) of the frames with numbers and a status other than "ok"."""
    return ~_clean(results) & ~failed(results)


def _clean(results: "Results") -> NDArray[np.bool_]:
    return np.array([status == "ok" for status in results.status], bool)


def map_rows(results: "Results", maps: "ContactMaps | None" = None) -> dict[int, int]:
    """Return frame -> index of its map, for every frame with a map.

    Args:
        maps: maps of the run; None: those of the insert.
    """
    maps = results.maps if maps is None else maps
    if maps is None:
        return {}
    finite = np.isfinite(maps.peaks_Pa)
    row_at = {float(t): row for row, t in enumerate(maps.time_s) if finite[row]}
    times = [float(time) for time in results["time_s"]]
    return {frame: row_at[time] for frame, time in enumerate(times) if time in row_at}


def stretches(points: Array) -> list[slice]:
    """Return the parts of a path (n, k), m, without NaN and jumps, of two points or more."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    finite = steps[np.isfinite(steps)]
    longest = max(JUMP, JUMP_STEPS * float(np.median(finite))) if len(finite) else 0.0
    near = np.concatenate([[False], steps <= longest, [False]])
    ends = np.flatnonzero(np.diff(near.astype(int))).reshape(-1, 2)
    return [slice(int(first), int(last) + 1) for first, last in ends]


def lateral_axis_name(results: "Results") -> str:
    """Return the direction of insert z: "medial" if the summary's `lateral_axis` is "-z"."""
    return "lateral" if results.summary.get("lateral_axis", "+z") == "+z" else "medial"
