"""Files from meshes: VTK XML for ParaView, the lattice of an insert, one of several bodies.

Arrays are in base64, little-endian and uncompressed, after their length in bytes (UInt64), and
coordinates in metres.
"""

import base64
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Comment, Element, ElementTree, SubElement, indent

import numpy as np
import trimesh
from numpy.typing import NDArray

from tkamb.contact.lattice.meshing.cells import scaled_jacobians
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.lattice.meshing.quality import LatticeQuality, measure_quality, whole_lattice
from tkamb.contact.registry import COARSEST
from tkamb.errors import InputError
from tkamb.files import replaced_file
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import Array
from tkamb.geometry.topology import separate_bodies
from tkamb.io.recordings.mesh_check import mended_mesh
from tkamb.io.recordings.meshes import axes_rotation, load_surface
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.run.maps import ContactMaps


HEXAHEDRON = 12
"""VTK's number for a cell of eight nodes."""
TYPES = {"f8": "Float64", "i8": "Int64", "u1": "UInt8", "i1": "Int8"}


def write_lattice(lattice: Lattice, path: str | Path) -> None:
    """Write the cells of a lattice, its node classes and scaled Jacobians as .vtu, in metres."""
    write_hexahedra(
        path,
        lattice.nodes,
        lattice.cells,
        {"node_class": lattice.node_class},
        {"scaled_jacobian": scaled_jacobians(lattice.nodes[lattice.cells])},
    )


def write_hexahedra(
    path: str | Path,
    points: Array,
    cells: NDArray[np.int64],
    point_data: Mapping[str, NDArray],
    cell_data: Mapping[str, NDArray],
) -> None:
    """Write cells (c, 8) over points (n, 3) m as an unstructured grid (.vtu)."""
    root, piece = _document("UnstructuredGrid", points, NumberOfCells=len(cells))
    block = SubElement(piece, "Cells")
    _append(block, "connectivity", cells.ravel().astype("<i8"))
    _append(block, "offsets", (8 * np.arange(1, len(cells) + 1)).astype("<i8"))
    _append(block, "types", np.full(len(cells), HEXAHEDRON, "u1"))
    _append_data(piece, point_data, cell_data)
    _write(root, path)


def write_triangles(
    path: str | Path,
    points: Array,
    triangles: NDArray[np.int64],
    point_data: Mapping[str, NDArray],
) -> None:
    """Write triangles (k, 3) over points (n, 3) m as poly data (.vtp), e.g. a pressure map."""
    root, piece = _document("PolyData", points, NumberOfPolys=len(triangles))
    block = SubElement(piece, "Polys")
    _append(block, "connectivity", triangles.ravel().astype("<i8"))
    _append(block, "offsets", (3 * np.arange(1, len(triangles) + 1)).astype("<i8"))
    _append_data(piece, point_data, {})
    _write(root, path)


def write_map_series(maps: "ContactMaps", folder: Path, stem: str = "contact") -> list[str]:
    """Write the maps of a run for ParaView: a .vtp for each frame, and a .pvd with all times.

    A failed frame has no map and no file.

    Returns:
        The names of the files, the .pvd first.
    """
    mapped_frames = np.flatnonzero(np.isfinite(maps.peaks_Pa))
    if not len(mapped_frames):
        raise InputError("no frame has a pressure map", "export --vtp")
    root = Element("VTKFile", type="Collection", version="1.0", byte_order="LittleEndian")
    collection, names = SubElement(root, "Collection"), []
    for k in map(int, mapped_frames):
        names.append(f"{stem}_{k:04d}.vtp")
        write_triangles(folder / names[-1], maps.points_m, maps.triangles, maps.frame_data(k))
        SubElement(collection, "DataSet", timestep=repr(float(maps.time_s[k])), file=names[-1])
    series = f"{stem}.pvd"
    _write(root, folder / series)
    return [series, *names]


def _document(kind: str, points: Array, **counts: int) -> tuple[Element, Element]:
    root = Element(
        "VTKFile", type=kind, version="1.0", byte_order="LittleEndian", header_type="UInt64"
    )
    piece = SubElement(SubElement(root, kind), "Piece", NumberOfPoints=str(len(points)))
    piece.attrib.update({name: str(count) for name, count in counts.items()})
    _append(SubElement(piece, "Points"), "points_m", points)
    return root, piece


def _append_data(
    piece: Element, point_data: Mapping[str, NDArray], cell_data: Mapping[str, NDArray]
) -> None:
    for tag, data in (("PointData", point_data), ("CellData", cell_data)):
        block = SubElement(piece, tag)
        for name, values in data.items():
            _append(block, name, values)


def _append(block: Element, name: str, values: NDArray) -> None:
    kind = values.dtype.str[1:]
    values = values if kind in TYPES else values.astype("<f8")
    array = SubElement(
        block, "DataArray", type=TYPES[values.dtype.str[1:]], Name=name, format="binary"
    )
    if values.ndim > 1:
        array.set("NumberOfComponents", str(values.shape[1]))
    raw = np.ascontiguousarray(values).tobytes()
    array.text = base64.b64encode(np.uint64(len(raw)).tobytes() + raw).decode("ascii")


def _write(root: Element, path: str | Path) -> None:
    indent(root)
    root.insert(0, Comment("written by tkamb"))
    with replaced_file(Path(path)) as temporary:
        ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)


BODY_FORMATS = (".stl", ".ply", ".obj")


@dataclass(frozen=True, eq=False)
class LatticeReport:
    """A lattice, its quality and its file.

    Args:
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
