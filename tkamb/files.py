"""Files that users name: regular ones of a known size alone are read, and read at once.

A FIFO would wait for ever, a device has no end, and a table of gigabytes is not a recording:
each is refused before a byte of it is read.
"""

import hashlib
import json
import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from tkamb.errors import InputError

MEGABYTE = 1_000_000


@dataclass(frozen=True)
class FileLimitSettings:
    """Sizes of the largest files that are read; a larger file is not of the stated kind."""

    text_bytes: float = 16 * MEGABYTE
    """Bytes of a scene, a URDF or a summary. Chosen: a thousand times the size of the shipped
    ones."""
    table_bytes: float = 512 * MEGABYTE
    """Bytes of a recording. Chosen: an hour of fifty channels at 200 Hz has 500 MB."""
    mesh_bytes: float = 1000 * MEGABYTE
    """Bytes of a mesh. Chosen: twenty million triangles in a binary STL."""
    xml_depth: int = 100
    """Nested elements of an XML file; a URDF has 5, an OpenSim model 20."""


FILE_LIMITS = FileLimitSettings()


SAVE_AS_UTF8 = "save it as UTF-8 text"

HASH_LIMIT = 100_000 * MEGABYTE
"""Bytes of a file of which the SHA-256 is taken: five minutes of reading."""


def open_regular(path: str | Path, limit: float, *, what: str = "file", follow: bool = True) -> int:
    """Return a descriptor of a regular file of at most `limit` bytes, opened for reading.

    Args:
        path: the file.
        limit: bytes.
        what: what to call it in messages.
        follow: whether it may be a symbolic link.

    Raises:
        InputError: no such file, another kind of file, too large, or not to be opened.
    """
    # O_NONBLOCK: opening a FIFO that nobody writes to would wait; regular files ignore it.
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)
    try:
        descriptor = os.open(os.fspath(path), flags)  # text: `tkamb run --profile` hears it
    except FileNotFoundError:
        raise InputError(f"no such {what}", path, "check the path") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the path
        raise InputError(f"cannot be read ({_reason(error)})", path) from None
    try:
        status = os.fstat(descriptor)
        check_readable(status, path, limit)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def check_readable(status: os.stat_result, path: str | Path, limit: float) -> None:
    """Raise unless what was found at a path is a regular file of at most `limit` bytes.

    Raises:
        InputError: a folder, FIFO, device or socket, or too large.
    """
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"is {_kind(status.st_mode)}, not a file", path, "give a regular file")
    if status.st_size > limit:
        size, most = status.st_size / MEGABYTE, limit / MEGABYTE
        raise InputError(f"is {size:.0f} MB large, more than the {most:.0f} MB that are read", path)


def read_bytes(
    path: str | Path, limit: float = FILE_LIMITS.text_bytes, *, what: str = "file"
) -> bytes:
    """Return the content of a regular file.

    Raises:
        InputError: as `open_regular`, or it cannot be read.
    """
    with os.fdopen(open_regular(path, limit, what=what), "rb") as file:
        try:
            return file.read()
        except OSError as error:
            raise InputError(f"cannot be read ({_reason(error)})", path) from None


def read_text(
    path: str | Path,
    limit: float = FILE_LIMITS.text_bytes,
    encoding: str = "utf-8",
    *,
    what: str = "file",
) -> str:
    """Return the content of a regular text file, with line ends as `\\n`.

    Raises:
        InputError: as `read_bytes`, or it is not text in that encoding.
    """
    try:
        text = read_bytes(path, limit, what=what).decode(encoding)
    except UnicodeDecodeError as error:
        raise InputError(f"cannot be read ({error})", path) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(
    path: str | Path, limit: float = FILE_LIMITS.text_bytes, *, what: str = "file"
) -> Any:
    """Return what a JSON file holds.

    Raises:
        InputError: as `read_bytes`, or not JSON, or nested beyond all measure.
    """
    try:
        return json.loads(read_text(path, limit, what=what))
    except (ValueError, RecursionError) as error:
        raise InputError(f"cannot be read as JSON ({error})", path) from None


def read_xml(
    path: str | Path, limit: float = FILE_LIMITS.text_bytes, *, what: str = "file"
) -> Element:
    """Return the root element of an XML file.

    Raises:
        InputError: as `read_bytes`, or not XML, or it declares entities (which could grow without
            end or name other files), or nested more than `FILE_LIMITS.xml_depth` elements deep.
    """
    return parse_xml(read_bytes(path, limit, what=what), path, what=what)


def parse_xml(content: bytes, path: str | Path, *, what: str = "file") -> Element:
    """Return the root element of XML that was read from a path.

    Raises:
        InputError: as `read_xml`.
    """
    builder = _ShallowBuilder(path)

    def refuse_entity(name: str, *_: object) -> None:
        hint = "write its text out"
        raise InputError(f"declares an entity '{name}', which is refused", path, hint)

    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.EntityDeclHandler = refuse_entity
    try:
        parser.Parse(content, True)
        return builder.close()
    except expat.ExpatError as error:
        place = f"{expat.ErrorString(error.code)}: line {error.lineno}, column {error.offset + 1}"
        what, hint = f"is not a readable {what} ({place})", _xml_hint(content, parser)
        raise InputError(what, path, hint) from None
    except (ValueError, LookupError) as error:  # the last: an unknown encoding
        raise InputError(f"is not a readable {what} ({error})", path, SAVE_AS_UTF8) from None


def _xml_hint(content: bytes, parser: expat.XMLParserType) -> str:
    """Return a hint for an error of the parser, from the bytes around its place."""
    at = max(parser.ErrorByteIndex, 0)
    near = content[max(at - 1, 0) : at + 12]
    if re.search(rb"&(?!\w{1,8};|#)", near):
        return "write &amp; for a & in a text"
    if any(byte > 127 for byte in near):
        return SAVE_AS_UTF8
    if not content.strip() or at >= len(content.rstrip()) - 1:
        return "the file ends too early: copy or download it again"
    return "correct that line, or open and save the file in the program that wrote it"


class _ShallowBuilder(TreeBuilder):
    """Builds a tree of elements, and refuses one that is too deep while it is being read."""

    def __init__(self, path: str | Path) -> None:
        super().__init__()
        self._path, self._depth = path, 0

    def start(self, tag: str, attrs: dict[str, str], /) -> Element:
        """Open an element."""
        self._depth += 1
        if self._depth > FILE_LIMITS.xml_depth:
            raise InputError(f"nests elements more than {FILE_LIMITS.xml_depth} deep", self._path)
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> Element:
        """Close an element."""
        self._depth -= 1
        return super().end(tag)


_NAMED = re.compile(rb'<\w+[^<>]*?\sfile="([^"<>]+)"')


def named_files(path: Path) -> list[Path]:
    """Return the files that elements of an XML file name with file="…", and those that these name.

    Args:
        path: an OpenSim model, whose sets may stand in files of their own.

    Raises:
        InputError: as `read_bytes`.
    """
    result: list[Path] = []
    waiting = [path]
    while waiting:
        folder = waiting.pop()
        for name in _NAMED.findall(read_bytes(folder)):
            other = folder.parent / os.fsdecode(name).replace("\\", "/")
            if other.is_file() and other not in (path, *result):
                result.append(other)
                waiting.append(other)
    return result


def check_file(path: str | Path, limit: float, *, what: str = "file") -> None:
    """Raise unless a path leads to a regular file of at most `limit` bytes that can be read.

    Raises:
        InputError: as `open_regular`.
    """
    os.close(open_regular(path, limit, what=what))


def sha256_of(path: str | Path, limit: float = HASH_LIMIT) -> str:
    """Return the SHA-256 of a regular file's content, hexadecimal.

    Args:
        path: the file.
        limit: bytes.

    Raises:
        InputError: no such file, too large, or it cannot be read.
    """
    with os.fdopen(open_regular(path, limit), "rb") as file:
        try:
            return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"cannot be read ({_reason(error)})", path) from None


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def _kind(mode: int) -> str:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a FIFO",
        stat.S_IFSOCK: "a socket",
        stat.S_IFLNK: "a symbolic link",
    }
    return kinds.get(stat.S_IFMT(mode), "a device")
