"""Writing of VTK XML files for ParaView and meshio: lattices as .vtu, contact maps as .vtp.

Arrays are in base64, little-endian and uncompressed. The length of an array in bytes (UInt64)
precedes it. Coordinates are in metres.
"""

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Comment, Element, ElementTree, SubElement, indent

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.meshing.cells import scaled_jacobians
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.errors import InputError
from tkamb.files import replaced_file
from tkamb.geometry.frames import Array

if TYPE_CHECKING:
    from tkamb.run.maps import ContactMaps

SERIES_NAME = "contact.pvd"
HEXAHEDRON = 12
"""VTK's number for a cell of eight nodes."""
TYPES = {"f8": "Float64", "i8": "Int64", "u1": "UInt8", "i1": "Int8"}


def write_lattice(lattice: Lattice, path: str | Path) -> None:
    """Write the cells of a lattice, its node classes and scaled Jacobians as .vtu, in metres.

    Raises:
        InputError: the file cannot be written.
    """
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


def write_map_series(maps: "ContactMaps", folder: Path) -> list[str]:
    """Write the maps of a run for ParaView: a .vtp for each frame, and a .pvd with all times.

    A failed frame has no map (NaN) and gets no file.

    Returns:
        The names of the files, the .pvd first.

    Raises:
        InputError: no frame has a map, or the folder cannot be written.
    """
    mapped_frames = np.flatnonzero(np.isfinite(maps.peaks_Pa))
    if not len(mapped_frames):
        raise InputError("no frame has a pressure map", "export --vtp")
    root = Element("VTKFile", type="Collection", version="1.0", byte_order="LittleEndian")
    collection, names = SubElement(root, "Collection"), []
    for k in map(int, mapped_frames):
        names.append(f"contact_{k:04d}.vtp")
        write_triangles(folder / names[-1], maps.points_m, maps.triangles, maps.frame_data(k))
        SubElement(collection, "DataSet", timestep=repr(float(maps.time_s[k])), file=names[-1])
    _write(root, folder / SERIES_NAME)
    return [SERIES_NAME, *names]


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
