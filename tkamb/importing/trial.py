"""A trial: markers or coordinates, which way the subject faces, which plates bear the foot."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.importing.anatomy import OTHER, Leg, way_to_pelvis
from tkamb.importing.links import Links
from tkamb.importing.markers import (
    Facing,
    ModelSegment,
    facing,
    feet,
    model_segments,
    seen_segments,
)
from tkamb.importing.model_motion import COLUMNS, MOTION_FILE, ModelMotion, model_motion
from tkamb.importing.plates import (
    Load,
    common_surface,
    known_interval,
    own_plates,
    plate_loads,
    unmeasured,
)
from tkamb.importing.recorded_poses import RecordedPoses
from tkamb.importing.request import ImportRequest
from tkamb.importing.scene_text import GroundFile, MarkerFile
from tkamb.importing.shank import ShankMarkers, shank_markers
from tkamb.inputs.c3d import Recording, read_c3d
from tkamb.inputs.tables import Table, read_table

SMALLEST_BEND = 3.5
"""deg; a knee that bends by less all along, read in degrees, is likely given in radians (0.06)."""
FRAMES_PER_CUTOFF = 5.0
"""Frames per period of the cut-off: what is low-passed holds nothing between them."""


@dataclass(frozen=True, eq=False)
class Trial:
    """What a recording gives: markers or coordinates, ground reaction, and lines on them."""

    ground: GroundFile | None
    said: tuple[str, ...]
    markers: MarkerFile | None = None
    motion: ModelMotion | None = None
    poses: RecordedPoses | None = None
    shank: ShankMarkers | None = None


def from_markers(request: ImportRequest, leg: Leg, links: Links, recorded: Table) -> Trial:
    """Return a recording of markers: C3D with its plates, or markers and a table of forces.

    Raises:
        InputError: markers, plates or interval that cannot be used.
    """
    segments = model_segments(links, recorded, request.without)
    seen = _facing(request, segments, recorded)
    ground, interval, stood = _ground(request, leg, recorded, seen.axes)
    interval, frames, thinned = _thinned(recorded.time(), interval, request.cutoff_Hz)
    markers = MarkerFile(
        request.recording, seen.axes, tuple(segments), request.method, "hinge", interval, frames
    )
    matched = _segment_lines(segments, request.without)
    said = (*matched, _facing_line(request, seen), *stood, thinned)
    return Trial(ground, said, markers)


def from_poses(
    request: ImportRequest, leg: Leg, links: Links, recorded: Table, poses: RecordedPoses
) -> Trial:
    """Return recorded poses of the knee, with a recording of markers that place the shank.

    Raises:
        InputError: markers or plates that cannot be used.
    """
    segments = seen_segments(links, recorded, request.without)
    seen = _facing(request, [s for s in segments.values() if len(s.points) >= 3], recorded)
    stance = poses.femur[poses.in_stance]
    shank = shank_markers(links, segments, stance, request.recording, seen.axes)
    covered = replace(request, interval=(float(poses.time[0]), float(poses.time[-1])))
    ground, _, stood = _ground(covered, leg, recorded, seen.axes)
    matched = _segment_lines(segments.values(), request.without)
    said = (*poses.said, *matched, _facing_line(request, seen), *shank.said, *stood)
    return Trial(ground, said, poses=poses, shank=shank)


def from_coordinates(request: ImportRequest, leg: Leg, links: Links, recorded: Table) -> Trial:
    """Return a motion in the model's own coordinates.

    Raises:
        InputError: no flexion of the knee in it, or a ground reaction of no foot.
    """
    for joint in way_to_pelvis(leg):
        if joint.unread:
            raise InputError(joint.unread)
    motion, part = _part(request, model_motion(links, recorded), recorded)
    said = [f"motion: the model's coordinates in {recorded.path.name}, into {MOTION_FILE}", *part]
    bend = float(np.abs(motion.values[:, COLUMNS.index("flexion_deg")]).max())
    if bend < SMALLEST_BEND and len(recorded.time()) > 1:
        stated = "yes" if recorded.in_degrees else "no"
        said.append(
            f"ATTENTION: the knee bends by {bend:.2g} deg at most with inDegrees={stated}: are the "
            "angles in radians? then write inDegrees=no"
        )
    if motion.missing:
        said.append(f"not in the motion, so at their defaults: {', '.join(motion.missing)}")
    ground = None
    if request.grf is not None:
        ground, line = _table_ground(request.grf, leg.side, "+x,+y,+z", request.grf_force)
        said.append(line + "; laboratory: the model's ground, x forward, y up")
    else:
        said.append("no ground reaction given: none is modelled")
    return Trial(ground, tuple(said), motion=motion)


def _part(
    request: ImportRequest, motion: ModelMotion, recorded: Table
) -> tuple[ModelMotion, list[str]]:
    """Return the part of a motion that is asked for, or that its forces cover, and a line on it.

    Raises:
        InputError: no such part, or no time in common with the forces.
    """
    time, where, why = motion.time, recorded.path, "the recorded forces cover no more"
    start, end = request.interval or (float(time[0]), float(time[-1]))
    if request.interval:
        _check_within(time, start, end)
        why = "as given"
    elif request.grf is not None:
        forces = read_table(request.grf).time()
        start, end = max(start, float(forces[0])), min(end, float(forces[-1]))
        if start >= end:
            raise InputError(
                f"ends or begins where the forces do not: it is of {time[0]:g} to {time[-1]:g} s, "
                f"they are of {forces[0]:g} to {forces[-1]:g} s",
                where,
                "give recordings of one trial",
            )
    inside = (time >= start - 1e-9) & (time <= end + 1e-9)
    if inside.all():
        return motion, []
    if inside.sum() < 2:
        raise InputError(f"has no two frames between {start:g} and {end:g} s", where)
    cut = replace(motion, time=time[inside], values=motion.values[inside])
    return cut, [f"interval: {cut.time[0]:.4f} to {cut.time[-1]:.4f} s of the motion, {why}"]


def _facing(request: ImportRequest, segments: list[ModelSegment], recorded: Table) -> Facing:
    if request.laboratory_axes is not None:
        return Facing(request.laboratory_axes, np.nan, np.nan)
    return facing(segments, recorded)


def _facing_line(request: ImportRequest, seen: Facing) -> str:
    line = f"laboratory: forward, up, right are the file's {seen.axes}"
    if request.laboratory_axes is not None:
        return line + ", as given"
    return line + (
        f" (the subject faces {seen.forward_deg:.0f} deg off that axis and leans by "
        f"{seen.up_deg:.0f} deg, on average)"
    )


def _segment_lines(segments: Iterable[ModelSegment], without: tuple[str, ...]) -> list[str]:
    lines = []
    for segment in segments:
        missing = f"; not recorded: {', '.join(segment.missing)}" if segment.missing else ""
        own = ", ".join(segment.points) or "none"
        lines.append(f"markers of the {segment.name}: {own}{missing}")
    return lines + ([f"markers left out, as given: {', '.join(without)}"] if without else [])


def _ground(
    request: ImportRequest, leg: Leg, recorded: Table, axes: str
) -> tuple[GroundFile | None, tuple[float, float] | None, list[str]]:
    """Return the ground reaction, the interval in which it is known, and lines on both."""
    if request.recording.suffix.lower() != ".c3d":
        if request.grf is None:
            return None, request.interval, ["no ground reaction given: none is modelled"]
        ground, line = _table_ground(request.grf, leg.side, axes, request.grf_force)
        return ground, request.interval, [line]
    recording = read_c3d(request.recording)
    if not recording.plates:
        raise InputError(
            "holds no force plates",
            request.recording,
            "give its markers with --trc and the ground reaction with --grf",
        )
    sides = feet(leg, recorded, OTHER[leg.side])
    if request.plates is not None:
        return (
            GroundFile(request.recording, axes, request.plates),
            request.interval,
            [f"force plates {_listed(request.plates)} under the {leg.side} foot, as given"],
        )
    loads = plate_loads(recording, axes, sides)
    plates = own_plates(loads, leg.side, recording)
    interval = request.interval or known_interval(loads, plates, recording)
    lines = [*(_load_line(load) for load in loads), _interval_line(request, interval)]
    lines += _unmeasured_line(loads, plates, recording, sides[leg.side], interval)
    surface = common_surface(loads, plates)
    return GroundFile(request.recording, axes, plates, surface=surface), interval, lines


def _thinned(
    time: Array, interval: tuple[float, float] | None, cutoff_Hz: float
) -> tuple[tuple[float, float], int | None, str]:
    """Return interval and number of frames at about five times the cut-off, and a line on it.

    The frames are every k-th of the recording, at its own times.
    """
    start, end = interval or (float(time[0]), float(time[-1]))
    _check_within(time, start, end)
    inside = time[(time >= start - 1e-9) & (time <= end + 1e-9)]
    if len(inside) < 2:
        raise InputError(
            f"has no two frames between {start:g} and {end:g} s", "--interval", "choose another"
        )
    rate = 1.0 / float(np.median(np.diff(inside)))
    every = max(int(rate / (FRAMES_PER_CUTOFF * cutoff_Hz) + 1e-9), 1)
    count = (len(inside) - 1) // every + 1
    even = np.ptp(np.diff(inside)) < 1e-6
    if every == 1 or not even or count < 8:
        return (float(inside[0]), float(inside[-1])), None, f"frames: all {len(inside)}"
    last = float(inside[(count - 1) * every])
    line = f"frames: every {every}th of the recording, {count} at {rate / every:g} Hz"
    return (float(inside[0]), last), count, line


def _check_within(time: Array, start: float, end: float) -> None:
    """Raise unless an interval lies within a recording, but for a frame at either end."""
    frame = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if start < time[0] - frame or end > time[-1] + frame:
        raise InputError(
            f"{start:g} to {end:g} s is not within the recording, "
            f"{time[0]:.4f} to {time[-1]:.4f} s",
            "--interval",
            "give it on the recording's own clock",
        )


def _load_line(load: Load) -> str:
    other = "" if np.isnan(load.other) else f", {load.other * 1e3:.0f} mm from the other's"
    step = (
        f"; the foot stands on a step, about {load.surface:.2f} m above the plate: the wrench is "
        "taken as it is, with its point on that level"
        if load.surface
        else ""
    )
    return (
        f"force plate {load.plate}: {load.side} foot from {load.start:.3f} to {load.end:.3f} s "
        f"(centre of pressure {load.distance * 1e3:.0f} mm from that foot's markers{other}){step}"
    )


def _interval_line(request: ImportRequest, interval: tuple[float, float]) -> str:
    why = "as given" if request.interval else "from the first to the last load on these plates"
    return f"interval: {interval[0]:.4f} to {interval[1]:.4f} s of the recording's clock, {why}"


def _unmeasured_line(
    loads: list[Load],
    plates: tuple[int, ...],
    recording: Recording,
    labels: list[str],
    interval: tuple[float, float],
) -> list[str]:
    times = unmeasured(loads, plates, recording, labels, interval)
    if not len(times):
        return []
    return [
        f"ATTENTION: off its plates the foot is nearly still in {len(times)} frames, first at "
        f"{times[0]:.3f} s: does it stand on something that was not measured?"
    ]


def _table_ground(path: Path, side: str, axes: str, force: str | None) -> tuple[GroundFile, str]:
    """Return the columns of one foot's ground reaction in a table of OpenSim's style."""
    table = read_table(path)
    stem = _force_stem(table, side, force)
    columns = [("time", "time")]
    columns += [(f"force_{k}", f"{stem}v{a}") for k, a in enumerate("xyz", 1)]
    columns += [(f"point_{k}", f"{stem}p{a}") for k, a in enumerate("xyz", 1)]
    torque = stem.replace("force", "torque").rstrip("_")
    found = [f"{torque}_{a}" for a in "xyz"]
    if all(name in table.columns for name in found):
        columns += [(f"moment_{k}", name) for k, name in enumerate(found, 1)]
    ground = GroundFile(path, axes, (), tuple(columns), "m")
    why = "as given" if force else "by their name"
    return ground, (
        f"ground reaction of the {side} foot: columns {stem}v*, {stem}p* of {path.name}, m, {why}"
    )


def _force_stem(table: Table, side: str, force: str | None) -> str:
    """Return what the columns of a foot's force begin with: as given, or named after the foot."""
    stems = [n[:-2] for n in table.columns if n.endswith("vy") and f"{n[:-2]}vx" in table.columns]
    there = ", ".join(stems) or "none"
    if force is not None:
        own = [s for s in stems if s.rstrip("_") == force.removesuffix("_v").rstrip("_")]
        if len(own) != 1:
            raise InputError(f"has no force '{force}' (it has {there})", table.path, "--grf-force")
        return own[0]
    own = [s for s in stems if re.search(rf"(^|_){side[0]}(_|$)|{side}", s.lower())]
    if len(own) != 1:
        raise InputError(
            f"does not say which force is the {side} foot's (it has {there})",
            table.path,
            f"give --grf-force, or name its columns after the foot: ground_force_{side[0]}_vx",
        )
    return own[0]


def _listed(numbers: tuple[int, ...]) -> str:
    return ", ".join(map(str, numbers))
