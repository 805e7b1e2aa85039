"""Motion, laboratory axes and ground reaction of a recorded trial, and its registered markers.

A standing trial of the same subject can calibrate the positions of the markers.
"""

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, Array, inverse, mirrored_pose, transform
from tkamb.io.importing.anatomy import OTHER, Leg, way_to_pelvis
from tkamb.io.importing.ground import common_interval, find_ground
from tkamb.io.importing.links import Links
from tkamb.io.importing.markers import (
    Facing,
    ModelSegment,
    facing,
    feet,
    model_segments,
    recorded_labels,
    seen_segments,
    segments_of,
)
from tkamb.io.importing.plates import marked_feet
from tkamb.io.importing.recorded_poses import (
    MOTION_FILE,
    ModelMotion,
    RecordedPoses,
    ShankMarkers,
    model_feet,
    model_motion,
    shank_markers,
)
from tkamb.io.importing.registration import Registration, misfit, register
from tkamb.io.importing.scene_text import GroundFile, ImportRequest, MarkerFile, SceneText
from tkamb.io.recordings.c3d import read_c3d
from tkamb.io.recordings.filtering import check_spacing
from tkamb.io.recordings.inverse_kinematics import LegChain
from tkamb.io.recordings.laboratory import laboratory_rotation
from tkamb.io.recordings.marker_motion import both_fits, leg_segments, neutral_coordinates
from tkamb.io.recordings.markers import (
    MAX_MEDIAN_RESIDUAL,
    marker_trajectories,
    matched_labels,
    plain_label,
)
from tkamb.io.recordings.recording_tables import MarkersTable
from tkamb.io.recordings.tables import Table, read_table, with_unit
from tkamb.io.scene import Scene
from tkamb.units import DEGREE, MILLIMETRE


def with_static_markers(
    scene: SceneText, static: Path, segments: list[ModelSegment], length_unit: str | None = None
) -> tuple[SceneText, list[str]]:
    """Return the scene with marker positions from a standing trial, and remarks on them.

    Args:
        length_unit: unit of lengths in the trial; None: the unit that the file states.
    """
    assert scene.markers is not None
    marker_table = Scene.model_validate(tomllib.loads(scene.text())).motion.markers
    assert marker_table is not None
    recorded = with_unit(read_table(static), length_unit)
    axes = facing(segments_of(recorded, segments), recorded).axes
    marker_table = marker_table.model_copy(update={"laboratory_axes": axes})
    side: Literal["right", "left"] = "left" if scene.side == "left" else "right"
    insert = scene.links.insert_in_tibia
    if side == "left":
        insert = mirrored_pose(insert)
    places = calibrated_markers(marker_table, recorded, side, insert)
    changed_segments, farthest = [], 0.0
    for segment in segments:
        by_label = {plain_label(k): v for k, v in places[segment.name].items()}
        points = {k: by_label.get(plain_label(k), v) for k, v in segment.points.items()}
        shifts = [np.linalg.norm(points[k] - v) for k, v in segment.points.items()]
        farthest = max(farthest, float(np.max(shifts)))
        changed_segments.append(replace(segment, points=points))
    markers = replace(scene.markers, segments=tuple(changed_segments))
    line = (
        f"marker positions are from the standing trial {static.name}, at most "
        f"{farthest * 1e3:.1f} mm from the model's"
    )
    notices = [f"notice: {remark}" for remark in recorded.remarks]
    return replace(scene, markers=markers), [line, *notices]


def calibrated_markers(
    table: MarkersTable,
    recorded: Table,
    side: Literal["right", "left"],
    pose_insert_in_tibia: Array,
) -> dict[str, dict[str, Array]]:
    """Return segment -> marker -> calibrated position in the segment, m, shape (3,).

    It is the marker's mean position in the segment of a leg chain fitted to the standing trial,
    with the table's marker positions.

    Args:
        table: markers and joints of the scene. Markers that the trial lacks are ignored.
        pose_insert_in_tibia: pose of the insert frame in the tibia link, (4, 4), mirrored for a
            left leg.
    """
    labels = [column[:-2] for column in recorded.columns if column.endswith("_x")]
    points = [
        segment.model_copy(
            update={
                "markers_mm": {
                    k: v for k, v in segment.markers_mm.items() if matched_labels([k], labels)
                }
            }
        )
        for segment in table.segment
    ]
    markers = table.model_copy(update={"segment": tuple(points)})
    segments, measured = leg_segments(markers, recorded, None, side)
    chain = LegChain(segments, pose_insert_in_tibia, markers.knee == "free")
    neutral = neutral_coordinates(markers, side)
    _, chain_fit = both_fits(chain, segments, measured, neutral, recorded)
    mirror = MIRROR if side == "left" else np.eye(3)
    result = {}
    for name, poses in chain.poses(chain_fit.state).items():
        positions = np.nanmean(transform(inverse(poses), measured[name]), axis=0) @ mirror
        result[name] = dict(zip(chain.segments[name].labels, positions, strict=True))
    return result


# Number of frames per period of the cut-off frequency. A motion that is low-pass-
# filtered at this frequency changes little between two such frames.
FRAMES_PER_PERIOD = 5.0


@dataclass(frozen=True, eq=False)
class Trial:
    """Motion and ground reaction of a recorded trial.

    Args:
        markers: recording of markers; None: the motion is not from markers.
        motion: motion from the model's coordinates; None: the motion is not from coordinates.
        poses: recorded poses of the knee; None: the motion is not from poses.
        shank: markers that give the shank's pose; None without `poses`.
    """

    ground: GroundFile | None
    remarks: tuple[str, ...]
    markers: MarkerFile | None = None
    motion: ModelMotion | None = None
    poses: RecordedPoses | None = None
    shank: ShankMarkers | None = None


def from_markers(request: ImportRequest, leg: Leg, links: Links, recorded: Table) -> Trial:
    """Return a trial whose motion is from markers."""
    segments = model_segments(links, recorded, request.without)
    facing = _facing(request, segments, recorded)
    foot_positions = marked_feet(recorded, facing.axes, feet(leg, recorded, OTHER[leg.side]))
    result = find_ground(request, leg, facing.axes, foot_positions)
    time = recorded.time()
    check_spacing(recorded.path, time)
    if request.interval is not None:
        _check_within(time, *request.interval)
    interval, joined = common_interval(time, result.interval, result.span)
    interval, frames, thinned = _thinned(time, interval, request.cutoff_Hz)
    markers = MarkerFile(
        request.recording,
        facing.axes,
        tuple(segments),
        request.method,
        "hinge",
        interval,
        frames,
        recorded.length_unit if recorded.unit_given else None,
        request.prefix is not None,
    )
    matched = [*_notices(request, recorded), *_segment_lines(segments, request.without)]
    text = (*matched, _facing_line(request, facing), *result.remarks, *joined, thinned)
    return Trial(result.ground, text, markers)


def from_poses(
    request: ImportRequest, leg: Leg, links: Links, recorded: Table, poses: RecordedPoses
) -> Trial:
    """Return a trial of recorded knee poses, with markers that give the shank's pose."""
    segments = seen_segments(links, recorded, request.without)
    facing = _facing(request, [s for s in segments.values() if len(s.points) >= 3], recorded)
    stance = poses.femur[poses.in_stance]
    shank = shank_markers(links, segments, stance, request.recording, facing.axes)
    covered = replace(request, interval=(float(poses.time[0]), float(poses.time[-1])))
    foot_positions = marked_feet(recorded, facing.axes, feet(leg, recorded, OTHER[leg.side]))
    result = find_ground(covered, leg, facing.axes, foot_positions)
    matched = [*_notices(request, recorded), *_segment_lines(segments.values(), request.without)]
    text = (
        *poses.remarks,
        *matched,
        _facing_line(request, facing),
        *shank.remarks,
        *result.remarks,
    )
    return Trial(result.ground, text, poses=poses, shank=shank)


def from_coordinates(request: ImportRequest, leg: Leg, links: Links, recorded: Table) -> Trial:
    """Return a trial whose motion is in the model's coordinates."""
    for joint in way_to_pelvis(leg):
        if joint.unread:
            raise InputError(joint.unread)
    motion = model_motion(links, recorded)
    text = [f"motion: the model's coordinates in {recorded.path.name}, into {MOTION_FILE}"]
    if motion.missing:
        text.append(f"not in the motion, so at their defaults: {', '.join(motion.missing)}")
    text += [*_notices(request, recorded), *motion.remarks]
    leg.model.check_gravity()
    feet = model_feet(links, recorded) if request.grf is not None else None
    axes = leg.model.ground_axes
    if axes is None:
        if request.grf is not None:
            raise InputError(
                "has gravity along none of its ground's axes, so forces in this ground cannot be "
                "read",
                request.model,
                "turn ground so that gravity is along an axis, or leave out --grf",
            )
        axes = "+x,+y,+z"
    result = find_ground(request, leg, axes, feet)
    text += result.remarks
    if result.ground is not None:
        text.append(f"laboratory: forward, up, right are {axes} of the model's ground")
    if request.interval is not None:
        _check_within(motion.time, *request.interval)
    interval, joined = common_interval(motion.time, result.interval, result.span)
    if interval is not None:
        motion = motion.part(*interval)
    return Trial(result.ground, (*text, *joined), motion=motion)


def _notices(request: ImportRequest, recorded: Table) -> list[str]:
    """Return notes on parts that are ignored or read in another way."""
    remarks = recorded.remarks
    if recorded.path.suffix.lower() == ".c3d":
        remarks = read_c3d(recorded.path, request.units).remarks
    return [f"notice: {remark}" for remark in remarks]


def _facing(request: ImportRequest, segments: list[ModelSegment], recorded: Table) -> Facing:
    if request.laboratory_axes is not None:
        return Facing(request.laboratory_axes, np.nan, np.nan)
    return facing(segments, recorded)


def _facing_line(request: ImportRequest, facing: Facing) -> str:
    line = f"laboratory: forward, up, right are the file's {facing.axes}"
    if request.laboratory_axes is not None:
        return line + ", as given"
    return line + (
        f" (the subject faces {facing.forward_deg:.0f} deg off the forward axis and leans by "
        f"{facing.up_deg:.0f} deg, on average)"
    )


def _segment_lines(segments: Iterable[ModelSegment], without: tuple[str, ...]) -> list[str]:
    lines = []
    for segment in segments:
        missing = f"; not recorded: {', '.join(segment.missing)}" if segment.missing else ""
        names = ", ".join(segment.points) or "none"
        lines.append(f"markers of the {segment.name}: {names}{missing}")
    return lines + ([f"markers left out, as given: {', '.join(without)}"] if without else [])


def _thinned(
    time: Array, interval: tuple[float, float] | None, cutoff_Hz: float
) -> tuple[tuple[float, float], int | None, str]:
    """Return the interval, the number of frames in it (None: all), and a remark.

    They are every k-th of the recording, at least `frames_per_period` times the cut-off frequency
    if it allows.
    """
    start, end = interval or (float(time[0]), float(time[-1]))
    inside = time[(time >= start - 1e-9) & (time <= end + 1e-9)]
    if len(inside) < 2:
        raise InputError(
            f"has no two frames between {start:g} and {end:g} s",
            "--interval",
            "choose another interval",
        )
    rate = 1.0 / float(np.median(np.diff(inside)))
    stride = max(int(rate / (FRAMES_PER_PERIOD * cutoff_Hz) + 1e-9), 1)
    count = (len(inside) - 1) // stride + 1
    even = np.ptp(np.diff(inside)) < 1e-6
    if stride == 1 or not even or count < 8:
        return (float(inside[0]), float(inside[-1])), None, f"frames: all {len(inside)}"
    last = float(inside[(count - 1) * stride])
    line = f"frames: one in {stride} of the recording, {count} at {rate / stride:g} Hz"
    return (float(inside[0]), last), count, line


def _check_within(time: Array, start: float, end: float) -> None:
    frame = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if start < time[0] - frame or end > time[-1] + frame:
        raise InputError(
            f"{start:g} to {end:g} s is not within the recording, "
            f"{time[0]:.4f} to {time[-1]:.4f} s",
            "--interval",
            "give times of the recording",
        )


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

    Without `request.register` they are registered if they misfit the model, else None is returned.
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

    Its distances to most others of its segment differ between the trials.
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
