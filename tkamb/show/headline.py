"""The headline of the report: tiles with the main results, and the three lines above them.

`assets/headline.txt` has the words, this module the numbers.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.geometry.frames import SIDES, Array
from tkamb.io import texts
from tkamb.run import claims, metrics
from tkamb.run.known_errors import is_large, short_error_words
from tkamb.run.status import AGREEMENT
from tkamb.show.axis import HorizontalAxis, horizontal_axis

if TYPE_CHECKING:
    from tkamb.run.results import Results

PACKAGE = "tkamb.show"
BANDED = {"force_total_N": "the total", "medial_force_N": "the medial force"}
AXIS_NAMES = {"ap": "AP", "si": "SI", "ml": "ML"}


# Largest number of inputs in a sentence. Not studied.
MOST_INPUTS = 2
# Largest number of saturated muscles in a sentence. Not studied.
MOST_MUSCLES = 4
# 1: a larger share of failed samples is stated. Fewer failed samples hardly move
# the 5th or 95th percentile.
NOTABLE_FAILED_SHARE = 0.05
# % of the SI contact force: smaller residuals count as none. They are within the
# tolerance of the equilibrium.
RESIDUAL_PERCENT = 0.05
# deg: if the quadriceps begins to wrap between frames farther apart than this, the flexion of both
# is stated. Readers need this flexion to a few degrees.
DISTANT_FRAMES_DEG = 5.0


OTHER_ERRORS = (
    "These are errors of the contact model alone: errors of load, pose, shape and material add to "
    "them."
)
"""Sentence after the known errors."""
PRESSURE_AND_AREA = ("peak_pressure", "mean_pressure", "area")


@dataclass(frozen=True)
class Card:
    """One headline number.

    Args:
        sentence: one sentence: place in the motion, or meaning of the number.
    """

    title: str
    value: str
    sentence: str
    more: tuple[str, ...] = ()
    warning: bool = False

    @property
    def detail(self) -> str:
        """All sentences."""
        return " ".join([self.sentence, *self.more])

    def line(self) -> str:
        """Return the card as one line of text."""
        return f"{self.title}: {self.value} ({self.sentence.removesuffix('.')})"


def run_title(summary: Mapping[str, Any]) -> str:
    """Return the title in a summary, or one by the path of its scene."""
    if summary.get("title"):
        return str(summary["title"])
    scene = Path(str(summary.get("scene") or "tkamb run"))
    name = scene.parent.name if scene.stem == "scene" and scene.parent.name else scene.stem
    return name.upper() if len(name) <= 3 else name.replace("_", " ").capitalize()


def cards(results: "Results", axis: HorizontalAxis) -> list[Card]:
    """Return the headline numbers that the run has."""
    made: list[Card] = []

    def card(title: str, value: str, warning: Any = False, *, caller: Callable[[], str]) -> str:
        sentence, *more = texts.nonempty(caller())
        made.append(Card(title, value, sentence, tuple(more), bool(warning)))
        return ""

    def where(frame: int) -> str:
        return _where(results, axis, frame)

    texts.lines(PACKAGE, "headline.txt", card=card, where=where, **_facts(results))
    return made


def _facts(results: "Results") -> dict[str, Any]:
    summary = results.summary
    return {
        "questions": summary.get("questions") or [],
        "remarks": summary.get("remarks") or [],
        "peaks": claims.peaks_of(results),
        "split": claims.split_of(results.columns),
        "error": claims.method_error(summary),
        "compared": _measured(results),
        "modelled": bool(np.isfinite(results["force_total_N"]).any()),
        "total": metrics.peak(results, "force_total_BW"),
        "results": results,
        "summary": summary,
        "band": _band(results),
        "muscles": _muscles(summary),
        "share": _shares(results),
        "pressure": _peak_pressure(results),
        "post": _post(results),
        "extensor": _extensor(results),
        "residual": _residuals(results),
        "failed": int(metrics.failed(results).sum()),
        "flagged": int(metrics.flagged(results).sum()),
        "body_weight": metrics.body_weight(results),
    }


def _where(results: "Results", axis: HorizontalAxis, frame: int) -> str:
    flexion = f"{round(results['flexion_deg'][frame]) + 0}° of flexion"
    if axis.kind == "flexion":
        return f"at {flexion}"
    name = f"{axis.at(frame)} of the cycle" if axis.kind == "cycle" else axis.at(frame)
    return f"at {name} ({flexion})"


def peak_words(peak: Mapping[str, Any]) -> str:
    """Return a peak force with its bands in words, body weights."""
    if peak.get("p05") is None:
        return f"{peak['nominal']:.2f}"
    words = f"{peak['median']:.2f} ({peak['p05']:.2f}–{peak['p95']:.2f}"
    if peak.get("discrepancy_p05") is not None:
        words += f"; {peak['discrepancy_p05']:.2f}–{peak['discrepancy_p95']:.2f}"
    return words + ")"


def peak_lines(results: "Results") -> list[str]:
    """Return a line of text for each supported peak force, and one on their meaning."""
    return texts.lines(
        PACKAGE,
        "peaks.txt",
        peaks=claims.peaks_of(results),
        split=claims.split_of(results.columns),
        words=peak_words,
    )


def extreme_lines(results: "Results") -> list[str]:
    """Return a line of text for the peaks of pressure and of quadriceps tension."""
    titles = ("Peak contact pressure", "Peak quadriceps tension")
    made = cards(results, horizontal_axis(results))
    return [one.line() for one in made if one.title in titles]


def limits_line(results: "Results") -> str | None:
    """Return a line on the hip's reserve moments and the saturated muscles, or None."""
    facts = _muscles(results.summary)
    return texts.lines(PACKAGE, "muscle_limits.txt", muscles=facts)[0] if facts else None


def _muscles(summary: Mapping[str, Any]) -> dict[str, Any] | None:
    reserves, saturated = summary.get("reserves") or {}, summary.get("saturated_muscles") or {}
    if not reserves:
        return None
    hip = [v["percent_of_largest_moment"] for k, v in reserves.items() if k.startswith("hip")]
    named = sorted(saturated, key=lambda name: -saturated[name])[:MOST_MUSCLES]
    return {
        "hip": max(hip, default=None),
        "saturated": ", ".join(f"{name} ({saturated[name]} frames)" for name in named),
        "more": len(saturated) - len(named),
    }


def _band(results: "Results") -> dict[str, Any] | None:
    """Return the peak force's band, main causes, and inputs that do not vary."""
    table, peak = results.summary.get("uncertainty"), metrics.peak(results, "force_total_BW")
    band = results.band("force_total_BW")
    if not table or peak is None or band is None:
        return None
    finite = bool(np.isfinite(band[0, peak.frame]))
    return {
        "table": table,
        "ends": [float(end) for end in band[:, peak.frame]],
        "finite": finite,
        "why": "" if finite else results.why_no_band(peak.frame),
        "causes": [
            f"{words} varies most with {_largest(table, name)}"
            for name, words in BANDED.items()
            if _largest(table, name)
        ],
        "many_failed": table["largest_failed_share"] > NOTABLE_FAILED_SHARE,
        "not_varied": ", ".join(name.replace("_", " ") for name in table["not_varied"]),
    }


def _with_band(results: "Results", name: str, frame: int, scale: float, digits: int) -> str:
    """Return median and 5 to 95 % of a column in words, or its nominal value."""
    band = results.band(name)
    if band is None or not np.isfinite(band[:, frame]).all():
        return f"{scale * results[name][frame]:.{digits}f}"
    low, middle, high = (f"{scale * end:.{digits}f}" for end in band[:, frame])
    return f"{middle} ({low}–{high})"


def _largest(table: Mapping[str, Any], result: str) -> str:
    shares = (table.get("shares_of_variance") or {}).get(result) or {}
    first = [(name, share) for name, share in shares.items() if name != "rest"][:MOST_INPUTS]
    return ", ".join(f"{_plain(name)} ({share:.0%})" for name, share in first if share >= 0.01)


def _plain(name: str) -> str:
    return AXIS_NAMES.get(name, name.replace("_", " ").replace(".", " "))


def _measured(results: "Results") -> tuple[str, str, bool] | None:
    if not results.summary.get("measured"):
        return None
    from tkamb.run.recorded import comparison_words

    return comparison_words(results.summary["measured"])


def _shares(results: "Results") -> dict[str, Any] | None:
    given = {}
    for estimate in ("deformation", "equilibrium"):
        share = 100 * metrics.medial_share(results, estimate)
        if np.isfinite(share).any():
            given[estimate] = _range(share, " %")
    split = claims.split_of(results.columns)
    if not given:
        return None
    share = metrics.medial_share(
        results, "deformation" if "deformation" in given else "equilibrium"
    )
    shift = metrics.moved_per_half_degree(results)
    return {
        "led": given[split.estimate],
        "estimate": split.estimate,
        "others": {name: text for name, text in given.items() if name != split.estimate},
        "alone": int(((share <= 0) | (share >= 1)).sum()),
        "apart": int((metrics.shares_apart(results) > AGREEMENT.share_difference).sum()),
        "undetermined": int(split.undetermined.sum()),
        "shift": _range(shift, " N") if np.isfinite(shift).any() else "",
    }


def _peak_pressure(results: "Results") -> dict[str, Any] | None:
    peak = metrics.peak(results, "<side>_peak_pressure_MPa")
    if peak is None:
        return None
    error = results.summary.get("known_error")
    doubt = metrics.doubt_of_peak(results, peak.side, peak.frame)
    sides = sorted(SIDES, key=lambda side: side != peak.side)
    above = {side: metrics.peak(results, f"{side}_area_above_yield") for side in sides}
    return {
        "peak": peak,
        "value": _with_band(results, f"{peak.side}_peak_pressure_MPa", peak.frame, 1.0, 1),
        "doubt": doubt,
        "yield_stress": results.summary.get("yield_stress_MPa"),
        "above": {side: one.value for side, one in above.items() if one is not None},
        "error": None if error is None else short_error_words(error, PRESSURE_AND_AREA),
        "large": bool(doubt) or (error is not None and is_large(error, PRESSURE_AND_AREA)),
    }


def _post(results: "Results") -> dict[str, Any] | None:
    peak = metrics.peak(results, "post_force_N") if "post_force_N" in results.columns else None
    if peak is None:
        return None
    return {"peak": peak, "pressure": metrics.peak(results, "post_peak_pressure_MPa")}


def _extensor(results: "Results") -> dict[str, Any] | None:
    peak = metrics.peak(results, "quadriceps_N")
    if peak is None:
        return None
    wraps = ""
    if "first_wrapping_flexion_deg" in results.summary:
        first = results.summary["first_wrapping_flexion_deg"]
        wraps = "does not wrap the femur" if first is None else _wraps_from(results, first)
    slope = results.columns.get("quadriceps_per_dome_mm_N")
    known = slope is not None and np.isfinite(slope[peak.frame]) and peak.value > 0
    return {
        "peak": peak,
        "value": _with_band(
            results, "quadriceps_N", peak.frame, 1.0 / metrics.body_weight(results), 2
        ),
        "ligament": _range(metrics.tension_ratio(results, "patellar_ligament_N"), "", 2),
        "patella": _range(metrics.tension_ratio(results, "patellofemoral_N"), "", 2),
        "wraps": wraps,
        "per_mm": abs(slope[peak.frame]) / peak.value if known and slope is not None else None,
    }


def _wraps_from(results: "Results", first: float) -> str:
    """Return the flexion from which the quadriceps wraps the femur, in words, `first` of a frame,
    deg.
    """
    flexion, wrap = results["flexion_deg"], results["quadriceps_wrap_deg"]
    last = max(flexion[(wrap == 0.0) & (flexion < first)], default=first)
    if first - last > DISTANT_FRAMES_DEG:
        return f"begins to wrap the femur between {last:.0f}° and {first:.0f}° of flexion"
    return f"wraps the femur from {first:.0f}° of flexion"


def _residuals(results: "Results") -> dict[str, Any] | None:
    share = 100 * metrics.residual_share(results)
    if not np.isfinite(share).any():
        return None
    released = set((results.summary.get("contact") or {}).get("released") or ())
    largest = float(np.nanmax(share))
    change, axial = 100 * metrics.residual_effect(results), np.abs(results["residual_axial_Nm"])
    return {
        "none": {"ap", "ml", "axial_rotation"} <= released and largest < RESIDUAL_PERCENT,
        "median": float(np.nanmedian(share)),
        "largest": largest,
        "change": float(np.nanmax(change)) if np.isfinite(change).any() else None,
        "axial": float(np.nanmax(axial)) if np.isfinite(axial).any() else None,
        "large": largest > 100 * AGREEMENT.large_residual_share,
    }


def _range(values: Array, unit: str, digits: int = 0) -> str:
    if not np.isfinite(values).any():
        return "–"
    low, high = f"{np.nanmin(values):.{digits}f}", f"{np.nanmax(values):.{digits}f}"
    return f"{low}{unit}" if low == high else f"{low}–{high}{unit}"
