"""A patient brought in: model, recording and meshes to a URDF and a scene that runs."""

import re
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from tkamb.case import Case, load_case
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, mirrored_pose
from tkamb.importing.anatomy import OTHER, Leg, find_leg
from tkamb.importing.links import Links, find_links
from tkamb.importing.markers import (
    Facing,
    ModelSegment,
    facing,
    feet,
    model_segments,
    recorded_labels,
    segments_of,
)
from tkamb.importing.model_motion import MOTION_FILE, ModelMotion, model_motion
from tkamb.importing.plates import Load, known_interval, own_plates, plate_loads, unmeasured
from tkamb.importing.scene_text import GroundFile, MarkerFile, Meshes, SceneText
from tkamb.importing.soft_tissue import soft_tissue
from tkamb.importing.urdf import patient_urdf
from tkamb.inputs.c3d import Recording, read_c3d
from tkamb.inputs.labels import plain_label
from tkamb.inputs.marker_motion import calibrated_markers
from tkamb.inputs.meshes import load_surface
from tkamb.inputs.tables import Table, read_table
from tkamb.opensim.read import read_osim
from tkamb.output.atomic import claim_directory, write_text
from tkamb.scene import Scene, load_scene
from tkamb.units import DEGREE, MILLIMETRE

FRAMES_PER_CUTOFF = 5.0
"""Frames per period of the cut-off: what is low-passed holds nothing between them."""
SAME_MASS = 0.01
"""A model whose mass is within this share of the subject's is not scaled."""


@dataclass(frozen=True)
class ImportRequest:
    """What is to be imported; None: to be inferred, or not there.

    Args:
        model: the .osim file.
        side: of the knee.
        mass_kg: of the subject.
        recording: .c3d or .trc; .mot or .sto of the model's coordinates.
        grf: table of ground reactions, beside a .trc.
        static: recording of a standing trial, from which the markers' places are calibrated.
        meshes: the implant's.
        knee: the femorotibial joint's name.
        frames: part -> frame of its mesh.
        plates: under the foot.
        interval: s, the part of the recording.
        laboratory_axes: the file's that point forward, up and right.
        scale_mass: whether the model's masses are scaled to the subject's.
        method: reading of the markers that is used.
        cutoff_Hz: of markers and plates.
        scene_name: of the scene file.
    """

    model: Path
    side: str
    mass_kg: float
    recording: Path
    grf: Path | None = None
    static: Path | None = None
    meshes: Meshes | None = None
    knee: str | None = None
    frames: dict[str, str | None] = field(default_factory=dict)
    plates: tuple[int, ...] | None = None
    interval: tuple[float, float] | None = None
    laboratory_axes: str | None = None
    scale_mass: bool | None = None
    method: str = "segments"
    cutoff_Hz: float = 6.0
    scene_name: str = "scene.toml"


@dataclass(frozen=True, eq=False)
class ImportedPatient:
    """What an import gives.

    Args:
        urdf: text of patient.urdf.
        scene: the scene, to be written as text.
        motion: text of motion.csv; None where markers are read from the recording.
        report: lines on what was understood and assumed.
    """

    urdf: str
    scene: SceneText
    motion: str | None
    report: tuple[str, ...]


def import_patient(request: ImportRequest, folder: Path) -> ImportedPatient:
    """Return a patient's URDF and scene.

    Args:
        request: files and what is known.
        folder: where the scene will stand.

    Raises:
        InputError: whatever cannot be used, in one line.
    """
    model = read_osim(request.model)
    leg = find_leg(model, request.side, request.knee)
    meshes = request.meshes
    insert = (
        load_surface(meshes.insert, meshes.unit, meshes.axes, name="insert", closed=True)
        if meshes
        else None
    )
    links = find_links(
        leg,
        insert,
        meshes.axes if meshes else "+x,+y,+z",
        request.frames,
        bool(meshes and meshes.patella),
    )
    scale, weighed = _mass_scale(request, leg)
    tissue = soft_tissue(links)
    recorded = read_table(request.recording)
    found = (
        _from_markers(request, leg, links, recorded)
        if recorded_labels(recorded)
        else _from_coordinates(request, leg, links, recorded)
    )
    scene = SceneText(
        _title(request),
        folder,
        request.side,
        request.mass_kg,
        "patient.urdf",
        request.cutoff_Hz,
        links,
        found.markers,
        found.ground,
        meshes,
        tissue,
        _notes(scale, found.ground is not None, bool(tissue.bundles), meshes is not None),
    )
    report = [*_leg_lines(leg), weighed, *links.said, *_patella_line(links)]
    report += [*found.said, *tissue.said]
    if request.static is not None and found.markers is not None:
        scene, line = _with_static_markers(scene, request.static, list(found.markers.segments))
        report.append(line)
    comment = f"Made by tkamb import from {request.model.name}, {request.side} leg (m, kg)"
    motion = found.motion.text() if found.motion else None
    return ImportedPatient(patient_urdf(links, scale, comment), scene, motion, tuple(report))


@dataclass(frozen=True, eq=False)
class _Trial:
    """What a recording gives: markers or coordinates, ground reaction, and lines on them."""

    markers: MarkerFile | None
    motion: ModelMotion | None
    ground: GroundFile | None
    said: tuple[str, ...]


def _from_markers(request: ImportRequest, leg: Leg, links: Links, recorded: Table) -> _Trial:
    segments = model_segments(links, recorded)
    seen = _facing(request, segments, recorded)
    ground, interval, stood = _ground(request, leg, recorded, seen.axes)
    interval, frames, thinned = _thinned(recorded.time(), interval, request.cutoff_Hz)
    markers = MarkerFile(
        request.recording, seen.axes, tuple(segments), request.method, "hinge", interval, frames
    )
    matched = [_segment_line(segment) for segment in segments]
    said = (*matched, _facing_line(request, seen), *stood, thinned)
    return _Trial(markers, None, ground, said)


def _from_coordinates(request: ImportRequest, leg: Leg, links: Links, recorded: Table) -> _Trial:
    motion = model_motion(links, recorded)
    said = [f"motion: the model's coordinates in {recorded.path.name}, into {MOTION_FILE}"]
    if motion.missing:
        said.append(f"not in the motion, so at their defaults: {', '.join(motion.missing)}")
    ground = None
    if request.grf is not None:
        ground, line = _table_ground(request.grf, leg.side, "+x,+y,+z")
        said.append(line + "; laboratory: the model's ground, x forward, y up")
    else:
        said.append("no ground reaction given: none is modelled")
    return _Trial(None, motion, ground, tuple(said))


def write_patient(patient: ImportedPatient, folder: Path, name: str) -> tuple[str, ...]:
    """Write URDF and scene, load them as a run would, and return what the markers say.

    Nothing is left behind where that fails.

    Raises:
        InputError: the folder cannot be written, holds a scene of that name already, or the
            scene does not load.
    """
    urdf, scene = folder / patient.scene.urdf, folder / name
    if scene.exists():
        raise InputError("is there already", scene, "choose another --out, or remove it")
    files = {urdf: patient.urdf, scene: patient.scene.text()}
    if patient.motion is not None:
        files[folder / MOTION_FILE] = patient.motion
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    claim_directory(folder)
    before = {p: p.read_text(encoding="utf-8") if p.is_file() else None for p in files}
    try:
        for path, text in files.items():
            write_text(path, text)
        case = load_case(load_scene(scene))
    except InputError:
        for path, old in before.items():
            path.unlink(missing_ok=True) if old is None else write_text(path, old)
        for place in made:
            place.rmdir()
        raise
    return marker_lines(case)


def marker_lines(case: Case) -> tuple[str, ...]:
    """Return how well the markers fit, by both readings, and how far the knee centres are apart."""
    found = case.motion.markers
    if found is None:
        return ()
    lines = []
    for method, words in (("segments", "rigid fits of shank and thigh"), ("chain", "the chain")):
        rms = found.at(found.rms[method], case.motion.time) / MILLIMETRE  # type: ignore[index]
        flexion = found.at(found.flexion[method], case.motion.time) / DEGREE  # type: ignore[index]
        used = ", used" if found.method == method else ""
        lines.append(
            f"markers, {words}{used}: rms {np.nanmedian(rms):.1f} mm (at most {np.nanmax(rms):.1f})"
            f", flexion {np.nanmin(flexion):.1f} to {np.nanmax(flexion):.1f} deg"
        )
    apart = found.at(found.centre_distance, case.motion.time) / MILLIMETRE
    turned = found.at(found.flexion["segments"] - found.flexion["chain"], case.motion.time) / DEGREE
    lines.append(
        f"knee centres of shank and thigh markers: {np.nanmedian(apart):.1f} mm apart (at most "
        f"{np.nanmax(apart):.1f}); flexions differ by at most {np.nanmax(np.abs(turned)):.1f} deg"
    )
    return tuple(lines)


def _mass_scale(request: ImportRequest, leg: Leg) -> tuple[float, str]:
    """Return the factor on the model's masses, and a line on it."""
    ratio = request.mass_kg / leg.model.mass_kg
    scaled = abs(ratio - 1.0) > SAME_MASS if request.scale_mass is None else request.scale_mass
    said = f"mass: the model's bodies sum to {leg.model.mass_kg:.2f} kg, the subject is "
    said += f"{request.mass_kg:g} kg: "
    if not 0.5 < ratio < 2.0:
        raise InputError(
            f"weighs {leg.model.mass_kg:.1f} kg, the subject {request.mass_kg:g} kg",
            request.model,
            "is --mass-kg in kilograms? else scale the model first",
        )
    return (ratio, said + f"scaled by {ratio:.4f}") if scaled else (1.0, said + "not scaled")


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


def _leg_lines(leg: Leg) -> list[str]:
    backwards = ", which runs backwards, from shank to thigh" if leg.knee.backwards else ""
    return [
        f"{leg.side} leg of '{leg.model.name}': knee '{leg.knee.name}'{backwards}, hip "
        f"'{leg.hip.name}', ankle '{leg.ankle.name}'",
        f"thigh = {', '.join(leg.femur)}; shank = {', '.join((*leg.tibia, *leg.foot))} (foot at "
        "its neutral angles); patella = " + (leg.patella or "none"),
    ]


def _patella_line(links: Links) -> list[str]:
    if links.patella is None:
        return []
    turn = links.patella[:3, :3]
    names = ("anterior", "superior", "right")
    axes = []
    for k, axis in enumerate("xyz"):
        j = int(np.argmax(np.abs(turn[k])))
        axes.append(f"{axis} {'' if turn[k, j] > 0 else '-'}{names[j]}")
    return [
        f"patella's axes: {', '.join(axes)} (within {links.patella_error / DEGREE:.0f} deg at the "
        "neutral pose); its mass is 0.1 kg, not the model's"
    ]


def _segment_line(segment: ModelSegment) -> str:
    missing = f"; not recorded: {', '.join(segment.missing)}" if segment.missing else ""
    return f"markers of the {segment.name}: {', '.join(segment.points)}{missing}"


def _ground(
    request: ImportRequest, leg: Leg, recorded: Table, axes: str
) -> tuple[GroundFile | None, tuple[float, float] | None, list[str]]:
    """Return the ground reaction, the interval in which it is known, and lines on both."""
    if request.recording.suffix.lower() != ".c3d":
        if request.grf is None:
            return None, request.interval, ["no ground reaction given: none is modelled"]
        ground, line = _table_ground(request.grf, leg.side, axes)
        return ground, request.interval, [line]
    recording = read_c3d(request.recording)
    if not recording.plates:
        raise InputError(
            "holds no force plates", request.recording, "give the ground reaction with --grf"
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
    return GroundFile(request.recording, axes, plates), interval, lines


def _thinned(
    time: Array, interval: tuple[float, float] | None, cutoff_Hz: float
) -> tuple[tuple[float, float], int | None, str]:
    """Return interval and number of frames at about five times the cut-off, and a line on it.

    The frames are every k-th of the recording, at its own times.
    """
    start, end = interval or (float(time[0]), float(time[-1]))
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


def _load_line(load: Load) -> str:
    other = "" if np.isnan(load.other) else f", {load.other * 1e3:.0f} mm from the other's"
    return (
        f"force plate {load.plate}: {load.side} foot from {load.start:.3f} to {load.end:.3f} s "
        f"(centre of pressure {load.distance * 1e3:.0f} mm from that foot's markers{other})"
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


def _table_ground(path: Path, side: str, axes: str) -> tuple[GroundFile, str]:
    """Return the columns of one foot's ground reaction in a table of OpenSim's style."""
    table = read_table(path)
    stems = [n[:-2] for n in table.columns if n.endswith("vy") and f"{n[:-2]}vx" in table.columns]
    own = [s for s in stems if re.search(rf"(^|_){side[0]}(_|$)|{side}", s.lower())]
    if len(own) != 1:
        raise InputError(
            f"does not say which force is the {side} foot's (it has {', '.join(stems) or 'none'})",
            path,
            f"name its columns after the foot, like ground_force_{side[0]}_vx",
        )
    stem = own[0]
    columns = [("time", "time")]
    columns += [(f"force_{k}", f"{stem}v{a}") for k, a in enumerate("xyz", 1)]
    columns += [(f"point_{k}", f"{stem}p{a}") for k, a in enumerate("xyz", 1)]
    torque = stem.replace("force", "torque").rstrip("_")
    found = [f"{torque}_{a}" for a in "xyz"]
    if all(name in table.columns for name in found):
        columns += [(f"moment_{k}", name) for k, name in enumerate(found, 1)]
    ground = GroundFile(path, axes, (), tuple(columns), "m")
    return ground, f"ground reaction: columns {stem}v*, {stem}p* of {path.name}, m"


def _listed(numbers: tuple[int, ...]) -> str:
    return ", ".join(map(str, numbers))


def _title(request: ImportRequest) -> tuple[str, ...]:
    return (
        f"The {request.side} knee of {request.model.name}, {request.recording.name}.",
        "Written by `tkamb import`; what it inferred stands here as given. The recording and the",
        "meshes are read where they lie.",
    )


def _notes(scale: float, ground: bool, own: bool, implant: bool) -> tuple[str, ...]:
    notes = [
        "Only the quadriceps acts: where hamstrings and gastrocnemius act too, the contact force "
        "is too low and the quadriceps force is what the joint moment needs at least.",
        "Shank and flexion come from skin markers; the columns marker_rms_*, flexion_* and "
        "knee_centre_distance_mm say how far the skin has moved.",
        "Foot and shank are one body with the ankle at its neutral angle.",
    ]
    if implant:
        notes.append(
            "Adduction, axial rotation, AP and ML of the femur are where contact, ligaments and "
            "muscle line leave them; nobody recorded them."
        )
    if implant and not own:
        notes.append("The ligaments are a generic set scaled to the implant, nobody's own.")
    if scale != 1.0:
        notes.append(f"Segment masses are the model's times {scale:.4f}.")
    if not ground:
        notes.append("No ground reaction: the shank hangs in the air.")
    return tuple(notes)


def _with_static_markers(
    scene: SceneText, static: Path, segments: list[ModelSegment]
) -> tuple[SceneText, str]:
    """Return the scene with its markers where they sit in a standing trial, and a line on it."""
    assert scene.markers is not None
    known = Scene.model_validate(tomllib.loads(scene.text())).motion.markers
    assert known is not None
    own = facing(segments_of(static, segments), read_table(static)).axes
    known = known.model_copy(update={"laboratory_axes": own})
    side: Literal["right", "left"] = "left" if scene.side == "left" else "right"
    insert = scene.links.insert_in_tibia
    if side == "left":
        insert = mirrored_pose(insert)
    places = calibrated_markers(known, static, side, insert)
    moved, farthest = [], 0.0
    for segment in segments:
        there = {plain_label(k): v for k, v in places[segment.name].items()}
        points = {k: there.get(plain_label(k), v) for k, v in segment.points.items()}
        shifts = [np.linalg.norm(points[k] - v) for k, v in segment.points.items()]
        farthest = max(farthest, float(np.max(shifts)))
        moved.append(replace(segment, points=points))
    markers = replace(scene.markers, segments=tuple(moved))
    line = (
        f"markers' places are those of the standing trial {static.name}, at most "
        f"{farthest * 1e3:.1f} mm from the model's"
    )
    return replace(scene, markers=markers), line
