"""Drawings as one compressed block of bytes, for the live window and for HTML files.

Layout before compression by gzip: the length of the header (uint32, little-endian), the header
(JSON, padded to 4 bytes), then the arrays. In the header an array is {"at": byte, "of": element
type, "n": number of elements}. Static objects are a list of meshcat commands in the msgpack form
that meshcat's viewer reads. Moving objects are arrays with one entry per frame.
"""

import gzip
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import umsgpack  # type: ignore[import-untyped]
from fast_simplification import simplify
from meshcat.commands import SetObject, SetTransform
from meshcat.geometry import MeshLambertMaterial, TriangularMeshGeometry, pack_numpy_array
from meshcat.path import Path as NodePath
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.show.levels import pressure_levels
from tkamb.show.view.drawing import (
    HIDDEN_AT_FIRST,
    LAYERS,
    Arrow,
    Colours,
    Drawing,
    Marker,
    PressureMap,
    Solid,
    Strand,
    activation_scale,
    pressure_scale,
    strain_scale,
    wear_colours,
    wear_scale,
)
from tkamb.units import MILLIMETRE

# Largest number of triangles of a drawn surface. A finer surface is decimated. A
# frame of two such surfaces takes less than 100 ms without a graphics card.
MAX_TRIANGLES = 6_000


AGGRESSIVENESS = range(5, 11)
"""Values of the simplifier's aggressiveness, tried in turn until few enough triangles remain."""


@dataclass(frozen=True, eq=False)
class Shaded:
    """A surface with one normal per vertex.

    Args:
        vertices: (n, 3) float32, m.
        normals: (n, 3) float32, unit.
        faces: (k, 3) uint32.
        error: largest distance between the drawn and the true surface, m; 0 if not decimated.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.uint32]
    error: float


@lru_cache(maxsize=16)
def shade(surface: Surface, most_triangles: int = MAX_TRIANGLES) -> Shaded:
    """Return a surface for drawing. A vertex on a sharp edge occurs once per normal."""
    surface, error = decimate(surface, most_triangles)
    normals = surface.corner_normals
    flat = np.repeat(surface.face_normals[:, None], 3, axis=1)
    normals = np.where(np.linalg.norm(normals, axis=-1, keepdims=True) > 0, normals, flat)
    key = np.round(normals.reshape(-1, 3) * 127.0).astype(np.int64)
    corners = np.column_stack([surface.faces.ravel(), key])
    _, first, inverse = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    return Shaded(
        surface.vertices[surface.faces.ravel()[first]].astype(np.float32),
        normals.reshape(-1, 3)[first].astype(np.float32),
        inverse.reshape(-1, 3).astype(np.uint32),
        error,
    )


def decimate(surface: Surface, most_triangles: int) -> tuple[Surface, float]:
    """Return a decimated surface and its largest distance from the given one, m.

    Edges collapse in the order of their quadric error (Garland & Heckbert, Proc SIGGRAPH 97,
    209). The distance is measured from the vertices and triangle centres of each surface to nearby
    points of the other. It may be too large by a tenth of a millimetre.
    """
    if len(surface.faces) <= most_triangles:
        return surface, 0.0
    points, faces = surface.vertices / MILLIMETRE, surface.faces.astype(np.int32)
    for aggressiveness in AGGRESSIVENESS:
        fewer, simplified = simplify(points, faces, target_count=most_triangles, agg=aggressiveness)
        if len(simplified) <= most_triangles:
            break
    result = Surface(fewer.astype(float) * MILLIMETRE, simplified.astype(np.int64), surface.name)
    return result, _distance(result, surface)


def _distance(one: Surface, other: Surface) -> float:
    """Return the largest distance (m) of vertices and triangle centres to the other surface."""
    return max(
        float(to.nearest.at(points).distance.max())
        for of, to in ((one, other), (other, one))
        for points in (of.vertices, of.triangles.mean(axis=1))
    )


# m per body weight: length of a force arrow. Arrows fit beside the knee.
ARROW_METRES_PER_BODY_WEIGHT = 0.03
# Number of levels between zero and the largest pressure. The levels are then
# invisible, and a level fits in 16 bits.
PRESSURE_LEVELS = 32767
# Largest number of triangles of a surface that shows wear. Merged triangles blur
# the colours of wear.
MOST_COLOURED_TRIANGLES = 100_000


WHITE = "#ffffff"
"""Colour of a material whose vertices have their own colours."""

FRONT = 0
"""Code of three.js: only the outer sides of triangles are drawn, which saves half of the work."""

TYPES = {"float32": np.float32, "uint8": np.uint8, "int16": np.int16, "uint32": np.uint32}


class Block:
    """Arrays of a block under construction; see the layout above."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def put(self, values: Any, kind: str) -> dict[str, Any]:
        """Add an array and return its place in the block."""
        array = np.ascontiguousarray(values, TYPES[kind])
        return self._add(array.tobytes(), kind, array.size)

    def put_bytes(self, text: bytes) -> dict[str, Any]:
        """Add bytes and return their place in the block."""
        return self._add(text, "uint8", len(text))

    def _add(self, part: bytes, kind: str, count: int) -> dict[str, Any]:
        span = {"at": self._size, "of": kind, "n": count}
        padded = part + bytes(-len(part) % 4)
        self._parts.append(padded)
        self._size += len(padded)
        return span

    def compress(self, header: dict[str, Any], level: int = 6) -> bytes:
        """Return header and arrays, compressed by gzip at a level from 0 to 9."""
        text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        return gzip.compress(
            struct.pack("<I", len(text)) + text + b"".join(self._parts), level, mtime=0
        )


def pack(drawings: Sequence[Drawing]) -> bytes:
    """Return the block of drawings that are shown side by side, with common colour scales."""
    block = Block()
    peak = peak_pressure(drawings)
    limit = max(one.strain_limit for one in drawings)
    deepest = max(one.deepest_wear for one in drawings)
    return block.compress(
        {
            "layers": list(LAYERS),
            "hidden": list(HIDDEN_AT_FIRST),
            "metres_per_body_weight": ARROW_METRES_PER_BODY_WEIGHT,
            "peak_MPa": peak,
            "strain_limit": limit,
            "activation_limit": max(one.activation_limit for one in drawings),
            "wear_limit_mm": deepest,
            "wear_scale": block.put(wear_scale(), "uint8"),
            "pressure_scale": block.put(pressure_scale(), "uint8"),
            "strain_scale": block.put(strain_scale(), "uint8"),
            "activation_scale": block.put(activation_scale(), "uint8"),
            "views": [_view(block, k, one, peak, deepest) for k, one in enumerate(drawings)],
        }
    )


def peak_pressure(drawings: Sequence[Drawing]) -> float:
    """Return the largest pressure (MPa) of all frames: the top of the common scale."""
    maps = [each for one in drawings for each in (one.map, one.button_map) if each]
    return max((one.peak for one in maps), default=0.0)


def packed_map(
    pressure_map: PressureMap, peak: float, words: str, button: PressureMap | None = None
) -> bytes:
    """Return one pressure map on the scale of an open page, with its legend, and the button's."""
    block = Block()
    maps = {"map": _map(block, pressure_map, peak)}
    if button is not None:
        maps["button_map"] = _map(block, button, peak)
    # Browser and server are on one machine, so speed matters more than size.
    return block.compress(maps | {"words": words}, 1)


def packed_lattice(lines: Array) -> bytes:
    """Return the block of the edges (s, 2, 3) of a lattice, m."""
    block = Block()
    return block.compress({"lattice": block.put(lines, "float32")})


def _view(
    block: Block, number: int, drawing: Drawing, peak: float, deepest: float
) -> dict[str, Any]:
    root = f"/tkamb/{number}"
    commands, moving, notes = [_insert_transform(root, drawing.side)], [], list(drawing.notes)
    for solid in drawing.solids:
        shape = shade(
            solid.surface,
            MAX_TRIANGLES if solid.wear is None else MOST_COLOURED_TRIANGLES,
        )
        if shape.error:
            notes.append(
                f"{solid.name.capitalize()}: drawn with {len(shape.faces)} of "
                f"{len(solid.surface.faces)} triangles, at most {shape.error / MILLIMETRE:.2f} mm "
                "from the true surface."
            )
        path = _node_name(root, solid.layer, solid.name)
        commands += _commands(path, solid, shape, deepest)
        if len(solid.poses) > 1:
            poses = block.put(np.swapaxes(solid.poses, 1, 2), "float32")
            moving.append({"path": path, "poses": poses})
    button, path = drawing.button_map, _node_name(root, "pressure map", "button")
    if button is not None and button.poses is not None:
        poses = block.put(np.swapaxes(button.poses, 1, 2), "float32")
        moving.append({"path": path, "poses": poses})
    return {
        "title": drawing.title,
        "side": drawing.side,
        "body_weight": drawing.body_weight,
        "contact": drawing.contact,
        "labels": drawing.labels,
        "statuses": drawing.statuses,
        "readings": [{"name": row.name, "values": row.values} for row in drawing.readings],
        "notes": notes,
        "times": [float(time) for time in drawing.times],
        "commands": [block.put_bytes(umsgpack.packb(one.lower())) for one in commands],
        "moving": moving,
        "strands": [_strand(block, root, one) for one in drawing.strands],
        "arrows": [_arrow(block, root, one) for one in drawing.arrows],
        "markers": [_marker(block, root, one) for one in drawing.markers],
        "map": _map(block, drawing.map, peak) if drawing.map else None,
        "button_map": _map(block, button, peak) if button else None,
        "lattice": block.put(drawing.lattice, "float32") if len(drawing.lattice) else None,
    }


def _strand(block: Block, root: str, strand: Strand) -> dict[str, Any]:
    return {
        "path": _node_name(root, strand.layer, strand.name),
        "frames": len(strand.points),
        "count": strand.points.shape[1],
        "points": block.put(strand.points, "float32"),
        "colours": block.put(strand.colours, "uint8"),
        "radius": strand.radius,
    }


def _arrow(block: Block, root: str, arrow: Arrow) -> dict[str, Any]:
    return {
        "path": _node_name(root, "forces", arrow.name),
        "name": arrow.name,
        "meaning": arrow.meaning,
        "colour": arrow.colour,
        "ends_there": arrow.ends_there,
        "points": block.put(arrow.points, "float32"),
        "forces": block.put(arrow.forces, "float32"),
    }


def _marker(block: Block, root: str, marker: Marker) -> dict[str, Any]:
    return {
        "path": _node_name(root, marker.layer, marker.name),
        "colour": marker.colour,
        "radius": marker.radius,
        "points": block.put(marker.points, "float32"),
    }


def _map(block: Block, pressure_map: PressureMap, peak: float) -> dict[str, Any]:
    return {
        "count": len(pressure_map.points),
        "points": block.put(pressure_map.points, "float32"),
        "triangles": block.put(pressure_map.triangles, "uint32"),
        "levels": block.put(map_levels(pressure_map, peak), "int16"),
    }


def map_levels(pressure_map: PressureMap, peak: float) -> NDArray[np.int16]:
    """Return the pressure level (f, n) of each point as an integer, at least 1 if loaded.

    Args:
        pressure_map: pressure map of all frames.
        peak: upper end of the colour scale, MPa. A higher pressure has the highest level.
    """
    level = pressure_levels(pressure_map.pressure, pressure_map.gap, pressure_map.triangles, peak)
    whole = np.maximum(np.round(np.abs(level) * PRESSURE_LEVELS), 1.0)
    return np.where(level > 0, whole, -whole).astype(np.int16)


def _insert_transform(root: str, side: str) -> SetTransform:
    """Return the command for the pose of the insert frame in meshcat, whose z is up.

    It mirrors a left knee.
    """
    turn = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    if side == "left":
        turn = turn @ np.diag([1.0, 1.0, -1.0, 1.0])
    return SetTransform(turn, _node(root))


def _commands(path: str, solid: Solid, shape: Shaded, deepest: float) -> list[Any]:
    """Return the commands that add a solid. Wear colours it on a scale from 0 to `deepest` mm."""
    colours, colour = None, solid.colour
    if solid.wear is not None:
        nearest = cKDTree(solid.surface.vertices).query(shape.vertices)[1]
        colours, colour = wear_colours(solid.wear[nearest], deepest), WHITE
    material = MeshLambertMaterial(
        color=int(colour.removeprefix("#"), 16),
        opacity=solid.opacity,
        side=FRONT,
        vertexColors=colours is not None,
    )
    commands = [SetObject(_Mesh(shape, colours), material, _node(path))]
    if len(solid.poses) == 1:
        commands.append(SetTransform(solid.poses[0], _node(path)))
    return commands


def _node_name(root: str, layer: str, name: str) -> str:
    """Return a path in the scene tree. Slashes in the name would divide it and are replaced."""
    return f"{root}/{layer}/{name.replace('/', '-')}"


def _node(path: str) -> NodePath:
    return NodePath(tuple(part for part in path.split("/") if part))


class _Mesh(TriangularMeshGeometry):
    def __init__(self, shape: Shaded, colours: Colours | None) -> None:
        share = None if colours is None else colours / np.float32(255.0)
        super().__init__(shape.vertices, shape.faces, share)
        self._normals = shape.normals

    def lower(self, object_data: Any) -> Any:
        lowered = super().lower(object_data)
        lowered["data"]["attributes"]["normal"] = pack_numpy_array(self._normals.T)
        return lowered
