"""Reading of users' TOML within limits, and writing of values as TOML text.

A small text must not take hours or gigabytes. The time of Python's reader grows with the square of
a dotted key's parts, and its memory with nesting. It fails at integers of thousands of digits.
tkamb checks all three first.
"""

import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb.errors import InputError
from tkamb.files import MEGABYTE, read_text
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class TomlLimits:
    """Limits of a TOML text, far above scenes, cohorts and materials."""

    size: int = 8 * MEGABYTE
    """bytes: largest file, for which Python's reader takes ten seconds."""
    key_parts: int = 16
    """Largest number of parts of a dotted key or of a table's name. A scene needs four."""
    digits: int = 100
    """Largest number of successive digits in a number."""
    depth: int = 32
    """Largest depth of nested lists and inline tables. A scene needs four."""


LIMITS = TomlLimits()

# Strings and comments may contain any brackets or dots. Each is replaced by an empty string.
_STRINGS = re.compile(
    r'"""(?:\\.|[^\\])*?"""|\'\'\'.*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'|#[^\n]*', re.DOTALL
)
_KEYS = re.compile(r'[\w."\- \t]+')
_BRACKETS = re.compile(r"[\[\]{}]")
_DIGITS = re.compile(rf"[0-9_]{{{LIMITS.digits + 1},}}|0[xob][0-9a-fA-F_]{{{LIMITS.digits + 1},}}")


def read_toml(path: str | Path, *, what: str) -> dict[str, Any]:
    """Return the content of a TOML file."""
    return parse_toml(read_text(path, LIMITS.size, what=what), path)


def parse_toml(text: str, where: object) -> dict[str, Any]:
    """Return the content of TOML text."""
    check_limits(text, where)
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))  # a byte order mark of an editor
    except (ValueError, RecursionError) as error:  # the parser's own error is a ValueError
        raise InputError(
            f"is not TOML ({str(error)[:200]})", where, "correct that line, or give a TOML file"
        ) from None


def check_key(dotted: str, where: object) -> None:
    """Raise an InputError if a dotted key has too many parts."""
    if dotted.count(".") >= LIMITS.key_parts:
        raise InputError(f"a key has more than {LIMITS.key_parts} parts", where, "check the dots")


def check_limits(text: str, where: object) -> None:
    """Raise an InputError if a TOML text, or a value in it, exceeds `TomlLimits`."""
    structure = _STRINGS.sub('""', text)
    for match in _KEYS.finditer(structure):
        check_key(match.group(), where)
    if _DIGITS.search(structure):
        raise InputError(f"has a number of more than {LIMITS.digits} digits", where)
    depth = 0
    for match in _BRACKETS.finditer(structure):
        depth = depth + 1 if match.group() in "[{" else max(depth - 1, 0)
        if depth > LIMITS.depth:
            raise InputError(f"nests values more than {LIMITS.depth} deep", where)


def toml_value(value: Any, decimals: int | None = None) -> str:
    """Return a value as TOML: text, path, list, array, inline table, or number (None: all decimals
    needed).
    """
    if hasattr(value, "tolist"):  # an array or number of NumPy, which is not imported here:
        value = value.tolist()  # `main` sets the threads of BLAS before NumPy is loaded
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False)
    if isinstance(value, Mapping):
        pairs = (f"{key} = {toml_value(one, decimals)}" for key, one in value.items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(toml_value(one, decimals) for one in value)}]"
    if isinstance(value, bool | int):
        return str(value).lower()
    # the sum has no negative zero
    return (
        repr(float(value)) if decimals is None else f"{round(value, decimals) + 0.0:.{decimals}f}"
    )


def table_lines(name: str, values: Mapping[str, Any]) -> list[str]:
    """Return a table's lines, with an empty one at its end."""
    return [name, *(f"{key} = {toml_value(value)}" for key, value in values.items()), ""]


def toml_mm(point: "Array") -> str:
    """Return a point (3,) m as TOML, in mm with three decimals."""
    return toml_value(point / MILLIMETRE, 3)


def toml_key(label: str, whole: bool = False) -> str:
    """Return a marker's label as a TOML key, with its prefix if `whole`."""
    plain = label if whole else label.rpartition(":")[2]
    return plain if re.fullmatch(r"[A-Za-z0-9_-]+", plain) else toml_value(plain)


def toml_markers(points: Mapping[str, "Array"], whole: bool = False) -> str:
    """Return marker positions, mm, as an inline table, with prefixes if `whole`."""
    return toml_value({toml_key(k, whole): p / MILLIMETRE for k, p in points.items()}, 3)
