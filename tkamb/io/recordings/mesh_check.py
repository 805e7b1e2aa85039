"""Check of a mesh file: content, repairs on loading, and guesses of unit and axes."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.geometry.defects import mesh_words
from tkamb.geometry.flat_bottom import facing, find_flats
from tkamb.geometry.frames import Array
from tkamb.geometry.repair import Repair, connected_parts, repair
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import BoundaryLoop, boundary_loops, separate_bodies
from tkamb.io.recordings.meshes import (
    BONE_SIZE,
    SHEET_OPENING,
    Indices,
    plausible_units,
    read_triangles,
)
from tkamb.units import LENGTH

# m: assumed length of a mesh whose unit cannot be guessed. A knee component has
# this length.
TYPICAL_SIZE = 0.08
# 1: smallest area of a flat side in the report, as a share of the mesh's area. The
# bottom of an insert is larger.
MIN_SIZE_SHARE = 0.12
# Largest number of bodies in the report. A report should be short.
MAX_LISTED = 10


@dataclass(frozen=True)
class Hole:
    """A loop of open edges: number of edges; width and centre in file units."""

    edges: int
    width: float
    centre: tuple[float, ...]


@dataclass(frozen=True)
class FlatSide:
    """A large flat side: the mesh axis that it faces (like "-y"), share of the area, and tilt."""

    faces: str
    area_share: float
    tilt_deg: float


@dataclass(frozen=True)
class Part:
    """A separate body: number of triangles; extents and centre in file units; whether closed."""

    triangles: int
    extents: tuple[float, ...]
    centre: tuple[float, ...]
    closed: bool

    def line(self) -> str:
        """Return size and centre, in file units."""
        size = " × ".join(f"{extent:.4g}" for extent in self.extents)
        where = ", ".join(f"{value:.4g}" for value in self.centre)
        state = "closed" if self.closed else "open"
        return f"{self.triangles} triangles, {size} at ({where}), {state}"


@dataclass(frozen=True)
class MeshHealth:
    """Content of a mesh file, lengths in its units.

    Args:
        extents: lengths along the mesh's x, y and z.
        bodies: the separate bodies after repair of small defects, with the largest surface
            first; a void belongs to the body around it.
        holes: loops of open edges in the file, widest first.
        remaining_holes: holes that loading would not close.
        forks: number of vertices on edges at which three or more sheets meet.
        one_sided: whether no winding of the triangles is consistent.
        units: plausible units: those in which the mesh has the size of a part of a knee.
        flats: the largest flat sides. The first is probably the bottom of an insert.
        roughness: spikes, noise and steps of the mesh in words, lengths in mm if the first of
            `units` is the file's unit.
    """

    file: str
    triangles: int
    vertices: int
    extents: tuple[float, ...]
    components: int
    bodies: tuple[Part, ...]
    watertight: bool
    closed_after_repair: bool
    repairs: tuple[str, ...]
    holes: tuple[Hole, ...]
    remaining_holes: tuple[Hole, ...]
    forks: int
    one_sided: bool
    units: tuple[str, ...]
    flats: tuple[FlatSide, ...]
    roughness: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return all fields as plain data."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the report, with guesses as questions."""
        size = " × ".join(f"{extent:.4g}" for extent in self.extents)
        return [
            f"{self.file}",
            f"  {self.triangles} triangles, {self.vertices} vertices, "
            f"{_count_noun(self.components, 'component')}",
            *self._parts(),
            f"  {self._closedness()}",
            *(f"  would be repaired when loaded: {phrase}" for phrase in self.repairs),
            *self._defects(),
            f"  extents {size} in file units: {self._unit_question()}",
            *self._axis_questions(),
        ]

    def _parts(self) -> list[str]:
        if len(self.bodies) < 2:
            return []
        unlisted = len(self.bodies) - MAX_LISTED
        return [
            f"  {len(self.bodies)} separate bodies; `tkamb mesh part FILE N --out F` writes one:",
            *(f"    {n}: {b.line()}" for n, b in enumerate(self.bodies[:MAX_LISTED], start=1)),
            *([f"    and {unlisted} smaller"] if unlisted > 0 else []),
        ]

    def _extent(self, axis: str) -> float:
        return self.extents["xyz".index(axis)]

    def _closedness(self) -> str:
        if self.watertight:
            return "watertight"
        after = "closed after repair" if self.closed_after_repair else "not closed after repair"
        return f"not watertight ({_count_noun(len(self.holes), 'hole')}); {after}"

    def _defects(self) -> list[str]:
        lines = []
        for hole in self.remaining_holes[:5]:
            where = ", ".join(f"{value:.4g}" for value in hole.centre)
            lines.append(f"  open: {hole.edges} edges, {hole.width:.3g} wide, at ({where})")
        if self.remaining_holes and self.remaining_holes[0].width > SHEET_OPENING * max(
            self.extents
        ):
            lines.append(
                "  an open sheet, which a run refuses as a part: give the whole closed part"
            )
        if len(self.remaining_holes) > 5:
            lines.append(f"  open: {len(self.remaining_holes) - 5} more")
        if self.forks:
            lines.append(f"  not a surface: three or more sheets meet at {self.forks} vertices")
        if self.one_sided:
            lines.append("  not a surface: it has only one side")
        return [
            *lines,
            *(f"  a contact there cannot be relied on: {one}" for one in self.roughness),
        ]

    def _unit_question(self) -> str:
        if not self.units:
            return f"not the size of a part of a knee in any of {', '.join(LENGTH)}"
        names = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "inch": "inches"}
        return " or ".join(f"{names[unit]}? then pass --units {unit}" for unit in self.units)

    def _axis_questions(self) -> list[str]:
        if not self.flats:
            return ["  no large flat side: no insert, or one without a flat bottom"]
        flat = self.flats[0]
        tilt = "" if flat.tilt_deg < 0.05 else f", tilted by {flat.tilt_deg:.1f} deg"
        up = f"{'-' if flat.faces[0] == '+' else '+'}{flat.faces[1]}"
        across = max((axis for axis in "xyz" if axis != flat.faces[1]), key=self._extent)
        along = next(axis for axis in "xyz" if axis not in (flat.faces[1], across))
        lines = [
            f"  largest flat side faces {flat.faces} ({100 * flat.area_share:.0f} % of the "
            f"area{tilt}). If this is an insert: its bottom? then superior is {up}, the longer "
            f"side {across} is right or left, {along} anterior or posterior: "
            f"--axes ±{along},{up},±{across}"
        ]
        others = ", ".join(flat.faces for flat in self.flats[1:])
        return [*lines, f"  flat sides of comparable area face {others}"] if others else lines


def check_mesh(path: str | Path) -> MeshHealth:
    """Return content and defects of a mesh file, and guesses of unit and axes."""
    vertices, faces = read_triangles(path)
    extents, units, scale = _measure(vertices, faces)
    mended = repair(vertices * scale, faces)
    merged, corners, watertight = _unrepaired(vertices, faces)
    return MeshHealth(
        file=str(path),
        triangles=len(faces),
        vertices=len(merged),
        extents=tuple(float(extent) for extent in extents),
        components=int(connected_parts(corners).max()) + 1,
        bodies=_bodies(mended, scale),
        watertight=watertight,
        closed_after_repair=len(mended.faces) > 0
        and not (mended.holes or len(mended.forks) or mended.one_sided),
        repairs=mended.notices,
        holes=tuple(_hole(loop, 1.0) for loop in boundary_loops(merged, corners)),
        remaining_holes=tuple(_hole(loop, scale) for loop in mended.holes),
        forks=len(mended.forks),
        one_sided=mended.one_sided,
        units=tuple(units),
        flats=_flats(mended, str(path)),
        roughness=_roughness(mended, units),
    )


def _roughness(mended: Repair, units: list[str]) -> tuple[str, ...]:
    if not units or not len(mended.faces):
        return ()
    words = mesh_words(Surface(mended.vertices, mended.faces, merged=True))
    return tuple(one for one in words if "opening" not in one)


def mended_mesh(path: str | Path) -> tuple[Repair, float]:
    """Return the repaired mesh, m, and the guessed metres per unit."""
    vertices, faces = read_triangles(path)
    scale = _measure(vertices, faces)[2]
    return repair(vertices * scale, faces), scale


def _measure(vertices: Array, faces: Indices) -> tuple[Array, list[str], float]:
    extents = np.ptp(vertices[faces.reshape(-1)], axis=0)
    longest = float(extents.max())
    units = plausible_units(longest) or plausible_units(longest, BONE_SIZE)
    return extents, units, LENGTH[units[0]] if units else TYPICAL_SIZE / (longest or 1.0)


def _bodies(mended: Repair, scale: float) -> tuple[Part, ...]:
    return tuple(
        Part(
            len(body.faces),
            tuple(float(extent) for extent in body.extents / scale),
            tuple(float(value) for value in body.centre / scale),
            body.closed,
        )
        for body in separate_bodies(mended.vertices, mended.faces)
    )


def _unrepaired(vertices: Array, faces: Indices) -> tuple[Array, Indices, bool]:
    merged = Surface(vertices, faces).mesh.copy()
    merged.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=12)
    closed = bool(merged.is_watertight and merged.is_winding_consistent)
    return np.asarray(merged.vertices), np.asarray(merged.faces, np.int64), closed


def _hole(loop: BoundaryLoop, scale: float) -> Hole:
    centre = tuple(float(value) for value in loop.centre / scale)
    return Hole(len(loop.vertices), loop.width / scale, centre)


def _flats(mended: Repair, name: str) -> tuple[FlatSide, ...]:
    surface = Surface(mended.vertices, mended.faces, name)
    total = float(surface.mesh.area)
    sides = []
    for flat in find_flats(surface):
        tilt = np.degrees(np.arccos(min(np.abs(flat.normal).max(), 1.0)))
        sides.append(FlatSide(facing(flat.normal), flat.area / total, float(tilt)))
    return tuple(side for side in sides if side.area_share > MIN_SIZE_SHARE and side.tilt_deg < 30)


def _count_noun(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
