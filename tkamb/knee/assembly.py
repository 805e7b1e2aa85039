"""What a `tkamb.Knee` is built from: its parts, brought from the user's model to the chain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, mirrored_pose, transform
from tkamb.geometry.surface import Surface
from tkamb.knee.anatomy import Anatomy, Place
from tkamb.knee.canonical import Bridge, se3
from tkamb.knee.chain import Chain
from tkamb.knee.parts import Extensor, Implant, as_surface, link_point, mirrored_surface

if TYPE_CHECKING:
    from tkamb.contact.model import ContactModel
    from tkamb.knee.contact import KneeContact
    from tkamb.knee.extensor import ExtensorLines
    from tkamb.knee.ligaments import BundleArrays, Ligament


@dataclass(frozen=True)
class AssemblySettings:
    """How parts are put together."""

    frame_tolerance: float = 1e-9
    """m and rad: an insert frame this near to that of its flat bottom is the same frame. Chosen:
    above rounding."""


ASSEMBLY = AssemblySettings()


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The implant's surfaces as those of a right knee; None: not given.

    Args:
        femoral: femoral component, in its own frame.
        insert: insert, in the insert frame.
        button: patellar button, in the patella's frame.
    """

    femoral: Surface | None
    insert: Surface | None
    button: Surface | None


def surfaces_of(
    implant: Implant, is_left: bool, with_contact: bool, with_extensor: bool
) -> Surfaces:
    """Return the surfaces of an implant, its insert where it was given.

    Raises:
        InputError: one that is needed is missing or cannot be used.
    """
    needs = {"femoral": with_contact or with_extensor}
    needs |= {"insert": with_contact, "patella": with_extensor}
    surfaces: list[Surface | None] = []
    for name, needed in needs.items():
        mesh = getattr(implant, name)
        if mesh is None and needed:
            what = "[the contact]" if name == "insert" else "the contact or the extensor"
            raise InputError(f"has no {name} mesh", "Implant", f"{what} needs it")
        if mesh is None:
            surfaces.append(None)
            continue
        surface = as_surface(mesh, f"{name} mesh", closed=name == "insert")
        surfaces.append(mirrored_surface(surface) if is_left else surface)
    return Surfaces(*surfaces)


def placed_insert(
    anatomy: Anatomy, implant: Implant, insert: Surface | None, is_left: bool
) -> tuple[Place, Surface | None]:
    """Return the insert frame on the tibia, and the insert in it."""
    place = anatomy.insert
    if insert is None or implant.placed:
        return place, insert
    from tkamb.geometry.flat_bottom import insert_placement

    placement = insert_placement(insert)
    if np.abs(placement - np.eye(4)).max() < ASSEMBLY.frame_tolerance:
        return place, insert
    mesh_in_insert = mirrored_pose(placement) if is_left else placement
    moved = Place(place.joint, place.placement * se3(inverse(mesh_in_insert)))
    return moved, insert.moved(placement)


def bundle_on_chain(bridge: Bridge, bundle: "Ligament") -> "Ligament":
    """Return a bundle with its ends on links of the chain.

    Raises:
        InputError: no slack length, or an end on a frame that is no part of the knee.
    """
    ends = [bridge.link_point(link_point(end)) for end in (bundle.proximal, bundle.distal)]
    if not bundle.slack_length > 0:
        raise InputError(
            f"slack length {bundle.slack_length} m",
            f"ligament {bundle.name}",
            "give slack_length in metres",
        )
    return replace(bundle, proximal=ends[0], distal=ends[1])


def crossing_and_others(
    chain: Chain, bundles: "Sequence[Ligament]"
) -> "tuple[BundleArrays | None, tuple[Ligament, ...]]":
    """Return the bundles between femur and tibia, and the others.

    The ends of the first are in the femoral and the insert frame.
    """
    crossing = [
        bundle
        for bundle in bundles
        if {bundle.proximal.link, bundle.distal.link} == {"femur", "tibia"}
    ]
    others = tuple(bundle for bundle in bundles if bundle not in crossing)
    if not crossing:
        return None, others
    from tkamb.knee.ligaments import BundleArrays

    shank = inverse(chain.insert_in_tibia)
    ends: dict[str, list[Array]] = {"femur": [], "tibia": []}
    for bundle in crossing:
        for end in (bundle.proximal, bundle.distal):
            at = transform(shank, end.position) if end.link == "tibia" else end.position
            ends[end.link].append(at)
    arrays = BundleArrays.of(crossing, np.array(ends["femur"]), np.array(ends["tibia"]))
    return arrays, others


def extensor_lines(bridge: Bridge, extensor: Extensor, surfaces: Surfaces) -> "ExtensorLines":
    """Return the lines of an extensor mechanism on the chain.

    Raises:
        InputError: a line that does not fit the knee.
    """
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
            bone, pose = mirrored_surface(bone), mirrored_pose(pose)
        wrap = replace(wrap, bone=bone.moved(pose))
    muscle = replace(muscle, points=points, wrap=wrap)
    check_muscles([muscle], bridge.chain)
    ends = [bridge.link_point(link_point(p)) for p in (ligament.proximal, ligament.distal)]
    ligament = replace(ligament, proximal=ends[0], distal=ends[1])
    if anatomy.patella is None and not ligament.length > 0:
        raise InputError(
            "has no length", "patellar ligament", "the place of the patella follows from it"
        )
    return ExtensorLines(
        ExtensorParts(
            muscle, ligament, bridge.chain, surfaces.femoral, surfaces.button, surfaces.insert
        )
    )


def prepared_contact(
    contact: "ContactModel | KneeContact | str", implant: Implant, surfaces: Surfaces, cache: bool
) -> "KneeContact":
    """Return a contact model, prepared for the surfaces of an implant, or as it was given."""
    from tkamb.contact.pair import ContactPair
    from tkamb.contact.registry import contact_model
    from tkamb.knee.contact import KneeContact

    if isinstance(contact, KneeContact):
        return contact
    model = contact_model(contact) if isinstance(contact, str) else contact
    if hasattr(model, "cache") and not cache:
        model = replace(model, cache=False)  # type: ignore[type-var]
    assert surfaces.femoral is not None and surfaces.insert is not None
    pair = ContactPair(surfaces.femoral, surfaces.insert, implant.insert_material, implant.bearing)
    return KneeContact(model, pair, 0.0, model.prepare(pair))
