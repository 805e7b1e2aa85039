"""Conclusions that a run supports, and those that it does not: on the report's first screen."""

from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.geometry.frames import Mask
from tkamb.run import metrics
from tkamb.run.known_errors import is_large, known_error_words
from tkamb.run.status import AGREEMENT
from tkamb.show.headline import PRESSURE_AND_AREA

if TYPE_CHECKING:
    from tkamb.run.results import Results

ALWAYS_NOT = (
    "What another patient, another trial or another day would show: this is one knee in one motion."
)


def conclusions(results: "Results") -> tuple[list[str], list[str]]:
    """Return the conclusions that the run supports and those that it does not, a sentence each."""
    sentences = (_force(results), _split(results), _pressure(results), _certainty(results))
    bears = [words for good, _ in sentences for words in good]
    bears_not = [words for _, bad in sentences for words in bad]
    questions = len(results.summary.get("questions") or [])
    if questions:
        many = "questions above are" if questions > 1 else "question above is"
        bears_not.insert(0, f"Any conclusion, before the {many} answered.")
    return bears, [*bears_not, ALWAYS_NOT]


def _force(results: "Results") -> tuple[list[str], list[str]]:
    if not np.isfinite(results["force_total_N"]).any():
        return [], ["The contact force: it is not modelled here, or every frame failed."]
    failures = metrics.failed(results)
    bad = [f"Results in {_frames(failures)}, which failed."] if failures.any() else []
    measured = _compared(results)
    if measured:
        parts = [f"{name} {one['rmse_BW']:.2f} BW" for name, one in measured.items()]
        worse = [name for name, one in measured.items() if (one["r_squared"] or 0.0) < 0.0]
        bad += [
            f"The course of the {name} force: its constant mean would fit the measurement better."
            for name in worse
        ]
        return [
            f"The forces of this trial, with an error of {', '.join(parts)} (rms) against the "
            f"measurement."
        ], bad
    if results.summary.get("muscle_groups"):
        bad.append("How the muscles really shared the load: nothing was measured for comparison.")
        return ["The total force if the muscles share the joint moments as the scene says."], bad
    bad.append("The effect of hamstrings and gastrocnemius: only the quadriceps is modelled.")
    return [
        "The least force that this motion needs, with the quadriceps alone: co-contraction of "
        "other muscles raises it."
    ], bad


def _compared(results: "Results") -> dict[str, Any]:
    """Return the comparison of each force that was measured in some frame."""
    result = results.summary.get("measured") or {}
    return {name: one for name, one in result.items() if one["frames_compared"]}


def _split(results: "Results") -> tuple[list[str], list[str]]:
    if _compared(results).keys() & {"medial", "lateral"}:
        return [], []
    if not np.isfinite(metrics.medial_share(results, "equilibrium")).any():
        return [], []
    unknown = metrics.split_undetermined(results)
    apart = (metrics.shares_apart(results) > AGREEMENT.share_difference) & ~unknown
    bad = []
    if unknown.any():
        bad = [
            f"The split by deformation in {_frames(unknown)}: half a degree of adduction changes "
            f"it."
        ]
    if apart.any():
        bad.append(
            f"The split in {_frames(apart)}: the estimates by equilibrium and deformation differ."
        )
    if apart.all():
        return [], bad
    how = ", by equilibrium of moments" if unknown.any() else ", as far as the knee's pose is right"
    return [f"Which condyle carries more{' elsewhere' if apart.any() else ''}{how}."], bad


def _pressure(results: "Results") -> tuple[list[str], list[str]]:
    error = results.summary.get("known_error")
    if error is None:
        return [], ["Pressures and areas: contact is not modelled."]
    bears = [
        "Whether another design, pose or setting, computed in the same way, has higher pressure."
    ]
    if isinstance(error, str):
        return bears, [f"Pressures and areas as absolute values: their error is {error}."]
    words = f"{known_error_words(error, PRESSURE_AND_AREA)}; load, pose and shape add their own"
    if is_large(error, PRESSURE_AND_AREA):
        return bears, [f"Pressures and areas as absolute values: {words}."]
    return [f"Pressures and areas of unworn surfaces: {words}.", *bears], []


def _certainty(results: "Results") -> tuple[list[str], list[str]]:
    if results.summary.get("uncertainty"):
        return ["The effect of the varied inputs: the shaded bands."], []
    return [], ["The uncertainty of these results: no input was varied (use tkamb uncertainty)."]


def _frames(chosen: Mask) -> str:
    """Return how many frames of a run (f,) are chosen, in words."""
    count = int(chosen.sum())
    if count == len(chosen):
        return "any frame" if count > 1 else "the frame"
    return f"{count} of {len(chosen)} frames"
