"""Implants, muscles and ligaments of a scene, in SI units; a left knee is mirrored."""

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, Array, mirrored_pose, pose
from tkamb.io.scene.scene import Scene
from tkamb.io.scene.tables import (
    Attachment,
    BoneTable,
    FemoralImplantTable,
    LigamentTable,
    LigamentWrapTable,
    MuscleTable,
    MuscleWrapTable,
    PatellarImplantTable,
)
from tkamb.knee.chain import Chain
from tkamb.knee.load import LinkPoint
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.muscles import Muscle, PatellarLigament, SagittalWrap
    from tkamb.knee.patella_frame import HeadShare
    from tkamb.knee.wrap_object import WrapObject

NAN = float("nan")


class ImplantParts:
    """The implant's surfaces in the frames of their links, and the poses of their meshes.

    Parts that are not needed are None.

    Args:
        insert_alone: whether the insert is the only part to read.
    """

    def __init__(self, scene: Scene, insert_alone: bool = False) -> None:
        implant, self._left = scene.implant, scene.patient.side == "left"
        wants_insert = (
            scene.contact is not None
            or scene.generic_ligaments is not None
            or scene.motion.interpretation == "pose"
            or scene.motion.motion == "roll-slip"
        )
        wants_femoral = wants_insert or scene.patella is not None
        self.femoral: Surface | None = None
        self.insert: Surface | None = None
        self.patella: Surface | None = None
        self.post: Surface | None = None
        self.insert_mesh_in_insert = self.femoral_mesh_in_femur = np.eye(4)
        self.insert_placement: Array | None = None
        if wants_insert:
            if not implant.insert:
                raise InputError(
                    "interpretation = 'pose' refers to the insert mesh's axes",
                    "[motion]",
                    "give [implant.insert] and [implant.femoral]",
                )
            self.insert = self._place_insert(scene)
            if scene.contact is not None and scene.contact.post:
                from tkamb.geometry.post import divide_insert

                self.insert, self.post = divide_insert(self.insert)
        elif implant.insert and scene.muscles is not None:  # [muscles] needs the placement
            self._place_insert(scene)
        if insert_alone:
            return
        if wants_femoral:
            if not implant.femoral:
                raise InputError("is missing", "[implant.femoral]", "the patella slides on it")
            self.femoral, self.femoral_mesh_in_femur = self._place(
                "femoral component", implant.femoral
            )
        if scene.patella is not None:
            if not implant.patella:
                raise InputError("is missing", "[implant.patella]", "[patella] needs its mesh")
            self.patella, _ = self._place("patellar button", implant.patella)

    def _place_insert(self, scene: Scene) -> "Surface":
        from tkamb.geometry.flat_bottom import insert_placement
        from tkamb.io.recordings.meshes import axes_rotation, load_surface

        table = scene.implant.insert
        assert table is not None
        surface = load_surface(table.mesh, table.unit, table.axes, name="insert", closed=True)
        try:
            placement = insert_placement(surface, axes_rotation(table.axes))
        except InputError as error:
            if scene.implant.femoral and self._could_be_insert(scene.implant.femoral):
                hint = (
                    "check whether the meshes of [implant.femoral] and [implant.insert] are "
                    "exchanged"
                )
                raise InputError(error.what, error.where, hint) from None
            raise
        self.insert_mesh_in_insert = placement @ pose(axes_rotation(table.axes), np.zeros(3))
        self.insert_placement = placement
        return self._right(surface.moved(placement))

    def _could_be_insert(self, table: FemoralImplantTable) -> bool:
        from tkamb.geometry.flat_bottom import insert_placement
        from tkamb.io.recordings.meshes import axes_rotation, load_surface

        try:
            surface = load_surface(table.mesh, table.unit, table.axes, name="femoral component")
            insert_placement(surface, axes_rotation(table.axes))
        except InputError:
            return False
        return True

    def _place(
        self, name: str, table: FemoralImplantTable | PatellarImplantTable
    ) -> "tuple[Surface, Array]":
        from scipy.spatial.transform import Rotation

        from tkamb.io.recordings.meshes import axes_rotation, load_surface

        surface = load_surface(table.mesh, table.unit, table.axes, name=name)
        turn = Rotation.from_euler("XYZ", table.rotation_deg, degrees=True).as_matrix()
        placement = pose(turn, np.array(table.position_mm) * MILLIMETRE)
        mesh_in_link = placement @ pose(axes_rotation(table.axes), np.zeros(3))
        return self._right(surface.moved(placement)), mesh_in_link

    def _right(self, surface: "Surface") -> "Surface":
        return surface.mirrored() if self._left else surface


def muscle_tables(scene: Scene) -> tuple[MuscleTable, ...]:
    """Return the scene's [[muscle]] tables, including one made from [quadriceps]."""
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


def read_muscles(scene: Scene, chain: Chain) -> "tuple[Muscle, ...]":
    """Return the muscles."""
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


def read_patellar_ligament(scene: Scene) -> "PatellarLigament | None":
    """Return the patellar ligament, or None if the scene has none."""
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


def read_ligaments(scene: Scene, parts: ImplantParts, chain: Chain) -> "tuple[Ligament, ...]":
    """Return the bundles of the [[ligament]] tables, then the bundles of [generic_ligaments]."""
    if not (scene.ligament or scene.generic_ligaments):
        return ()
    from tkamb.knee.ligaments import check_collateral_sides, generic_ligaments

    side = scene.patient.side
    is_left = side == "left"
    bundles = tuple(
        replace(
            ligament(table, is_left),
            wraps=tuple(wrap_object(wrap, parts, chain, is_left) for wrap in table.wrap),
        )
        for table in scene.ligament
    )
    check_collateral_sides(bundles, chain, side)
    if scene.generic_ligaments:
        assert parts.femoral is not None and parts.insert is not None
        names = scene.generic_ligaments.ligaments
        bundles += generic_ligaments(parts.femoral, parts.insert, chain.insert_in_tibia, names)
    return bundles


def read_patella_lines(
    scene: Scene, parts: ImplantParts, chain: Chain
) -> "tuple[tuple[HeadShare, ...], tuple[Ligament, ...]]":
    """Return the heads of the quadriceps and the ligaments of a released patella."""
    table, is_left = scene.patella, scene.patient.side == "left"
    if table is None or not table.released:
        return (), ()
    from tkamb.knee.patella_frame import HeadShare

    lines = tuple(
        replace(
            ligament(one, is_left),
            wraps=tuple(wrap_object(wrap, parts, chain, is_left) for wrap in one.wrap),
        )
        for one in table.ligament
    )
    joined = {line.name: {chain.carrier(link) for link in line.links} for line in lines}
    for name, links in joined.items():
        if "patella" not in links:
            where = f"[[patella.ligament]] {name}"
            raise InputError("has no end on the patella", where, "give it as [[ligament]]")
        if len(links) < 2:
            where = f"[[patella.ligament]] {name}"
            hint = "let one end be on the tibia or the femur"
            raise InputError("has both ends on the patella", where, hint)
    if not any({"patella", "tibia"} <= links for links in joined.values()):
        hint = "give strands of the patellar ligament"
        raise InputError("none runs from the patella to the tibia", "[[patella.ligament]]", hint)
    heads = tuple(
        HeadShare(
            head.name, _point(head.origin, is_left), _point(head.insertion, is_left), head.share
        )
        for head in table.head
    )
    for head in heads:
        ends = [chain.carrier(end.link) for end in (head.origin, head.insertion)]
        if ends != ["femur", "patella"]:
            where = f"[[patella.head]] {head.name}"
            hint = "give an origin on the femur and an insertion on the patella"
            raise InputError(f"runs from {ends[0]} to {ends[1]}", where, hint)
    return heads, lines


def ligament(table: LigamentTable, left: bool = False) -> "Ligament":
    """Return the bundle that a table describes, without its surfaces, mirrored if `left`."""
    from tkamb.knee.ligament_laws import ligament_law
    from tkamb.knee.ligaments import Ligament

    stiffness = table.stiffness_N_per_strain
    if table.stiffness_N_per_mm is not None:
        stiffness = table.stiffness_N_per_mm / MILLIMETRE
    assert stiffness is not None
    return Ligament(
        table.name,
        _point(table.proximal, left),
        _point(table.distal, left),
        ligament_law(table.law, stiffness),
        NAN if table.slack_length_mm is None else table.slack_length_mm * MILLIMETRE,
        NAN if table.reference_strain is None else table.reference_strain,
        table.reference_flexion_deg * DEGREE,
    )


def wrap_object(
    table: LigamentWrapTable, parts: ImplantParts, chain: Chain, left: bool = False
) -> "WrapObject":
    """Return the surface that a table describes, mirrored if `left`."""
    from scipy.spatial.transform import Rotation

    from tkamb.geometry.polygons import convex_outline
    from tkamb.knee.wrap_object import WrapObject, mesh_section

    turn = Rotation.from_euler("XYZ", table.rotation_deg, degrees=True).as_matrix()
    placed = pose(turn, np.array(table.position_mm) * MILLIMETRE)
    if table.part is not None:
        surface = parts.insert if table.part == "insert" else parts.femoral
        if surface is None:
            raise InputError(
                f"the scene does not read the {table.part}", f"wrap {table.name}", "give [contact]"
            )
        here = mirrored_pose(placed) if left else placed
        band, offset = table.band_mm * MILLIMETRE, table.offset_mm * MILLIMETRE
        found = mesh_section(table.name, "femur", surface, here, band, offset)
        return found.on("tibia", chain.insert_in_tibia) if table.part == "insert" else found
    assert table.link is not None
    outline: Array | None = None
    sizes = (table.radius_mm, table.length_mm, *(table.semi_axes_mm or ()))
    if table.outline_mm is not None:
        corners = np.array(table.outline_mm, float) * MILLIMETRE
        outline = convex_outline(corners)
        if len(outline) != len(corners):
            raise InputError("outline_mm is not strictly convex", f"wrap {table.name}")
    dimensions = tuple(float(size) * MILLIMETRE for size in sizes if size is not None)
    found = WrapObject(table.name, table.link, table.shape, placed, dimensions, outline=outline)
    return found.mirrored() if left else found


def wrap_table(wrap: "WrapObject", left: bool = False) -> dict[str, Any]:
    """Return the table that describes a surface, mirrored if `left`."""
    from scipy.spatial.transform import Rotation

    if wrap.shape == "torus" or wrap.quadrant is not None:
        raise InputError(
            "a scene has no torus and no half of a surface", f"wrap object {wrap.name}"
        )
    placed = (wrap.mirrored() if left else wrap).pose
    sizes = [float(size) / MILLIMETRE for size in wrap.dimensions]
    if wrap.shape == "ellipsoid":
        keys: dict[str, Any] = {"semi_axes_mm": sizes}
    elif wrap.outline is not None:
        keys = {"outline_mm": (wrap.outline / MILLIMETRE).tolist()}
    else:
        keys = dict(zip(("radius_mm", "length_mm"), sizes, strict=False))
    turn = Rotation.from_matrix(placed[:3, :3]).as_euler("XYZ", degrees=True)
    return {
        "name": re.sub(r"\W", "_", wrap.name, flags=re.ASCII),
        "shape": wrap.shape,
        "link": wrap.body,
        "position_mm": (placed[:3, 3] / MILLIMETRE).tolist(),
        "rotation_deg": turn.tolist(),
        **keys,
    }


def _point(end: Attachment, left: bool) -> LinkPoint:
    position = np.array(end.point_mm) * MILLIMETRE
    return LinkPoint(end.link, MIRROR @ position if left else position)


def _wrap(table: MuscleWrapTable, bone: "Surface | None") -> "SagittalWrap":
    from tkamb.knee.muscles import SagittalWrap

    return SagittalWrap(table.band_mm * MILLIMETRE, table.half_thickness_mm * MILLIMETRE, bone)


def _bone(table: BoneTable | None, chain: Chain, left: bool) -> "Surface | None":
    if table is None:
        return None
    from tkamb.io.recordings.meshes import BONE_SIZE, load_surface

    surface = load_surface(table.mesh, table.unit, table.axes, name="bone", size=BONE_SIZE)
    return (surface.mirrored() if left else surface).moved(chain.link_in(table.link, "femur"))
