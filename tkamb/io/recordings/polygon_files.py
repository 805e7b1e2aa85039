"""Vertices and polygons of OBJ, PLY, binary STL and VTP files, in file units.

Colours, textures and normals are not read.

OBJ: Wavefront, "Object Files", Advanced Visualizer manual, appendix B1. PLY: Turk, "The PLY
polygon file format" (1994).

The header of an array is its length in bytes or, if compressed by zlib, number and sizes of its
blocks.

Format: VTK User's Guide, "VTK XML file formats".
"""

import base64
import logging
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.files import MESH_BYTES, parse_xml, read_bytes
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.polygons import triangulated

Polygons = tuple[Array, Index, Index]
"""Vertices (n, 3), vertex indices of all corners (m,), and where each polygon ends in them (p,)."""

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_HEADER_LINES = 1000


def read_obj(path: str | Path) -> Polygons:
    """Return the vertices and polygons of an OBJ file, in file units.

    A negative index counts back from the last vertex before its line.

    Raises:
        InputError: no such file.
        ValueError: an invalid line, which the message quotes.
    """
    text = read_bytes(path, MESH_BYTES, what="mesh file").decode("latin-1")
    if "\\" in text:  # a backslash continues a line
        text = text.replace("\\\r\n", " ").replace("\\\n", " ")
    vertices: list[tuple[float, ...]] = []
    corners: list[int] = []
    ends: list[int] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0] not in ("v", "f", "fo"):
            continue
        try:
            if words[0] == "v":
                vertices.append((float(words[1]), float(words[2]), float(words[3])))
                continue
            for word in words[1:]:
                if word.startswith("#"):
                    break
                index = int(word.split("/")[0])
                corners.append(index - 1 if index > 0 else len(vertices) + index)
                if index == 0 or corners[-1] < 0:
                    raise ValueError(f"vertex {index} of {len(vertices)}")
            ends.append(len(corners))
        except (ValueError, IndexError) as error:
            raise ValueError(f"line {number}: '{line.strip()[:40]}', {error}") from None
    return _checked(vertices, corners, ends)


@dataclass(frozen=True)
class _Element:
    """A kind of element of a PLY file.

    A property has a name, a type and, if it is a list, the type of the list's length (else "").
    """

    name: str
    count: int
    properties: tuple[tuple[str, str, str], ...]


def read_ply(path: str | Path) -> Polygons:
    """Return the vertices and polygons of a PLY file, text or binary, in file units.

    Raises:
        InputError: no such file.
        ValueError: the file is no PLY file, is cut short or holds triangle strips.
    """
    content = read_bytes(path, MESH_BYTES, what="mesh file")
    order, elements, start = _ply_header(content)
    if any(element.name == "tristrips" for element in elements):
        raise ValueError("it holds triangle strips")
    values = _ply_text if order == "" else _ply_binary
    result = dict(values(content, start, elements, order))
    if "vertex" not in result:
        raise ValueError("it has no vertices")
    flat, _ = result["vertex"]
    corners, ends = result.get("face", (np.zeros(0), np.zeros(0, np.int64)))
    return _checked(flat.reshape(-1, 3), corners, ends)


def _checked(vertices: object, corners: object, ends: object) -> Polygons:
    points = np.asarray(vertices, np.float64).reshape(-1, 3)
    index = np.asarray(corners).astype(np.int64)
    if len(index) and not (index.min() >= 0 and index.max() < len(points)):
        raise ValueError(f"a polygon has a corner that is none of the {len(points)} vertices")
    return points, index, np.asarray(ends).astype(np.int64)


def _ply_header(content: bytes) -> tuple[str, list[_Element], int]:
    if not content.startswith(b"ply"):
        raise ValueError("it does not begin with 'ply'")
    order, elements, position = None, list[_Element](), 0
    for _ in range(_MOST_HEADER_LINES):
        end = content.find(b"\n", position)
        if end < 0:
            break
        words = content[position:end].decode("latin-1").split()
        position = end + 1
        if words[:1] == ["format"]:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2]), ()))
        elif words[:1] == ["property"] and elements:
            kinds = words[2:4] if words[1] == "list" else ["", words[1]]
            if words[-1] in ("x", "y", "z") or all(kind in _TYPES or not kind for kind in kinds):
                last = elements[-1]
                more = (*last.properties, (words[-1], _TYPES[kinds[1]], _TYPES.get(kinds[0], "")))
                elements[-1] = _Element(last.name, last.count, more)
            else:
                raise ValueError(f"unknown property type '{' '.join(words[1:-1])}'")
        elif words[:1] == ["end_header"]:
            if order is None:
                raise ValueError("its format is none of ascii, binary_little_endian, _big_endian")
            return order, elements, position
    raise ValueError("its header has no end")


def _columns_to_read(element: _Element) -> list[int]:
    """Return the properties to read: x, y and z, or the list of corners."""
    names = [name for name, _, _ in element.properties]
    if element.name == "vertex":
        return [names.index(axis) for axis in "xyz" if axis in names]
    lists = [n for n, (name, _, length) in enumerate(element.properties) if length]
    return [n for n in lists if names[n] in ("vertex_indices", "vertex_index")] or lists[:1]


def _ply_text(
    content: bytes, start: int, elements: list[_Element], order: str
) -> Iterator[tuple[str, tuple[Array, Index]]]:
    lines = iter(content[start:].decode("latin-1").splitlines())
    for element in elements:
        columns, values, ends = _columns_to_read(element), list[float](), list[int]()
        if element.name == "vertex" and len(columns) < 3:
            raise ValueError("its vertices lack x, y or z")
        for row in range(element.count):
            words = next((w for w in (line.split() for line in lines) if w), None)
            if words is None:
                raise ValueError(f"it is cut short: {row} of {element.count} of {element.name}")
            position, items = 0, []
            for _, _, length in element.properties:
                count = int(words[position]) if length else 1
                position += bool(length)
                items.append(words[position : position + count])
                if len(items[-1]) < count:
                    raise ValueError(f"{element.name} {row} is cut short")
                position += count
            for n in columns:
                values.extend(float(word) for word in items[n])
            ends.append(len(values))
        yield element.name, (np.array(values), np.array(ends, np.int64))


def _ply_binary(
    content: bytes, start: int, elements: list[_Element], order: str
) -> Iterator[tuple[str, tuple[Array, Index]]]:
    for element in elements:
        columns, position = _columns_to_read(element), start
        if element.name == "vertex" and len(columns) < 3:
            raise ValueError("its vertices lack x, y or z")
        rows, start = _equal_rows(content, start, element, order)
        if rows is not None:
            parts = [rows[f"p{n}"].reshape(element.count, -1) for n in columns]
            table = np.concatenate([part.astype(float) for part in parts], axis=1) if parts else (
                np.zeros((element.count, 0))
            )  # fmt: skip
            ends = table.shape[1] * np.arange(1, element.count + 1)
            yield element.name, (table.ravel(), ends)
            continue
        values, ends_, start = _uneven_rows(content, position, element, order, columns)
        yield element.name, (values, ends_)


def _equal_rows(
    content: bytes, start: int, element: _Element, order: str
) -> tuple[NDArray | None, int]:
    fields: list[tuple[Any, ...]] = []
    position = start
    for n, (_, kind, length) in enumerate(element.properties):
        dtype = np.dtype(order + kind)
        shape: tuple[int, ...] = ()
        if length:
            header = np.dtype(order + length)
            if element.count == 0 or len(content) < position + header.itemsize:
                return None, start
            shape = (int(np.frombuffer(content, header, 1, position)[0]),)
            fields.append((f"n{n}", header))
            position += header.itemsize
        fields.append((f"p{n}", dtype, shape))
        position += dtype.itemsize * int(np.prod(shape))
    row = np.dtype(fields)
    end = start + row.itemsize * element.count
    if len(content) < end:
        return None, start
    rows = np.frombuffer(content, row, element.count, start)
    for name in row.names or ():
        if name.startswith("n") and element.count and (rows[name] != rows[name][0]).any():
            return None, start
    return rows, end


def _uneven_rows(
    content: bytes, start: int, element: _Element, order: str, columns: list[int]
) -> tuple[Array, Index, int]:
    kinds = [
        (np.dtype(order + kind), np.dtype(order + length) if length else None)
        for _, kind, length in element.properties
    ]
    values, ends, total = list[Array](), list[int](), 0
    for row in range(element.count):
        for n, (dtype, header) in enumerate(kinds):
            count = 1
            if header is not None and len(content) >= start + header.itemsize:
                count = int(np.frombuffer(content, header, 1, start)[0])
                start += header.itemsize
            if count < 0 or len(content) < start + count * dtype.itemsize:
                raise ValueError(f"it is cut short: {row} of {element.count} of {element.name}")
            if n in columns:
                values.append(np.frombuffer(content, dtype, count, start).astype(float))
                total += count
            start += count * dtype.itemsize
        ends.append(total)
    joined = np.concatenate(values) if values else np.zeros(0)
    return joined, np.array(ends, np.int64), start


_log = logging.getLogger("tkamb")

_HEADER = 84
"""Bytes before the first triangle: 80 bytes of header, and the number of triangles."""
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_TEXT_WITHIN = 2000
"""Bytes at the beginning of a text STL that contain its first facet."""


def read_binary_stl(path: Path) -> Array | None:
    """Return the corners (3 k, 3) of a binary STL file, in file units; None for a text file.

    A solid has a header of 80 bytes and the number of triangles. Each triangle has a normal, three
    corners and two bytes (little-endian). Consecutive solids are read as one. Bytes after the last
    triangle are ignored, with a notice on the logger "tkamb". If the number is 0 or the largest
    integer, all triangles are read: some programs never write the number.
    """
    content = path.read_bytes()
    if len(content) < _HEADER or _is_text(content):
        return None
    solids, position = list[Array](), 0
    while len(content) - position >= _HEADER:
        available = len(content) - position - _HEADER
        count = int.from_bytes(content[position + 80 : position + _HEADER], "little")
        if position == 0 and count in (0, 2**32 - 1) and available >= _TRIANGLE.itemsize:
            count = available // _TRIANGLE.itemsize
            _log.warning("%s: does not state its number of triangles; %d are read", path, count)
        if count == 0 or count * _TRIANGLE.itemsize > available:
            break
        solids.append(np.frombuffer(content, _TRIANGLE, count, position + _HEADER)["corners"])
        position += _HEADER + count * _TRIANGLE.itemsize
        if not _another_solid(content, position):
            break
    if not solids:
        _refuse_cut_short(content, path)
        return None
    if position < len(content):
        _log.warning(
            "%s: %d bytes after the last triangle are ignored", path, len(content) - position
        )
    return np.concatenate(solids).reshape(-1, 3).astype(np.float64)


def _is_text(content: bytes) -> bool:
    """A binary STL may also begin with the word "solid"."""
    begin = content[:_TEXT_WITHIN].lower()
    words = b"facet" in begin or b"endsolid" in begin
    return content.lstrip()[:5].lower() == b"solid" and words and b"\0" not in begin


def _another_solid(content: bytes, position: int) -> bool:
    available = len(content) - position - _HEADER
    if available < _TRIANGLE.itemsize:
        return False
    count = int.from_bytes(content[position + 80 : position + _HEADER], "little")
    if count == 0 or count * _TRIANGLE.itemsize > available:
        return False
    corners = np.frombuffer(content, _TRIANGLE, count, position + _HEADER)["corners"]
    return bool(np.isfinite(corners).all())


def _refuse_cut_short(content: bytes, path: Path) -> None:
    count = int.from_bytes(content[80:_HEADER], "little")
    stored = (len(content) - _HEADER) // _TRIANGLE.itemsize
    if not 0 < stored < count:
        return
    corners = np.frombuffer(content, _TRIANGLE, stored, _HEADER)["corners"]
    if np.isfinite(corners).all() and 0.0 < np.abs(corners).max() < 1e7:
        raise InputError(
            f"cannot be read as a mesh (cut short: {stored} of {count} triangles)",
            path,
            "copy or export it again",
        )


Indices = NDArray[np.int64]

Read = TypeVar("Read")

_VTK_TYPES = {"Float32": "f4", "Float64": "f8"} | {
    f"{sign}Int{bits}": f"{letter}{bits // 8}"
    for sign, letter in (("", "i"), ("U", "u"))
    for bits in (8, 16, 32, 64)
}
MORE_THAN_STATED = "an array is larger than the number of points or polygons that is stated"
COMPONENTS = 9
"""1: largest number of values per point that is read: a tensor."""
_SAVE_AGAIN = "save it again as ASCII .vtp, .stl or .ply"
_RAW = re.compile(rb"<AppendedData[^>]*encoding=[\"']raw[\"'][^>]*>\s*_")


def read_vtp(path: str | Path) -> tuple[Array, Indices]:
    """Return the points (n, 3) and triangles (k, 3) of a .vtp file, in file units.

    Polygons of more than three corners are cut into triangles. Vertex cells, lines and data arrays
    are not read.
    """
    return _read(path, lambda data: data.triangles())


def read_vtp_values(path: str | Path, name: str) -> Array:
    """Return the values (n,) of a point data array of a .vtp file."""
    return _read(path, lambda data: data.values(name))


def _read(path: str | Path, select: "Callable[[_PolyData], Read]") -> Read:
    content = read_bytes(path, MESH_BYTES, what="mesh file")
    try:
        return select(_PolyData(content, path))
    except (ValueError, KeyError, OverflowError, zlib.error) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"cannot be read as VTK PolyData ({reason})", path, _SAVE_AGAIN) from None


class _PolyData:
    def __init__(self, content: bytes, path: str | Path) -> None:
        self._appended = b""
        self._raw = False
        if raw := _RAW.search(content):  # raw bytes are not XML
            self._raw, self._appended = True, content[raw.end() :]
            content = content[: raw.end() - 1] + b"</AppendedData></VTKFile>"
        self._root = parse_xml(content, path, what="mesh file")
        if self._root.tag != "VTKFile" or self._root.get("type") != "PolyData":
            raise ValueError(f"it is {self._root.get('type') or self._root.tag}")
        compressor = self._root.get("compressor")
        if compressor not in (None, "vtkZLibDataCompressor"):
            raise ValueError(f"compressed by {compressor}")
        self._compressed = compressor is not None
        self._order = ">" if self._root.get("byte_order") == "BigEndian" else "<"
        header = self._root.get("header_type", "UInt32")
        if header not in ("UInt32", "UInt64"):
            raise ValueError(f"unknown header type '{header}'")
        self._header = np.dtype(self._order + _VTK_TYPES[header])
        block = self._root.find("AppendedData")
        if block is not None and not self._raw:
            self._appended = "".join((block.text or "").split()).removeprefix("_").encode()

    def triangles(self) -> tuple[Array, Indices]:
        points, faces, start = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
        for piece in self._root.iter("Piece"):
            if int(piece.get("NumberOfStrips", 0)):
                raise ValueError("it holds triangle strips")
            if int(piece.get("NumberOfPoints", -1)) == 0:
                continue
            corners = self._array(
                piece.find("Points/DataArray"), "points", 3 * int(piece.get("NumberOfPoints", 0))
            ).reshape(-1, 3)
            if int(piece.get("NumberOfPoints", len(corners))) != len(corners):
                raise ValueError("the number of points is not as stated")
            if int(piece.get("NumberOfPolys", 0)):
                faces.append(self._polygons(piece, corners.astype(float)) + start)
            points.append(corners.astype(float))
            start += len(corners)
        return np.concatenate(points), np.concatenate(faces)

    def values(self, name: str) -> Array:
        result = []
        for piece in self._root.iter("Piece"):
            named = {array.get("Name"): array for array in piece.iterfind("PointData/DataArray")}
            most = COMPONENTS * int(piece.get("NumberOfPoints", 0))
            result.append(self._array(named.get(name), name, most).astype(float))
        return np.concatenate(result)

    def _polygons(self, piece: Element, points: Array) -> Indices:
        named = {array.get("Name"): array for array in piece.iterfind("Polys/DataArray")}
        count = int(piece.get("NumberOfPolys", 0))
        ends = self._array(named["offsets"], "offsets", count).astype(np.int64)
        if len(ends) != count:
            raise ValueError("the number of polygons is not as stated")
        most = max(int(ends[-1]), 0)
        index = self._array(named["connectivity"], "connectivity", most).astype(np.int64)
        starts = np.concatenate([[0], ends[:-1]])
        if (ends < starts).any() or ends[-1] != len(index):
            raise ValueError("offsets and connectivity do not agree")
        if len(index) and not (index.min() >= 0 and index.max() < len(points)):
            raise ValueError("a polygon has a corner that is no point")
        return triangulated(points, index, ends)

    def _array(self, array: Element | None, name: str, most: int) -> NDArray:
        if array is None:
            raise KeyError(name)
        dtype = np.dtype(self._order + _VTK_TYPES[array.attrib["type"]])
        form = array.get("format")
        if form == "ascii":
            return np.array((array.text or "").split(), dtype)
        if form == "binary":
            source = "".join((array.text or "").split()).encode()
        elif form == "appended":
            offset = int(array.attrib["offset"])
            if not 0 <= offset < len(self._appended):
                raise ValueError("it is cut short")
            source = self._appended[offset:]
        else:
            raise ValueError(f"unknown format '{form}'")
        raw = form == "appended" and self._raw
        return np.frombuffer(self._decode(source, raw, most * dtype.itemsize), dtype)

    def _decode(self, source: bytes, raw: bool, most: int) -> bytes:
        """Return the bytes after its header."""
        size = self._header.itemsize
        if not self._compressed:
            header, remaining = self._decoded(source, size, raw)
            if int(np.frombuffer(header, self._header)[0]) > most:
                raise ValueError(MORE_THAN_STATED)
            return self._uncompressed(source, header, remaining, raw)
        header, _ = self._decoded(source, size, raw)
        count = int(np.frombuffer(header, self._header)[0])
        header, remaining = self._decoded(source, (3 + count) * size, raw)
        _, block_size, last_size, *sizes = (int(n) for n in np.frombuffer(header, self._header))
        if count == 0:
            return b""
        if block_size * (count - 1) + (last_size or block_size) > most:
            raise ValueError(MORE_THAN_STATED)
        packed, _ = self._decoded(remaining, sum(sizes), raw)
        blocks, start = [], 0
        for number, length in enumerate(sizes):
            expected = last_size if last_size and number == count - 1 else block_size
            block = zlib.decompressobj().decompress(packed[start : start + length], expected)
            if len(block) != expected:
                raise ValueError("a compressed block is cut short")
            blocks.append(block)
            start += length
        return b"".join(blocks)

    def _uncompressed(self, source: bytes, header: bytes, remaining: bytes, raw: bool) -> bytes:
        """In base64 the header may be separate."""
        size, length = len(header), int(np.frombuffer(header, self._header)[0])
        coded = source[: 4 * -(-size // 3)]
        if raw or (size % 3 and coded.endswith(b"=")):
            return self._decoded(remaining, length, raw)[0]
        return self._decoded(source, size + length, raw)[0][size:]

    def _decoded(self, source: bytes, count: int, raw: bool) -> tuple[bytes, bytes]:
        """Return the first `count` bytes of a raw or base64 text, and the remaining text."""
        length = count if raw else 4 * -(-count // 3)
        piece = source[:length]
        packed = piece if raw else base64.b64decode(piece, validate=True)
        if len(packed) < count:
            raise ValueError("it is cut short")
        return packed[:count], source[length:]
