"""Ownership of output folders: a folder is tkamb's own, and one process at a time writes to it.

The file `.tkamb` marks a folder as tkamb's own. A process that writes holds a lock on it (flock).
The system releases the lock when the process ends for any reason. tkamb uses a folder with foreign
files only if the user asks for it, and removes only its own files. The files in a folder also show
which command wrote them. A command does not write into a folder with another command's output.
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
"""Command -> files that show its output. `uncertainty` writes bands.csv and also results.csv.

The files of `compare` and `export --vtp` have other names and may be in any folder.
"""
BESIDE = {"wear": {"run", "uncertainty"}, "run": {"wear"}, "uncertainty": {"wear"}}
"""Command -> other commands that may write into the same folder. Their file names differ, and the
page of a run shows its wear."""


def occupants(folder: Path) -> dict[str, str]:
    """Return the commands with output in a folder, finished or not, and one file name of each."""
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
    """Raise an InputError if a folder holds the output of a command that may not share it."""
    foreign = {
        other: name
        for other, name in occupants(folder).items()
        if other != command and other not in BESIDE.get(command, ())
    }
    for other, name in foreign.items():
        what = f"holds what `tkamb {other}` wrote ({name})"
        raise InputError(what, folder, "choose another directory, or give force=True")


def _frames_of(folder: Path) -> tuple[str, str]:
    """Return the command of a folder's unfinished run ("" without one), and the run's file."""
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
    """Return the command of a folder's unfinished study ("" without one), and the study's file."""
    name = "rows.jsonl"
    if any((folder / summary).is_file() for summary in ("tradeoff.json", "stability.json")):
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
"""s: longest time that a reader waits while a writer moves finished files into place."""

_held: set[tuple[int, int, int]] = set()
"""(thread, device, inode) of each folder that this process has locked."""


@contextmanager
def claimed_directory(path: str | Path, force: bool = False, command: str = "") -> Iterator[Path]:
    """Lock an output folder for this process while the block runs.

    Unfinished file changes of a killed process are completed or removed. If the block raises an
    InputError, the new marker and new empty folders are removed. A thread may lock a folder that it
    has locked already.

    Args:
        path: the folder; it is made if it does not exist.
        force: whether the folder may hold foreign files, which stay unchanged, or another command's
            output.
        command: tkamb command that writes into the folder; "": any command's output is allowed.

    Raises:
        InputError: the folder cannot be made or written, holds foreign files or another command's
            output, or is locked by another process; or an error of the block.
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
                # The marker stays beside stored frames of an interrupted computation, which can
                # then be resumed.
                if fresh and set(os.listdir(path)) - {MARKER} <= held_before:
                    (path / MARKER).unlink(missing_ok=True)
                raise
            finally:
                _held.discard(key)
    except InputError:
        with suppress(OSError, ValueError):  # the folder is not empty, or does not exist
            for folder in new_folders:
                folder.rmdir()
        raise


def settle(folder: Path) -> None:
    """Complete a killed process's file changes in a folder, which may then be read.

    Raises:
        InputError: the changes cannot be completed.
    """
    deadline = clock.monotonic() + LONGEST_WAIT
    while replacement_pending(folder):
        try:
            with _holding_lock(folder):
                finish_replacement(folder)
        except BusyFolderError:  # the process that has the lock completes the changes
            if clock.monotonic() > deadline:
                raise
            clock.sleep(0.02)


class BusyFolderError(InputError):
    """Another process writes into the folder."""


@contextmanager
def _holding_lock(path: Path) -> Iterator[None]:
    """Lock a folder's marker while the block runs; the marker is made if it does not exist."""
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
        # The previous owner of the lock may have removed the marker. This lock is then on a
        # removed file and excludes no other process.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), marker.lstat()):
                return descriptor
        os.close(descriptor)


def _mark(path: Path) -> None:
    """Write the marker's content if it is empty."""
    if folder_token(path):
        return
    content = {
        "tkamb": __version__,
        "token": secrets.token_hex(8),
        "note": "tkamb writes its results into this folder and may replace them",
    }
    marker = path / MARKER
    try:
        with open(
            marker, "r+", encoding="utf-8"
        ) as file:  # in place: the lock belongs to its inode
            file.truncate()
            file.write(json.dumps(content) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", marker, CHOOSE) from None


def _remove_temporaries(path: Path) -> None:
    """Remove the temporary files of a killed process; their names contain the folder's token."""
    token = folder_token(path)
    for entry in path.glob(f".tkamb-{token}-*.part"):
        if stat.S_ISREG(entry.lstat().st_mode):
            entry.unlink(missing_ok=True)


def _check_ours(path: Path, force: bool) -> None:
    """Raise an InputError if a folder holds files and none of them marks it as tkamb's own."""
    if force or is_ours(path):
        return
    others = sorted(entry.name for entry in path.iterdir())
    if others:
        what = f"is not empty and not tkamb's own (it holds {others[0]!r})"
        raise InputError(what, path, "choose another directory, or give force=True")


def is_ours(path: Path) -> bool:
    """Return whether a folder holds tkamb's marker file or its output.

    Releases without the marker are recognised by a summary.json with tkamb's version, by the file
    of an unfinished run, or by the rows of a study.
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
"""Mark near the beginning of every page, map and deck that tkamb writes."""
MARK_WITHIN = 4096
"""Number of bytes at the beginning of a file that are searched for the mark."""
PICTURES = {".png": (0, b"\x89PNG"), ".gif": (0, b"GIF8"), ".mp4": (4, b"ftyp")}
"""Suffix of a picture or film -> (offset, bytes) that identify its format. Pictures and films have
no mark of tkamb. One may therefore replace any other of its format."""


def check_output_file(path: str | Path | None, force: bool = False) -> None:
    """Raise an InputError if writing an output file would replace a file that tkamb did not write.

    Args:
        path: the output file; None: no file is written.
        force: whether any file may be replaced.

    Raises:
        InputError: the path is not a file, or holds a file that tkamb did not write.
    """
    if path is None or not os.path.lexists(path):
        return
    path = Path(path)
    if not path.is_file():
        raise InputError("exists already and is not a file", path, "give another name")
    if force:
        return
    try:
        with open(path, "rb") as file:
            head = file.read(MARK_WITHIN)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path, "give another name") from None
    offset, magic = PICTURES.get(path.suffix.lower(), (0, None))
    if not head or (OWN_MARK in head if magic is None else head.startswith(magic, offset)):
        return
    what = "exists already, and tkamb did not write it"
    raise InputError(what, path, "give another name, or force=True to replace it")


def _object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file, or {} if the file is unreadable or holds no object."""
    try:
        content = read_json(path)
    except InputError:
        return {}
    return content if isinstance(content, dict) else {}


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # `mkdir` later reports a name that is too long or has a NUL.
        return True
