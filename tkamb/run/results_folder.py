"""Results folders: writing, reading, and verification by SHA-256."""

import hashlib
import json
import math
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb import __version__
from tkamb.errors import InputError, must_be
from tkamb.files import (
    MEGABYTE,
    Replacement,
    check_replaced,
    read_json,
    replaced_together,
    sha256_of,
    write_rows,
    write_synced,
)
from tkamb.io.claim import claimed_directory
from tkamb.run.columns import COLUMNS, FAMILIES, KINDS, belongs
from tkamb.run.results import Results, csv_rows, read_bands, read_csv

if TYPE_CHECKING:
    from tkamb.run.maps import ContactMaps

FOLDER = ".frames"
IDENTITY_NAME = "run.json"
OWN_NAMES = (IDENTITY_NAME, "contact.h5", "button.h5", "*.frame", ".tkamb-*.part")
"""Patterns of the files in `.frames`. No other file is removed from it."""
CSV_NAME, SUMMARY_NAME, REPORT_NAME = "results.csv", "summary.json", "report.html"
MAPS_NAME, BUTTON_NAME = "contact.h5", "button.h5"
METADATA_NAME = "results.csv-metadata.json"
BANDS_NAME, TORNADO_NAME, SAMPLES_NAME = "bands.csv", "tornado.csv", "samples.h5"
INDICES_NAME = "indices.csv"
UNCERTAINTY_NAMES = (BANDS_NAME, TORNADO_NAME, SAMPLES_NAME, INDICES_NAME)
"""Files of an uncertainty study, which new results without a study remove."""
SUMMARY_LIMIT = 256 * MEGABYTE
"""bytes: largest size of summary.json, which has an entry for each failed frame."""


def read_results(directory: str | Path, *, check: bool = True) -> Results:
    """Read results from a folder. The numbers are exactly the written ones.

    Args:
        check: whether to compare the files with the SHA-256 in summary.json.

    Raises:
        InputError: a file is missing, has a wrong format, or has changed since it was written.
    """
    must_be(directory, (str, os.PathLike), "read_results", "give the folder of a run")
    directory = Path(directory)
    check_replaced(directory)
    if not os.path.exists(directory / CSV_NAME):  # unlike Path.exists, it never raises
        hint = "give a folder that `tkamb run` wrote"
        if os.path.exists(scene := directory / "scene.toml"):
            hint = f"run its scene first (`tkamb run {scene}`), and give the output folder"
        raise InputError(f"holds no {CSV_NAME}", directory, hint)
    columns = read_csv(directory / CSV_NAME)
    if not len(next(iter(columns.values()), ())):
        raise InputError("holds no frame", directory / CSV_NAME, "run it again")
    for name in ("time_s", "flexion_deg"):
        if name in columns and not np.isfinite(np.asarray(columns[name], float)).all():
            raise InputError(f"'{name}' is not a number", directory / CSV_NAME, "run it again")
    summary = read_summary(directory)
    if check and (changes := differences(directory, summary)):
        raise InputError(changes[0], directory, "`tkamb verify` lists all changes; run it again")
    frames, complete = len(next(iter(columns.values()))), not summary.get("unfinished_frames")
    maps, button = (
        _read_maps(directory / name, frames if complete else 0) for name in (MAPS_NAME, BUTTON_NAME)
    )
    has_bands = (directory / BANDS_NAME).exists()
    bands = read_bands(directory / BANDS_NAME) if has_bands else {}
    return Results(columns, summary, maps, directory, bands, button)


def _read_maps(path: Path, frames: int) -> "ContactMaps | None":
    if not path.exists():
        return None
    from tkamb.run.maps import read_maps

    maps = read_maps(path)
    if len(maps) < frames:
        what = f"has {len(maps)} frames, but {CSV_NAME} has {frames}"
        raise InputError(what, path, "run it again")
    return maps


def read_summary(directory: Path) -> dict[str, Any]:
    """Return the content of a folder's summary.json."""
    path = directory / SUMMARY_NAME
    summary = read_json(path, SUMMARY_LIMIT, what="summary of a run")
    if not isinstance(summary, dict):
        raise InputError("is not a JSON object", path, "give a folder that `tkamb run` wrote")
    return summary


def differences(directory: Path, summary: Mapping[str, Any]) -> list[str]:
    """Return messages on changed files of a folder; none for a release without SHA-256."""
    messages, recorded = [], summary.get("files")
    if not isinstance(recorded, Mapping):
        return []
    if summary.get("summary_sha256") != _summary_hash(summary):
        messages.append(f"{SUMMARY_NAME} has changed since it was written")
    for name in (CSV_NAME, MAPS_NAME, BUTTON_NAME, *UNCERTAINTY_NAMES):
        exists = (directory / name).exists()
        if exists and name not in recorded:
            messages.append(f"{name} does not belong to these results")
        elif not exists and name in recorded:
            messages.append(f"{name} is missing")
        elif exists and sha256_of(directory / name) != recorded[name]:
            messages.append(f"{name} has changed since it was written")
    return messages


def write_results(
    results: Results,
    directory: str | Path,
    *,
    force: bool = False,
    more: Mapping[str, Callable[[Path], object]] | None = None,
    report: Callable[[Results], str] | None = None,
) -> None:
    """Write results.csv, summary.json, contact.h5 and a report.html: all of them or none.

    Files of an earlier run in the folder are replaced or removed, and `.frames` is removed.

    Args:
        directory: path of the folder, which is created if it does not exist.
        force: whether to write into a folder with files that are not tkamb's.
        more: name in `UNCERTAINTY_NAMES` -> function that writes the file at a path. Other files of
            these names are removed.
        report: function that returns the page report.html; None: the folder has no report.
    """
    if BANDS_NAME not in (more or {}):
        results = replace(results, bands={})  # the report must not show bands without their file
    with claimed_directory(directory, force, "run") as folder:
        with replaced_together(folder) as files:
            _put_maps(results.maps, MAPS_NAME, files)
            _put_maps(results.button_maps, BUTTON_NAME, files)
            for name, write in (more or {}).items():
                write(files.path(name))
            put_numbers(results, files)
            if report is None:
                files.remove(REPORT_NAME)
            else:
                write_synced(files.path(REPORT_NAME), report(results))
        remove_shards(folder)


def put_numbers(results: Results, files: Replacement) -> None:
    """Write results.csv, and summary.json with the SHA-256 of the files beside it.

    Args:
        files: replacement of the folder's files, whose contact.h5 is kept if it has none, unlike
            old files of `UNCERTAINTY_NAMES`.
    """
    write_rows(files.path(CSV_NAME), csv_rows(results.columns))
    write_synced(files.path(METADATA_NAME), table_metadata(results.columns, results.summary))
    recorded = {CSV_NAME: sha256_of(files.path(CSV_NAME))}
    for name, maps in ((MAPS_NAME, results.maps), (BUTTON_NAME, results.button_maps)):
        if maps is None:
            files.remove(name)
        else:
            recorded[name] = sha256_of(files.current(name))
    for name in UNCERTAINTY_NAMES:
        if files.current(name) == files.folder / name:  # a file of an earlier run
            files.remove(name)
        else:
            recorded[name] = sha256_of(files.current(name))
    summary = _plain(results.summary) | {"files": recorded}
    summary["summary_sha256"] = _summary_hash(summary)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    write_synced(files.path(SUMMARY_NAME), text + "\n")


def _summary_hash(summary: Mapping[str, Any]) -> str:
    content = {key: value for key, value in summary.items() if key != "summary_sha256"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def _put_maps(maps: "ContactMaps | None", name: str, files: Replacement) -> None:
    if maps is None:
        return
    if isinstance(maps.source, Path) and maps.source.absolute() == files.current(name).absolute():
        return
    from tkamb.run.maps import write_maps

    write_maps(maps, files.path(name))


def remove_shards(directory: Path, name: str = FOLDER) -> None:
    """Remove the finished frames' files, the identity of their run first."""
    folder = directory / name
    if folder.is_symlink():
        return
    for name in OWN_NAMES:
        for path in folder.glob(name):
            path.unlink(missing_ok=True)
    with suppress(OSError):  # it does not exist, or it has files that are not tkamb's
        folder.rmdir()


UNITS = {
    "N_per_mm": "N/mm",
    "N_per_deg": "N/deg",
    "mm_per_s": "mm/s",
    "seconds": "s",
    "percent": "%",
    "mm2": "mm²",
    "Nm": "N·m",
    **{unit: unit for unit in ("N", "mm", "MPa", "deg", "s", "BW")},
}
"""End of a column's name -> its unit. Longer ends come first."""
DATATYPES = {"text": "string", "integer": "integer"}


def unit_of(column: str) -> str:
    """Return the unit of a column; "1": a share, a number or a text."""
    if "_per_dome_mm_" in column:
        return "N/mm"
    return next((unit for end, unit in UNITS.items() if column.endswith(f"_{end}")), "1")


def table_metadata(columns: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Return the content of results.csv-metadata.json: name, unit and meaning of each column.

    It is a file of its own, because a comment above the header would stop readers of CSV. Source:
    W3C, Metadata Vocabulary for Tabular Data (2015), section 5.
    """
    meanings = {one.name: one.meaning for one in COLUMNS}
    rows = []
    for name in columns:
        family = next((one for one in FAMILIES if belongs(name, one)), name)
        rows.append(
            {
                "titles": name,
                "dc:description": meanings.get(name, meanings.get(family, "")),
                "schema:unitText": unit_of(name),
                "datatype": DATATYPES.get(KINDS.get(name, "number"), "number"),
            }
        )
    content = {
        "@context": ["http://www.w3.org/ns/csvw", {"@language": "en"}],
        "url": "results.csv",
        "dc:creator": f"tkamb {summary.get('versions', {}).get('tkamb', __version__)}",
        "dc:license": summary.get("licence") or "not stated",
        "dc:source": f"scene SHA-256 {summary.get('scene_sha256')}",
        "dialect": {"header": True, "delimiter": ",", "encoding": "utf-8"},
        "tableSchema": {"columns": rows},
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"
