"""A case with the errors of one sample in its inputs, including those of its skin markers.

The errors are applied to the case in SI, as a right knee's: no file is read again.

A skin marker is displaced from its place on its segment by an error that is the same in all frames.
The rigid fit of the segment's markers is then off by the pose that best maps their true places to
the displaced ones (`method = "segments"`). A chain's joints spread the same errors over more
segments.
"""

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    MIRROR,
    Array,
    inverse,
    knee_coordinates,
    knee_pose,
)
from tkamb.io.recordings.markers import fit_seen
from tkamb.io.recordings.recording_tables import MarkerSegmentTable
from tkamb.io.scene import Scene
from tkamb.io.scene.case import Case
from tkamb.knee.ligaments import Ligament
from tkamb.knee.load import LinkPoint
from tkamb.knee.muscles import Muscle, SagittalWrap
from tkamb.run.muscles.shared_muscles import SharedMuscles
from tkamb.studies.uncertainty.inputs import (
    COP_AXES,
    GROUP_ENDS,
    LINE_ENDS,
    MARKED,
    PATELLAR_LIGAMENT,
    UNITS,
    Draw,
)
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.io.recordings.ground_reaction import GroundReaction
    from tkamb.io.recordings.motion import KneeMotion
    from tkamb.io.recordings.tibia import BodyMotion


def varied_case(case: Case, draw: Draw) -> Case:
    """Return the case with varied inputs; rates and accelerations stay as recorded.

    The insert's modulus and the shared muscles are not in a case:
    `tkamb.studies.uncertainty.sample` varies them.
    """
    tibia, coordinates = displaced_by_markers(case, draw)
    varied = replace(case, tibia=tibia, motion=replace(case.motion, coordinates=coordinates))
    changes: dict[str, Any] = {"motion": _motion(varied, draw), "scene": _scene(case, draw)}
    if tibia is not None:
        place = tibia.pose.copy()
        place[:, :3, 3] += tibia.pose[:, :3, :3] @ draw.place("knee_centre")
        changes["tibia"] = replace(tibia, pose=place)
    if case.ground is not None:
        changes["ground"] = _ground(case.ground, draw)
    changes["chain"] = case.chain.changed(
        draw.factor("segment_mass"),
        draw.place("insert_placement"),
        Rotation.from_rotvec(draw.turn("insert_placement")).as_matrix(),
    )
    changes["ligaments"] = tuple(_ligament(case, one, draw) for one in case.ligaments)
    changes["muscles"] = tuple(_muscle(case, one, draw) for one in case.muscles)
    if case.patellar_ligament is not None:
        end = case.patellar_ligament.distal
        distal = LinkPoint(end.link, end.position + draw.place("tuberosity"))
        wrap = _wrap(case.patellar_ligament.wrap, PATELLAR_LIGAMENT, draw)
        changes["patellar_ligament"] = replace(case.patellar_ligament, distal=distal, wrap=wrap)
    return replace(case, **changes)


def _scene(case: Case, draw: Draw) -> Scene:
    """Return the scene with the numbers that are read from it."""
    scene = case.scene
    if scene.contact is None:
        return scene
    friction = max(0.0, scene.contact.friction + draw.error("friction"))
    limit = {"yield_stress_MPa": scene.yield_stress_MPa * draw.factor("yield_stress")}
    changes: dict[str, Any] = {
        "contact": scene.contact.model_copy(update={"friction": friction}),
        "output": scene.output.model_copy(update=limit),
    }
    if scene.material is not None:
        changes["material"] = scene.material.model_copy(update=limit)
    return scene.model_copy(update=changes)


def _ground(ground: "GroundReaction", draw: Draw) -> "GroundReaction":
    shift = np.zeros(3)
    for name, axis in COP_AXES.items():
        shift[axis] = draw.error(f"centre_of_pressure_{name}")
    factor = draw.factor("ground_reaction")
    return replace(
        ground,
        force=ground.force * factor,
        moment=ground.moment * factor,
        point=ground.point + shift,
    )


def _motion(case: Case, draw: Draw) -> "KneeMotion":
    motion, errors = case.motion, draw.standardised()
    coordinates = motion.coordinates.copy()
    for i, one in enumerate(draw.inputs):
        if one.name in KNEE_COORDINATES:
            scale = one.deviation * UNITS[one.unit]
            coordinates[:, KNEE_COORDINATES.index(one.name)] += scale * errors[:, i]
    patella = motion.patella
    if patella is not None:
        patella = patella + np.array([draw.error("dome.ap"), draw.error("dome.si"), 0.0])
    return replace(motion, coordinates=coordinates, patella=patella)


def _ligament(case: Case, bundle: Ligament, draw: Draw) -> Ligament:
    strain = draw.error(f"ligament_strain.{bundle.name}")
    return replace(
        bundle,
        proximal=_on_femur(case, bundle.proximal, draw),
        distal=_on_femur(case, bundle.distal, draw),
        stiffness=bundle.stiffness * draw.factor(f"ligament_stiffness.{bundle.name}"),
        slack_length=bundle.slack_length / (1.0 + strain),  # one of the two is NaN and stays so
        reference_strain=bundle.reference_strain + strain,
    )


def _muscle(case: Case, muscle: Muscle, draw: Draw) -> Muscle:
    points = [_on_femur(case, point, draw) for point in muscle.points]
    for k, end in zip((0, -1), LINE_ENDS, strict=True):
        shift = draw.place(f"muscle_attachment.{muscle.name}.{end}")
        points[k] = LinkPoint(points[k].link, points[k].position + shift)
    return replace(muscle, points=tuple(points), wrap=_wrap(muscle.wrap, muscle.name, draw))


def _wrap(wrap: SagittalWrap | None, name: str, draw: Draw) -> SagittalWrap | None:
    """Return how a tendon wraps, its band wider or narrower by the draw's error."""
    error = draw.error(f"tendon_band.{name}")
    return wrap if wrap is None or not error else replace(wrap, band=max(0.0, wrap.band + error))


def varied_muscles(muscles: SharedMuscles | None, draw: Draw) -> SharedMuscles | None:
    """Return shared muscles with their groups' strengths and attachments moved.

    Their motion and the rows of hip and ankle stay as recorded.
    """
    if muscles is None:
        return None
    names = muscles.trial.muscles
    factors, shifts = np.ones(len(names)), np.zeros((len(GROUP_ENDS), len(names), 3))
    for group, members in muscles.groups.items():
        own = np.isin(names, members)
        factors[own] = draw.factor(f"muscle_strength.{group}")
        for shift, end in zip(shifts, GROUP_ENDS, strict=True):
            shift[own] = draw.place(f"muscle_attachment.{group}.{end}")
    return muscles.changed(factors, *shifts)


def _on_femur(case: Case, end: LinkPoint, draw: Draw) -> LinkPoint:
    """Return a point moved with the femur, if it is on it."""
    shift = draw.place("femoral_placement")
    if not shift.any() or case.chain.carrier(end.link) != "femur":
        return end
    shift_in_femur = case.chain.link_in(end.link, "femur")[:3, :3].T @ shift
    return LinkPoint(end.link, end.position + shift_in_femur)


def thinnable(case: Case) -> bool:
    """Say whether a frame needs no other frame of the motion.

    It needs others if a solved patella is differentiated in time, or if a reference strain refers
    to another frame.
    """
    solved = case.scene.patella is not None and case.scene.patella.motion == "solved"
    return not solved and all(np.isfinite(one.slack_length) for one in case.ligaments)


def thinned(case: Case, frames: range) -> Case:
    """Return the case with only these frames of its motion."""
    count, chosen = len(case.motion.time), list(frames)

    def at_frames(recording: Any) -> Any:
        if recording is None:
            return None
        values = {one.name: getattr(recording, one.name) for one in fields(recording)}
        series = {
            name: value[chosen]
            for name, value in values.items()
            if isinstance(value, np.ndarray) and len(value) == count
        }
        return replace(recording, **series)

    return replace(
        case,
        motion=at_frames(case.motion),
        tibia=at_frames(case.tibia),
        ground=at_frames(case.ground),
    )


def displaced_by_markers(case: Case, draw: Draw) -> "tuple[BodyMotion | None, Array]":
    """Return the shank, and the knee coordinates (f, 6), with the markers' errors in them.

    Only coordinates that are taken from the markers change.

    Args:
        case: the case.
        draw: the errors of its inputs, `marker.<label>` among them.
    """
    markers, tibia, coordinates = case.scene.motion.markers, case.tibia, case.motion.coordinates
    if (
        markers is None
        or tibia is None
        or not any(one.name.startswith("marker.") for one in draw.inputs)
    ):
        return tibia, coordinates
    tables = {one.name: one for one in markers.segment}
    is_left = case.scene.patient.side == "left"
    shank, thigh = (_misfit(tables[name], draw, is_left) for name in MARKED)
    insert, knee = case.chain.insert_in_tibia, knee_pose(coordinates)
    thigh_pose = inverse(shank @ insert) @ insert @ knee @ thigh
    change = knee_coordinates(thigh_pose) - knee_coordinates(knee)
    varied = coordinates.copy()
    columns = [KNEE_COORDINATES.index(name) for name in markers.coordinates]
    varied[:, columns] += change[:, columns]
    return replace(tibia, pose=tibia.pose @ shank), varied


def _misfit(segment: MarkerSegmentTable, draw: Draw, is_left: bool) -> Array:
    """Return the pose (4, 4) of the fitted segment in the true one, as a right leg's."""
    points = np.array(list(segment.markers_mm.values())) * MILLIMETRE
    points = points @ MIRROR if is_left else points
    errors = np.array([draw.place(f"marker.{label}") for label in segment.markers_mm])
    weights = np.array([segment.weights.get(label, 1.0) for label in segment.markers_mm])
    poses, _ = fit_seen((points + errors)[None], points, weights, segment.name)
    return np.asarray(poses[0])
