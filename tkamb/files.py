"""Files that users name are read with limits; files that tkamb writes are whole or not there.

Reading: regular files of a known size alone, and at once. A FIFO would wait for ever, a device has
no end, and a table of gigabytes is not a recording: each is refused before a byte of it is read.

Writing: a file is written beside its place, then renamed. Files that belong together are first all
written beside their places; then a journal that names them makes the change certain, and they are
renamed. A kill before the journal leaves the old files. After a kill with a journal, the next
command that opens the folder finishes the renames (`finish_replacement`). So a folder has the old
state or the new one.
"""

import csv
import hashlib
import io
import json
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from tkamb.errors import InputError

MEGABYTE = 1_000_000


@dataclass(frozen=True)
class FileLimitSettings:
    """Largest sizes of the files that are read."""

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
    if re.match(rb"<[\s\d=]", near):
        return "write &lt; for a < in a text"
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


def _kind(mode: int) -> str:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a FIFO",
        stat.S_IFSOCK: "a socket",
        stat.S_IFLNK: "a symbolic link",
    }
    return kinds.get(stat.S_IFMT(mode), "a device")


MARKER = ".tkamb"
"""File that marks a folder as tkamb's own (`tkamb.io.claim`) and names its temporary files."""
JOURNAL = ".tkamb-commit"
CHOOSE_OUT = "choose another --out, or remove it"
_PLAIN_NAME = re.compile(r"[A-Za-z0-9_.][A-Za-z0-9_.-]*")


def folder_token(folder: Path) -> str | None:
    """Return what the names of a folder's temporary files begin with; None: it has no marker."""
    try:
        result = read_json(folder / MARKER)
    except InputError:
        return None
    token = result.get("token") if isinstance(result, dict) else None
    return token if isinstance(token, str) and re.fullmatch("[0-9a-f]{16}", token) else None


def temporary_path(folder: Path) -> Path:
    """Return a new path for a temporary file in a folder; the folder's own by its token."""
    token = folder_token(folder) or "loose"
    return folder / f".tkamb-{token}-{secrets.token_hex(6)}.part"


@contextmanager
def replaced_file(path: Path) -> Iterator[Path]:
    """Give a temporary path in the same folder that takes the place of `path` at the end.

    When the block raises, `path` is left as it was.

    Raises:
        InputError: the folder cannot be written.
    """
    temporary = temporary_path(path.parent)
    try:
        yield temporary
        os.replace(temporary, path)
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the path
        raise InputError(f"cannot be written ({_reason(error)})", path) from None
    finally:
        _remove(temporary)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, whole or not at all.

    Raises:
        InputError: the folder cannot be written.
    """
    with replaced_file(path) as temporary:
        write_synced(temporary, text)


def write_new_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8 into a file that is not there yet, whole or not at all.

    Raises:
        InputError: something of that name is there, or the folder cannot be written.
    """
    temporary = temporary_path(path.parent)
    try:
        write_synced(temporary, text)
        os.link(temporary, path)  # unlike a rename, it fails where the name is taken
    except FileExistsError:
        raise InputError("exists already", path, CHOOSE_OUT) from None
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be written ({_reason(error)})", path) from None
    finally:
        _remove(temporary)


def write_synced(path: Path, text: str) -> None:
    """Write `text` as UTF-8 and flush it to the disk."""
    # Names of files that are not UTF-8 come as lone surrogates, which UTF-8 does not have:
    # "\udcff" is written as these six characters, in JSON a valid escape for the same name.
    with open(path, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def write_rows(path: Path, rows: Iterable[Iterable[object]]) -> None:
    """Write rows of cells as CSV and flush them to the disk."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    write_synced(path, buffer.getvalue())


class Replacement:
    """Files of one folder that are to take their places together.

    Args:
        folder: an existing folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._written: dict[str, Path] = {}
        self._removed: list[str] = []

    def path(self, name: str) -> Path:
        """Return where to write what takes the place of the file of that name."""
        return self._written.setdefault(name, temporary_path(self.folder))

    def current(self, name: str) -> Path:
        """Return where that file is now: what was written, or else what is in its place."""
        return self._written.get(name, self.folder / name)

    def remove(self, name: str) -> None:
        """Remove the file of that name on `commit`, if there is one."""
        self._removed.append(name)

    def commit(self) -> None:
        """Put all files in their places."""
        for path in self._written.values():
            with open(path, "rb") as file:
                os.fsync(file.fileno())
        written = {name: path.name for name, path in self._written.items()}
        journal = {"written": written, "removed": self._removed}
        write_text(self.folder / JOURNAL, json.dumps(journal))
        self._written.clear()  # from here on the journal owns them
        finish_replacement(self.folder)

    def discard(self) -> None:
        """Remove what was written and did not take its place."""
        for path in self._written.values():
            _remove(path)


@contextmanager
def replaced_together(folder: Path) -> Iterator[Replacement]:
    """Give a `Replacement` that is done at the end; when the block raises, nothing changes.

    Raises:
        InputError: the folder cannot be written.
    """
    files = Replacement(folder)
    try:
        yield files
        files.commit()
    except OSError as error:
        raise InputError(f"cannot be written ({_reason(error)})", folder) from None
    finally:
        files.discard()


def replacement_pending(folder: Path) -> bool:
    """Say whether a kill left files of a folder that have yet to take their places."""
    return os.path.lexists(folder / JOURNAL)


def finish_replacement(folder: Path) -> None:
    """Put files in their places that a journal names; nothing without one.

    May be done any number of times, by one process at a time.

    Raises:
        InputError: the journal is not one of tkamb's, or the folder cannot be written.
    """
    journal = folder / JOURNAL
    if not replacement_pending(folder):
        return
    try:
        content = read_json(journal)
        written, removed = dict(content["written"]), list(content["removed"])
        names = [*written, *written.values(), *removed]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"is not a journal of tkamb ({error})", journal, "remove it") from None
    if not all(isinstance(name, str) and _PLAIN_NAME.fullmatch(name) for name in names):
        raise InputError("names files outside its folder", journal, "remove it")
    try:
        for name, temporary in written.items():
            with suppress(FileNotFoundError):  # in its place already
                os.replace(folder / temporary, folder / name)
        for name in removed:
            (folder / name).unlink(missing_ok=True)
        journal.unlink(missing_ok=True)
    except OSError as error:
        what = f"results could not be put in their places ({_reason(error)})"
        raise InputError(what, folder, "`tkamb verify` on the folder finishes it") from None


def claim_directory(path: str | Path) -> Path:
    """Make the output folder and prove that it can be written, before anything is computed.

    Raises:
        InputError: it is a file, or cannot be made or written.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path) as probe:
            probe.write(b"tkamb")
    except (OSError, ValueError) as error:
        raise InputError(
            f"output folder cannot be written ({_reason(error)})", path, "choose another directory"
        ) from None
    return path


def _remove(path: Path) -> None:
    """Remove a file if possible; the reason of a failure was reported before."""
    with suppress(OSError, ValueError):
        path.unlink(missing_ok=True)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
