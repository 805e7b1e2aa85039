"""Scaling of a case to a synthetic subject of the same shape.

A scale factor s multiplies lengths by s, masses and ground reaction by s³ (equal density), moments
of the plate by s⁴ and inertias by s⁵. The tissue's modulus E does not change: stiffness E A / L is
multiplied by s, force per strain E A and muscle strength by s². Angles and times do not change.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array
from tkamb.knee.load import LinkPoint

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface
    from tkamb.io.recordings.ground_reaction import GroundReaction
    from tkamb.io.recordings.motion import KneeMotion
    from tkamb.io.recordings.tibia import BodyMotion
    from tkamb.io.scene.case import Case
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.muscles import Muscle, PatellarLigament, SagittalWrap

TRANSLATIONS = [k for k, name in enumerate(KNEE_COORDINATES) if name in ("ap", "si", "ml")]
PATELLA_TRANSLATIONS = [0, 1]


def scaled_case(case: "Case") -> "Case":
    """Return the case at the size of its scene's `[patient] scale`.

    Raises:
        InputError: the scene has [muscles], markers or [measured], which belong to the unscaled
            subject.
    """
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
