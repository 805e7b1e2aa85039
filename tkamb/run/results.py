"""The results of a run: columns with one row per frame, pressure maps, and summary."""

import csv
import math
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from sys import intern
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import InputError, names_near, not_installed
from tkamb.files import TABLE_BYTES, open_regular, undamaged
from tkamb.geometry.frames import Array
from tkamb.run.columns import KINDS, RENAMED, in_a_family, ordered_names

if TYPE_CHECKING:
    from pandas import DataFrame

    from tkamb.run.maps import ContactMaps


PERCENTILES = {"p05": 5.0, "p50": 50.0, "p95": 95.0}
"""Suffix in bands.csv -> percentile of the samples, per cent."""


# 1: least number of samples. The 5th percentile of 20 samples lies between the two
# smallest.
MIN_SAMPLES = 20
# 1: largest share of failed samples. A minority is not representative.
MAX_FAILED_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Results:
    """The columns, pressure maps and summary of a run.

    Args:
        columns: name of a column -> float array with one entry per frame; `status` is a list of
            texts. Missing columns of `COLUMNS` are added as NaN (not modelled), and the order
            becomes that of `COLUMNS`.
        summary: content of summary.json (docs/results.md).
        maps: pressure maps; None without contact.
        directory: folder of the results; None: in memory only.
        bands: columns of bands.csv; empty if no inputs were varied.
        button_maps: pressure maps of the patellar button in its own frame; None: not modelled.

    Raises:
        InputError: a column is unknown, lengths differ, or time or status is missing.
    """

    columns: dict[str, Any]
    summary: dict[str, Any] = field(default_factory=dict)
    maps: "ContactMaps | None" = None
    directory: Path | None = None
    bands: dict[str, Array] = field(default_factory=dict)
    button_maps: "ContactMaps | None" = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", _complete_columns(self.columns))

    def __len__(self) -> int:
        return len(self.columns["status"])

    def __repr__(self) -> str:
        """Return a line with the numbers of frames, columns and map points."""
        failures = sum(status.startswith("failed") for status in self.status)
        contact = self.summary.get("contact") or {}
        parts = [
            f"{len(self)} frames" + (f" ({failures} failed)" if failures else ""),
            contact.get("model", "no contact"),
            f"{len(self.columns)} columns, {len(self.not_modelled)} of them not modelled",
            "no maps" if self.maps is None else f"maps of {len(self.maps.points_m)} points",
        ]
        return f"<tkamb.Results: {', '.join(parts)}>"

    def __getitem__(self, name: str) -> Array:
        """Return a numeric column (f,)."""
        if name not in self.columns:
            raise InputError(f"no column '{name}'", "results", names_near(name, self.columns))
        return self.columns[name]

    @property
    def status(self) -> list[str]:
        """The status of each frame: "ok", or reasons joined by "; "."""
        return self.columns["status"]

    @property
    def questions(self) -> list[str]:
        """The questions about unlikely inputs."""
        return list(self.summary.get("questions") or [])

    @property
    def not_modelled(self) -> tuple[str, ...]:
        """The columns without a number in any frame."""
        return tuple(
            name
            for name, values in self.columns.items()
            if KINDS.get(name) != "text" and bool(np.isnan(values).all())
        )

    def band(self, name: str) -> Array | None:
        """Return p05, p50 and p95 (3, f) of a column; None: it has no band."""
        ends = [self.bands.get(f"{name}_{end}") for end in PERCENTILES]
        result = [end for end in ends if end is not None]
        return np.array(result) if len(result) == len(ends) else None

    def band_with_discrepancy(self, name: str) -> Array | None:
        """Return p05 and p95 (2, f) of a column with input errors and discrepancy, or None."""
        ends = [self.bands.get(f"{name}_discrepancy_{end}") for end in ("p05", "p95")]
        finite = [end for end in ends if end is not None]
        return np.array(finite) if len(finite) == len(ends) else None

    def why_no_band(self, frame: int) -> str:
        """Return why a frame has no band."""
        if self.bands["failed_share"][frame] > MAX_FAILED_SHARE:
            return "more than half of the samples failed"
        return f"fewer than {MIN_SAMPLES} samples have it, use more"

    def to_dataframe(self) -> "DataFrame":
        """Return the columns as a pandas DataFrame with frames as rows.

        Raises:
            InputError: pandas is not installed.
        """
        try:
            from pandas import DataFrame
        except ImportError:
            raise not_installed("pandas", "to_dataframe", "notebook") from None
        return DataFrame(self.columns)


def _complete_columns(given: Mapping[str, Any]) -> dict[str, Any]:
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


def read_csv(path: str | Path) -> dict[str, Any]:
    """Read the columns of a results.csv of this or an earlier release."""
    columns = _read_columns(Path(path))
    for name in columns:
        if name not in KINDS and not in_a_family(name):
            raise InputError(f"unknown column '{name}'", path, names_near(name, KINDS))
    return columns


def read_bands(path: str | Path) -> dict[str, Array]:
    """Read the columns of a bands.csv."""
    return _read_columns(Path(path))


def _read_columns(path: Path) -> dict[str, Any]:
    """Return a table's columns, with the new names for those of earlier releases.

    Rows are read one by one, to save memory.
    """
    descriptor = open_regular(path, TABLE_BYTES)
    with undamaged(path), open(descriptor, encoding="utf-8", newline="") as file:
        rows = csv.reader(file)
        header = [RENAMED.get(name, name) for name in next(rows, ())]
        if not header:
            raise InputError("is empty", path, "run the scene again")
        columns: list[Any] = [[] if KINDS.get(name) == "text" else array("d") for name in header]
        for number, row in enumerate(rows, start=2):
            if len(row) != len(header):
                what = f"line {number} has {len(row)} cells, not {len(header)}"
                raise InputError(what, path)
            for name, column, cell in zip(header, columns, row, strict=True):
                column.append(_value(name, cell) if isinstance(column, array) else intern(cell))
    return {
        name: np.array(column) if isinstance(column, array) else column
        for name, column in zip(header, columns, strict=True)
    }


def _value(name: str, cell: str) -> float:
    try:
        return float(cell) if cell else math.nan
    except ValueError as error:
        raise ValueError(f"column '{name}': {error}") from None


def csv_rows(columns: Mapping[str, Any]) -> Iterator[Sequence[str]]:
    """Yield the rows of a results.csv: numbers without rounding, NaN as an empty cell."""
    yield list(columns)
    cells = [_cells(KINDS.get(name, "number"), values) for name, values in columns.items()]
    yield from zip(*cells, strict=True)


def _cells(kind: str, values: Iterable[Any]) -> Iterator[str]:
    if kind == "text":
        return map(str, values)
    text = _integer if kind == "integer" else repr
    return ("" if math.isnan(number) else text(number) for number in map(float, values))


def _integer(number: float) -> str:
    return str(int(number)) if number.is_integer() else repr(number)
