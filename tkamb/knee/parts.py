"""The parts of a `tkamb.Knee` as plain data, and their conversion to the canonical chain.

Lengths are in metres, forces in newtons. A point on a frame of the user's model is a `LinkPoint`,
or a pair of the frame's name and three coordinates, such as ("femur", (0.0, 0.01, -0.042)).
"""

import hashlib
import pickle
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tkamb.errors import InputError, must_be, real_number
from tkamb.geometry.frames import Array, inverse, mirrored_pose
from tkamb.geometry.surface import Surface
from tkamb.knee.anatomy import Anatomy, FixedFrame
from tkamb.knee.canonical import Bridge, se3
from tkamb.knee.chain import Chain
from tkamb.knee.load import link_point
from tkamb.knee.muscles import Muscle, PatellarLigament
from tkamb.settings import changed_settings

if TYPE_CHECKING:
    import pinocchio as pin

    from tkamb.contact.materials import Material
    from tkamb.contact.model import ContactModel
    from tkamb.contact.pair import ContactPair
    from tkamb.knee.button import Button
    from tkamb.knee.contact import KneeContact
    from tkamb.knee.extensor import ExtensorLines
    from tkamb.knee.ligaments import BundleArrays, Ligament


Mesh = Any
"""A `trimesh.Trimesh`, a pair (vertices (n, 3) m, triangles (k, 3)), or a `Surface`."""


# m: a longer mesh is refused, because it is probably in millimetres. No part of an
# implant is longer.
MAX_LENGTH = 0.5


def check_names(what: str, names: Sequence[str]) -> None:
    """Raise an InputError if two lines have one name."""
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two are named '{name}'", what, "give each its own name")


def check_length(length: float, what: str, where: str) -> None:
    """Raise an InputError if a length of a line is not positive, or is in millimetres."""
    if not length > 0:
        raise InputError(f"{what} {length} m", where, f"give {what} in metres")
    if length > MAX_LENGTH:
        raise InputError(f"{what} {length:.4g} m", where, "is it in millimetres? give metres")


@dataclass(frozen=True, eq=False)
class Implant:
    """The parts of a total knee replacement, SI.

    Args:
        femoral: mesh of the femoral component, in the axes of the frame "femoral" (see
            `tkamb.Knee`): x anterior, y superior, z to the patient's right.
        insert: closed mesh of the polyethylene insert, in the axes of the frame "insert", which
            have the same directions. The flat bottom faces -y.
        patella: mesh of the patellar button, in the axes of the frame "patella". The articular
            side faces -x.
        material: material of the insert, a name (`tkamb.contact.materials.MATERIALS`) or a
            `Material`.
        bearing: "fixed" (bottom glued) or "mobile" (bottom slides).
        placed: True: the insert frame of the results is the frame "insert". False: its origin is
            the centre of the mesh's flat bottom.
        patella_material: material of the patellar button, as `material`.
    """

    femoral: Mesh = None
    insert: Mesh = None
    patella: Mesh = None
    material: "str | Material" = "polyethylene"
    bearing: Literal["fixed", "mobile"] = "fixed"
    placed: bool = False
    patella_material: "str | Material" = "polyethylene"

    @property
    def insert_material(self) -> "Material":
        """Material of the insert as an object."""
        return _as_material(self.material)

    @property
    def button_material(self) -> "Material":
        """Material of the patellar button as an object."""
        return _as_material(self.patella_material)


def _as_material(given: "str | Material") -> "Material":
    from tkamb.contact.materials import Material, material

    made = material(given) if isinstance(given, str) else given
    must_be(made, Material, "Implant: material", "give its name or a Material")
    return made


@dataclass(frozen=True, eq=False)
class Extensor:
    """Quadriceps, patella and patellar ligament.

    The patella moves in a sagittal plane of the femur. If the model has a frame "patella" that
    moves relative to the femur, q gives the pose of the patella. Otherwise the pose is that of a
    massless patella in equilibrium, with a constant length of the ligament.

    Args:
        quadriceps: muscle from the femur to the patella.
        patellar_ligament: line from the patella to the tibia. Its `length` is required if q does
            not give the pose of the patella.
        plane: pose of the plane's frame in the frame "femur", `pin.SE3` or (4, 4); None: the
            placement of the joint "patella_ap", or the frame "femur" if the model has no such
            joint.
        solved: whether `Knee.equilibrium` solves the patella of the model again when the femur
            moves. False: the patella moves with the femur.
    """

    quadriceps: Muscle
    patellar_ligament: PatellarLigament
    plane: "pin.SE3 | Array | None" = None
    solved: bool = False


def as_surface(mesh: Mesh, name: str, closed: bool = False) -> Surface:
    """Return a mesh in memory as a surface, m.

    Duplicate and degenerate triangles, wrong winding and small holes are repaired
    (`tkamb.geometry.repair`). A `Surface` is returned unchanged; `name` is for messages.

    Raises:
        InputError: the mesh has no valid triangles, is not finite, is in millimetres, is not one
            surface, or is open although `closed`.
    """
    if isinstance(mesh, Surface):
        return mesh
    from tkamb.geometry.repair import repair

    vertices, faces = _arrays(mesh, name)
    if not np.isfinite(vertices).all():
        raise InputError("holds coordinates that are not finite", name, "check the mesh")
    extent = float(np.ptp(vertices, axis=0).max())
    if not 0.0 < extent < MAX_LENGTH:
        raise InputError(
            f"is {extent:.4g} m long",
            name,
            "meshes are in metres: multiply millimetres by 1e-3",
        )
    repaired = repair(vertices, faces)
    if repaired.one_sided or len(repaired.faces) < 4 or len(repaired.forks):
        raise InputError("is not one triangulated surface", name, "give the part's outer skin")
    if closed and repaired.holes:
        width = repaired.holes[0].width
        raise InputError(
            f"is not closed: its widest hole is {width:.3g} m across", name, "close the mesh"
        )
    return Surface(repaired.vertices, repaired.faces, name, merged=True)


def _arrays(mesh: Mesh, name: str) -> tuple[Array, Any]:
    hint = "give a trimesh.Trimesh, or vertices (n, 3) in metres and triangles (k, 3)"
    parts = (mesh.vertices, mesh.faces) if hasattr(mesh, "faces") else mesh
    try:
        vertices, faces = (np.asarray(part) for part in parts)
    except (TypeError, ValueError):
        raise InputError("is not a mesh", name, hint) from None
    triangles = vertices.ndim == faces.ndim == 2 and vertices.shape[1] == faces.shape[1] == 3
    if not triangles or not len(faces) or not np.issubdtype(faces.dtype, np.integer):
        raise InputError("is not a triangle mesh", name, hint)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("has triangles with vertex numbers out of range", name, hint)
    return vertices.astype(float), faces.astype(np.int64)


# m and rad: difference between the mesh frame and the frame of the flat bottom below which the two
# are equal. It is above rounding errors.
FRAME_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The implant's surfaces in their parts' frames, mirrored for a left knee."""

    femoral: Surface | None
    insert: Surface | None
    button: Surface | None


def surfaces_of(
    implant: Implant, is_left: bool, with_contact: bool, with_extensor: bool
) -> Surfaces:
    """Return the surfaces, with the insert in the frame "insert"."""
    needs = {"femoral": with_contact or with_extensor}
    needs |= {"insert": with_contact, "patella": with_extensor}
    surfaces: list[Surface | None] = []
    for name, needed in needs.items():
        mesh = getattr(implant, name)
        if mesh is None and needed:
            what = "the contact" if name == "insert" else "the contact or the extensor"
            raise InputError(f"has no {name} mesh", "Implant", f"{what} needs it")
        if mesh is None:
            surfaces.append(None)
            continue
        surface = as_surface(mesh, f"{name} mesh", closed=name == "insert")
        surfaces.append(surface.mirrored() if is_left else surface)
    return Surfaces(*surfaces)


def placed_insert(
    anatomy: Anatomy, implant: Implant, insert: Surface | None, is_left: bool
) -> tuple[FixedFrame, Surface | None]:
    """Return the insert frame on the tibia, and the insert's surface in that frame."""
    frame = anatomy.insert
    if insert is None or implant.placed:
        return frame, insert
    from tkamb.geometry.flat_bottom import insert_placement

    placement = insert_placement(insert)
    if np.abs(placement - np.eye(4)).max() < FRAME_TOLERANCE:
        return frame, insert
    # A left knee needs the mirror image, because the placement is that of the mirrored mesh.
    mesh_in_insert = mirrored_pose(placement) if is_left else placement
    moved_frame = FixedFrame(frame.joint, frame.placement * se3(inverse(mesh_in_insert)))
    return moved_frame, insert.moved(placement)


def bundle_on_chain(bridge: Bridge, bundle: "Ligament") -> "Ligament":
    """Return a bundle on links of the chain."""
    ends = [bridge.link_point(link_point(end)) for end in (bundle.proximal, bundle.distal)]
    where = f"ligament {bundle.name}"
    slack = real_number(
        bundle.slack_length, f"{where}: slack_length", "give slack_length in metres"
    )
    check_length(slack, "slack_length", where)
    must_be(bundle.wraps, (tuple, list), f"{where}: wraps", "give a list of wrap objects")
    wraps = tuple(bridge.wrap_object(wrap) for wrap in bundle.wraps)
    return replace(bundle, proximal=ends[0], distal=ends[1], wraps=wraps)


def crossing_and_others(
    chain: Chain, bundles: "Sequence[Ligament]"
) -> "tuple[BundleArrays | None, tuple[Ligament, ...]]":
    """Return the bundles between femur and tibia as arrays, and all others.

    The arrays' ends are in the femoral frame and the insert frame.
    """
    crossing = [bundle for bundle in bundles if set(bundle.links) == {"femur", "tibia"}]
    others = tuple(bundle for bundle in bundles if bundle not in crossing)
    if not crossing:
        return None, others
    from tkamb.knee.ligaments import DISTAL, PROXIMAL, BundleArrays

    # The pose of the knee is that of the femoral frame in the insert frame.
    placed = {"femur": (PROXIMAL, np.eye(4)), "tibia": (DISTAL, inverse(chain.insert_in_tibia))}
    return BundleArrays.between([bundle.on_links(placed) for bundle in crossing]), others


def extensor_lines(bridge: Bridge, extensor: Extensor, surfaces: Surfaces) -> "ExtensorLines":
    """Return the lines of an extensor mechanism on the chain."""
    from tkamb.knee.extensor import ExtensorLines, ExtensorParts
    from tkamb.knee.muscles import check_muscles

    assert surfaces.femoral is not None and surfaces.button is not None
    muscle, ligament = extensor.quadriceps, extensor.patellar_ligament
    points = tuple(bridge.link_point(link_point(point)) for point in muscle.points)
    wrap, anatomy = muscle.wrap, bridge.anatomy
    if wrap is not None and wrap.bone is not None:
        bone = as_surface(wrap.bone, "bone mesh")
        to_component = bridge.component.placement.inverse() * anatomy.femur.placement
        pose = to_component.homogeneous
        if bridge.left:
            bone, pose = bone.mirrored(), mirrored_pose(pose)
        wrap = replace(wrap, bone=bone.moved(pose))
    muscle = replace(muscle, points=points, wrap=wrap)
    check_muscles([muscle], bridge.chain)
    ends = [bridge.link_point(link_point(p)) for p in (ligament.proximal, ligament.distal)]
    ligament = replace(ligament, proximal=ends[0], distal=ends[1])
    if anatomy.patella is None:
        check_length(ligament.length, "length", "patellar ligament")
    return ExtensorLines(
        ExtensorParts(
            muscle, ligament, bridge.chain, surfaces.femoral, surfaces.button, surfaces.insert
        )
    )


def prepared_contact(
    contact: "ContactModel | KneeContact | str", implant: Implant, surfaces: Surfaces, cache: bool
) -> "KneeContact":
    """Return a contact model prepared for an implant's surfaces."""
    from tkamb.contact.pair import ContactPair
    from tkamb.knee.contact import KneeContact

    if isinstance(contact, KneeContact):
        return contact
    model = as_model(contact, "contact", cache)
    assert surfaces.femoral is not None and surfaces.insert is not None
    pair = ContactPair(surfaces.femoral, surfaces.insert, implant.insert_material, implant.bearing)
    return _prepared_pair(model, pair)


def prepared_button(
    contact: "ContactModel | str", implant: Implant, surfaces: Surfaces, chain: Chain, cache: bool
) -> "Button":
    """Return a contact model prepared for button and femoral component."""
    from tkamb.contact.pair import ContactPair
    from tkamb.knee.button import Button, button_in_patella, without_pegs

    model = as_model(contact, "patellofemoral_contact", cache)
    assert surfaces.femoral is not None and surfaces.button is not None
    in_patella = button_in_patella(surfaces.button)
    body = without_pegs(surfaces.button.moved(inverse(in_patella)))
    pair = ContactPair(surfaces.femoral, body, implant.button_material)
    # The facets meet in the patella's sagittal plane.
    pair.__dict__["split"] = float(chain.patella_joint_in_femur[2, 3])
    return Button(_prepared_pair(model, pair), in_patella)


def as_model(contact: "ContactModel | str", where: str, cache: bool = True) -> "ContactModel":
    """Return a contact model, perhaps by name; `cache` False: a lattice without one."""
    from tkamb.contact.model import ContactModel
    from tkamb.contact.registry import contact_model

    model = contact_model(contact) if isinstance(contact, str) else contact
    if not isinstance(model, ContactModel):
        raise InputError(
            f"{model!r} is no contact model", where, "give tkamb.contact_model(name) or a name"
        )
    if hasattr(model, "cache") and not cache:
        model = replace(model, cache=False)  # type: ignore[type-var]
    return model


def _prepared_pair(model: "ContactModel", pair: "ContactPair") -> "KneeContact":
    """Return the prepared model, of another knee if that has the same pair."""
    from tkamb.knee.contact import KneeContact

    key = _content(pair, model)
    prepared = None if key is None else _PREPARED.get(key)
    if prepared is None:
        prepared = KneeContact(model, pair, 0.0, model.prepare(pair))
        if key is not None:
            _PREPARED[key] = prepared
    return prepared


_PREPARED: "weakref.WeakValueDictionary[str, KneeContact]" = weakref.WeakValueDictionary()
"""Content of a contact -> the prepared contact, as long as a knee uses it."""


def _content(pair: "ContactPair", model: "ContactModel") -> str | None:
    """Return the SHA-256 of all that a prepared contact depends on; None: the model cannot be
    pickled, its options are unknown.
    """
    parts = (model, pair.material, pair.bearing, pair.__dict__.get("split"), changed_settings())
    try:
        digest = hashlib.sha256(pickle.dumps(parts))
    except (pickle.PicklingError, AttributeError, TypeError):
        return None
    for surface in (pair.femoral, pair.insert):
        digest.update(f"{surface.name}, {surface.vertices.shape}".encode())
        for array in (surface.vertices, surface.faces):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
