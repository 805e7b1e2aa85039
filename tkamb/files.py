"""Reading of files with size limits; writing of files that are never incomplete.

Reading: only regular files up to a size limit are read. A FIFO would block for ever, a device has
no end, and a table of gigabytes is not a recording.

Writing: a file is written under a temporary name in the same folder, then renamed, so that no link
is followed. Files that belong together are all written first; then a journal lists them, and they
are renamed. If the process is killed before the journal is written, the old files remain. If later,
the next command that writes into the folder finishes the renames (`finish_replacement`).
"""

import codecs
import csv
import hashlib
import json
import os
import re
import secrets
import stat
import tempfile
import time as clock
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from tkamb.errors import InputError

MEGABYTE = 1_000_000


# bytes: largest scene, URDF or summary. The shipped files are a thousand times
# smaller.
TEXT_BYTES = 16 * MEGABYTE
# bytes: largest recording. An hour of fifty channels at 200 Hz has 500 MB.
TABLE_BYTES = 512 * MEGABYTE
# bytes: largest mesh. Twenty million triangles in a binary STL have this size.
MESH_BYTES = 1000 * MEGABYTE
# Largest depth of nested elements in an XML file. A URDF has 5, an OpenSim model 20.
XML_DEPTH = 100


BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
"""First bytes of a text file -> its encoding. Editors of Windows write them."""

SAVE_AS_UTF8 = "save it as UTF-8 text"

HASH_LIMIT = 100_000 * MEGABYTE
"""bytes: largest file for a SHA-256. Reading it takes five minutes."""


def open_regular(path: str | Path, limit: float, *, what: str = "file", follow: bool = True) -> int:
    """Return a descriptor of a regular file of at most `limit` bytes, opened for reading.

    Args:
        what: kind of file, for messages.
        follow: whether the path may be a symbolic link.

    Raises:
        InputError: the file does not exist, is not regular, is too large or cannot be opened.
    """
    # Without O_NONBLOCK, opening a FIFO would wait for a writer. Regular files ignore the flag.
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)
    try:
        descriptor = os.open(os.fspath(path), flags)  # `tkamb run --profile` lists str paths
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
    """Raise unless a file's status is that of a regular file of at most `limit` bytes.

    Raises:
        InputError: the path is a folder, FIFO, device or socket, or the file is too large.
    """
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"is {_kind(status.st_mode)}, not a file", path, "give a regular file")
    if status.st_size > limit:
        size, most = status.st_size / MEGABYTE, limit / MEGABYTE
        raise InputError(f"is {size:.0f} MB large, more than the {most:.0f} MB that are read", path)


def read_bytes(path: str | Path, limit: float = TEXT_BYTES, *, what: str = "file") -> bytes:
    """Return the content of a regular file.

    Raises:
        InputError: as `open_regular`, or reading fails.
    """
    with os.fdopen(open_regular(path, limit, what=what), "rb") as file:
        try:
            return file.read()
        except OSError as error:
            raise InputError(f"cannot be read ({_reason(error)})", path) from None


def read_text(
    path: str | Path,
    limit: float = TEXT_BYTES,
    encoding: str = "utf-8",
    *,
    what: str = "file",
) -> str:
    """Return the content of a regular text file, with line ends as `\\n`.

    A byte order mark at its beginning decides the encoding.

    Raises:
        InputError: as `read_bytes`, or the content is not text in this encoding.
    """
    content = read_bytes(path, limit, what=what)
    for mark, marked in BYTE_ORDER_MARKS.items():
        encoding = marked if content.startswith(mark) else encoding
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        raise InputError(f"cannot be read ({error})", path) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: str | Path, limit: float = TEXT_BYTES, *, what: str = "file") -> Any:
    """Return the content of a JSON file.

    Raises:
        InputError: as `read_bytes`, or the content is not JSON or too deeply nested.
    """
    try:
        return json.loads(read_text(path, limit, what=what))
    except (ValueError, RecursionError) as error:
        raise InputError(f"cannot be read as JSON ({error})", path) from None


def read_xml(path: str | Path, limit: float = TEXT_BYTES, *, what: str = "file") -> Element:
    """Return the root element of an XML file.

    Raises:
        InputError: as `read_bytes`, or the content is not XML, declares entities (which can grow
            without end or name other files) or nests elements too deeply.
    """
    return parse_xml(read_bytes(path, limit, what=what), path, what=what)


def parse_xml(content: bytes, path: str | Path, *, what: str = "file") -> Element:
    """Return the root element of the content of an XML file.

    Raises:
        InputError: as `read_xml`.
    """
    builder = _ShallowBuilder(path)

    def refuse_entity(name: str, *_: object) -> None:
        hint = "replace the entity by its text"
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
    except (ValueError, LookupError) as error:  # LookupError: an unknown encoding
        raise InputError(f"is not a readable {what} ({error})", path, SAVE_AS_UTF8) from None


def _xml_hint(content: bytes, parser: expat.XMLParserType) -> str:
    """Return a hint from the bytes around the parser's error."""
    position = max(parser.ErrorByteIndex, 0)
    near = content[max(position - 1, 0) : position + 12]
    if re.match(rb"<[\s\d=]", near):
        return "write &lt; for a < in a text"
    if re.search(rb"&(?!\w{1,8};|#)", near):
        return "write &amp; for a & in a text"
    if any(byte > 127 for byte in near):
        return SAVE_AS_UTF8
    if not content.strip() or position >= len(content.rstrip()) - 1:
        return "the file ends too early: copy or download it again"
    return "correct that line, or open and save the file in the program that wrote it"


class _ShallowBuilder(TreeBuilder):
    """Raises as soon as the elements are too deeply nested."""

    def __init__(self, path: str | Path) -> None:
        super().__init__()
        self._path, self._depth = path, 0

    def start(self, tag: str, attrs: dict[str, str], /) -> Element:
        self._depth += 1
        if self._depth > XML_DEPTH:
            raise InputError(f"nests elements more than {XML_DEPTH} deep", self._path)
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> Element:
        self._depth -= 1
        return super().end(tag)


_NAMED = re.compile(rb'<\w+[^<>]*?\sfile="([^"<>]+)"')


def named_files(path: Path) -> list[Path]:
    """Return the files that an OpenSim model names by file="…", and in turn those that these name.

    Raises:
        InputError: as `read_bytes`.
    """
    result: list[Path] = []
    waiting = [path]
    while waiting:
        source = waiting.pop()
        for name in _NAMED.findall(read_bytes(source)):
            other = source.parent / os.fsdecode(name).replace("\\", "/")
            if other.is_file() and other not in (path, *result):
                result.append(other)
                waiting.append(other)
    return result


def check_file(path: str | Path, limit: float, *, what: str = "file") -> None:
    """Raise unless a path is a readable regular file of at most `limit` bytes.

    Raises:
        InputError: as `open_regular`.
    """
    os.close(open_regular(path, limit, what=what))


def sha256_of(path: str | Path, limit: float = HASH_LIMIT) -> str:
    """Return the SHA-256 of a regular file's content, hexadecimal.

    Args:
        limit: largest size, bytes.

    Raises:
        InputError: the file does not exist, is too large or cannot be read.
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
"""File that marks a folder as made by tkamb and is locked by its writer (`tkamb.io.claim`)."""
JOURNAL = ".tkamb-commit"
CHOOSE_OUT = "choose another --out, or remove it"
OUTPUT_NAMES = frozenset(
    (
        *("results.csv", "results.csv-metadata.json", "summary.json", "contact.h5", "button.h5"),
        "report.html",
        *("bands.csv", "tornado.csv", "samples.h5", "indices.csv"),
        *("cohort.parquet", "runs.csv", "groups.csv", "cohort.json", "cohort.html"),
        *(
            "wear.csv",
            "wear.json",
            "wear.vtp",
            "worn_insert.stl",
            "worn_button.stl",
            "wear.png",
            ".wear.npz",
        ),
    )
)
"""Files that are replaced together; a journal can rename and remove no others."""
TEMPORARY = re.compile(r"\.tkamb-[0-9a-f]{12}\.part")
LONGEST_WAIT = 2.0
"""s: time that a reader waits until a writer has moved its finished files into place, which takes
milliseconds."""


def temporary_path(folder: Path) -> Path:
    """Return a new temporary path in a folder."""
    return folder / f".tkamb-{secrets.token_hex(6)}.part"


@contextmanager
def replaced_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder. At the end its file replaces `path`.

    When the block raises, `path` stays unchanged.

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
    """Write UTF-8, completely or not at all.

    Raises:
        InputError: the folder cannot be written.
    """
    with replaced_file(path) as temporary:
        write_synced(temporary, text)


def write_new_text(path: Path, text: str) -> None:
    """Write a new file in UTF-8, completely or not at all.

    Raises:
        InputError: the name is in use, or the folder cannot be written.
    """
    temporary = temporary_path(path.parent)
    try:
        write_synced(temporary, text)
        os.link(temporary, path)  # unlike a rename, a link fails if the name is in use
    except FileExistsError:
        raise InputError("exists already", path, CHOOSE_OUT) from None
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be written ({_reason(error)})", path) from None
    finally:
        _remove(temporary)


def write_synced(path: Path, text: str) -> None:
    """Write UTF-8 and flush it to the disk."""
    # A file name that is not UTF-8 contains lone surrogates, which UTF-8 cannot encode. "\udcff" is
    # written as these six characters, which JSON reads as the same name.
    with open(path, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def write_rows(path: Path, rows: Iterable[Iterable[object]]) -> None:
    """Write rows of cells as CSV, and flush them to the disk; NaN is empty."""
    with open(path, "w", encoding="utf-8", errors="backslashreplace", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            ["" if cell != cell else cell for cell in row] for row in rows
        )
        file.flush()
        os.fsync(file.fileno())


class Replacement:
    """Files of one existing folder that are replaced together."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._written: dict[str, Path] = {}
        self._removed: list[str] = []

    def path(self, name: str) -> Path:
        """Return the temporary path of a file of `OUTPUT_NAMES`."""
        assert name in OUTPUT_NAMES
        return self._written.setdefault(name, temporary_path(self.folder))

    def current(self, name: str) -> Path:
        """Return the path of the new version, or of the old one if there is no new."""
        return self._written.get(name, self.folder / name)

    def remove(self, name: str) -> None:
        """Remove the file on `commit`, if it exists."""
        self._removed.append(name)

    def commit(self) -> None:
        """Replace and remove the files."""
        for path in self._written.values():
            with open(path, "rb") as file:
                os.fsync(file.fileno())
        written = {name: path.name for name, path in self._written.items()}
        journal = {"written": written, "removed": self._removed}
        write_text(self.folder / JOURNAL, json.dumps(journal))
        self._written.clear()  # from now on the journal lists them
        finish_replacement(self.folder)

    def discard(self) -> None:
        """Remove new files that were not committed."""
        for path in self._written.values():
            _remove(path)


@contextmanager
def replaced_together(folder: Path) -> Iterator[Replacement]:
    """Yield a `Replacement` and commit it at the end. When the block raises, nothing changes.

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
    """Return whether files of a folder are still to be renamed."""
    return os.path.lexists(folder / JOURNAL)


def check_replaced(folder: Path) -> None:
    """Wait, without writing, until a writer has renamed its finished files.

    Raises:
        InputError: the writer was killed meanwhile.
    """
    deadline = clock.monotonic() + LONGEST_WAIT
    while replacement_pending(folder):
        if clock.monotonic() > deadline:
            what = f"a killed tkamb left finished files that are not in place ({JOURNAL})"
            hint = f"`tkamb report {folder}`, or the same run with resume=True, completes them"
            raise InputError(what, folder, hint)
        clock.sleep(0.02)


def finish_replacement(folder: Path) -> None:
    """Rename the files that a folder's journal lists. Without a journal, do nothing.

    The call can be repeated, but only by the process that has claimed the folder.

    Raises:
        InputError: the journal is damaged, or the folder cannot be written.
    """
    journal = folder / JOURNAL
    if not replacement_pending(folder):
        return
    with undamaged(journal, "remove it"):
        content = read_json(journal)
        written, removed = dict(content["written"]), list(content["removed"])
        if not OUTPUT_NAMES.issuperset([*written, *removed]):
            raise ValueError("it names a file that is not tkamb's")
        if not all(TEMPORARY.fullmatch(name) for name in written.values()):
            raise ValueError("it names a file that is not temporary")
    try:
        for name, temporary in written.items():
            with suppress(FileNotFoundError):  # already renamed
                os.replace(folder / temporary, folder / name)
        for name in removed:
            (folder / name).unlink(missing_ok=True)
        journal.unlink(missing_ok=True)
    except OSError as error:
        what = f"results could not be renamed ({_reason(error)})"
        raise InputError(what, folder, f"finish with `tkamb report {folder}`") from None


@contextmanager
def undamaged(path: str | Path, hint: str = "run it again") -> Iterator[None]:
    """Raise "is damaged: what" for any failure to read a file that tkamb wrote.

    This is the boundary of all readers of results and kept work: inside, tkamb's own form is
    assumed.

    Args:
        hint: what to do.

    Raises:
        InputError: the block raises.
    """
    try:
        yield
    except InputError:
        raise
    except MemoryError:
        raise InputError("needs more memory than there is", path, hint) from None
    except Exception as error:
        words = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
        lines = words.splitlines() or [type(error).__name__]
        raise InputError(f"is damaged: {lines[0][:200]}", path, hint) from None


def claim_directory(path: str | Path) -> Path:
    """Make the output folder and check that it can be written.

    Raises:
        InputError: the path is a file, or the folder cannot be made or written.
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
    """A failure is ignored, because its cause has been reported."""
    with suppress(OSError, ValueError):
        path.unlink(missing_ok=True)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
