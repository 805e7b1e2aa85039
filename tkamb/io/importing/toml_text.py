"""Values as TOML writes them: texts, numbers, places in millimetres, markers, ends of strands."""

import json
import re
from collections.abc import Mapping

from tkamb.geometry.frames import Array
from tkamb.io.importing.soft_tissue import End


def toml_text(value: str) -> str:
    """Return a text in quotes."""
    return json.dumps(value, ensure_ascii=False)


def toml_numbers(values: Array) -> str:
    """Return numbers to three decimals."""
    return "[" + ", ".join(f"{round(float(v), 3) + 0.0:.3f}" for v in values) + "]"


def toml_mm(point: Array) -> str:
    """Return a place, m, in mm to three decimals."""
    return toml_numbers(point * 1e3)


def toml_key(label: str, whole: bool = False) -> str:
    """Return a marker's label, quoted where TOML wants it; not `whole`: without its prefix."""
    plain = label if whole else label.rpartition(":")[2]
    return plain if re.fullmatch(r"[A-Za-z0-9_-]+", plain) else toml_text(plain)


def toml_markers(points: Mapping[str, Array], whole: bool = False) -> str:
    """Return markers, by their `whole` labels or without prefix, and their places as TOML in mm."""
    places = [f"{toml_key(label, whole)} = {toml_mm(point)}" for label, point in points.items()]
    return f"{{ {', '.join(places)} }}"


def toml_end(key: str, end: End) -> str:
    """Return the line of a strand's end."""
    return f"{key} = {{ link = {toml_text(end.link)}, point_mm = {toml_mm(end.point)} }}"
