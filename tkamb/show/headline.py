"""The headline of the report: cards with the main results."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.geometry.frames import SIDES, Array
from tkamb.run import metrics
from tkamb.run.known_errors import is_large, short_error_words
from tkamb.run.status import AGREEMENT
from tkamb.show.axis import HorizontalAxis

if TYPE_CHECKING:
    from tkamb.run.results import Results

BANDED = {"force_total_N": "the total", "medial_force_N": "the medial force"}
AXIS_NAMES = {"ap": "AP", "si": "SI", "ml": "ML"}


@dataclass(frozen=True)
class HeadlineSettings:
    """Limits of the report's headline."""

    most_inputs: int = 2
    """Largest number of inputs in a sentence. Chosen because the sentence stays short."""
    most_muscles: int = 4
    """Largest number of saturated muscles in a sentence. Chosen because the sentence stays
    short."""
    notable_failed_share: float = 0.05
    """1: a larger share of failed samples is stated. Chosen because fewer failed samples hardly
    move the 5th or 95th percentile."""
    residual_percent: float = 0.05
    """% of the SI contact force: smaller residuals count as none. Chosen because they are within
    the tolerance of the equilibrium."""
    distant_frames_deg: float = 5.0
    """deg: if the quadriceps begins to wrap between frames farther apart than this, the flexion of
    both is stated. Chosen because readers need this flexion to a few degrees."""


HEADLINE = HeadlineSettings()

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
        title: name of the number.
        value: the number with its unit.
        detail: place in the motion, and meaning of the number.
        warning: whether the card is highlighted as a warning.
    """

    title: str
    value: str
    detail: str
    warning: bool = False

    def line(self) -> str:
        """Return the card as one line of text."""
        return f"{self.title}: {self.value} ({self.detail})"


def run_title(summary: Mapping[str, Any]) -> str:
    """Return the title in a run's summary, or a title made from the path of its scene."""
    if summary.get("title"):
        return str(summary["title"])
    scene = Path(str(summary.get("scene") or "tkamb run"))
    name = scene.parent.name if scene.stem == "scene" and scene.parent.name else scene.stem
    return name.upper() if len(name) <= 3 else name.replace("_", " ").capitalize()


def cards(results: "Results", axis: HorizontalAxis) -> list[Card]:
    """Return the headline numbers that the run has."""
    result = (
        _questions(results),
        _remarks(results),
        _peaks(results),
        _peak_force(results, axis),
        _band(results, axis),
        _measured(results),
        _discrepancy(results),
        muscle_limits(results),
        _shares(results),
        _peak_pressure(results, axis),
        _post(results, axis),
        _extensor(results, axis),
        _residuals(results),
        _frames(results),
    )
    return [card for card in result if card is not None]


def _where(results: "Results", axis: HorizontalAxis, frame: int) -> str:
    flexion = f"{round(results['flexion_deg'][frame]) + 0}° of flexion"
    if axis.kind == "flexion":
        return f"at {flexion}"
    name = f"{axis.at(frame)} of the cycle" if axis.kind == "cycle" else axis.at(frame)
    return f"at {name} ({flexion})"


def _questions(results: "Results") -> Card | None:
    questions = results.summary.get("questions") or []
    if not questions:
        return None
    many = len(questions) > 1
    detail = " ".join(f"({k}) {q}" if many else str(q) for k, q in enumerate(questions, 1))
    return Card("Questions to answer", str(len(questions)), detail, True)


def _remarks(results: "Results") -> Card | None:
    remarks = results.summary.get("remarks") or []
    if not remarks:
        return None
    return Card("Notices on recordings", str(len(remarks)), "; ".join(map(str, remarks)))


def peak_words(peak: Mapping[str, Any]) -> str:
    """Return a peak force with its bands in words, body weights.

    Args:
        peak: entry of `peaks_BW` in the summary, or with bands in `uncertainty` of the summary.
    """
    if peak.get("p05") is None:
        return f"{peak['nominal']:.2f}"
    words = f"{peak['median']:.2f} ({peak['p05']:.2f}–{peak['p95']:.2f}"
    if peak.get("discrepancy_p05") is not None:
        words += f"; {peak['discrepancy_p05']:.2f}–{peak['discrepancy_p95']:.2f}"
    return words + ")"


def peaks_of(summary: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return name of a force -> entry for `peak_words`, with bands if inputs were varied."""
    varied = (summary.get("uncertainty") or {}).get("peaks_BW")
    return varied or summary.get("peaks_BW") or {}


def peak_legend(peaks: Mapping[str, Any]) -> str:
    """Return the meaning of the brackets in `peak_words`."""
    if not any(one.get("p05") is not None for one in peaks.values()):
        return "with the inputs as given; `tkamb uncertainty` computes their uncertainty"
    words = "median of the samples (5 to 95 % by the inputs"
    if any(one.get("discrepancy_p05") is not None for one in peaks.values()):
        words += "; 5 to 95 % by the inputs and by the discrepancy of the method"
    return words + ")"


def _peaks(results: "Results") -> Card | None:
    """Return the peak total, medial and lateral force with their bands."""
    peaks = peaks_of(results.summary)
    if not peaks:
        return None
    values, bands = [], []
    for name, one in peaks.items():
        number, _, band = peak_words(one).partition(" (")
        values.append(f"{name} {number}")
        bands += [f"{name} {band.removesuffix(')').replace('; ', ' and ')}"] if band else []
    value = ", ".join(values) + " BW"
    kind = "a median of the samples" if bands else "computed with the inputs as given"
    sentences = [
        f"Each force is {kind}, at the frame of its own maximum.",
        "The total is the component along the insert's axis, as an instrumented tray measures it.",
    ]
    if bands:
        wide = any(one.get("discrepancy_p05") is not None for one in peaks.values())
        more = ", and by the inputs and the discrepancy of the method" if wide else ""
        sentences.append(f"The bands are 5 to 95 % by the inputs{more}: {', '.join(bands)}.")
    else:
        sentences.append("`tkamb uncertainty` computes the uncertainty of these forces.")
    return Card("Peak forces: superior–inferior total, medial, lateral", value, " ".join(sentences))


def _discrepancy(results: "Results") -> Card | None:
    """Return the error of the method in measured knees; None: unknown, or this knee is measured."""
    if not results.summary.get("discrepancy") or results.summary.get("measured"):
        return None
    value = f"{results.summary['discrepancy']['rmse_BW']:.2f} BW RMS"
    detail = (
        "This is the error of the total force. The report's list “What to know” names the trials "
        "and the other forces."
    )
    if "muscles" not in (results.summary.get("scene_tables") or {}):
        detail += " The compared runs had all muscles; the error of this run, without [muscles], "
        detail += "may be larger."
    return Card("Error of this method in measured knees", value, detail)


def muscle_limits(results: "Results") -> Card | None:
    """Return the card of the hip's reserve moments and of the saturated muscles."""
    reserves = results.summary.get("reserves") or {}
    saturated = results.summary.get("saturated_muscles") or {}
    if not reserves:
        return None
    hip = {name: one for name, one in reserves.items() if name.startswith("hip")}
    largest = max((one["percent_of_largest_moment"] for one in hip.values()), default=0.0)
    named = sorted(saturated, key=lambda name: -saturated[name])[: HEADLINE.most_muscles]
    listed = ", ".join(f"{name} ({saturated[name]} frames)" for name in named)
    if len(saturated) > len(named):
        listed += f" and {len(saturated) - len(named)} more"
    detail = "No muscle reaches its largest force."
    if named:
        detail = f"These muscles reach their largest force: {listed}."
    value = f"hip {largest:.0f} % of its largest moment" if hip else "no hip"
    return Card("Reserves, and saturated muscles", value, detail, bool(saturated))


def _peak_force(results: "Results", axis: HorizontalAxis) -> Card | None:
    result = metrics.peak(results, "force_total_BW")
    if result is None:
        return None
    share = results["force_si_N"][result.frame] / results["force_total_N"][result.frame]
    table, band = results.summary.get("uncertainty"), results.band("force_total_BW")
    if table and band is not None and np.isfinite(band[0, result.frame]):
        low, middle, high = band[:, result.frame]
        sampled = table.get("peak_force_total_BW") or {}
        words = sampled.get("words", f"{result.value:.2f} BW with the inputs as given")
        detail = (
            f"The value is the median of {table['samples']} samples, with 5 to 95 % of them, "
            f"{_where(results, axis, result.frame)}. The run has {words}."
        )
        return Card(
            "Peak resultant contact force", f"{middle:.2f} BW ({low:.2f}–{high:.2f})", detail
        )
    detail = (
        f"The resultant is {results['force_total_N'][result.frame]:.0f} N "
        f"{_where(results, axis, result.frame)}. "
        f"Its superior–inferior component is {100 * share:.1f} % of it."
    )
    return Card("Peak resultant contact force", f"{result.value:.2f} BW", detail)


def _band(results: "Results", axis: HorizontalAxis) -> Card | None:
    """Return the band of the peak force, its main causes, and inputs that are not varied."""
    table, peak = results.summary.get("uncertainty"), metrics.peak(results, "force_total_BW")
    band = results.band("force_total_BW")
    if not table or peak is None or band is None:
        return None
    low, middle, high = band[:, peak.frame]
    parts = [f"The band holds 5 to 95 % of {table['samples']} samples, median {middle:.2f} BW."]
    if not np.isfinite(low):
        why = results.why_no_band(peak.frame)
        parts = [f"There is no band {_where(results, axis, peak.frame)}: {why}."]
    causes = [
        f"{words} varies most with {_largest(table, name)}"
        for name, words in BANDED.items()
        if _largest(table, name)
    ]
    parts += [_sentence(" and ".join(causes))] if causes else []
    for name, inside in table.get("measured_inside", {}).items():
        if inside["frames"]:
            more = inside.get("share_with_discrepancy")
            wide = "" if more is None else f", and within the band with discrepancy in {more:.0%}"
            parts.append(
                f"The measured {name} force lies within its band in {inside['share']:.0%} of "
                f"{inside['frames']} frames{wide}."
            )
    sampled = table.get("peak_force_total_BW")
    if sampled and sampled["median"] is None:
        parts.append(_sentence(sampled["words"]))
    worst, not_varied = table["largest_failed_share"], table["not_varied"]
    if worst > HEADLINE.notable_failed_share:
        why = "".join(f", most often: {text}" for text in [*table.get("causes_of_failure", ())][:1])
        parts.append(f"In up to {worst:.0%} of the samples a frame failed{why}.")
    if not_varied:
        names = ", ".join(name.replace("_", " ") for name in not_varied)
        parts.append(f"The band does not include inputs that are not varied: {names}.")
    value = f"{low:.2f}–{high:.2f} BW" if np.isfinite(low) else "–"
    return Card("Uncertainty of the peak", value, " ".join(parts), bool(not_varied))


def _sentence(words: str) -> str:
    """Return words with a capital letter and a full stop."""
    return f"{words[:1].upper()}{words[1:]}."


def _largest(table: Mapping[str, Any], result: str) -> str:
    """Return the inputs with the largest shares of the variance of a result, in words."""
    shares = (table.get("shares_of_variance") or {}).get(result) or {}
    first = [(name, share) for name, share in shares.items() if name != "rest"][
        : HEADLINE.most_inputs
    ]
    return ", ".join(f"{_plain(name)} ({share:.0%})" for name, share in first if share >= 0.01)


def _plain(name: str) -> str:
    return AXIS_NAMES.get(name, name.replace("_", " ").replace(".", " "))


def _measured(results: "Results") -> Card | None:
    """Return the difference from the forces of an instrumented implant, with [measured]."""
    if not results.summary.get("measured"):
        return None
    from tkamb.run.recorded import comparison_words

    value, detail, incomplete = comparison_words(results.summary["measured"])
    return Card("Compared with the measured force", value, detail, incomplete)


def _shares(results: "Results") -> Card | None:
    texts = {}
    for estimate in ("deformation", "equilibrium"):
        share = 100 * metrics.medial_share(results, estimate)
        if np.isfinite(share).any():
            texts[estimate] = _range(share, " %")
    if not texts:
        return None
    unknown = int(metrics.split_undetermined(results).sum())
    first = "equilibrium" if unknown and "equilibrium" in texts else next(iter(texts))
    others = "".join(f"; {name} gives {text}" for name, text in texts.items() if name != first)
    sentences = [f"{first.capitalize()} gives this share{others}."]
    share = metrics.medial_share(results, "deformation" if "deformation" in texts else first)
    alone = int(((share <= 0) | (share >= 1)).sum())
    apart = int((metrics.shares_apart(results) > AGREEMENT.share_difference).sum())
    flags = [f"one condyle is unloaded in {alone} frame{'s' * (alone > 1)}"] if alone else []
    flags += [f"both estimates disagree in {apart} frame{'s' * (apart > 1)}"] if apart else []
    sentences += [_sentence(" and ".join(flags))] if flags else []
    sentences += _adduction(results, unknown)
    warning = bool(alone or apart or unknown)
    return Card("Medial share of the load", texts[first], " ".join(sentences), warning)


def _adduction(results: "Results", unknown: int) -> list[str]:
    """Return a sentence on the effect of an error of the adduction; empty without an effect."""
    shift = metrics.moved_per_half_degree(results)
    words = []
    if unknown:
        where = "in any frame" if unknown == len(results) else f"in {unknown} frames"
        words.append(f"the share by deformation is not determined {where}")
    if np.isfinite(shift).any():
        text = _range(shift, " N")
        words.append(
            f"an error of 0.5 deg in adduction shifts {text} from one condyle to the other"
        )
    return [_sentence(": ".join(words))] if words else []


def _peak_pressure(results: "Results", axis: HorizontalAxis) -> Card | None:
    result = metrics.peak(results, "<side>_peak_pressure_MPa")
    if result is None:
        return None
    detail = f"The peak is on the {result.side} condyle {_where(results, axis, result.frame)}"
    doubt = metrics.doubt_of_peak(results, result.side, result.frame)
    detail += f", where {doubt}." if doubt else "."
    detail += _above_yield(results, result.side)
    error = results.summary.get("known_error")
    if error is not None:
        detail += f" {short_error_words(error, PRESSURE_AND_AREA)}"
    large = bool(doubt) or (error is not None and is_large(error, PRESSURE_AND_AREA))
    return Card("Peak contact pressure", f"{result.value:.1f} MPa", detail, large)


def _above_yield(results: "Results", first: str) -> str:
    """Return a sentence on the largest share of each condyle's area above the yield stress.

    Args:
        results: results of a run.
        first: side that is named first.
    """
    stress = results.summary.get("yield_stress_MPa")
    parts = []
    for side in sorted(SIDES, key=lambda side: side != first):
        above = metrics.peak(results, f"{side}_area_above_yield")
        if above is not None:
            parts.append((100 * above.value, side))
    if stress is None or not parts:
        return ""
    if not any(percent > 0 for percent, _ in parts):
        return f" The pressure is never above yield ({stress:g}\u00a0MPa)."
    words = " and ".join(f"{percent:.0f} % of the {side} area" for percent, side in parts)
    return f" Up to {words} is above yield ({stress:g}\u00a0MPa)."


def _post(results: "Results", axis: HorizontalAxis) -> Card | None:
    """Return the peak force and pressure of the cam on the post; None: the post is not modelled."""
    result = metrics.peak(results, "post_force_N") if "post_force_N" in results.columns else None
    if result is None:
        return None
    if result.value <= 0:
        return Card("Peak force on the post", "none", "Cam and post are not in contact.")
    pressure = metrics.peak(results, "post_peak_pressure_MPa")
    detail = (
        f"The cam presses on the post with {result.value:.0f} N "
        f"{_where(results, axis, result.frame)}."
    )
    if pressure is not None:
        detail += f" The pressure on the post is at most {pressure.value:.1f}\u00a0MPa."
        detail += " The error of this pressure is not measured."
    value = f"{result.value / metrics.body_weight(results):.2f} BW"
    return Card("Peak force on the post", value, detail)


def _extensor(results: "Results", axis: HorizontalAxis) -> Card | None:
    result = metrics.peak(results, "quadriceps_N")
    if result is None:
        return None
    value = result.value / metrics.body_weight(results)
    ligament = _range(metrics.tension_ratio(results, "patellar_ligament_N"), "", 2)
    patella = _range(metrics.tension_ratio(results, "patellofemoral_N"), "", 2)
    detail = f"The peak is {_where(results, axis, result.frame)}"
    if "first_wrapping_flexion_deg" in results.summary:
        first = results.summary["first_wrapping_flexion_deg"]
        wraps = "does not wrap the femur" if first is None else _wraps_from(results, first)
        detail += f"; the quadriceps {wraps}"
    detail += (
        f". Over the motion, the patellar ligament carries {ligament} of the quadriceps tension "
        f"(PL/Q) and the patellofemoral force is {patella} of it (PF/Q)."
    )
    slope = results.columns.get("quadriceps_per_dome_mm_N")
    if slope is not None and np.isfinite(slope[result.frame]) and result.value > 0:
        percent = 100 * abs(slope[result.frame]) / result.value
        detail += (
            f" The tension changes by {percent:.1f} % if the button is placed 1 mm higher or lower "
            "on the patella than in the scene."
        )
    return Card("Peak quadriceps tension", f"{value:.2f} BW", detail)


def _wraps_from(results: "Results", first: float) -> str:
    """Return in words the flexion at which the quadriceps begins to wrap the femur.

    Args:
        results: results of a run.
        first: smallest flexion of a frame in which it wraps, deg.
    """
    flexion, wrap = results["flexion_deg"], results["quadriceps_wrap_deg"]
    last = max(flexion[(wrap == 0.0) & (flexion < first)], default=first)
    if first - last > HEADLINE.distant_frames_deg:
        return f"begins to wrap the femur between {last:.0f}° and {first:.0f}° of flexion"
    return f"wraps the femur from {first:.0f}° of flexion"


def _residuals(results: "Results") -> Card | None:
    share = 100 * metrics.residual_share(results)
    if not np.isfinite(share).any():
        return None
    released = (results.summary.get("contact") or {}).get("released") or ()
    if {"ap", "ml", "axial_rotation"} <= set(released) and np.nanmax(
        share
    ) < HEADLINE.residual_percent:
        detail = (
            "AP, ML and axial rotation are released. Equilibrium holds along these coordinates."
        )
        return Card("Residual force", "none", detail)
    middle = f"{np.nanmedian(share):.1f} %"
    detail = (
        "The value is the median over the frames, relative to the superior–inferior contact force; "
        f"the largest value is {np.nanmax(share):.1f} %."
    )
    change = 100 * metrics.residual_effect(results)
    if np.isfinite(change).any():
        largest = np.nanmax(change)
        detail += (
            " If the residual acted 10 mm above or below the midpoint of the contact points, the "
            f"total would change by at most {largest:.1f} %."
        )
    axial = np.abs(results["residual_axial_Nm"])
    if np.isfinite(axial).any():
        detail += f" The residual axial moment is at most {np.nanmax(axial):.1f}\u00a0N·m."
    return Card(
        "Residual force",
        middle,
        detail,
        bool(np.nanmax(share) > 100 * AGREEMENT.large_residual_share),
    )


def _frames(results: "Results") -> Card:
    failed = int(metrics.failed(results).sum())
    flagged = int(metrics.flagged(results).sum())
    value = f"{len(results) - failed} of {len(results)}"
    if failed or flagged:
        words = [f"{failed} failed and have no numbers"] if failed else []
        words += [f"{flagged} are to be read with care"] if flagged else []
        detail = f"Of the frames, {' and '.join(words)}."
        detail += " The report's table and the column status give the reasons."
    else:
        detail = "No frame failed and none is flagged."
    return Card("Frames computed", value, detail, bool(failed or flagged))


def _range(values: Array, unit: str, digits: int = 0) -> str:
    if not np.isfinite(values).any():
        return "–"
    low, high = f"{np.nanmin(values):.{digits}f}", f"{np.nanmax(values):.{digits}f}"
    return f"{low}{unit}" if low == high else f"{low}–{high}{unit}"
