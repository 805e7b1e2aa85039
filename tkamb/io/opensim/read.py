"""Reading of an .osim file into an `OpenSimModel`, without OpenSim.

tkamb reads the layout of OpenSim 4 (sockets, offset frames, sets of joints), the older layout
(joints nested in their bodies), and sets in separate files. An element that cannot be read is an
error, or in a partial reading listed in `unread`. Elements that tkamb does not model, such as
contact forces, are in `left_out`.
"""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.opensim.document import Document, Element, open_document
from tkamb.io.opensim.model import (
    GROUND,
    Body,
    ConstantDistance,
    Coordinate,
    CoordinateCoupler,
    Joint,
    Marker,
    OpenSimModel,
    Scaled,
    Unread,
)
from tkamb.io.opensim.read_joints import Frames, outwards, read_joints
from tkamb.io.opensim.read_paths import read_forces, read_wrap_objects
from tkamb.units import STANDARD_GRAVITY

UNITS = {
    "length_units": ("meters", "meter", "metres", "metre", "m"),
    "force_units": ("n", "newton", "newtons"),
}
"""Tag of a unit -> accepted spellings of metre and newton."""
NO_UNIT = ("unassigned", "unknown")
"""Words for a unit that OpenSim writes when it does not know the unit. OpenSim then computes in
metres and newtons, as always."""


# Oldest version of a file that is read, from OpenSim 2.3.2. Older files use other names.
OLDEST_VERSION = 20302
# kg: a lighter body has no inertia, as in OpenSim's Body::getInertia.
MASSLESS_BELOW = 2e-14
# 1: a notice names gravity that differs from standard gravity by more than this share. It differs
# by 0.45 % at most between places at sea level.
GRAVITY_SHARE = 0.01
# rad: largest angle between gravity and an axis of ground that counts as rounding. It turns 0.01 %
# of the weight aside.
ALIGNED = 1e-4
# m: largest distance between joints on one body, in a file without a unit of length.
# No segment of a person is as long.
LONGEST = 3.0


def read_osim(path: str | Path, partial: bool = False) -> OpenSimModel:
    """Return the model in an .osim file.

    Args:
        partial: whether joints, constraints, forces, wrap objects and markers that cannot be read
            are listed in `unread`; otherwise they are errors. A joint is welded if only its motion
            cannot be read.

    Raises:
        InputError: the file does not exist, is not an OpenSim model, or has an element that cannot
            be read.
    """
    path = Path(path)
    root, notices = open_document(path)
    document, model = _opened(root, path, partial, notices)
    bodies = _bodies(document, model)
    gravity = document.numbers(model, "gravity", count=3, default="0 -9.80665 0")
    upright, ground_axes = _upright(gravity, notices)
    frames = Frames.of(document, model, (GROUND, *bodies), upright)
    joints, coordinates = read_joints(document, model, frames)
    _check_metres(document, model, joints)
    wraps = read_wrap_objects(document, model, frames)
    muscles, ligaments, left_out = read_forces(document, model, frames, coordinates, wraps)
    couplers, distances, not_enforced = _constraints(document, model, frames, coordinates)
    left_out = [*left_out, *not_enforced]
    for tag in ("ContactGeometrySet", "ControllerSet", "ProbeSet", "ComponentSet"):
        left_out += [f"{e.tag} '{e.get('name', '')}'" for e in document.objects(model, tag)]
    ordered = outwards(document, joints, bodies)
    markers = _markers(document, model, frames)
    return OpenSimModel(
        name=model.get("name", path.stem),
        gravity=upright @ gravity,
        bodies=bodies,
        joints=ordered,
        coordinates=coordinates,
        couplers=couplers,
        constant_distances=distances,
        markers=markers,
        muscles=muscles,
        ligaments=ligaments,
        wrap_objects=wraps,
        offset_frames={
            name: frames.resolve(model, name, owner)
            for owner, name in frames.offsets
            if owner in bodies
        },
        left_out=tuple(left_out),
        unread=tuple(
            Unread(e.tag, e.get("name", ""), reason, _concerns(e, frames, coordinates))
            for e, reason in document.unread
        ),
        notices=tuple(notices),
        ground_axes=ground_axes,
    )


def _upright(gravity: Array, notices: list[str]) -> tuple[Array, str | None]:
    """Return the rotation (3, 3) of the file's ground to one whose y points up, and its axes.

    It is the smallest such rotation. The axes are those of `OpenSimModel.ground_axes`. `notices`
    gets a line if gravity is not that of a ground with y up.
    """
    size = float(np.linalg.norm(gravity))
    if size == 0.0:
        notices.append("its gravity is zero: y of ground is taken to point up")
        return np.eye(3), "+x,+y,+z"
    if abs(size / STANDARD_GRAVITY - 1.0) > GRAVITY_SHARE:
        notices.append(f"its gravity is {size:.4g} m/s²; loads of a knee use {STANDARD_GRAVITY:g}")
    up = -gravity / size
    axis = int(np.argmax(np.abs(up)))
    nearest = np.sign(up[axis]) * np.eye(3)[axis]
    is_aligned = np.linalg.norm(up - nearest) <= ALIGNED
    turn = np.round(_least_turn(nearest)) if is_aligned else _least_turn(up)
    words = " ".join(f"{value:g}" for value in gravity)
    if not is_aligned:
        notices.append(f"its gravity is {words}: ground is turned so that it points down along y")
        return turn, None
    rows = [(int(np.argmax(np.abs(row))), row.sum()) for row in turn]
    axes = ",".join(f"{'+' if sign > 0 else '-'}{'xyz'[k]}" for k, sign in rows)
    if axis != 1 or up[1] < 0.0:
        notices.append(f"its gravity is {words}: forward, up, right are its ground's {axes}")
    return turn, axes


def _least_turn(up: Array) -> Array:
    """Return the smallest rotation (3, 3) that turns a unit vector (3,) to y."""
    axis = np.cross(up, [0.0, 1.0, 0.0])
    sine = float(np.linalg.norm(axis))
    if sine == 0.0:
        return np.eye(3) if up[1] > 0.0 else np.diag([1.0, -1.0, -1.0])  # half a turn about x
    return np.asarray(Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[1])).as_matrix())


def _check_metres(document: Document, model: Element, joints: list[Joint]) -> None:
    word = (model.findtext("length_units") or "").strip()
    if word.lower() not in NO_UNIT:
        return
    ends = [(j.parent, j.pose_parent_frame) for j in joints]
    ends += [(j.child, j.pose_child_frame) for j in joints]
    far = max((float(np.linalg.norm(p[:3, 3])) for body, p in ends if body != GROUND), default=0.0)
    if far > LONGEST:
        raise InputError(
            f"has length_units '{word}', and a joint {far:.4g} from the origin of its body, "
            "which is no length in metres",
            document.path,
            "scale the model to metres in OpenSim",
        )


def _concerns(
    element: Element, frames: Frames, coordinates: Mapping[str, Coordinate]
) -> frozenset[str]:
    """Return the bodies and coordinates in an element."""
    texts = [part for e in element.iter() for part in ((e.text or ""), e.get("name", ""))]
    words = {word for text in texts for word in text.replace("/", " ").split()}
    named = {word for word in words if word in frames.bodies or word in coordinates}
    user = element.get("name", "")
    for owner, name in frames.offsets:
        if name in words and (owner == user or (user, name) not in frames.offsets):
            with suppress(InputError):
                named.add(frames.resolve(element, name, owner)[0])
    return frozenset(named - {GROUND})


def _opened(
    root: Element, path: Path, partial: bool, notices: list[str]
) -> tuple[Document, Element]:
    """Return the document and its <Model>. `notices` gets a line for each unit without a name."""
    model = root.find("Model")
    if root.tag != "OpenSimDocument" or model is None:
        raise InputError(
            f"is not an OpenSim model: its root is <{root.tag}>", path, "give an .osim file"
        )
    version = root.get("Version", "")
    if not version.isdigit() or int(version) < OLDEST_VERSION:
        raise InputError(
            f"has Version '{version}'; the oldest that is read is {OLDEST_VERSION} (OpenSim 2.3.2)",
            path,
            "open it in OpenSim 3.3 or 4 and save it",
        )
    for tag, units in UNITS.items():
        result = (model.findtext(tag) or units[0]).strip()
        if result.lower() in NO_UNIT:
            notices.append(f"its {tag} is '{result}': {units[0]}, as in OpenSim")
        elif result.lower() not in (*units, ""):
            hint = "scale the model to metres and newtons in OpenSim"
            raise InputError(f"has {tag} '{result}', only '{units[0]}' is read", path, hint)
    defaults = root.find("defaults")
    defaults = model.find("defaults") if defaults is None else defaults
    by_class = {} if defaults is None else {e.tag: e for e in defaults}
    return Document(path, by_class, partial), model


def _bodies(document: Document, model: Element) -> dict[str, Body]:
    bodies: dict[str, Body] = {}
    for element in document.objects(model, "BodySet"):
        name = document.name(element)
        if element.tag != "Body":
            raise InputError("is a kind of body that is not read", document.where(element))
        if name in bodies:
            raise InputError("is defined twice", document.where(element), "rename one")
        if name != GROUND:
            mass = document.number(element, "mass")
            centre = document.numbers(element, "mass_center", count=3, default="0 0 0")
            if mass < 0.0:
                raise InputError(f"has a mass of {mass:g} kg", document.where(element))
            inertia = _inertia(document, element) if mass > MASSLESS_BELOW else np.zeros((3, 3))
            bodies[name] = Body(name, mass, centre, inertia)
    if not bodies:
        raise InputError("has no bodies", document.path)
    return bodies


def _inertia(document: Document, element: Element) -> Array:
    """Return (3, 3), kg·m², about the centre of mass, from an old or new file."""
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
    couplers: list[CoordinateCoupler] = []
    distances: list[ConstantDistance] = []
    not_enforced = []
    for element in document.objects(model, "ConstraintSet"):
        with document.reading(element):
            enforced = document.flag(element, "isEnforced", True)
            enforced = enforced and not document.flag(element, "isDisabled", False)
            if element.tag == "ConstantDistanceConstraint":
                distances.append(_constant_distance(document, element, frames, enforced))
            elif not enforced:
                not_enforced.append(f"{element.tag} '{element.get('name', '')}' (not enforced)")
            elif element.tag == "CoordinateCouplerConstraint":
                coupler = _coupler(document, element, coordinates)
                _check_follower(document, element, coupler, couplers)
                couplers.append(coupler)
            else:
                raise InputError(
                    "is a constraint that is not read",
                    document.where(element),
                    "tkamb reads CoordinateCouplerConstraint and ConstantDistanceConstraint",
                )
    return _followers_last(couplers), tuple(distances), not_enforced


def _check_follower(
    document: Document, element: Element, new: CoordinateCoupler, others: list[CoordinateCoupler]
) -> None:
    leads = {coupler.dependent: coupler.independent for coupler in others}
    if new.dependent in leads:
        raise InputError(
            f"makes '{new.dependent}' depend on a second coordinate", document.where(element)
        )
    lead: str | None = new.independent
    while lead is not None and lead != new.dependent:
        lead = leads.get(lead)
    if lead is not None:
        raise InputError(f"makes '{new.dependent}' depend on itself", document.where(element))


def _followers_last(couplers: list[CoordinateCoupler]) -> tuple[CoordinateCoupler, ...]:
    ordered: list[CoordinateCoupler] = []
    remaining = list(couplers)
    while remaining:
        unset = {coupler.dependent for coupler in remaining}
        ready = [c for c in remaining if c.independent not in unset]
        ordered += ready
        remaining = [c for c in remaining if c not in ready]
    return tuple(ordered)


def _coupler(
    document: Document, element: Element, coordinates: Mapping[str, Coordinate]
) -> CoordinateCoupler:
    independent = document.text(element, "independent_coordinate_names").split()
    dependent = document.text(element, "dependent_coordinate_name")
    for name in (*independent, dependent):
        if name not in coordinates:
            raise InputError(
                f"names a coordinate '{name}' that does not exist", document.where(element)
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
        socket = document.socket(element, f"body_{k}", f"body_{k}")
        location = document.numbers(element, f"location_body_{k}", count=3, default="0 0 0")
        ends.append(frames.point(element, socket, location))
    (body_1, point_1), (body_2, point_2) = ends
    distance = document.number(element, "constant_distance")
    name = element.get("name", "")
    return ConstantDistance(name, (body_1, body_2), (point_1, point_2), distance, enforced)


def _markers(document: Document, model: Element, frames: Frames) -> dict[str, Marker]:
    markers: dict[str, Marker] = {}
    for element in document.objects(model, "MarkerSet"):
        with document.reading(element):
            name = document.name(element)
            socket = document.socket(element, "parent_frame", "body")
            location = document.numbers(element, "location", count=3)
            fixed = document.flag(element, "fixed", False)
            marker = Marker(name, *frames.point(element, socket, location), fixed)
            other = markers.pop(name, None)
            if other is not None and not _same_place(marker, other):
                raise InputError("is defined twice", document.where(element), "rename one")
            markers[name] = marker
    return markers


def _same_place(marker: Marker, other: Marker) -> bool:
    same_location = np.allclose(marker.location, other.location, atol=1e-9, rtol=0)
    return marker.body == other.body and same_location
