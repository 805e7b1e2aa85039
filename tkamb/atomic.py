"""Files that are whole or not there: written beside their place, then renamed.

One file takes its place in one rename. Files that belong together are first all written beside
their places; then a journal that names them makes the change certain, and they are renamed. A
kill before the journal leaves the old files. After a kill with a journal, the next command that
opens the folder finishes the renames (`finish_replacement`). So a folder has the old state or the
new one.
"""

import csv
import io
import json
import os
import re
import secrets
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tkamb.errors import InputError
from tkamb.files import read_json

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
            f"output folder cannot be written ({_reason(error)})", path, "choose another with --out"
        ) from None
    return path


def _remove(path: Path) -> None:
    """Remove a file if possible; the reason of a failure was reported before."""
    with suppress(OSError, ValueError):
        path.unlink(missing_ok=True)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
