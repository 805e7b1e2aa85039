"""Triangles from VTK's XML PolyData (.vtp): text, base64 or raw, in place or appended.

The header of an array is its length in bytes. If the array is compressed by zlib, its header is the
number and sizes of its blocks.

Format: VTK User's Guide, "VTK XML file formats".
"""

import base64
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.files import MESH_BYTES, parse_xml, read_bytes
from tkamb.geometry.frames import Array
from tkamb.geometry.polygons import triangulated

Indices = NDArray[np.int64]

Read = TypeVar("Read")

_TYPES = {"Float32": "f4", "Float64": "f8"} | {
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

    Raises:
        InputError: no such file, not PolyData, cut short, triangle strips, or another encoding.
    """
    return _read(path, lambda data: data.triangles())


def read_vtp_values(path: str | Path, name: str) -> Array:
    """Return the values (n,) of a point data array of a .vtp file.

    Raises:
        InputError: as `read_vtp`, or there is no array of this name.
    """
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
        self._header = np.dtype(self._order + _TYPES[header])
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
        dtype = np.dtype(self._order + _TYPES[array.attrib["type"]])
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
        """Return the bytes of an array after its header."""
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
        """Return the bytes of an uncompressed array; in base64 the header may be separate."""
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
