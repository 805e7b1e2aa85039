"""What a run found: one row per frame, the contact maps, and where it all came from."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import InputError, names_near
from tkamb.files import MEGABYTE, read_json, sha256_of
from tkamb.geometry.frames import Array
from tkamb.atomic import (
    Replacement,
    claim_directory,
    replaced_together,
    write_synced,
    write_text,
)
from tkamb.claim import claimed_directory, settle
from tkamb.output.results_csv import csv_text, read_csv
from tkamb.columns import COLUMNS, KINDS, ordered_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tkamb.output.maps import ContactMaps

__all__ = ["COLUMNS", "Results", "claim_directory", "read_results", "write_results"]

CSV_NAME, SUMMARY_NAME, REPORT_NAME = "results.csv", "summary.json", "report.html"
MAPS_NAME = "contact.h5"
SUMMARY_LIMIT = 256 * MEGABYTE
"""Bytes of a summary: a line for every failed frame."""


@dataclass(frozen=True, eq=False)
class Results:
    """The time series, maps and provenance of a run.

    Args:
        columns: column name -> one entry per frame: float arrays, and `status` as a list of
            texts. Columns of the table `COLUMNS` that are not given are not modelled and
            hold NaN; the order becomes the table's.
        summary: provenance and notes, JSON-able; the keys that the report reads are listed
            in `tkamb.output.provenance`.
        maps: pressure maps per frame; None without contact.
        directory: where it was written to or read from.

    Raises:
        InputError: an unknown column, columns of different lengths, or no time or status.
    """

    columns: dict[str, Any]
    summary: dict[str, Any] = field(default_factory=dict)
    maps: "ContactMaps | None" = None
    directory: Path | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", _completed(self.columns))

    def __len__(self) -> int:
        return len(self.columns["status"])

    def __getitem__(self, name: str) -> Array:
        """Return a numeric column (f,).

        Raises:
            InputError: no such column; the message lists the nearest names.
        """
        if name not in self.columns:
            raise InputError(f"no column '{name}'", "results", names_near(name, self.columns))
        return self.columns[name]

    @property
    def status(self) -> list[str]:
        """Return the status of each frame: "ok" or reason words joined by ;."""
        return self.columns["status"]

    @property
    def not_modelled(self) -> tuple[str, ...]:
        """Return the columns that hold no number in any frame."""
        return tuple(
            name
            for name, values in self.columns.items()
            if KINDS.get(name) != "text" and bool(np.isnan(values).all())
        )

    def plot(self, *names: str, axis: str | None = None) -> "Figure":
        """Return plots of the run in one matplotlib figure, which notebooks show.

        Args:
            names: ids of the report's plots ("forces", "condyles", "pressures", ...);
                default: forces, condyles, ratios and pressures.
            axis: "flexion", "cycle" or "time"; default: as the scene asks.

        Raises:
            InputError: a plot or an axis that does not exist.
        """
        from tkamb.output.plots import plot

        return plot(self, names, axis)

    def _repr_html_(self) -> str:
        """Return the report's headline numbers, for notebooks."""
        from tkamb.output.report import headline_html

        return headline_html(self)

    def write_csv(self, path: str | Path) -> None:
        """Write results.csv, whole or not at all; NaN is an empty cell.

        Raises:
            InputError: the folder cannot be written.
        """
        write_text(Path(path), csv_text(self.columns))


def read_results(directory: str | Path, *, check: bool = True) -> Results:
    """Read what `write_results` wrote; numbers come back bit for bit.

    What a kill left to be put in place is put there first.

    Args:
        directory: the folder.
        check: hold the files against the SHA-256 in summary.json.

    Raises:
        InputError: a file is missing, is not what it should be, or not what was written.
    """
    directory = Path(directory)
    settle(directory)
    columns = read_csv(directory / CSV_NAME)
    summary = read_summary(directory)
    maps = None
    if (directory / MAPS_NAME).exists():
        from tkamb.output.maps import read_maps

        maps = read_maps(directory / MAPS_NAME)
    if check and (found := differences(directory, summary)):
        raise InputError(found[0], directory, "`tkamb verify` tells all; run it again")
    return Results(columns, summary, maps, directory)


def read_summary(directory: Path) -> dict[str, Any]:
    """Return a folder's summary.json.

    Raises:
        InputError: no such file, or not a JSON object.
    """
    path = directory / SUMMARY_NAME
    found = read_json(path, SUMMARY_LIMIT, what="summary of a run")
    if not isinstance(found, dict):
        raise InputError("is no JSON object", path, "is it a folder that `tkamb run` wrote?")
    return found


def differences(directory: Path, summary: Mapping[str, Any]) -> list[str]:
    """Return in words what of a folder's files is not what was written with the summary.

    Results of a release that kept no SHA-256 differ in nothing that could be known.
    """
    said, recorded = [], summary.get("files")
    if not isinstance(recorded, Mapping):
        return []
    if summary.get("summary_sha256") != _summary_hash(summary):
        said.append(f"{SUMMARY_NAME} has changed since it was written")
    for name in (CSV_NAME, MAPS_NAME):
        there = (directory / name).exists()
        if there and name not in recorded:
            said.append(f"{name} does not belong to these results")
        elif not there and name in recorded:
            said.append(f"{name} is missing")
        elif there and sha256_of(directory / name) != recorded[name]:
            said.append(f"{name} has changed since it was written")
    return said


def write_results(results: Results, directory: str | Path, *, force: bool = False) -> None:
    """Write results.csv, summary.json, contact.h5 and report.html: all of them or none.

    Without maps, a contact.h5 of an earlier run in that folder is removed, since it would pass
    for this run's. The shards of a run under way (`tkamb.run.shards`) have served and go.

    Args:
        results: what to write.
        directory: the folder; made if it is not there.
        force: write even into a folder that holds things that are not tkamb's.

    Raises:
        InputError: the folder cannot be claimed (`tkamb.claim`) or written.
    """
    from tkamb.output.report import report_html
    from tkamb.run.shards import remove_shards

    with claimed_directory(directory, force) as folder:
        with replaced_together(folder) as files:
            _put_maps(results.maps, files)
            put_numbers(results, files)
            write_synced(files.path(REPORT_NAME), report_html(results))
        remove_shards(folder)


def put_numbers(results: Results, files: Replacement) -> None:
    """Write results.csv and summary.json with what becomes results.csv's and contact.h5's SHA-256.

    Args:
        results: what to write.
        files: among which a new contact.h5 is already; else the one in place is kept.
    """
    write_synced(files.path(CSV_NAME), csv_text(results.columns))
    recorded = {CSV_NAME: sha256_of(files.path(CSV_NAME))}
    if results.maps is None:
        files.remove(MAPS_NAME)
    else:
        recorded[MAPS_NAME] = sha256_of(files.current(MAPS_NAME))
    summary = _plain(results.summary) | {"files": recorded}
    summary["summary_sha256"] = _summary_hash(summary)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    write_synced(files.path(SUMMARY_NAME), text + "\n")


def _summary_hash(summary: Mapping[str, Any]) -> str:
    """Return the SHA-256 of all of a summary but this."""
    content = {key: value for key, value in summary.items() if key != "summary_sha256"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _completed(given: Mapping[str, Any]) -> dict[str, Any]:
    names = ordered_names(given)
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise InputError(f"unknown column '{unknown[0]}'", "results", names_near(unknown[0], KINDS))
    for needed in ("time_s", "status"):
        if needed not in given:
            raise InputError(f"column '{needed}' is missing", "results")
    frames = len(given["status"])
    columns: dict[str, Any] = {}
    for name in names:
        if KINDS.get(name) == "text":
            columns[name] = [str(value) for value in given[name]]
        else:
            columns[name] = np.array(given.get(name, np.full(frames, np.nan)), float)
        if np.shape(columns[name]) != (frames,):
            shape = np.shape(columns[name])
            raise InputError(f"column '{name}' is {shape}, not one of {frames} frames", "results")
    return columns


def _plain(value: Any) -> Any:
    """Return the value with numpy, paths and NaN turned into what JSON has."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def _put_maps(maps: "ContactMaps | None", files: Replacement) -> None:
    """Write maps that are not in their place already."""
    if maps is None:
        return
    if (
        isinstance(maps.source, Path)
        and maps.source.absolute() == files.current(MAPS_NAME).absolute()
    ):
        return
    from tkamb.output.maps import write_maps

    write_maps(maps, files.path(MAPS_NAME))
