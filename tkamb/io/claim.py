"""Ownership of output folders: a folder is tkamb's own, and one process at a time writes to it.

The file `.tkamb` marks a folder as tkamb's own. A process that writes holds a lock on it (flock).
The system releases the lock when the process ends for any reason. tkamb uses a folder with other
files only if the user asks for it, and removes only files that it names itself. The files in a
folder also show which command wrote there, so that no command overwrites or mixes another's output.
"""

import fcntl
import json
import os
import re
import secrets
import stat
import threading
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tkamb import __version__
from tkamb.errors import InputError
from tkamb.files import (
    FILE_LIMITS,
    MARKER,
    claim_directory,
    finish_replacement,
    folder_token,
    read_json,
    read_text,
    replacement_pending,
)

WRITTEN = {
    "uncertainty": ("bands.csv",),
    "run": ("results.csv",),
    "tradeoff": ("tradeoff.json",),
    "stability": ("stability.json",),
    "cohort": ("cohort.json",),
    "wear": ("wear.json", ".wear.npz"),
}
"""Command -> files that only it writes; results.csv is from `uncertainty` if there is a bands.csv.

The page of `compare` and the maps of `export --vtp` have other names and fit into any folder.
"""
BESIDE = {"wear": {"run", "uncertainty"}, "run": {"wear"}, "uncertainty": {"wear"}}
"""Command -> commands whose folder it may share: their file names differ, and the page of a run
shows its wear."""


def occupants(folder: Path) -> dict[str, str]:
    """Return command -> the file that says that its output, finished or under way, is there."""
    result = {
        command: name
        for command, names in WRITTEN.items()
        for name in names
        if (folder / name).is_file()
    }
    for command, name in (_frames_of(folder), _rows_of(folder)):
        if command:
            result.setdefault(command, name)
    if "uncertainty" in result:
        result.pop("run", None)
    return result


def check_occupants(folder: Path, command: str) -> None:
    """Raise an InputError where a folder holds another command's output than may be beside this."""
    foreign = {
        other: name
        for other, name in occupants(folder).items()
        if other != command and other not in BESIDE.get(command, ())
    }
    for other, name in foreign.items():
        what = f"holds what `tkamb {other}` wrote ({name})"
        raise InputError(what, folder, "choose another directory, or give force=True")


def _frames_of(folder: Path) -> tuple[str, str]:
    """Return the command whose unfinished run is kept in a folder, and its file."""
    name = ".frames/run.json"
    try:
        result = read_json(folder / name)
    except InputError:
        return "", name
    if not isinstance(result, dict):
        return "", name
    if "table of runs" in result:
        return "cohort", name
    return ("uncertainty" if "method of sampling" in result else "run"), name


def _rows_of(folder: Path) -> tuple[str, str]:
    """Return the command whose unfinished study is kept in a folder, and its file."""
    name = "rows.jsonl"
    if any((folder / done).is_file() for done in ("tradeoff.json", "stability.json")):
        return "", name
    try:
        first = read_text(folder / name, FILE_LIMITS.table_bytes).partition("\n")[0]
    except InputError:
        return "", name
    if not first.startswith('{"key": '):
        return "", name
    return ("stability" if re.search(r'"row": \{[^{}]*"kind": ', first) else "tradeoff"), name


CHOOSE = "choose another directory"
LONGEST_WAIT = 5.0
"""s: longest time that a reader waits for a writer that is moving finished files into place."""

_held: set[tuple[int, int, int]] = set()
"""(thread, device, inode) of the folders that this process holds."""


@contextmanager
def claimed_directory(path: str | Path, force: bool = False, command: str = "") -> Iterator[Path]:
    """Lock an output folder that can be written, is tkamb's own and is used by no other process.

    Unfinished work of a killed process is finished or removed. After bad input the folder is as
    it was before: new files and folders are removed. A thread may claim a folder that it holds
    already.

    Args:
        path: of the folder; made if it is not there.
        force: use it even if it holds other files, which are not changed, or another command's
        output.
        command: tkamb command that writes there; empty: output of any command may be there.

    Raises:
        InputError: it cannot be made or written, is not tkamb's, holds another command's output
            (`tkamb.io.claim`), or another process holds it; or from the block.
    """
    path = Path(path)
    new_folders = [folder for folder in (path, *path.parents) if not _exists(folder)]
    fresh = None
    try:
        claim_directory(path)
        status = path.stat()
        key = (threading.get_ident(), status.st_dev, status.st_ino)
        if key in _held:
            yield path
            return
        _check_ours(path, force)
        fresh = not os.path.lexists(path / MARKER)
        held_before = set(os.listdir(path))
        with _holding_lock(path):
            _held.add(key)
            try:
                _mark(path)
                finish_replacement(path)
                _remove_temporaries(path)
                if command and not force:
                    check_occupants(path, command)
                yield path
            except InputError:
                # The kept part of an interrupted computation keeps the marker, so that it can go
                # on.
                if fresh and set(os.listdir(path)) - {MARKER} <= held_before:
                    (path / MARKER).unlink(missing_ok=True)
                raise
            finally:
                _held.discard(key)
    except InputError:
        with suppress(OSError, ValueError):  # no longer empty, or never made
            for folder in new_folders:
                folder.rmdir()
        raise


def settle(folder: Path) -> None:
    """Finish the interrupted file changes of a killed process in a folder, before it is read.

    Raises:
        InputError: it cannot be finished.
    """
    deadline = clock.monotonic() + LONGEST_WAIT
    while replacement_pending(folder):
        try:
            with _holding_lock(folder):
                finish_replacement(folder)
        except BusyFolderError:  # the one who holds it is about to finish it
            if clock.monotonic() > deadline:
                raise
            clock.sleep(0.02)


class BusyFolderError(InputError):
    """Another process writes into the folder."""


@contextmanager
def _holding_lock(path: Path) -> Iterator[None]:
    """Hold the lock of a folder's marker, which is made if it is not there."""
    descriptor = _acquire_lock(path)
    try:
        yield
    finally:
        os.close(descriptor)


def _acquire_lock(path: Path) -> int:
    marker = path / MARKER
    while True:
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            descriptor = os.open(marker, flags, 0o644)
        except OSError as error:
            raise InputError(f"cannot be opened ({error.strerror})", marker, CHOOSE) from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            what = "another tkamb is writing into this folder"
            raise BusyFolderError(what, path, f"wait for it, or {CHOOSE}") from None
        except OSError as error:
            os.close(descriptor)
            what = f"cannot be locked ({error.strerror})"
            raise InputError(what, marker, CHOOSE) from None
        # The process that held the lock before may have removed the marker. The lock is then on a
        # file that no other process can find.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), marker.lstat()):
                return descriptor
        os.close(descriptor)


def _mark(path: Path) -> None:
    """Write the marker if it says nothing yet."""
    if folder_token(path):
        return
    content = {
        "tkamb": __version__,
        "token": secrets.token_hex(8),
        "note": "tkamb writes its results into this folder and may replace them",
    }
    marker = path / MARKER
    try:
        with open(marker, "r+", encoding="utf-8") as file:  # in place: its inode has the lock
            file.truncate()
            file.write(json.dumps(content) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", marker, CHOOSE) from None


def _remove_temporaries(path: Path) -> None:
    """Remove the unfinished temporary files of a killed process; they contain our token."""
    token = folder_token(path)
    for entry in path.glob(f".tkamb-{token}-*.part"):
        if stat.S_ISREG(entry.lstat().st_mode):
            entry.unlink(missing_ok=True)


def _check_ours(path: Path, force: bool) -> None:
    """Raise if a folder holds things and none of them says that it is tkamb's."""
    if force or is_ours(path):
        return
    others = sorted(entry.name for entry in path.iterdir())
    if others:
        what = f"is not empty and not tkamb's own (it holds {others[0]!r})"
        raise InputError(what, path, "choose another directory, or give force=True")


def is_ours(path: Path) -> bool:
    """Say whether tkamb has written into a folder before: this release or an earlier one.

    Releases before the marker left a summary.json that names tkamb's version, the identity of
    an unfinished run, or the rows of a study.
    """
    if (path / MARKER).is_file() and not (path / MARKER).is_symlink():
        return True
    versions = _object(path / "summary.json").get("versions")
    if isinstance(versions, dict) and "tkamb" in versions:
        return True
    if "version of tkamb" in _object(path / ".frames" / "run.json"):
        return True
    try:
        rows = read_text(path / "rows.jsonl", FILE_LIMITS.table_bytes)
    except InputError:
        return False
    return rows.startswith('{"key": ') and '"row": ' in rows.partition("\n")[0]


OWN_MARK = b"tkamb"
"""Bytes at the beginning of every page, map and deck that tkamb writes."""
MARK_WITHIN = 4096
"""Number of bytes at the beginning of a file in which the mark is searched."""
PICTURES = {".png": b"\x89PNG", ".gif": b"GIF8"}
"""Formats without a mark: a picture takes the place of a picture."""


def check_output_file(path: str | Path | None, force: bool = False) -> None:
    """Raise unless a file may be written here: its place is free, or holds one of tkamb's own.

    Args:
        path: of the file; None: none is written.
        force: replace whatever file is there.

    Raises:
        InputError: there is a file that tkamb did not write, or something that is no file.
    """
    if path is None or not os.path.lexists(path):
        return
    path = Path(path)
    if not path.is_file():
        raise InputError("exists already and is not a file", path, "give another name")
    if force or path.suffix.lower() == ".mp4":
        return
    try:
        with open(path, "rb") as file:
            head = file.read(MARK_WITHIN)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path, "give another name") from None
    magic = PICTURES.get(path.suffix.lower())
    if not head or (OWN_MARK in head if magic is None else head.startswith(magic)):
        return
    what = "exists already, and tkamb did not write it"
    raise InputError(what, path, "give another name, or force=True to replace it")


def _object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; an empty one if there is none."""
    try:
        claim = read_json(path)
    except InputError:
        return {}
    return claim if isinstance(claim, dict) else {}


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a name that is too long, or with NUL: said when it is made
        return True
