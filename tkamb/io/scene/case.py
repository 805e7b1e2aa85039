"""A case: a scene and the content of its files, in SI units. A left knee is mirrored.

A scale factor s multiplies lengths by s, masses and ground reaction by s³ (equal density), moments
of the plate by s⁴ and inertias by s⁵. The tissue's modulus E does not change: stiffness E A / L is
multiplied by s, force per strain E A and muscle strength by s². Angles and times do not change.
"""

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array
from tkamb.io.recordings.filtering import check_frames, differentiate_coordinates
from tkamb.io.recordings.motion import KneeMotion, load_motion
from tkamb.io.recordings.patient import load_urdf
from tkamb.io.recordings.recording_tables import MotionTable
from tkamb.io.scene.parts import (
    ImplantParts,
    read_ligaments,
    read_muscles,
    read_patella_lines,
    read_patellar_ligament,
)
from tkamb.io.scene.scene import Scene
from tkamb.knee.chain import Chain
from tkamb.knee.load import LinkPoint
from tkamb.units import MEGAPASCAL

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface
    from tkamb.io.recordings.ground_reaction import GroundReaction
    from tkamb.io.recordings.measured import Envelopes, MeasuredForce
    from tkamb.io.recordings.motion import KneeMotion
    from tkamb.io.recordings.tibia import BodyMotion
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.muscles import Muscle, PatellarLigament, SagittalWrap
    from tkamb.knee.patella_frame import HeadShare


logger = logging.getLogger("tkamb")


@dataclass(frozen=True, eq=False)
class Case:
    """The input of a run; absent parts are None.

    Args:
        motion: coordinates of the knee, and of a recorded patella, per frame.
        tibia: motion of the shank in the laboratory; None: the shank is upright and does not move.
        ground: ground reaction in the laboratory.
        femoral: femoral component in the femur link's frame.
        insert: insert in the insert frame, without its post if `post` is given.
        patella: patellar button in the patella link's frame.
        ligaments: the bundles, including generic ones; the slack length is NaN if the scene does
            not state it.
        post: the insert's post in the insert frame, if the scene has [contact] post.
        insert_placement: pose of the insert's mesh in the insert frame, after the mesh is turned to
            anatomical axes about its origin, not mirrored, m, (4, 4); None if not needed.
    """

    scene: Scene
    chain: Chain
    motion: KneeMotion
    tibia: "BodyMotion | None"
    ground: "GroundReaction | None"
    femoral: "Surface | None"
    insert: "Surface | None"
    patella: "Surface | None"
    ligaments: "tuple[Ligament, ...]" = ()
    muscles: "tuple[Muscle, ...]" = ()
    patellar_ligament: "PatellarLigament | None" = None
    measured: "MeasuredForce | None" = None
    emg: "Envelopes | None" = None
    post: "Surface | None" = None
    insert_placement: Array | None = None
    patella_heads: "tuple[HeadShare, ...]" = ()
    patella_ligaments: "tuple[Ligament, ...]" = ()

    @cached_property
    def split(self) -> float | None:
        """z coordinate between the condyles, m, femoral frame; None with only one condyle."""
        from tkamb.geometry.condyles import condyle_split

        return condyle_split(self.femoral) if self.femoral else None

    def rates(self, time: Array, places: Array) -> tuple[Array, Array, Array]:
        """Filter coordinates of the patella like recorded ones, and differentiate them twice.

        Args:
            time: times, s, (n,).
            places: coordinates of the patella, (n, 3).
        """
        cutoff = self.scene.motion.cutoff_Hz
        check_frames(self.motion.time, cutoff, self.scene.motion.frames)
        return differentiate_coordinates(time, places, cutoff, name="positions of the patella")

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notices on how recordings were read, and what of them is not used."""
        parts = (self.motion, self.tibia, self.ground, self.measured, self.emg)
        remarks = [remark for part in parts if part is not None for remark in part.remarks]
        return tuple(dict.fromkeys(remarks))

    @cached_property
    def gait_cycle_s(self) -> tuple[float, float] | None:
        """Times of 0 and 100 % of the gait cycle, s, from the scene or else the force plates.

        None if neither states them, or if the motion's time column is in per cent of a cycle.
        """
        if self.motion.cycle_percent is not None:
            return None
        if self.scene.output.cycle_s is not None:
            return self.scene.output.cycle_s
        gait = None if self.ground is None else self.ground.gait
        if gait is None:
            return None
        return gait.cycle(float(self.motion.time[0]), float(self.motion.time[-1]))

    @property
    def bone(self) -> "Surface | None":
        """The bone that a muscle wraps, in the femur link's frame, or None."""
        return next((m.wrap.bone for m in self.muscles if m.wrap and m.wrap.bone), None)

    @property
    def body_mass(self) -> float:
        """Body mass of the patient at the scene's scale, kg."""
        return self.scene.patient.mass_kg * self.scene.patient.scale**3

    @property
    def height_mm(self) -> float | None:
        """Body height at the scene's scale, mm, or None."""
        patient = self.scene.patient
        return None if patient.height_mm is None else patient.height_mm * patient.scale

    @cached_property
    def body_weight(self) -> float:
        """Body weight at the scene's scale, N."""
        return self.body_mass * -float(self.chain.model.gravity.linear[1])

    @cached_property
    def yield_stress(self) -> float:
        """Yield stress of the insert, Pa, to which the column `area_above_yield` refers."""
        return self.scene.yield_stress_MPa * MEGAPASCAL


def _recordings(
    scene: Scene, source: MotionTable, chain: Chain, parts: ImplantParts | None
) -> "tuple[KneeMotion, BodyMotion | None, GroundReaction | None]":
    released = scene.contact.released if scene.contact else ()
    motion = load_motion(
        source,
        scene.patient.side,
        parts.insert_mesh_in_insert if parts else np.eye(4),
        parts.femoral_mesh_in_femur if parts else np.eye(4),
        (*released, "si") if released else (),
        chain.insert_in_tibia,
    )
    tibia = ground = None
    if scene.tibia:
        from tkamb.io.recordings.tibia import load_tibia

        tibia = load_tibia(scene.tibia, motion.time, scene.patient.side, scene.motion.cutoff_Hz)
    elif motion.markers:
        cutoff = scene.motion.cutoff_Hz
        tibia = motion.markers.shank_motion(cutoff, motion.time, str(scene.motion.file))
    if scene.ground_reaction:
        from tkamb.io.recordings.ground_reaction import check_under_foot, load_ground_reaction

        ground = load_ground_reaction(scene.ground_reaction, motion.time, scene.patient.side)
        if tibia and scene.ground_reaction.applied == "cop":
            check_under_foot(ground, tibia.pose[:, :3, 3], scene.ground_reaction.file)
    return motion, tibia, ground


def _common_part(scene: Scene) -> MotionTable | None:
    """Return [motion] with the interval that the ground reaction covers.

    The whole recording may begin and end at slightly different times. It is None if the interval
    cannot or need not be changed.
    """
    if scene.ground_reaction is None or scene.motion.interval_s or scene.motion.cycle_s:
        return None
    from tkamb.io.recordings.ground_reaction import recorded_span
    from tkamb.io.recordings.tables import read_table

    source = scene.motion
    recorded = read_table(source.file, source.format)
    time = recorded.time(source.columns.get("time", "time"))
    start, end = recorded_span(scene.ground_reaction)
    inside = time[(time >= start - 1e-9) & (time <= end + 1e-9)]
    if len(inside) < 2 or len(inside) == len(time):
        return None
    common = (float(inside[0]), float(inside[-1]))
    logger.warning(
        "%s: recorded from %.4f to %.4f s, the motion from %.4f to %.4f s: %.4f to %.4f s are used",
        scene.ground_reaction.file,
        *(start, end, time[0], time[-1], *common),
    )
    return source.model_copy(update={"interval_s": common})


def load_case(scene: Scene) -> Case:
    """Read the files that the scene names."""
    with_patella = scene.patella is not None
    chain = Chain(load_urdf(scene.patient, with_patella), with_patella)
    # Meshes take longer to read than tables. Tables come first: their errors then appear at once.
    parts = ImplantParts(scene) if scene.motion.interpretation == "pose" else None
    try:
        motion, tibia, ground = _recordings(scene, scene.motion, chain, parts)
    except InputError:
        source = _common_part(scene)
        if source is None:
            raise
        motion, tibia, ground = _recordings(scene, source, chain, parts)
    parts = parts or ImplantParts(scene)
    motion = _derived(scene, motion, parts)
    muscles: tuple[Muscle, ...] = ()
    patellar_ligament = None
    if scene.patella:
        muscles, patellar_ligament = read_muscles(scene, chain), read_patellar_ligament(scene)
    measured = emg = None
    if scene.measured is not None:
        from tkamb.io.recordings.measured import load_measured_force

        measured = load_measured_force(scene.measured, motion.time)
    if scene.muscles is not None and scene.muscles.emg is not None:
        from tkamb.io.recordings.measured import load_envelopes

        emg = load_envelopes(scene.muscles.emg, motion.time)
    case = Case(
        scene,
        chain,
        motion,
        tibia,
        ground,
        parts.femoral,
        parts.insert,
        parts.patella,
        read_ligaments(scene, parts, chain),
        muscles,
        patellar_ligament,
        measured,
        emg,
        parts.post,
        parts.insert_placement,
        *read_patella_lines(scene, parts, chain),
    )
    if scene.patient.scale == 1.0:
        return case

    return scaled_case(case)


def with_insert(case: Case, mesh: Path) -> Case:
    """Return a case with another mesh file of the insert, in the same unit and axes."""
    implant = case.scene.implant
    assert implant.insert is not None
    insert = implant.insert.model_copy(update={"mesh": mesh})
    implant = implant.model_copy(update={"insert": insert})
    scene = case.scene.model_copy(update={"implant": implant})
    parts = ImplantParts(scene, insert_alone=True)
    return replace(
        case,
        scene=scene,
        insert=parts.insert,
        post=parts.post,
        insert_placement=parts.insert_placement,
    )


def _derived(scene: Scene, motion: KneeMotion, parts: ImplantParts) -> KneeMotion:
    """Return the motion with coordinates from the surfaces: initial guess, or roll and slip."""
    table = scene.motion
    if motion.unrecorded or table.motion == "roll-slip":
        check_frames(motion.time, table.cutoff_Hz, table.frames)
    if motion.unrecorded:
        from tkamb.io.scene.derived_motion import seated_motion

        assert parts.femoral is not None and parts.insert is not None
        motion = seated_motion(motion, parts.femoral, parts.insert, table.cutoff_Hz)
    if table.motion == "roll-slip":
        from tkamb.io.scene.derived_motion import rolling_motion

        assert parts.femoral is not None and parts.insert is not None
        motion = rolling_motion(
            motion, parts.femoral, parts.insert, table.slip_share, table.cutoff_Hz
        )
    return motion


TRANSLATIONS = [k for k, name in enumerate(KNEE_COORDINATES) if name in ("ap", "si", "ml")]
PATELLA_TRANSLATIONS = [0, 1]


def scaled_case(case: "Case") -> "Case":
    """Return the case at the size of its scene's `[patient] scale`."""
    s = case.scene.patient.scale
    for content, table in (
        (case.scene.muscles, "[muscles]"),
        (case.motion.markers, "[motion.markers]"),
        (case.scene.measured, "[measured]"),
    ):
        if content is not None:
            what, hint = f"cannot scale a scene with {table}", "scale its models, or leave it out"
            raise InputError(what, "[patient] scale", hint)
    return replace(
        case,
        chain=case.chain.scaled(s),
        motion=_motion(case.motion, s),
        tibia=None if case.tibia is None else _shank(case.tibia, s),
        ground=None if case.ground is None else _ground(case.ground, s),
        femoral=_surface(case.femoral, s),
        insert=_surface(case.insert, s),
        patella=_surface(case.patella, s),
        post=_surface(case.post, s),
        ligaments=tuple(_ligament(bundle, s) for bundle in case.ligaments),
        muscles=tuple(_muscle(muscle, s) for muscle in case.muscles),
        patellar_ligament=_patellar_ligament(case.patellar_ligament, s),
        patella_heads=tuple(
            replace(head, origin=_point(head.origin, s), insertion=_point(head.insertion, s))
            for head in case.patella_heads
        ),
        patella_ligaments=tuple(_ligament(bundle, s) for bundle in case.patella_ligaments),
    )


def _columns(values: Array, columns: list[int], s: float) -> Array:
    result = values.copy()
    result[:, columns] *= s
    return result


def _motion(motion: "KneeMotion", s: float) -> "KneeMotion":
    names = ("coordinates", "velocity", "acceleration", "raw_coordinates")
    changes: dict[str, Any] = {
        name: _columns(getattr(motion, name), TRANSLATIONS, s) for name in names
    }
    changes["deviation_translation"] = motion.deviation_translation * s
    for name in ("patella", "patella_velocity", "patella_acceleration"):
        if getattr(motion, name) is not None:
            changes[name] = _columns(getattr(motion, name), PATELLA_TRANSLATIONS, s)
    return replace(motion, **changes)


def _shank(tibia: "BodyMotion", s: float) -> "BodyMotion":
    pose = tibia.pose.copy()
    pose[:, :3, 3] *= s
    linear = [0, 1, 2]
    return replace(
        tibia,
        pose=pose,
        velocity=_columns(tibia.velocity, linear, s),
        acceleration=_columns(tibia.acceleration, linear, s),
        residual=None if tibia.residual is None else tibia.residual * s,
    )


def _ground(ground: "GroundReaction", s: float) -> "GroundReaction":
    return replace(
        ground, force=ground.force * s**3, point=ground.point * s, moment=ground.moment * s**4
    )


def _surface(surface: "Surface | None", s: float) -> "Surface | None":
    return None if surface is None else replace(surface, vertices=surface.vertices * s)


def _point(point: LinkPoint, s: float) -> LinkPoint:
    return LinkPoint(point.link, point.position * s)


def _ligament(bundle: "Ligament", s: float) -> "Ligament":
    return replace(
        bundle,
        proximal=_point(bundle.proximal, s),
        distal=_point(bundle.distal, s),
        law=bundle.law.scaled(s),
        slack_length=bundle.slack_length * s,
        wraps=tuple(wrap.scaled(s) for wrap in bundle.wraps),
    )


def _muscle(muscle: "Muscle", s: float) -> "Muscle":
    points = tuple(_point(point, s) for point in muscle.points)
    return replace(
        muscle, points=points, wrap=_wrap(muscle.wrap, s), strength=muscle.strength * s**2
    )


def _wrap(wrap: "SagittalWrap | None", s: float) -> "SagittalWrap | None":
    if wrap is None:
        return None
    return replace(
        wrap,
        band=wrap.band * s,
        half_thickness=wrap.half_thickness * s,
        bone=_surface(wrap.bone, s),
    )


def _patellar_ligament(line: "PatellarLigament | None", s: float) -> "PatellarLigament | None":
    if line is None:
        return None
    return replace(
        line,
        proximal=_point(line.proximal, s),
        distal=_point(line.distal, s),
        wrap=_wrap(line.wrap, s),
        length=line.length * s,
    )
