"""Triangles from binary STL files, also with extra bytes at the end."""

import logging
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array

_log = logging.getLogger("tkamb")

_HEADER = 84
"""Bytes before the first triangle: 80 of anything, and the number of triangles."""
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
_TEXT_WITHIN = 2000
"""Bytes at the beginning among which a text STL has its first facet."""


def read_binary_stl(path: Path) -> Array | None:
    """Return the corners (3 k, 3) of a binary STL file, in file units; None for a text file.

    80 bytes of anything, the number of triangles, then for each a normal, three corners and two
    bytes (little-endian). Several solids one after the other are read as one. Bytes after the last
    triangle are left out, with a notice on the logger "tkamb". A number of triangles of 0 or of the
    largest integer is ignored, too: programs write it if they do not return to the header.

    Raises:
        InputError: it is cut short.
    """
    content = path.read_bytes()
    if len(content) < _HEADER or _is_text(content):
        return None
    solids, place = list[Array](), 0
    while len(content) - place >= _HEADER:
        rest = len(content) - place - _HEADER
        count = int.from_bytes(content[place + 80 : place + _HEADER], "little")
        if place == 0 and count in (0, 2**32 - 1) and rest >= _TRIANGLE.itemsize:
            count = rest // _TRIANGLE.itemsize
            _log.warning("%s: does not say how many triangles it has; %d are read", path, count)
        if count == 0 or count * _TRIANGLE.itemsize > rest:
            break
        solids.append(np.frombuffer(content, _TRIANGLE, count, place + _HEADER)["corners"])
        place += _HEADER + count * _TRIANGLE.itemsize
        if not _goes_on(content, place):
            break
    if not solids:
        _refuse_cut_short(content, path)
        return None
    if place < len(content):
        _log.warning("%s: %d bytes after the last triangle left out", path, len(content) - place)
    return np.concatenate(solids).reshape(-1, 3).astype(np.float64)


def _is_text(content: bytes) -> bool:
    """Say whether it is a text STL; binary ones too may begin with the word "solid"."""
    begin = content[:_TEXT_WITHIN].lower()
    words = b"facet" in begin or b"endsolid" in begin
    return content.lstrip()[:5].lower() == b"solid" and words and b"\0" not in begin


def _goes_on(content: bytes, place: int) -> bool:
    """Say whether another whole solid of finite corners begins at a place."""
    rest = len(content) - place - _HEADER
    if rest < _TRIANGLE.itemsize:
        return False
    count = int.from_bytes(content[place + 80 : place + _HEADER], "little")
    if count == 0 or count * _TRIANGLE.itemsize > rest:
        return False
    corners = np.frombuffer(content, _TRIANGLE, count, place + _HEADER)["corners"]
    return bool(np.isfinite(corners).all())


def _refuse_cut_short(content: bytes, path: Path) -> None:
    """Refuse a file that announces more triangles than it has, where the others are plausible."""
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
