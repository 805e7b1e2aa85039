"""Copies of the shipped knee bend, with changed or omitted keys of its scene."""

import shutil
import tempfile
import tomllib
from functools import cache
from pathlib import Path

MODEL = Path(__file__).parents[1] / "models" / "deep_knee_bend"
TEMPORARY_FOLDERS = []
"""Temporary folders, which are deleted when the tests end."""


def write_scene(folder, drop=(), **changes):
    """Write a copy of the shipped patient into `folder`; return the scene's path.

    The contact model is `foundation`, for speed, unless the changes name another model.

    Args:
        folder: the folder; it receives copies of all files of the patient.
        drop: tables to leave out.
        changes: "table__key" = value; None removes the key.
    """
    shutil.copytree(MODEL, folder, dirs_exist_ok=True)
    content = tomllib.loads((MODEL / "scene.toml").read_text(encoding="utf-8"))
    for table in drop:
        content.pop(table, None)
    if "contact" in content:
        content["contact"]["model"] = "foundation"
    for dotted, value in changes.items():
        *tables, key = dotted.split("__")
        inner = content
        for name in tables:
            inner = inner.setdefault(name, {})
        if value is None:
            inner.pop(key, None)
        else:
            inner[key] = value
    path = Path(folder) / "scene.toml"
    path.write_text(as_toml(content), encoding="utf-8")
    return path


@cache
def fast_scene():
    """Return the path of a copy of the shipped scene with `foundation`, shared by all tests."""
    folder = tempfile.TemporaryDirectory(prefix="tkamb-tests-")
    TEMPORARY_FOLDERS.append(folder)
    return write_scene(Path(folder.name) / "deep_knee_bend")


def as_toml(content):
    """Return a dictionary of plain values as TOML (inline tables below the first level)."""
    return "\n".join(f"{key} = {_value(value)}" for key, value in content.items()) + "\n"


def _value(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{k}" = {_value(v)}' for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)
