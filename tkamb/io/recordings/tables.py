"""Read recorded tables: `.csv`, OpenSim `.sto` and `.mot`, and markers of `.trc` and `.c3d`."""

import contextlib
import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tkamb.errors import InputError, names_near
from tkamb.files import BYTE_ORDER_MARKS, TABLE_BYTES, read_bytes
from tkamb.geometry.frames import Array
from tkamb.io.recordings.laboratory import GivenUnits, metres
from tkamb.units import LENGTH

# s: largest rounding of the times of a `.trc`. Cameras write milliseconds.
TRC_TIME_ROUNDING = 1e-3
# Largest number in any unit. A larger number is refused as no measurement.
MAX_VALUE = 1e12


TRC_LABELS = 3
"""Index of the line of a `.trc` with the markers' labels."""

_NOT_A_NUMBER = re.compile(r"[+-]?(nan(\(\w*\))?|1\.#(ind|qnan)0*)")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?")
"""A plain decimal number, while Python's float also accepts 1_000 and other digits."""
_NUMBER_CHARACTERS = "0123456789+-.eE "
"""Characters of plain decimal numbers."""
_INFINITE = re.compile(r"[+-]?inf(inity)?")
_COMMA_NUMBER = re.compile(r"[+-]?[0-9]*,[0-9]+([eE][+-]?[0-9]{1,3})?")
STATED_DEGREES = {"yes": True, "true": True, "1": True, "no": False, "false": False, "0": False}
"""Words after `inDegrees=` in a storage file -> whether angles are in degrees."""


@dataclass(frozen=True, eq=False)
class Table:
    """Named columns of equal length, in the units of the file.

    Args:
        columns: name -> (n,) values. A marker M of `.trc` or `.c3d` has columns M_x, M_y, M_z.
        length_unit: unit of length that the file states (`.trc`, `.c3d`), else None.
        in_degrees: whether angles are in degrees; None if the file does not state it.
        equal: names that several columns share; none of these columns is in `columns`.
        notices: remarks on unused parts and on contradictions in the file.
        unit_word: the file's word for its unit of length, known or not.
        unit_given: whether the user states the unit of length.
    """

    path: Path
    columns: dict[str, Array]
    length_unit: str | None = None
    in_degrees: bool | None = None
    equal: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    unit_given: bool = False
    unit_word: str = ""

    @property
    def remarks(self) -> tuple[str, ...]:
        """The notices, each with the name of the file."""
        return tuple(f"{self.path.name}: {notice}" for notice in self.notices)

    @property
    def rows(self) -> int:
        """Number of data rows."""
        return len(next(iter(self.columns.values())))

    def column(self, name: str) -> Array:
        """Return one column."""
        if name in self.equal:
            raise InputError(f"has two columns named '{name}'", self.path, "rename one")
        if name not in self.columns:
            hint = names_near(name, self.columns, "its header")
            raise InputError(f"has no column '{name}'", self.path, hint)
        return self.columns[name]

    def complete_column(self, name: str) -> Array:
        """Return one column, which must be finite."""
        values = self.column(name)
        gaps = np.flatnonzero(~np.isfinite(values))
        if len(gaps):
            raise InputError(
                f"column '{name}' has {len(gaps)} missing or non-finite value(s), "
                f"the first in data row {gaps[0] + 1}",
                self.path,
                "fill or cut the gap",
            )
        return values

    def time(self, name: str = "time") -> Array:
        """Return the time column, which must rise strictly.

        Raises:
            InputError: no such column, a gap, or a time that does not rise.
        """
        values = self.complete_column(name)
        falls = np.flatnonzero(np.diff(values) <= 0)
        if len(falls):
            row = int(falls[0])
            raise InputError(
                f"column '{name}' does not rise from data row {row + 1} ({values[row]:g}) "
                f"to {row + 2} ({values[row + 1]:g})",
                self.path,
                "sort the rows by time and drop duplicates",
            )
        return values

    def unit_scale(self, length_unit: str | None, key: str) -> float:
        """Return metres per unit of length of this file.

        Args:
            length_unit: unit that the scene states; None: the file's header states it.
        """
        unit = length_unit or self.length_unit
        if unit not in LENGTH:
            word = f"the unit '{self.unit_word}'" if self.unit_word else "no unit of length"
            hint = f"give '{key}' in the scene, or --length-unit to an import: m, cm or mm"
            raise InputError(f"states {word}", self.path, hint)
        if length_unit and self.length_unit and length_unit != self.length_unit:
            raise InputError(
                f"is in {self.length_unit} by its own header, but the scene says {length_unit}",
                self.path,
                f"correct '{key}'",
            )
        return LENGTH[unit]


def read_table(path: Path, format: str | None = None) -> Table:
    """Read a table.

    Args:
        format: a name of `READERS`; by default the suffix.
    """
    path = Path(path)
    kind = format or path.suffix.lower().lstrip(".")
    if kind not in READERS:
        raise InputError(f"unknown table format '{kind}'", path, f"use {', '.join(READERS)}")
    return READERS[kind](path)


def with_unit(table: Table, length_unit: str | None) -> Table:
    """Return a table with the user's unit of length; None: unchanged."""
    if length_unit is None:
        return table
    if table.path.suffix.lower() == ".c3d" and table.length_unit is not None:
        from tkamb.io.recordings.c3d import read_c3d

        read_c3d(table.path, GivenUnits(length_unit))
        return table  # in m already
    table.unit_scale(length_unit, "--length-unit")
    return replace(table, length_unit=length_unit, unit_given=True)


def read_csv(path: Path) -> Table:
    """Read comma-separated values with one header row.

    Semicolons or tabs may separate the cells, with points or commas in the numbers; a notice
    says so. Empty lines and lines that begin with # are skipped. Empty cells after the last named
    column are skipped, too, because some programs end every line with a comma.
    """
    lines = [
        (number, line.replace('"', ""))
        for number, line in enumerate(read_lines(path), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise InputError("is empty", path, "export the recording again")
    # A header may contain commas, as in "Force, N"; a separator is in every line.
    sign = next((one for one in (";", "\t") if all(one in line for _, line in lines)), ",")
    rows = [(number, line.split(sign)) for number, line in lines]
    rows, notices = (rows, ()) if sign == "," else _with_points(rows, sign, path)
    names = [name.strip() for name in rows[0][1]]
    body = [
        (number, cells if any(map(str.strip, cells[len(names) :])) else cells[: len(names)])
        for number, cells in rows[1:]
    ]
    columns, equal = _columns(path, names, body)
    return Table(path, columns, equal=equal, notices=(*notices, *_equal_notices(equal)))


def _with_points(
    rows: list[tuple[int, list[str]]], sign: str, path: Path
) -> tuple[list[tuple[int, list[str]]], tuple[str, ...]]:
    """Return rows with points in the numbers, and a notice."""
    cells = [cell.strip() for _, row in rows[1:] for cell in row]
    comma = next((cell for cell in cells if _COMMA_NUMBER.fullmatch(cell)), None)
    point = next((cell for cell in cells if "." in cell and _NUMBER.fullmatch(cell)), None)
    if comma and point:
        what = f"has numbers with a comma ('{comma}') and others with a point ('{point}')"
        raise InputError(what, path, "export it with one decimal sign")
    words = f"has {SEPARATORS[sign]} between its cells"
    if not comma:
        return rows, (f"{words}: read so",)
    body = [(number, [cell.replace(",", ".") for cell in row]) for number, row in rows[1:]]
    notice = f"{words} and commas in its numbers: read so, '{comma}' as {comma.replace(',', '.')}"
    return [rows[0], *body], (notice,)


def read_storage(path: Path) -> Table:
    """Read an OpenSim storage file: `key=value` lines, `endheader`, column names, rows."""
    lines = read_lines(path)
    ends = [k for k, line in enumerate(lines) if line.strip(' \t",;').lower() == "endheader"]
    if not ends:
        raise InputError(
            "has no 'endheader' line", path, "give an OpenSim storage file (.mot or .sto)"
        )
    names = next((k for k in range(ends[0] + 1, len(lines)) if lines[k].strip()), len(lines))
    lines, changes = tab_separated(lines, names)
    header = {}
    for line in lines[: ends[0]]:
        key, _, value = line.partition("=")
        header[key.strip().lower()] = value.strip().lower()
    rows = [
        (number, line.split())
        for number, line in enumerate(lines[ends[0] + 1 :], ends[0] + 2)
        if line.strip()
    ]
    if not rows:
        raise InputError("has no columns after 'endheader'", path)
    if header.get("datatype", "double") != "double":
        what = f"holds values of the type {header['datatype']}, not single numbers"
        raise InputError(what, path, "export it with DataType=double")
    columns, equal = _columns(path, rows[0][1], rows[1:])
    rows_stated = _row_notices(header.get("nrows"), len(rows) - 1)
    notices = (*changes, *_equal_notices(equal), *rows_stated)
    degrees = STATED_DEGREES.get(header.get("indegrees", ""))
    return Table(path, columns, in_degrees=degrees, equal=equal, notices=notices)


def _row_notices(stated: str | None, rows: int) -> tuple[str, ...]:
    if stated is None or not stated.isdecimal() or int(stated) == rows:
        return ()
    return (f"has {rows} rows, but its header says {int(stated)}; it may be cut short",)


def read_trc(path: Path) -> Table:
    """Read markers of a `.trc` file.

    A marker at exactly (0, 0, 0), an empty cell and NaN are gaps. Tabs separate the cells, or
    blanks in a line without tabs. Markers without a label get names like `marker 7`.
    """
    lines, changes = tab_separated(read_lines(path), TRC_LABELS)
    if len(lines) < 6 or not lines[0].startswith("PathFileType"):
        raise InputError("is not a .trc file: too short or no 'PathFileType' line", path)
    header = dict(zip(lines[1].split(), lines[2].split(), strict=False))
    body = [(number, _trc_cells(line)) for number, line in enumerate(lines[5:], 6) if line.strip()]
    usual = int(np.median([_filled(cells) for _, cells in body])) if body else 2
    markers = _trc_labels(lines[TRC_LABELS], lines[4], usual, path)
    labels = [name or f"marker {k}" for k, name in enumerate(markers, 1)]
    columns = ["frame", "time", *(f"{m}_{axis}" for m in labels for axis in "xyz")]
    rows = []
    for number, cells in body:
        padded = cells[: len(columns)] + [""] * (len(columns) - len(cells))
        rows.append((number, padded if _filled(cells) <= len(columns) else cells))
    table, equal = _columns(path, columns, rows)
    complete = [m for m in labels if f"{m}_x" in table]
    for marker in complete:
        absent = np.all([table[f"{marker}_{axis}"] == 0.0 for axis in "xyz"], axis=0)
        for axis in "xyz":
            table[f"{marker}_{axis}"][absent] = np.nan
    frame = table.pop("frame")
    table["time"] = _exact_time(table["time"], frame, header.get("DataRate", ""))
    twice = sorted({name[:-2] for name in equal})
    notices = changes + [f"has two markers '{name}'; neither is used" for name in twice]
    if unlabelled := markers.count(""):
        notices.append(f"has {unlabelled} marker(s) without a label; they are not used")
    notices += _row_notices(header.get("NumFrames"), len(rows))
    return Table(
        path,
        table,
        _trc_unit(header, path),
        equal=equal,
        notices=tuple(notices),
        unit_word=header.get("Units", ""),
    )


def _trc_cells(line: str) -> list[str]:
    """Return the cells between tabs or, in a line without tabs, blanks."""
    if "\t" not in line.strip():
        return line.split()
    cells = [cell.strip() for cell in line.split("\t")]
    if any(len(cell.split()) > 1 for cell in cells):
        return [part for cell in cells for part in cell.split() or [""]]
    return cells


def _filled(cells: list[str]) -> int:
    return max((k for k, cell in enumerate(cells, 1) if cell), default=0)


def _trc_labels(names: str, axes: str, usual: int, path: Path) -> list[str]:
    """Return a label per marker; "" for a marker without a label.

    The line of labels has a label every three cells. Some programs write blanks in place of tabs:
    then as many labels as markers are read in order. `usual` is the median number of cells in a
    row.
    """
    count = max(len(axes.split()) // 3, math.ceil((usual - 2) / 3))
    cells = [cell.strip() for cell in names.split("\t")][2:]
    places = [k for k, cell in enumerate(cells) if cell]
    if places and all(k % 3 == 0 for k in places):
        spread = [cells[3 * k] if 3 * k < len(cells) else "" for k in range(count)]
        if len(places) == sum(bool(name) for name in spread):
            return spread
    readings = [[cell for cell in cells if cell]]
    readings.append([part for part in re.split(r"\t|\s{2,}", names.strip()) if part][2:])
    readings.append(names.split()[2:])
    for labels in readings:
        if len(labels) == count:
            return labels
    raise InputError(
        f"names {len(readings[0] or readings[-1])} markers in line 4, but has columns for {count}",
        path,
        "write one label every three columns, with tabs between the cells",
    )


def _trc_unit(header: dict[str, str], path: Path) -> str | None:
    """Return the stated unit of length, like "mm"; None for an unknown one."""
    scale = metres(header.get("Units", ""))
    return next((name for name, value in LENGTH.items() if value == scale), None)


def read_c3d_markers(path: Path) -> Table:
    """Return the markers of a C3D file, in m, at the times of the recording.

    With an unknown word for the unit, the numbers are as in the file.
    """
    from tkamb.io.recordings.c3d import read_c3d

    recording = read_c3d(path)
    recording.check_markers()
    equal = {name for name, count in Counter(recording.labels).items() if count > 1}
    columns = {
        f"{label}_{axis}": recording.points[:, k, i]
        for k, label in enumerate(recording.labels)
        for i, axis in enumerate("xyz")
        if label not in equal
    }
    return Table(
        path,
        {"time": recording.time, **columns},
        length_unit=recording.length_unit,
        equal=tuple(f"{label}_{axis}" for label in sorted(equal) for axis in "xyz"),
        notices=recording.all_notices,
        unit_word=recording.length_word,
    )


def _exact_time(time: Array, frame: Array, rate: str) -> Array:
    """Return evenly spaced times if the column is these times rounded; else the column.

    Their spacing follows from the rate (Hz), their offset is the best fit.
    """
    try:
        period = 1.0 / float(rate)
    except (ValueError, ZeroDivisionError):
        return time
    even = (frame - frame[0]) * period
    even = even + (time - even).mean()
    return even if np.abs(even - time).max() <= TRC_TIME_ROUNDING else time


def _columns(
    path: Path, names: list[str], rows: list[tuple[int, list[str]]]
) -> tuple[dict[str, Array], tuple[str, ...]]:
    if not rows:
        raise InputError("has no data rows", path, "export the recording again")
    counts = Counter(names)
    values = np.empty((len(rows), len(names)))
    for k, (number, cells) in enumerate(rows):
        if len(cells) != len(names):
            what = f"line {number} has {len(cells)} cells, the header {len(names)}"
            raise InputError(what, path, _why_uneven(cells, names))
        values[k] = _row(cells, path, number)
    result = {name: values[:, k].copy() for k, name in enumerate(names) if counts[name] == 1}
    return result, tuple(sorted(name for name, count in counts.items() if count > 1))


def _equal_notices(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"has two columns named '{name}'; neither is used" for name in names)


def _row(cells: list[str], path: Path, line: int) -> list[float]:
    if not "".join(cells).strip(_NUMBER_CHARACTERS):
        # Converting the whole row at once is faster. A cell that fails gets its message below.
        with contextlib.suppress(ValueError):
            numbers = [float(cell) for cell in cells]
            if max(numbers) <= MAX_VALUE and min(numbers) >= -MAX_VALUE:
                return numbers
    return [_number(cell, path, line) for cell in cells]


def _number(cell: str, path: Path, line: int) -> float:
    text = cell.strip()
    if not text or _NOT_A_NUMBER.fullmatch(text.lower()):
        return math.nan
    if not (_NUMBER.fullmatch(text) or _INFINITE.fullmatch(text.lower())):
        comma = "write a decimal point, not a comma" if _COMMA_NUMBER.match(text) else None
        hint = comma or "write plain decimal numbers like -12.5"
        raise InputError(f"line {line} holds '{text}', which is no number", path, hint)
    number = float(text)
    if math.isinf(number):
        hint = "leave the cell empty where nothing was measured"
        raise InputError(f"line {line} holds '{text}', which is not finite", path, hint)
    if abs(number) > MAX_VALUE:
        raise InputError(
            f"line {line} holds '{text}', which is no measurement", path, "correct the cell"
        )
    return number


def _why_uneven(cells: list[str], names: list[str]) -> str:
    if len(cells) < len(names):
        return "add the missing cell or comma"
    # Decimal commas cut each number into two integers, so that rows are about twice as long.
    integers_only = all(re.fullmatch(r"[+-]?[0-9]*", cell.strip()) for cell in cells)
    if integers_only and 4 * len(cells) > 5 * len(names):
        return "write decimal points, not commas"
    return "give every column a name in the header"


READERS: dict[str, Callable[[Path], Table]] = {
    "csv": read_csv,
    "sto": read_storage,
    "mot": read_storage,
    "trc": read_trc,
    "c3d": read_c3d_markers,
}
"""Name of a format, which is the file's suffix -> reader."""


SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
"""Separator of cells -> its name in notices."""


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file.

    A byte order mark decides the encoding; without one it is UTF-8. If the bytes are not valid
    UTF-8, it is Latin-1, which older programs write.
    """
    content = read_bytes(path, TABLE_BYTES)
    encodings = [name for mark, name in BYTE_ORDER_MARKS.items() if content.startswith(mark)]
    try:
        text = content.decode((encodings or ["utf-8"])[0])
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n").splitlines()


def tab_separated(lines: Sequence[str], header: int) -> tuple[list[str], list[str]]:
    """Return the lines with tabs between the cells, and a notice for each change.

    Args:
        header: index of the line with the names of the columns. If it holds no tab, its commas or
            semicolons are the separators of all lines.
    """
    notices = []
    result = list(lines)
    if any('"' in line for line in result):
        result = [line.replace('"', "") for line in result]
        notices.append("has quotes around its cells; they are left out")
    names = result[header] if header < len(result) else ""
    for separator in (",", ";"):
        if separator in names and "\t" not in names.strip():
            word = SEPARATORS[separator]
            result = [line.replace("\t", " ").replace(separator, "\t") for line in result]
            notices.append(f"has {word} between its cells, and is read so")
            break
    rows = [line for line in result[header + 1 :] if line.strip()]
    # A row whose first cell is a frame without a number has the time in the second cell.
    # The line of a .trc with the axes, like X1 Y1 Z1, is no row.
    numbers = [line for line in rows if not re.match(r"\s*[A-Za-z]", line)]
    if rows and all(re.match(r"\t\d+\t", line) for line in numbers):
        result = [
            line[1:] if k > header and re.match(r"\t\d+\t", line) else line
            for k, line in enumerate(result)
        ]
        notices.append("has a tab before each row; it is left out")
    return [line.lstrip("\t") if k <= header else line for k, line in enumerate(result)], notices
