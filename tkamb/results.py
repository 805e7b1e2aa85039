"""What a run found: one row per frame, the contact maps, and where it all came from."""

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array
from tkamb.output.atomic import claim_directory, write_text
from tkamb.run.columns import COLUMNS, KINDS, is_ligament, ordered_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tkamb.output.maps_file import ContactMaps
    from tkamb.view.show import Show

__all__ = ["COLUMNS", "Results", "claim_directory", "read_results", "write_results"]

CSV_NAME, SUMMARY_NAME, REPORT_NAME = "results.csv", "summary.json", "report.html"


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

    def view(self, frame: int = 0) -> "Show":
        """Return the run to look at and turn around, which notebooks show.

        Args:
            frame: shown first.

        Raises:
            InputError: the scene is not there, or no longer what was run.
        """
        from tkamb.view.run import run_of
        from tkamb.view.show import Show

        return Show([run_of(self)], frame=frame)

    def _repr_html_(self) -> str:
        """Return the report's headline numbers, for notebooks."""
        from tkamb.output.report import headline_html

        return headline_html(self)

    def write_csv(self, path: str | Path) -> None:
        """Write results.csv, whole or not at all; NaN is an empty cell.

        Raises:
            InputError: the folder cannot be written.
        """
        write_text(Path(path), _csv_text(self.columns))


def read_results(directory: str | Path) -> Results:
    """Read what `write_results` wrote; numbers come back bit for bit.

    Raises:
        InputError: a file is missing or is not what it should be.
    """
    directory = Path(directory)
    columns = read_csv(directory / CSV_NAME)
    summary = _read_json(directory / SUMMARY_NAME)
    maps_path = directory / "contact.h5"
    maps = None
    if maps_path.exists():
        from tkamb.output.maps_file import read_maps

        maps = read_maps(maps_path)
    return Results(columns, summary, maps, directory)


def write_results(results: Results, directory: str | Path) -> None:
    """Write results.csv, summary.json and report.html, each whole or not at all.

    Maps that are in memory are written to contact.h5 too; without maps, a contact.h5 of an
    earlier run in that folder is removed, since it would pass for this run's. The shards of a
    run under way (`tkamb.output.shards`) have served and go.

    Raises:
        InputError: the folder cannot be written.
    """
    from tkamb.output.report import write_report
    from tkamb.output.shards import remove_shards

    directory = claim_directory(directory)
    write_numbers(results, directory)
    _settle_maps(results.maps, directory)
    write_report(results, directory / REPORT_NAME)
    remove_shards(directory)


def write_numbers(results: Results, directory: Path) -> None:
    """Write results.csv and summary.json, each whole or not at all.

    Raises:
        InputError: the folder cannot be written.
    """
    results.write_csv(directory / CSV_NAME)
    text = json.dumps(_plain(results.summary), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(directory / SUMMARY_NAME, text + "\n")


def read_csv(path: str | Path) -> dict[str, Any]:
    """Read the columns of a results.csv.

    Raises:
        InputError: no such file, an unknown column, a row of another length, not a number.
    """
    path = Path(path)
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    except FileNotFoundError:
        raise InputError("no such file", path, "give a folder that `tkamb run` wrote") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read ({error})", path) from None
    if not rows:
        raise InputError("is empty", path)
    header, body = rows[0], rows[1:]
    for number, row in enumerate(body, start=2):
        if len(row) != len(header):
            raise InputError(f"line {number} has {len(row)} cells, not {len(header)}", path)
    cells = list(zip(*body, strict=True)) or [() for _ in header]
    return {name: _parsed(name, values, path) for name, values in zip(header, cells, strict=True)}


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


def _csv_text(columns: Mapping[str, Any]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    cells = [[_cell(name, value) for value in values] for name, values in columns.items()]
    writer.writerows(zip(*cells, strict=True))
    return buffer.getvalue()


def _cell(name: str, value: Any) -> str:
    kind = KINDS.get(name, "number")
    if kind == "text":
        return str(value)
    if math.isnan(value):
        return ""
    if kind == "integer" and float(value).is_integer():
        return str(int(value))
    return repr(float(value))


def _parsed(name: str, cells: tuple[str, ...], path: Path) -> Any:
    if KINDS.get(name) == "text":
        return list(cells)
    if name not in KINDS and not is_ligament(name):
        raise InputError(f"unknown column '{name}'", path, names_near(name, KINDS))
    try:
        return np.array([float(cell) if cell else math.nan for cell in cells])
    except ValueError as error:
        raise InputError(f"column '{name}': {error}", path) from None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError("no such file", path) from None
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read as JSON ({error})", path) from None


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


def _settle_maps(maps: "ContactMaps | None", directory: Path) -> None:
    path = directory / "contact.h5"
    if maps is None:
        path.unlink(missing_ok=True)
        return
    if isinstance(maps.source, Path) and maps.source.absolute() == path.absolute():
        return
    from tkamb.output.maps_file import write_maps

    write_maps(maps, path)
