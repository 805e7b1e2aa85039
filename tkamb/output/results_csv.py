"""results.csv: one row per frame, one column per quantity; an empty cell holds no number."""

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.errors import InputError, names_near
from tkamb.files import TABLE_LIMIT, read_text
from tkamb.columns import KINDS, is_ligament


def read_csv(path: str | Path) -> dict[str, Any]:
    """Read the columns of a results.csv.

    Raises:
        InputError: no such file, an unknown column, a row of another length, not a number.
    """
    path = Path(path)
    try:
        rows = list(csv.reader(io.StringIO(read_text(path, TABLE_LIMIT))))
    except csv.Error as error:
        raise InputError(f"cannot be read as CSV ({error})", path) from None
    if not rows:
        raise InputError("is empty", path)
    header, body = rows[0], rows[1:]
    for number, row in enumerate(body, start=2):
        if len(row) != len(header):
            raise InputError(f"line {number} has {len(row)} cells, not {len(header)}", path)
    cells = list(zip(*body, strict=True)) or [() for _ in header]
    return {name: _parsed(name, values, path) for name, values in zip(header, cells, strict=True)}


def csv_text(columns: Mapping[str, Any]) -> str:
    """Return the text of a results.csv: numbers bit for bit, NaN as an empty cell."""
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
