"""Import of a patient's URDF and scene from an OpenSim model, a recording and meshes."""

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.files import CHOOSE_OUT, TABLE_BYTES, claim_directory, read_bytes, write_new_text
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.surface import Surface
from tkamb.io.importing.anatomy import Leg, find_leg
from tkamb.io.importing.links import Links, find_links, patient_urdf
from tkamb.io.importing.markers import ModelSegment, recorded_labels, with_prefix
from tkamb.io.importing.recorded_poses import MOTION_FILE, read_poses
from tkamb.io.importing.registration import Registration
from tkamb.io.importing.scene_text import GROUND_FILE, ImportRequest, SceneText
from tkamb.io.importing.soft_tissue import soft_tissue, some_names
from tkamb.io.importing.trial import (
    Trial,
    from_coordinates,
    from_markers,
    from_poses,
    with_registered_markers,
    with_static_markers,
)
from tkamb.io.opensim.model import OpenSimModel
from tkamb.io.opensim.read import read_osim
from tkamb.io.recordings.meshes import axes_rotation, load_surface
from tkamb.io.recordings.tables import read_table, with_unit
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.units import DEGREE, MILLIMETRE

# A model is of one leg if thigh, shank and foot have more than this share of its mass.
# One leg has less than a fifth of a whole body's mass.
ONE_LEG_SHARE = 0.6
# Share of the body's mass in one leg, from thigh 0.100, shank 0.0465 and foot 0.0145 (Winter,
# Biomechanics, 2009).
LEG_MASS_SHARE = 0.161
# The report of an import gives reasons for at most this number of unreadable parts. Chosen to keep
# the report short.
MAX_REASONS = 3
# The model is not scaled if its mass differs from the subject's by less than this share.
# Such a difference may come from clothes and rounding.
SAME_MASS_SHARE = 0.01


LEG_SHARES = (0.10, 0.25)
"""Accepted shares of one leg in the body's mass, with a margin for individuals: Winter (2009) gives
0.161, de Leva (1996) 0.20.
"""


@dataclass(frozen=True, eq=False)
class ImportedPatient:
    """The result of an import.

    Args:
        motion: text of motion.csv; None: the scene reads the recorded motion.
        ground: text of ground_reaction.csv; None: the scene reads the recorded forces, if any.
        registration: registered markers; None: their positions are the model's or of a standing
            trial.
        model_segments: segments with the positions before the registration; () without one.
    """

    urdf: str
    scene: SceneText
    motion: str | None
    report: tuple[str, ...]
    ground: str | None = None
    registration: Registration | None = None
    model_segments: tuple[ModelSegment, ...] = ()


def import_patient(request: ImportRequest, folder: Path) -> ImportedPatient:
    """Return a patient's URDF and scene."""
    model = read_osim(request.model, partial=True)
    leg = find_leg(model, request.side, request.knee)
    meshes = request.meshes
    insert = placement = None
    if meshes:
        insert = load_surface(meshes.insert, meshes.unit, meshes.axes, name="insert", closed=True)
        placement = insert_placement(insert, axes_rotation(meshes.axes))
    links = find_links(
        leg,
        placement,
        meshes.axes if meshes else "+x,+y,+z",
        request.frames,
        bool(meshes and meshes.patella),
    )
    scale, mass_line = _mass_scale(request, leg)
    tissue = soft_tissue(links)
    if meshes and meshes.femur_bone and not (tissue.quadriceps and tissue.patellar_ligament):
        hint = "leave it out, or complete the model"
        what = "is the bone that the quadriceps wraps, but the model has no quadriceps"
        raise InputError(what, "--femur-bone", hint)
    result = _trial(request, leg, links, insert)
    scene = SceneText(
        _title(request),
        folder,
        request.side,
        request.mass_kg,
        "patient.urdf",
        request.cutoff_Hz,
        links,
        result.markers,
        result.poses,
        result.shank,
        result.ground,
        meshes,
        tissue,
        request.contact,
        request.activity,
        (*_notes(request, scale, result, bool(tissue.bundles)), *request.notes),
        request.model if request.muscles else None,
        request.recording if result.motion else None,
        request.cycle,
    )
    report = [
        *_model_lines(model),
        *_leg_lines(leg),
        mass_line,
        *links.remarks,
        *_patella_line(links),
    ]
    report += [*result.remarks, *tissue.remarks]
    if request.static is not None:
        if result.markers is None:
            raise InputError(
                "is for a knee whose motion comes from markers", "--static", "leave it out"
            )
        segments = list(result.markers.segments)
        unit = request.units.length
        scene, lines = with_static_markers(scene, request.static, segments, unit)
        report += lines
    registration: Registration | None = None
    before: tuple[ModelSegment, ...] = ()
    if scene.markers is not None:
        before = scene.markers.segments
        scene, registration, lines = with_registered_markers(scene, request, links)
        report += lines
    elif request.register or request.companions:
        raise InputError(
            "is for a knee whose motion comes from markers", "--register", "leave it out"
        )
    comment = f"Made by tkamb import from {request.model.name}, {request.side} leg (m, kg)"
    motion = result.motion.text() if result.motion else None
    ground = result.ground.made if result.ground else None
    return ImportedPatient(
        patient_urdf(links, scale, comment),
        scene,
        motion,
        tuple(report),
        ground,
        registration,
        before,
    )


def _trial(request: ImportRequest, leg: Leg, links: Links, insert: Surface | None) -> Trial:
    recorded = with_unit(read_table(request.recording), request.units.length)
    if request.prefix is not None:
        recorded = with_prefix(recorded, request.prefix)
    labels = recorded_labels(recorded)
    if request.poses is not None:
        if insert is None or request.meshes is None or not labels:
            raise InputError(
                "needs the implant's meshes and a recording of markers",
                "--poses",
                "give --femoral, --insert, and --c3d or --trc",
            )
        poses = read_poses(
            request.poses, links, insert, request.meshes.axes, request.cutoff_Hz, request.interval
        )
        return from_poses(request, leg, links, recorded, poses)
    if labels:
        return from_markers(request, leg, links, recorded)
    if request.without:
        raise InputError("has no markers to leave out", recorded.path, "drop --without")
    return from_coordinates(request, leg, links, recorded)


def write_patient(patient: ImportedPatient, folder: Path, name: str) -> tuple[str, ...]:
    """Write URDF and scene, load them as a check, and return remarks on markers and gait.

    Existing files do not change, and scenes may share one with the same content. After an error all
    new files are removed.
    """
    scene = folder / name
    if os.path.lexists(scene):
        raise InputError("exists already", scene, CHOOSE_OUT)
    files = {folder / patient.scene.urdf: patient.urdf, scene: patient.scene.text()}
    if patient.motion is not None:
        files[folder / MOTION_FILE] = patient.motion
    if patient.ground is not None:
        files[folder / GROUND_FILE] = patient.ground
    new = {path: text for path, text in files.items() if not _same_there(path, text)}
    new_folders = [place for place in (folder, *folder.parents) if not place.exists()]
    written: list[Path] = []
    try:
        claim_directory(folder)
        for path, text in new.items():
            write_new_text(path, text)
            written.append(path)
        case = load_case(load_scene(scene))
        return (*marker_lines(case), *_gait_lines(case, patient.scene.cycle == "plates"))
    except BaseException:  # includes a keyboard interrupt
        for path in written:
            path.unlink(missing_ok=True)
        with suppress(OSError):  # The folder is not empty, or does not exist.
            for place in new_folders:
                place.rmdir()
        raise


def _gait_lines(case: Case, asks_gait: bool) -> tuple[str, ...]:
    gait = None if case.ground is None else case.ground.gait
    if asks_gait and case.gait_cycle_s is None:
        raise InputError(
            "the force plates show no two strikes of this foot within the motion",
            "--cycle plates",
            "give --cycle A:B, the times (s) of two strikes, from the heel's markers for example",
        )
    if gait is None or not gait.foot_strikes:
        return ()
    parts = [
        f"{name} at {', '.join(f'{time:.3f}' for time in times)} s"
        for name, times in (("foot strikes", gait.foot_strikes), ("toe-offs", gait.toe_offs))
        if times
    ]
    cycle = case.gait_cycle_s
    last = "" if cycle is None else f"; the gait cycle lies from {cycle[0]:.3f} to {cycle[1]:.3f} s"
    return (f"force plates: {', '.join(parts)}{last}",)


def _same_there(path: Path, text: str) -> bool:
    if not os.path.lexists(path):
        return False
    with suppress(InputError):
        if read_bytes(path, TABLE_BYTES) == text.encode("utf-8", "backslashreplace"):
            return True
    what = "exists already with another content; another scene may need it"
    raise InputError(what, path, CHOOSE_OUT)


def marker_lines(case: Case) -> tuple[str, ...]:
    """Return lines on both marker fits and the distance of the knee centres."""
    result = case.motion.markers
    if result is None:
        rms = case.tibia.residual if case.tibia else None
        if rms is None:
            return ()
        return (
            f"markers and joint centres of the shank: rms {np.median(rms) / MILLIMETRE:.1f} mm "
            f"(at most {rms.max() / MILLIMETRE:.1f})",
        )
    lines = []
    for method, words in (("segments", "rigid fits of shank and thigh"), ("chain", "the chain")):
        rms = result.at(result.rms[method], case.motion.time) / MILLIMETRE  # type: ignore[index]
        flexion = result.at(result.flexion[method], case.motion.time) / DEGREE  # type: ignore[index]
        used = ", used" if result.method == method else ""
        lines.append(
            f"markers, {words}{used}: rms {np.nanmedian(rms):.1f} mm (at most {np.nanmax(rms):.1f})"
            f", flexion {np.nanmin(flexion):.1f} to {np.nanmax(flexion):.1f} deg"
        )
    distance = result.at(result.centre_distance, case.motion.time) / MILLIMETRE
    difference = (
        result.at(result.flexion["segments"] - result.flexion["chain"], case.motion.time) / DEGREE
    )
    lines.append(
        f"knee centres of shank and thigh markers: {np.nanmedian(distance):.1f} mm apart (at most "
        f"{np.nanmax(distance):.1f}); flexions differ by at most "
        f"{np.nanmax(np.abs(difference)):.1f} deg"
    )
    return tuple(lines)


def _mass_scale(request: ImportRequest, leg: Leg) -> tuple[float, str]:
    """Return the factor on the masses, and a remark."""
    model, subject = leg.model.mass_kg, request.mass_kg
    leg_mass = sum(leg.model.bodies[b].mass_kg for b in (*leg.femur, *leg.tibia, *leg.foot))
    if leg_mass <= 0.0:
        raise InputError(
            "gives thigh, shank and foot no mass", request.model, "give its bodies their masses"
        )
    if leg_mass > ONE_LEG_SHARE * model:
        return _leg_scale(request, leg_mass)
    ratio = subject / model
    scaled = (
        abs(ratio - 1.0) > SAME_MASS_SHARE if request.scale_mass is None else request.scale_mass
    )
    text = f"mass: the model's bodies sum to {model:.2f} kg, the subject is {subject:g} kg: "
    if not 0.5 < ratio < 2.0:
        raise InputError(
            f"weighs {model:.1f} kg, the subject {subject:g} kg",
            request.model,
            "check that --mass-kg is in kilograms; if it is, scale the model first",
        )
    return (ratio, text + f"scaled by {ratio:.4f}") if scaled else (1.0, text + "not scaled")


def _leg_scale(request: ImportRequest, leg_mass: float) -> tuple[float, str]:
    """Return the factor on the masses of a model of one leg, and a remark on it.

    The model has the mass of a leg, or of the whole body if a scaling tool scaled it to the
    subject's mass. If the factor is not 1, the leg gets `LEG_MASS_SHARE` of the subject's mass.

    Args:
        leg_mass: mass of thigh, shank and foot in the model, kg.
    """
    subject = request.mass_kg
    share, target = leg_mass / subject, LEG_MASS_SHARE * subject
    low, high = LEG_SHARES
    whole_body = 0.5 < share < 2.0
    text = (
        f"mass: the model is one leg of {leg_mass:.2f} kg, {share:.0%} of the subject's "
        f"{subject:g} kg"
    )
    if low <= share <= high and not request.scale_mass:
        return 1.0, text + ": not scaled"
    if not (low <= share <= high or whole_body) or (whole_body and request.scale_mass is False):
        raise InputError(
            f"is one leg of {leg_mass:.1f} kg, the subject weighs {subject:g} kg: a leg has "
            f"{low:.0%} to {high:.0%} of the body's mass",
            request.model,
            "check that --mass-kg is in kilograms; if it is, give the model's bodies a leg's "
            "masses",
        )
    why = ", the whole body's" if whole_body else ""
    return target / leg_mass, (
        f"{text}{why}: scaled to {target:.2f} kg, the {LEG_MASS_SHARE:.1%} of a leg (Winter 2009)"
    )


def _model_lines(model: OpenSimModel) -> list[str]:
    lines = [f"model: {notice}" for notice in model.notices]
    unread = [f"{element.kind} '{element.name}'" for element in model.unread]
    if unread:
        lines.append(f"not read, and not needed for this knee: {some_names(unread)}")
        lines += [f"  {element.reason}" for element in model.unread[:MAX_REASONS]]
    return lines


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
        "neutral position); its mass is 0.1 kg, not the model's"
    ]


def _title(request: ImportRequest) -> tuple[str, ...]:
    poses = f", poses of {request.poses.file.name}" if request.poses else ""
    return (
        f"The {request.side} knee of {request.model.name}, {request.recording.name}{poses}.",
        "Written by `tkamb import`, with all that it inferred. The recording and the meshes stay",
        "where they are.",
    )


def _notes(
    request: ImportRequest, scale: float, trial: Trial, own_ligaments: bool
) -> tuple[str, ...]:
    quadriceps_note = (
        "Without [muscles] only the quadriceps acts: the forces of hamstrings and gastrocnemius "
        "are missing, and the quadriceps force is the least that the joint moment needs."
    )
    notes = [
        *(() if request.muscles else (quadriceps_note,)),
        *_motion_notes(request, trial),
        "Foot and shank are one body with the ankle at its neutral angle.",
    ]
    if request.meshes and not trial.poses:
        notes.append(
            "Adduction, axial rotation, AP and ML of the femur were not recorded; they follow from "
            "the equilibrium of contact, ligaments and muscle line."
        )
    if request.meshes and not own_ligaments:
        notes.append(
            "The ligaments are a generic set scaled to the implant, not the patient's own."
        )
    if scale != 1.0:
        notes.append(f"Segment masses are the model's times {scale:.4f}.")
    if trial.ground is None:
        notes.append("No ground reaction is modelled: the foot is unloaded.")
    return tuple(notes)


def _motion_notes(request: ImportRequest, trial: Trial) -> list[str]:
    if trial.motion is not None:
        return ["Shank and flexion come from the joint angles of a motion file of the model."]
    if request.poses is None or trial.shank is None:
        return [
            "Shank and flexion come from skin markers; the columns marker_rms_*, flexion_* and "
            "knee_centre_distance_mm say how far the skin has moved."
        ]
    notes = []
    if request.poses.turned:
        names = ", ".join(request.poses.turned)
        notes.append(f"The poses are read with the other sign of {names}.")
    if request.poses.stride:
        notes.append(
            "The knee's motion is from another recording than ground reaction and shank. tkamb "
            "assumes that it has the phase of one stride of that recording."
        )
    if centres := [name.replace("_", " ") for name in trial.shank.centres]:
        notes.append(
            f"The shank shows {len(trial.shank.points)} markers. Its pose also uses "
            f"{' and '.join(centres)} from the markers of neighbouring segments, so that its lean "
            "is less certain."
        )
    return notes
