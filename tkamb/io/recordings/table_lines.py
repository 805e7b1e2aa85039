"""Lines of a text table, with tabs between the cells as programs of motion capture write them.

Spreadsheets save such a table with commas or semicolons, with quotes, or with a tab before each
row. `tab_separated` undoes this, with a notice for each change.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from tkamb.files import BYTE_ORDER_MARKS, TABLE_BYTES, read_bytes

SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
"""Separator of cells -> its name in notices."""


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file.

    A byte order mark decides the encoding; without one it is UTF-8. If the bytes are not valid
    UTF-8, it is Latin-1, which older programs write.

    Raises:
        InputError: no such file, or larger than a table may be.
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
        lines: lines of the file.
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
    if rows and all(re.match(r"\t\d+\t", line) for line in rows if not _is_axes(line)):
        result = [
            line[1:] if k > header and re.match(r"\t\d+\t", line) else line
            for k, line in enumerate(result)
        ]
        notices.append("has a tab before each row; it is left out")
    return [line.lstrip("\t") if k <= header else line for k, line in enumerate(result)], notices


def _is_axes(line: str) -> bool:
    """Return whether a line of a .trc names axes, like X1 Y1 Z1."""
    return bool(re.match(r"\s*[A-Za-z]", line))
