"""Reading of muscles, ligaments, their paths and wrap objects from an OpenSim document."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.opensim.document import Document, Element
from tkamb.io.opensim.model import (
    AnyPathPoint,
    ConditionalPathPoint,
    Coordinate,
    Function,
    MovingPathPoint,
    OpenSimLigament,
    OpenSimMuscle,
    Path,
    PathPoint,
    PathWrap,
)
from tkamb.io.opensim.read_joints import Frames, offset_pose
from tkamb.knee.wrap_object import Shape, WrapObject

MUSCLES = (
    "Thelen2003Muscle",
    "Thelen2003Muscle_Deprecated",
    "Millard2012EquilibriumMuscle",
    "Millard2012AccelerationMuscle",
    "Schutte1993Muscle",
    "Schutte1993Muscle_Deprecated",
    "Delp1990Muscle",
    "Delp1990Muscle_Deprecated",
    "DeGrooteFregly2016Muscle",
    "RigidTendonMuscle",
)
"""Supported classes of muscles. They share the parameters that tkamb reads."""

SHAPES: dict[str, tuple[Shape, tuple[str, ...]]] = {
    "WrapCylinder": ("cylinder", ("radius", "length")),
    "WrapSphere": ("sphere", ("radius",)),
    "WrapEllipsoid": ("ellipsoid", ("dimensions",)),
    "WrapTorus": ("torus", ("outer_radius", "inner_radius")),
}

METHODS = ("hybrid", "midpoint", "axial")


def read_wrap_objects(document: Document, model: Element, frames: Frames) -> dict[str, WrapObject]:
    """Return name -> wrap object; the first of equal names counts, as in OpenSim."""
    result: dict[str, WrapObject] = {}
    ground = [] if (element := model.find("Ground")) is None else [element]
    for body in (*ground, *document.objects(model, "BodySet")):
        for entry in document.objects(body, "WrapObjectSet"):
            with document.reading(entry):
                name, in_body = frames.resolve(entry, document.name(body))
                wrap = _wrap_object(document, entry, name, in_body)
                result.setdefault(wrap.name, wrap)
    return result


def _wrap_object(document: Document, entry: Element, body: str, in_body: Array) -> WrapObject:
    if entry.tag not in SHAPES:
        raise InputError("is a wrap object that is not read", document.where(entry))
    shape, tags = SHAPES[entry.tag]
    if shape == "ellipsoid":
        dimensions = document.numbers(entry, "dimensions", count=3)
    else:
        dimensions = np.array([document.number(entry, tag) for tag in tags])
    if not (dimensions > 0.0).all():
        raise InputError("has a dimension that is not positive", document.where(entry))
    rotation = document.numbers(entry, "xyz_body_rotation", count=3, default="0 0 0")
    translation = document.numbers(entry, "translation", count=3, default="0 0 0")
    return WrapObject(
        document.name(entry),
        body,
        shape,
        in_body @ offset_pose(rotation, translation),
        tuple(float(d) for d in dimensions),
        _quadrant(document, entry),
        document.flag(entry, "active", True),
    )


def _quadrant(document: Document, entry: Element) -> tuple[int, int] | None:
    text = document.text(entry, "quadrant", default="all").lower()
    if text in ("all", "unassigned"):
        return None
    sign, axis = (-1, text[1:]) if text[0] == "-" else (1, text.removeprefix("+"))
    if axis not in ("x", "y", "z"):
        raise InputError(f"<quadrant>{text}</quadrant> is not read", document.where(entry))
    return "xyz".index(axis), sign


def read_forces(
    document: Document,
    model: Element,
    frames: Frames,
    coordinates: Mapping[str, Coordinate],
    wraps: Mapping[str, WrapObject],
) -> tuple[dict[str, OpenSimMuscle], dict[str, OpenSimLigament], list[str]]:
    """Return muscles, ligaments, and "class 'name'" of each force that is left out."""
    muscles: dict[str, OpenSimMuscle] = {}
    ligaments: dict[str, OpenSimLigament] = {}
    left_out = []
    reader = _PathReader(document, frames, coordinates, wraps)
    for element in document.objects(model, "ForceSet"):
        name = element.get("name", "")
        with document.reading(element):
            if element.tag in MUSCLES:
                _check_new(document, element, {*muscles, *ligaments})
                muscles[name] = _muscle(document, element, reader.path(element))
            elif element.tag in ("Ligament", "Blankevoort1991Ligament"):
                _check_new(document, element, {*muscles, *ligaments})
                ligaments[name] = _ligament(document, element, reader.path(element))
            elif "Muscle" in element.tag or "Ligament" in element.tag:
                raise InputError(
                    "is a kind of muscle or ligament that is not read", document.where(element)
                )
            else:
                left_out.append(f"{element.tag} '{name}'")
    return muscles, ligaments, left_out


def _check_new(document: Document, element: Element, names: set[str]) -> None:
    if document.name(element) in names:
        raise InputError("is defined twice", document.where(element), "rename one")


def _enabled(document: Document, element: Element) -> bool:
    applies = document.flag(element, "appliesForce", True)
    return applies and not document.flag(element, "isDisabled", False)


def _muscle(document: Document, element: Element, path: Path) -> OpenSimMuscle:
    number = document.number
    return OpenSimMuscle(
        name=document.name(element),
        kind=element.tag,
        path=path,
        max_isometric_force_N=number(element, "max_isometric_force", default=1000.0),
        optimal_fibre_length_m=number(element, "optimal_fiber_length", default=0.1),
        tendon_slack_length_m=number(element, "tendon_slack_length", default=0.2),
        pennation_rad=number(element, "pennation_angle_at_optimal", "pennation_angle", default=0.0),
        max_contraction_velocity=number(element, "max_contraction_velocity", default=10.0),
        enabled=_enabled(document, element),
    )


def _ligament(document: Document, element: Element, path: Path) -> OpenSimLigament:
    common: dict[str, Any] = {
        "name": document.name(element),
        "kind": element.tag,
        "path": path,
        "enabled": _enabled(document, element),
    }
    if element.tag == "Ligament":
        curve = document.held_function(element, "force_length_curve")
        return OpenSimLigament(
            slack_length_m=document.number(element, "resting_length"),
            stiffness_N=None,
            transition_strain=None,
            damping_s=None,
            force_length=curve,
            scale_N=document.number(element, "pcsa_force", default=1.0),
            **common,
        )
    return OpenSimLigament(
        slack_length_m=document.number(element, "slack_length"),
        stiffness_N=document.number(element, "linear_stiffness"),
        transition_strain=document.number(element, "transition_strain", default=0.06),
        damping_s=document.number(element, "damping_coefficient", default=0.003),
        force_length=None,
        scale_N=None,
        **common,
    )


class _PathReader:
    def __init__(
        self,
        document: Document,
        frames: Frames,
        coordinates: Mapping[str, Coordinate],
        wraps: Mapping[str, WrapObject],
    ) -> None:
        self.document, self.frames = document, frames
        self.coordinates, self.wraps = coordinates, wraps

    def path(self, element: Element) -> Path:
        document = self.document
        geometry = document.find(element, "GeometryPath")
        if geometry is None:
            raise InputError("has no <GeometryPath>", document.where(element))
        entries = list(document.objects(geometry, "PathPointSet"))
        points = tuple(self._point(element, entry) for entry in entries)
        if len(points) < 2:
            raise InputError("has fewer than two path points", document.where(element))
        wraps = []
        for entry in document.objects(geometry, "PathWrapSet"):
            # After a partial reading the path lacks a wrap object that could not be read.
            with document.reading(element):
                wraps.append(self._wrap(element, entry, len(points)))
        return Path(points, tuple(wraps))

    def _point(self, owner: Element, entry: Element) -> AnyPathPoint:
        document, name = self.document, entry.get("name", "")
        socket = document.socket(entry, "parent_frame", "body")
        where = f"{document.where(owner)}: point '{name}'"
        if entry.tag == "MovingPathPoint":
            return self._moving_point(entry, socket, where)
        body, location = self.frames.point(
            entry, socket, document.numbers(entry, "location", count=3)
        )
        if entry.tag == "PathPoint":
            return PathPoint(name, body, location)
        if entry.tag == "ConditionalPathPoint":
            coordinate = self._coordinate(entry, "coordinate", where=where)
            low, high = document.numbers(entry, "range", count=2)
            if coordinate is None:
                raise InputError("names no coordinate", where)
            return ConditionalPathPoint(name, body, location, coordinate, (float(low), float(high)))
        raise InputError(f"{entry.tag} is a kind of path point that is not read", where)

    def _moving_point(self, entry: Element, socket: str, where: str) -> MovingPathPoint:
        body, in_body = self.frames.resolve(entry, socket)
        if not np.array_equal(in_body, np.eye(4)):
            raise InputError("moves in an offset frame, which is not read", where)
        coordinates: list[str | None] = []
        functions: list[Function] = []
        for axis in "xyz":
            function = self.document.held_function(entry, f"{axis}_location")
            if function is None:
                raise InputError(f"has no <{axis}_location>", where)
            coordinates.append(self._coordinate(entry, f"{axis}_coordinate", where=where))
            functions.append(function)
        return MovingPathPoint(entry.get("name", ""), body, tuple(coordinates), tuple(functions))

    def _coordinate(self, entry: Element, name: str, *, where: str) -> str | None:
        socket = self.document.socket(entry, name, name, default=" ").strip()
        name = socket.split("/")[-1]
        if name and name not in self.coordinates:
            raise InputError(f"names a coordinate '{socket}' that does not exist", where)
        return name or None

    def _wrap(self, owner: Element, entry: Element, count: int) -> PathWrap:
        document = self.document
        where = f"{document.where(owner)}: {entry.tag}"
        name = document.text(entry, "wrap_object")
        method = document.text(entry, "method", default="hybrid").lower()
        method = "hybrid" if method == "unassigned" else method
        first, last = document.numbers(entry, "range", count=2, default="-1 -1").astype(int)
        if name not in self.wraps:
            raise InputError(f"names a wrap object '{name}' that does not exist", where)
        if method not in METHODS:
            raise InputError(f"has a method '{method}' that is not read", where)
        # The file counts points from 1; a smaller number means the first or the last point.
        begin = 0 if first < 1 else int(first) - 1
        end = count - 1 if last < 1 else int(last) - 1
        if not begin < end < count:
            raise InputError(f"has a range {first} {last} outside the path's {count} points", where)
        return PathWrap(name, begin, end, method)
