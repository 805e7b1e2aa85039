"""Ownership of output folders: a folder is tkamb's own, and one process at a time writes to it.

The file `.tkamb` marks a folder, and a process that writes locks it (filelock), until it ends for
any reason. tkamb uses a folder with foreign files only if the user asks for it, and removes only
its own files. A command does not write into a folder with another command's files.
"""

import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from tkamb.errors import InputError
from tkamb.files import (
    MARKER,
    TABLE_BYTES,
    TEMPORARY,
    claim_directory,
    finish_replacement,
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
"""Command -> others that may write into the same folder, under other names; a run's page shows its
wear.
"""


def occupants(folder: Path) -> dict[str, str]:
    """Return the commands with output in a folder, and one file name of each."""
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
    """Raise an InputError if another command's output may not share a folder."""
    foreign = {
        other: name
        for other, name in occupants(folder).items()
        if other != command and other not in BESIDE.get(command, ())
    }
    for other, name in foreign.items():
        what = f"holds what `tkamb {other}` wrote ({name})"
        raise InputError(what, folder, "choose another directory, or give force=True")


def _frames_of(folder: Path) -> tuple[str, str]:
    """Return the command of an unfinished run ("" without one), and its file."""
    name = ".frames/run.json"
    content = _object(folder / name)
    if "table of runs" in content:
        return "cohort", name
    if "method of sampling" in content:
        return "uncertainty", name
    return ("run" if content else ""), name


def _rows_of(folder: Path) -> tuple[str, str]:
    """Return the command of an unfinished study ("" without one), and its file."""
    name = "rows.jsonl"
    try:
        first = read_text(folder / name, TABLE_BYTES).partition("\n")[0]
    except InputError:
        return "", name
    if not first.startswith('{"key": '):
        return "", name
    return ("stability" if re.search(r'"row": \{[^{}]*"kind": ', first) else "tradeoff"), name


CHOOSE = "choose another directory"


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
    """
    path = Path(path)
    new_folders = [folder for folder in (path, *path.parents) if not _exists(folder)]
    try:
        claim_directory(path)
        lock = FileLock(path.absolute() / MARKER, is_singleton=True)
        if lock.is_locked:
            yield path
            return
        _check_ours(path, force)
        fresh, held_before = not os.path.lexists(path / MARKER), set(os.listdir(path))
        with _holding(lock, path):
            try:
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
    except InputError:
        with suppress(OSError, ValueError):  # the folder is not empty, or does not exist
            for folder in new_folders:
                folder.rmdir()
        raise


def settle(folder: Path) -> None:
    """Complete a killed process's file changes in tkamb's folder."""
    if replacement_pending(folder):
        with claimed_directory(folder):
            pass


@contextmanager
def _holding(lock: FileLock, path: Path) -> Iterator[None]:
    """The marker is made if it does not exist."""
    marker = path / MARKER
    with suppress(FileNotFoundError):
        status = marker.lstat()
        if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
            raise InputError("is a link or no file", marker, "remove it: it is not tkamb's")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        hint = f"wait for it, or {CHOOSE}"
        raise InputError("another tkamb is writing into this folder", path, hint) from None
    except OSError as error:
        raise InputError(f"cannot be locked ({error.strerror})", marker, CHOOSE) from None
    try:
        yield
    finally:
        lock.release()


def _remove_temporaries(path: Path) -> None:
    for entry in path.iterdir():
        if TEMPORARY.fullmatch(entry.name) and stat.S_ISREG(entry.lstat().st_mode):
            entry.unlink(missing_ok=True)


def _check_ours(path: Path, force: bool) -> None:
    if force or is_ours(path):
        return
    others = sorted(entry.name for entry in path.iterdir())
    if others:
        what = f"is not empty and not tkamb's own (it holds {others[0]!r})"
        raise InputError(what, path, "choose another directory, or give force=True")


def is_ours(path: Path) -> bool:
    """Return whether a folder holds tkamb's marker file or its output.

    Without the marker, a summary.json with tkamb's version, an unfinished run's file or a study's
    rows show it.
    """
    if os.path.lexists(path / MARKER):
        return True
    versions = _object(path / "summary.json").get("versions")
    if isinstance(versions, dict) and "tkamb" in versions:
        return True
    return bool(_frames_of(path)[0] or _rows_of(path)[0])


OWN_MARK = b"tkamb"
"""Mark near the beginning of every page, map and deck that tkamb writes."""
MARK_WITHIN = 4096
"""Bytes at the beginning of a file that are searched for the mark."""
PICTURES = {".png": (0, b"\x89PNG"), ".gif": (0, b"GIF8"), ".mp4": (4, b"ftyp")}
"""Suffix of a picture or film -> (offset, bytes) of its format. These have no mark of tkamb, so one
may replace any other of its format.
"""


def check_output_file(path: str | Path | None, force: bool = False) -> None:
    """Raise an InputError if an output file would replace one that tkamb did not write.

    Args:
        path: the output file; None: no file is written.
        force: whether any file may be replaced.
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
    """Return {} for an unreadable file, or one without an object."""
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
