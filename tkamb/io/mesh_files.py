"""Files from a mesh: the lattice of an insert, or one of several bodies in the mesh."""

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import trimesh

from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.lattice.meshing.quality import LatticeQuality, measure_quality, whole_lattice
from tkamb.contact.registry import COARSEST
from tkamb.errors import InputError
from tkamb.files import replaced_file
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.topology import separate_bodies
from tkamb.io.recordings.mesh_check import mended_mesh
from tkamb.io.recordings.meshes import axes_rotation, load_surface
from tkamb.io.vtk import write_lattice
from tkamb.units import MILLIMETRE

BODY_FORMATS = (".stl", ".ply", ".obj")


@dataclass(frozen=True, eq=False)
class LatticeReport:
    """A lattice, its quality and its file.

    Args:
        lattice: the lattice in the insert frame.
        out: path of the .vtu file; None: no file is written.
        side: side of the knee; the lattice of a left insert is mirrored.
    """

    lattice: Lattice
    quality: LatticeQuality
    out: Path | None
    side: str

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        mirrored = "; the left insert's mirror image" if self.side == "left" else ""
        written = [] if self.out is None else [f"written to {self.out}{mirrored}"]
        return [*self.quality.lines(), *written]

    def as_dict(self) -> dict[str, Any]:
        """Return the report for JSON, in SI units and rad."""
        values = asdict(self.quality)
        return {
            **values,
            "volume_error": self.quality.volume_error,
            "out": self.out and str(self.out),
            "mirrored": self.side == "left",
        }


def lattice_of_file(
    insert: str | Path,
    resolution_mm: float,
    units: str = "mm",
    axes: str = "+x,+y,+z",
    side: str = "right",
    out: str | Path | None = None,
) -> LatticeReport:
    """Build the lattice of an insert's mesh, and write it to `out` unless that is None.

    Args:
        resolution_mm: edge length of a cell, mm.
        units: unit of the mesh: "m", "cm", "mm" or "inch".
        axes: axes of the mesh that point anterior, superior and right.
        side: side of the knee; a left insert is mirrored.
        out: path of the .vtu file, in metres and in the insert frame; None: no file is written.

    Raises:
        InputError: file, unit, axes, side or resolution cannot be used, or the mesh is open.
    """
    if out is not None and Path(out).suffix != ".vtu":
        raise InputError(f"'{out}' is not a .vtu file", "out", "give a name like lattice.vtu")
    if not 0 < resolution_mm * MILLIMETRE <= COARSEST:
        hint = f"give more than 0, at most {COARSEST / MILLIMETRE:g} mm"
        raise InputError(f"resolution {resolution_mm} mm", "mesh lattice", hint)
    surface = load_surface(insert, units, axes, name="insert", closed=True)
    if side == "left":
        surface = surface.mirrored()
    elif side != "right":
        raise InputError(f"'{side}' is not a side", "side", "give right or left")
    surface = surface.moved(insert_placement(surface, axes_rotation(axes)))
    lattice = whole_lattice(surface, resolution_mm * MILLIMETRE)
    if out is not None:
        write_lattice(lattice, out)
    return LatticeReport(
        lattice, measure_quality(lattice, surface), None if out is None else Path(out), side
    )


def write_body(path: str | Path, number: int, out: str | Path) -> str:
    """Write one of several bodies in a mesh to a file, in the mesh's unit and axes.

    The mesh is repaired first, as in a run.

    Args:
        number: number of the body in `tkamb mesh check`; body 1 has the largest surface.

    Returns:
        One line on the written body.

    Raises:
        InputError: the mesh cannot be read or has no such body, or `out` exists, has another
            format, or cannot be written.
    """
    out = Path(out)
    if out.suffix.lower() not in BODY_FORMATS:
        hint = f"choose a name that ends in {' or '.join(BODY_FORMATS)}"
        raise InputError("has no format for meshes", out, hint)
    if os.path.exists(out):
        raise InputError(
            "exists already", out, "give a new file: tkamb does not replace your files"
        )
    mended, scale = mended_mesh(path)
    bodies = separate_bodies(mended.vertices, mended.faces)
    if not 1 <= number <= len(bodies):
        raise InputError(
            f"has no body {number}", path, f"it has {len(bodies)}; `tkamb mesh check` lists them"
        )
    faces = mended.faces[bodies[number - 1].faces]
    body = trimesh.Trimesh(mended.vertices / scale, faces, process=False)
    body.remove_unreferenced_vertices()
    with replaced_file(out) as temporary:
        body.export(temporary, file_type=out.suffix.lower()[1:])
    return f"body {number} of {len(bodies)}, {len(faces)} triangles"
