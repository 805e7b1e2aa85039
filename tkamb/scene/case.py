"""A case: the scene with its files read, in SI, as a right knee. Only what the scene asks for."""

import logging
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.body.chain import Chain
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, pose
from tkamb.inputs.motion import KneeMotion, load_motion
from tkamb.inputs.patient import load_urdf
from tkamb.scene import Scene
from tkamb.scene.tables import Attachment, FemoralImplantTable, PatellarImplantTable
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface
    from tkamb.inputs.ground_reaction import GroundReaction
    from tkamb.inputs.tibia import BodyMotion

logger = logging.getLogger("tkamb")


@dataclass(frozen=True, eq=False)
class Case:
    """What a run works on. Absent in the scene: None.

    Args:
        scene: the scene; of a left knee with its points mirrored.
        chain: the patient in Pinocchio.
        motion: knee (and recorded patella) coordinates per frame.
        tibia: the shank in the laboratory; None: upright and at rest.
        ground: ground reaction in the laboratory.
        femoral: femoral component in the femur link's frame.
        insert: insert in the insert frame.
        patella: patellar button in the patella link's frame.
    """

    scene: Scene
    chain: Chain
    motion: KneeMotion
    tibia: "BodyMotion | None"
    ground: "GroundReaction | None"
    femoral: "Surface | None"
    insert: "Surface | None"
    patella: "Surface | None"

    @cached_property
    def split(self) -> float | None:
        """z (m, femoral frame) between the condyles; None if there is only one."""
        from tkamb.geometry.condyles import condyle_split

        return condyle_split(self.femoral) if self.femoral else None

    @property
    def body_weight(self) -> float:
        """N."""
        return self.scene.patient.mass_kg * -float(self.chain.model.gravity.linear[1])


def load_case(scene: Scene) -> Case:
    """Read the files that the scene names, and no other.

    Raises:
        InputError: whatever is wrong with them, in one line.
    """
    if scene.patient.side == "left":
        scene = _with_mirrored_attachments(scene)
    with_patella = scene.patella is not None
    chain = Chain(load_urdf(scene.patient, with_patella), with_patella)
    parts = _Parts(scene)
    released = scene.contact.released if scene.contact else ()
    motion = load_motion(
        scene.motion,
        scene.patient.side,
        parts.insert_mesh_in_insert,
        parts.femoral_mesh_in_femur,
        (*released, "si") if released else (),
        chain.insert_in_tibia,
    )
    if motion.unrecorded:
        from tkamb.mechanics.seat import seated_motion

        assert parts.femoral is not None and parts.insert is not None
        motion = seated_motion(motion, parts.femoral, parts.insert, scene.motion.cutoff_Hz)
    if scene.motion.motion == "roll-slip":
        from tkamb.mechanics.rolling import rolling_motion

        assert parts.femoral is not None and parts.insert is not None
        table = scene.motion
        motion = rolling_motion(
            motion, parts.femoral, parts.insert, table.slip_share, table.cutoff_Hz
        )
    if scene.generic_ligaments:
        scene = _with_generic_ligaments(scene, parts, chain.insert_in_tibia)
    tibia = ground = None
    if scene.tibia:
        from tkamb.inputs.tibia import load_tibia

        tibia = load_tibia(scene.tibia, motion.time, scene.patient.side, scene.motion.cutoff_Hz)
    elif motion.markers:
        cutoff = scene.motion.cutoff_Hz
        tibia = motion.markers.shank_motion(cutoff, motion.time, str(scene.motion.file))
    if scene.ground_reaction:
        from tkamb.inputs.ground_reaction import check_under_foot, load_ground_reaction

        ground = load_ground_reaction(scene.ground_reaction, motion.time, scene.patient.side)
        if tibia and scene.ground_reaction.applied == "cop":
            check_under_foot(ground, tibia.pose[:, :3, 3], scene.ground_reaction.file)
    return Case(scene, chain, motion, tibia, ground, parts.femoral, parts.insert, parts.patella)


def _with_mirrored_attachments(scene: Scene) -> Scene:
    """Return a left knee's scene with the points of lines and ligaments reflected in z."""

    def mirrored(table: Any) -> Any:
        ends = {
            name: end.model_copy(update={"point_mm": (*end.point_mm[:2], -end.point_mm[2])})
            for name, end in table
            if isinstance(end, Attachment)
        }
        return table.model_copy(update=ends)

    lines = {
        name: mirrored(table)
        for name in ("quadriceps", "patellar_ligament")
        if (table := getattr(scene, name)) is not None
    }
    bundles = tuple(mirrored(table) for table in scene.ligament)
    return scene.model_copy(update={**lines, "ligament": bundles})


def _with_generic_ligaments(scene: Scene, parts: "_Parts", pose_insert_in_tibia: Array) -> Scene:
    """Return the scene with the generic bundles it asks for among its own."""
    from tkamb.body.generic_ligaments import generic_ligaments

    assert scene.generic_ligaments is not None
    assert parts.femoral is not None and parts.insert is not None
    bundles = generic_ligaments(
        parts.femoral, parts.insert, pose_insert_in_tibia, scene.generic_ligaments.ligaments
    )
    return scene.model_copy(update={"ligament": scene.ligament + bundles})


class _Parts:
    """The implant's surfaces in their own frames, and where their meshes' axes lie."""

    def __init__(self, scene: Scene) -> None:
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
        self.insert_mesh_in_insert = self.femoral_mesh_in_femur = np.eye(4)
        if wants_insert:
            if not implant.insert:
                raise InputError(
                    "interpretation = 'pose' is in the insert mesh's axes",
                    "[motion]",
                    "give [implant.insert] and [implant.femoral]",
                )
            self._place_insert(scene)
        if wants_femoral:
            if not implant.femoral:
                raise InputError("is missing", "[implant.femoral]", "the patella rides on it")
            self.femoral, self.femoral_mesh_in_femur = self._place(
                "femoral component", implant.femoral
            )
        if scene.patella is not None:
            if not implant.patella:
                raise InputError("is missing", "[implant.patella]", "[patella] needs its mesh")
            self.patella, _ = self._place("patellar button", implant.patella)

    def _place_insert(self, scene: Scene) -> None:
        from tkamb.geometry.flat_bottom import insert_placement
        from tkamb.inputs.meshes import axes_rotation, load_surface

        table = scene.implant.insert
        assert table is not None
        surface = load_surface(table.mesh, table.unit, table.axes, name="insert", closed=True)
        try:
            placement = insert_placement(surface, axes_rotation(table.axes))
        except InputError as error:
            if scene.implant.femoral and self._could_be_insert(scene.implant.femoral):
                question = "are the meshes of [implant.femoral] and [implant.insert] exchanged?"
                raise InputError(error.what, error.where, question) from None
            raise
        self.insert_mesh_in_insert = placement @ pose(axes_rotation(table.axes), np.zeros(3))
        self.insert = self._sided(surface.moved(placement))

    def _could_be_insert(self, table: FemoralImplantTable) -> bool:
        """Say whether the mesh that the scene calls femoral has an insert's flat bottom."""
        from tkamb.geometry.flat_bottom import insert_placement
        from tkamb.inputs.meshes import axes_rotation, load_surface

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

        from tkamb.inputs.meshes import axes_rotation, load_surface

        surface = load_surface(table.mesh, table.unit, table.axes, name=name)
        turn = Rotation.from_euler("XYZ", table.rotation_deg, degrees=True).as_matrix()
        placement = pose(turn, np.array(table.position_mm) * MILLIMETRE)
        mesh_in_link = placement @ pose(axes_rotation(table.axes), np.zeros(3))
        return self._sided(surface.moved(placement)), mesh_in_link

    def _sided(self, surface: "Surface") -> "Surface":
        from tkamb.inputs.meshes import mirrored

        return mirrored(surface) if self._left else surface
