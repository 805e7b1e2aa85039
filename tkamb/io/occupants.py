"""Which commands' output a folder holds, so that no command overwrites or mixes another's."""

import re
from pathlib import Path

from tkamb.errors import InputError
from tkamb.files import FILE_LIMITS, read_json, read_text

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
        raise InputError(what, folder, "choose another folder with --out, or give --force")


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
