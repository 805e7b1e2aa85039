"""An .osim file read into an OpenSimModel; OpenSim itself is not needed.

Both layouts are read: that of OpenSim 4 (sockets, offset frames, sets of joints) and the older
one (joints nested in their bodies). What cannot be read and would change the answer is
refused by name; forces and the like that play no part here are listed in `left_out`.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.files import read_xml
from tkamb.geometry.frames import Array
from tkamb.opensim.elements import Document, Element
from tkamb.opensim.functions import Scaled
from tkamb.opensim.model import (
    GROUND,
    Body,
    ConstantDistance,
    Coordinate,
    CoordinateCoupler,
    Marker,
    OpenSimModel,
)
from tkamb.opensim.read_joints import Frames, outwards, read_joints
from tkamb.opensim.read_paths import read_forces, read_wrap_objects

OLDEST_VERSION = 20302
"""Of OpenSim 2.3.2; what is older names things differently."""


def read_osim(path: str | Path) -> OpenSimModel:
    """Return the model in an .osim file.

    Args:
        path: the file.

    Raises:
        InputError: no such file, no OpenSim model, or something in it that cannot be read.
    """
    path = Path(path)
    root = read_xml(path, what="OpenSim model")
    document, model = _opened(root, path)
    bodies = _bodies(document, model)
    frames = Frames.of(document, model, (GROUND, *bodies))
    joints, coordinates = read_joints(document, model, frames)
    wraps = read_wrap_objects(document, model)
    muscles, ligaments, left_out = read_forces(document, model, frames, coordinates, wraps)
    couplers, distances, unread = _constraints(document, model, frames, coordinates)
    for tag in ("ContactGeometrySet", "ControllerSet", "ProbeSet", "ComponentSet"):
        unread += [f"{e.tag} '{e.get('name', '')}'" for e in document.objects(model, tag)]
    return OpenSimModel(
        name=model.get("name", path.stem),
        gravity=document.numbers(model, "gravity", count=3, default="0 -9.80665 0"),
        bodies=bodies,
        joints=outwards(path, joints, bodies),
        coordinates=coordinates,
        couplers=couplers,
        constant_distances=distances,
        markers=_markers(document, model, frames),
        muscles=muscles,
        ligaments=ligaments,
        wrap_objects=wraps,
        offset_frames={
            name: frames.resolve(model, name, owner)
            for owner, name in frames.offsets
            if owner in bodies
        },
        left_out=(*left_out, *unread),
    )


def _opened(root: Element, path: Path) -> tuple[Document, Element]:
    """Return the document and its <Model>, of a version that can be read."""
    model = root.find("Model")
    if root.tag != "OpenSimDocument" or model is None:
        raise InputError(f"is not an OpenSim model: its root is <{root.tag}>", path)
    version = root.get("Version", "")
    if not version.isdigit() or int(version) < OLDEST_VERSION:
        raise InputError(
            f"has Version '{version}', {OLDEST_VERSION} is the oldest that is read",
            path,
            "open and save it in OpenSim",
        )
    for tag, units in (("length_units", ("meters", "m")), ("force_units", ("N", "newtons"))):
        if (found := (model.findtext(tag) or units[0]).strip()) not in units:
            raise InputError(f"has {tag} '{found}', only '{units[0]}' is read", path)
    defaults = root.find("defaults")
    defaults = model.find("defaults") if defaults is None else defaults
    return Document(path, {} if defaults is None else {e.tag: e for e in defaults}), model


def _bodies(document: Document, model: Element) -> dict[str, Body]:
    bodies: dict[str, Body] = {}
    for element in document.objects(model, "BodySet"):
        name = document.name(element)
        if element.tag != "Body":
            raise InputError("is a kind of body that is not read", document.where(element))
        if name in bodies:
            raise InputError("is there twice", document.where(element), "rename one")
        if name != GROUND:
            mass = document.number(element, "mass")
            centre = document.numbers(element, "mass_center", count=3, default="0 0 0")
            if mass < 0.0:
                raise InputError(f"has a mass of {mass:g} kg", document.where(element))
            bodies[name] = Body(name, mass, centre, _inertia(document, element))
    if not bodies:
        raise InputError("has no bodies", document.path)
    return bodies


def _inertia(document: Document, element: Element) -> Array:
    """Return the (3, 3) inertia about the mass centre, from either layout."""
    if document.find(element, "inertia") is not None:
        xx, yy, zz, xy, xz, yz = document.numbers(element, "inertia", count=6)
    else:
        keys = ("xx", "yy", "zz", "xy", "xz", "yz")
        xx, yy, zz, xy, xz, yz = (
            document.number(element, f"inertia_{key}", default=0.0) for key in keys
        )
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _constraints(
    document: Document, model: Element, frames: Frames, coordinates: Mapping[str, Coordinate]
) -> tuple[tuple[CoordinateCoupler, ...], tuple[ConstantDistance, ...], list[str]]:
    couplers, distances, unread = [], [], []
    for element in document.objects(model, "ConstraintSet"):
        enforced = document.flag(element, "isEnforced", True)
        enforced = enforced and not document.flag(element, "isDisabled", False)
        if element.tag == "CoordinateCouplerConstraint" and enforced:
            couplers.append(_coupler(document, element, coordinates))
        elif element.tag == "ConstantDistanceConstraint":
            distances.append(_constant_distance(document, element, frames, enforced))
        elif enforced:
            raise InputError(
                "is a constraint that is not read",
                document.where(element),
                "CoordinateCouplerConstraint and ConstantDistanceConstraint are",
            )
        else:
            unread.append(f"{element.tag} '{element.get('name', '')}' (not enforced)")
    return tuple(couplers), tuple(distances), unread


def _coupler(
    document: Document, element: Element, coordinates: Mapping[str, Coordinate]
) -> CoordinateCoupler:
    independent = document.text(element, "independent_coordinate_names").split()
    dependent = document.text(element, "dependent_coordinate_name")
    for name in (*independent, dependent):
        if name not in coordinates:
            raise InputError(
                f"names a coordinate '{name}' that is not there", document.where(element)
            )
    function = document.held_function(element, "coupled_coordinates_function")
    if len(independent) != 1 or function is None:
        raise InputError("needs one independent coordinate and a function", document.where(element))
    scale = document.number(element, "scale_factor", default=1.0)
    scaled = function if scale == 1.0 else Scaled(function, scale)
    return CoordinateCoupler(element.get("name", ""), dependent, independent[0], scaled)


def _constant_distance(
    document: Document, element: Element, frames: Frames, enforced: bool
) -> ConstantDistance:
    ends = []
    for k in (1, 2):
        socket = document.text(element, f"socket_body_{k}", f"body_{k}")
        location = document.numbers(element, f"location_body_{k}", count=3, default="0 0 0")
        ends.append(frames.point(element, socket, location))
    (body_1, point_1), (body_2, point_2) = ends
    distance = document.number(element, "constant_distance")
    name = element.get("name", "")
    return ConstantDistance(name, (body_1, body_2), (point_1, point_2), distance, enforced)


def _markers(document: Document, model: Element, frames: Frames) -> dict[str, Marker]:
    markers: dict[str, Marker] = {}
    for element in document.objects(model, "MarkerSet"):
        name = document.name(element)
        socket = document.text(element, "socket_parent_frame", "body")
        location = document.numbers(element, "location", count=3)
        if name in markers:
            raise InputError("is there twice", document.where(element), "rename one")
        fixed = document.flag(element, "fixed", False)
        markers[name] = Marker(name, *frames.point(element, socket, location), fixed)
    return markers
