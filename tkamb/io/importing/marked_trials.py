"""Markers of several trials of one subject, and the scene with registered markers."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.importing.links import Links
from tkamb.io.importing.markers import ModelSegment, facing, recorded_labels, segments_of
from tkamb.io.importing.registration import Registration, misfit, register
from tkamb.io.importing.request import ImportRequest
from tkamb.io.importing.scene_text import SceneText
from tkamb.io.recordings.laboratory import laboratory_rotation
from tkamb.io.recordings.markers import MAX_MEDIAN_RESIDUAL, marker_trajectories, matched_labels
from tkamb.io.recordings.tables import Table, read_table, with_unit
from tkamb.units import DEGREE, MILLIMETRE

# m: a trial is registered by default if its markers misfit the model by more (root mean square of
# the rigid fits of shank and thigh). Markers that a standing trial has placed
# misfit by 2 to 5 mm, and those of a model of another session by 20 mm and more.
MISFIT = 10.0 * MILLIMETRE
# m: likewise for the median distance of the knee centres of shank and thigh. Frames
# of a run with a larger distance are flagged.
KNEE_DISTANCE = 20.0 * MILLIMETRE
# m: a marker sits elsewhere in another trial if its distances to the others of its segment differ
# by more. Skin changes them by less than 6 mm in walks and squats.
MOVED = 10.0 * MILLIMETRE


def with_registered_markers(
    scene: SceneText, request: ImportRequest, links: Links
) -> tuple[SceneText, Registration | None, list[str]]:
    """Return the scene with registered markers, the registration, and remarks on it.

    Without `request.register` the markers are registered if they misfit the model. The registration
    is None if they are not.

    Raises:
        InputError: a trial cannot be read, or the registration fails.
    """
    assert scene.markers is not None
    segments = list(scene.markers.segments)
    own = measured_markers(request.recording, request, segments, scene.markers.axes)
    rms, apart = misfit(links, segments, own)
    poor = rms > MISFIT or apart > KNEE_DISTANCE
    if rms > MAX_MEDIAN_RESIDUAL:
        return scene, None, []  # loading the scene refuses the wrong unit or label
    if not (poor or request.companions if request.register is None else request.register):
        return scene, None, []
    trials, lines = {request.recording.name: own}, []
    for path in request.companions:
        measured = measured_markers(path, request, segments)
        for label in moved_markers(segments, own, measured):
            lines.append(f"marker {label} sits elsewhere in {path.name} and is not used there")
        trials[path.name] = measured
    found = register(links, segments, trials)
    markers = replace(scene.markers, segments=found.segments)
    knee = float(np.sqrt(np.mean(found.knee_centre**2))) / MILLIMETRE
    uncertainty = {
        "knee_centre_mm": round(knee, 1),
        "frontal_alignment_deg": round(found.frontal_alignment / DEGREE, 2),
    }
    scene = replace(scene, markers=markers, uncertainty=uncertainty)
    return scene, found, [*lines, *_lines(found, segments)]


def measured_markers(
    path: Path, request: ImportRequest, segments: Sequence[ModelSegment], axes: str | None = None
) -> dict[str, Array]:
    """Return segment -> measured markers (n, m, 3), m, of a recording, x forward and y up.

    Args:
        request: the import, with its unit of length and marker prefix.
        segments: segments with their markers. A marker that the recording lacks is NaN.
        axes: axes of the file that point forward, up and right; None: from the markers.
    """
    recorded = _read(path, request)
    own = segments_of(recorded, list(segments))
    turn = laboratory_rotation(axes or facing(own, recorded).axes, recorded.path)
    scale = recorded.unit_scale(None, "length_unit")
    labels, frames = recorded_labels(recorded), len(recorded.time())
    result = {}
    for segment in segments:
        match = matched_labels(segment.points, labels)
        result[segment.name] = np.full((frames, len(segment.points), 3), np.nan)
        for k, label in enumerate(segment.points):
            if label in match:
                track = marker_trajectories(recorded, [match[label]], scale)[:, 0]
                result[segment.name][:, k] = track @ turn.T
    return result


def _read(path: Path, request: ImportRequest) -> Table:
    recorded = with_unit(read_table(path), request.units.length)
    if not recorded_labels(recorded):
        raise InputError("has no markers", path, "give --with recordings of markers")
    return recorded


def moved_markers(
    segments: Sequence[ModelSegment], own: dict[str, Array], other: dict[str, Array]
) -> list[str]:
    """Return the markers that sit elsewhere in another trial, and set them to NaN in `other`.

    The distances of such a marker to most of the others of its segment differ between the trials.
    """
    moved = []
    for segment in segments:
        here, there = (_distances(markers[segment.name]) for markers in (own, other))
        for k, label in enumerate(segment.points):
            change = np.sort(np.abs(np.delete(here[k] - there[k], k)))
            change = change[np.isfinite(change)]
            if len(change) and change[(len(change) - 1) // 2] > MOVED:
                moved.append(label)
        gone = [k for k, label in enumerate(segment.points) if label in moved]
        other[segment.name][:, gone] = np.nan
    return moved


def _distances(points: Array) -> Array:
    """Return the median distances (m, m) of markers (n, m, 3), m; NaN if never seen together."""
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    seen = np.isfinite(apart).any(axis=0)
    result = np.full(seen.shape, np.nan)
    result[seen] = np.nanmedian(apart[:, seen], axis=0)
    return result


def _lines(found: Registration, model: Sequence[ModelSegment]) -> list[str]:
    rms = {name: found.rms(values) / MILLIMETRE for name, values in found.residuals.items()}
    apart = [distance / MILLIMETRE for distance in found.knee_distance]
    lines = [
        f"markers registered with the motion of {', '.join(found.trials)} ({found.frames} frames): "
        f"rigid fits of shank and thigh {rms['before']:.1f} -> {rms['after']:.1f} mm (rms), knee "
        f"centres {apart[0]:.1f} -> {apart[1]:.1f} mm apart (median)",
        "  marker: residual before -> after, shift from the model's position ± its deviation, "
        "share that the data decide (the model decides the rest)",
    ]
    for segment in found.segments:
        for label in segment.points:
            before, after = (found.residuals[k][label] / MILLIMETRE for k in ("before", "after"))
            shift = ", ".join(
                f"{a / MILLIMETRE:.0f} ± {b / MILLIMETRE:.0f}"
                for a, b in zip(found.shift(label, model), found.deviation[label], strict=True)
            )
            lines.append(
                f"  {label}: {before:.1f} -> {after:.1f} mm, ({shift}) mm, "
                f"{found.data_share(label):.0%}"
            )
    for name, (moved, deviation) in found.joints.items():
        parts = ", ".join(
            f"{a / MILLIMETRE:.0f} ± {b / MILLIMETRE:.0f}"
            for a, b in zip(moved, deviation, strict=True)
        )
        lines.append(f"  centre of the {name}: ({parts}) mm from the model's")
    centre = ", ".join(f"{one / MILLIMETRE:.1f}" for one in found.knee_centre)
    lines.append(
        f"deviation of the knee's centre: ({centre}) mm AP, SI, ML; of the shank's frontal angle: "
        f"{found.frontal_alignment / DEGREE:.1f} deg. They are the scene's [uncertainty]"
    )
    return lines
