"""Muscles, ligaments and the patellar ligament of a scene, in SI, as those of a right knee."""

from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import MIRROR
from tkamb.io.scene.scene import Scene
from tkamb.io.scene.tables import Attachment, BoneTable, LigamentTable, MuscleTable, MuscleWrapTable
from tkamb.knee.chain import Chain
from tkamb.knee.load import LinkPoint
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.muscles import Muscle, PatellarLigament, SagittalWrap

NAN = float("nan")


def muscle_tables(scene: Scene) -> tuple[MuscleTable, ...]:
    """Return the scene's [[muscle]] tables, the short form [quadriceps] written out as one."""
    short = scene.quadriceps
    if short is None:
        return scene.muscle
    wrap = None
    if short.wrap:
        wrap = MuscleWrapTable(
            bone=short.bone, half_thickness_mm=short.half_thickness_mm, band_mm=short.band_mm
        )
    path = (short.origin, short.insertion)
    return (*scene.muscle, MuscleTable(name="quadriceps", path=path, wrap=wrap))


def muscles(scene: Scene, chain: Chain) -> "tuple[Muscle, ...]":
    """Return the muscles.

    Raises:
        InputError: they cannot be balanced (`tkamb.knee.muscles.check_muscles`), or a bone's mesh
            cannot be read.
    """
    from tkamb.knee.muscles import Muscle, check_muscles

    is_left = scene.patient.side == "left"
    result = tuple(
        Muscle(
            table.name,
            tuple(_point(end, is_left) for end in table.path),
            _wrap(table.wrap, _bone(table.wrap.bone, chain, is_left)) if table.wrap else None,
            NAN if table.force_N is None else table.force_N,
            table.group,
        )
        for table in muscle_tables(scene)
    )
    check_muscles(result, chain)
    return result


def patellar_ligament(scene: Scene) -> "PatellarLigament | None":
    """Return the patellar ligament; None where the scene has none."""
    from tkamb.knee.muscles import PatellarLigament, SagittalWrap

    table, is_left = scene.patellar_ligament, scene.patient.side == "left"
    if table is None:
        return None
    wrap = None
    if table.wrap:
        wrap = SagittalWrap(table.band_mm * MILLIMETRE, table.half_thickness_mm * MILLIMETRE)
    length = NAN if table.length_mm is None else table.length_mm * MILLIMETRE
    return PatellarLigament(
        _point(table.proximal, is_left), _point(table.distal, is_left), wrap, length
    )


def ligaments(scene: Scene) -> "tuple[Ligament, ...]":
    """Return the bundles of the scene's [[ligament]] tables."""
    return tuple(ligament(table, scene.patient.side == "left") for table in scene.ligament)


def ligament(table: LigamentTable, left: bool = False) -> "Ligament":
    """Return one bundle."""
    from tkamb.knee.ligaments import Ligament

    stiffness = table.stiffness_N_per_strain
    if table.stiffness_N_per_mm is not None:
        stiffness = table.stiffness_N_per_mm / MILLIMETRE
    assert stiffness is not None
    return Ligament(
        table.name,
        _point(table.proximal, left),
        _point(table.distal, left),
        table.law,
        stiffness,
        NAN if table.slack_length_mm is None else table.slack_length_mm * MILLIMETRE,
        NAN if table.reference_strain is None else table.reference_strain,
        table.reference_flexion_deg * DEGREE,
    )


def _point(end: Attachment, left: bool) -> LinkPoint:
    position = np.array(end.point_mm) * MILLIMETRE
    return LinkPoint(end.link, MIRROR @ position if left else position)


def _wrap(table: MuscleWrapTable, bone: "Surface | None") -> "SagittalWrap":
    from tkamb.knee.muscles import SagittalWrap

    return SagittalWrap(table.band_mm * MILLIMETRE, table.half_thickness_mm * MILLIMETRE, bone)


def _bone(table: BoneTable | None, chain: Chain, left: bool) -> "Surface | None":
    """Return a bone's surface in the femur link's frame."""
    if table is None:
        return None
    from tkamb.io.recordings.meshes import BONE_SIZE, load_surface, mirrored

    surface = load_surface(table.mesh, table.unit, table.axes, name="bone", size=BONE_SIZE)
    return (mirrored(surface) if left else surface).moved(chain.link_in(table.link, "femur"))
