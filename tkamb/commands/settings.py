"""The settings of tkamb's algorithms (`tkamb settings`).

This module finds the settings objects that `tkamb.settings` describes.
"""

import argparse
import ast
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

from tkamb.commands.options import option
from tkamb.errors import InputError
from tkamb.settings import SUFFIX

PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Setting:
    """One setting of an algorithm.

    Args:
        name: dotted name, such as "lattice_solver.force_tolerance".
        algorithm: first line of the docstring of the settings class.
    """

    name: str
    value: Any
    default: Any
    meaning: str
    algorithm: str
    module: str


def all_settings() -> list[Setting]:
    """Import all modules with settings, and return the settings in the order of the modules."""
    rows: list[Setting] = []
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if SUFFIX not in text:
            continue
        names = [name for name, _ in _instances(ast.parse(text))]
        module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        for name in names:
            rows += _rows(module, name, text)
    return rows


def _instances(tree: ast.Module) -> Iterator[tuple[str, str]]:
    for node in tree.body:
        if (
            isinstance(node, ast.Assign)
            and isinstance(node.value, ast.Call)
            and isinstance(node.value.func, ast.Name)
            and node.value.func.id.endswith(SUFFIX)
            and isinstance(node.targets[0], ast.Name)
        ):
            yield node.targets[0].id, node.value.func.id


def _rows(module: str, name: str, text: str) -> Iterator[Setting]:
    value = getattr(import_module(module), name)
    default, kind = type(value)(), type(value)
    meanings = field_docstrings(ast.parse(text), kind.__name__)
    algorithm = " ".join((kind.__doc__ or "").split("\n\n")[0].split())
    for field in fields(value):
        yield Setting(
            f"{name.lower()}.{field.name}",
            getattr(value, field.name),
            getattr(default, field.name),
            meanings.get(field.name, ""),
            algorithm,
            module,
        )


def field_docstrings(tree: ast.Module, name: str) -> dict[str, str]:
    """Return field -> docstring below it, of a class."""
    body = next((n.body for n in tree.body if isinstance(n, ast.ClassDef) and n.name == name), [])
    texts = {}
    for node, following in pairwise(body):
        if (
            isinstance(node, ast.AnnAssign)
            and isinstance(node.target, ast.Name)
            and isinstance(following, ast.Expr)
            and isinstance(following.value, ast.Constant)
        ):
            texts[node.target.id] = " ".join(str(following.value.value).split())
    return texts


def add_settings(commands: Any) -> None:
    """Add `tkamb settings` to the command line."""
    parser = commands.add_parser(
        "settings",
        help="the settings of the algorithms, with their meaning",
        description="Print the settings of every algorithm: name, value, unit and meaning.",
    )
    parser.add_argument("words", nargs="*", metavar="WORD", help="only settings with all words")
    option(parser, "--json", "print one JSON object")
    parser.set_defaults(command=_settings)


def _settings(options: argparse.Namespace) -> int:
    words = [word.lower() for word in options.words]
    rows = [
        row
        for row in all_settings()
        if all(word in f"{row.name} {row.algorithm} {row.meaning}".lower() for word in words)
    ]
    if not rows:
        hint = "`tkamb settings` prints all settings"
        raise InputError(f"no setting contains {' and '.join(options.words)}", hint=hint)
    if options.json:
        print(json.dumps({row.name: asdict(row) for row in rows}, indent=2))
        return 0
    algorithm = ""
    for row in rows:
        if row.algorithm != algorithm:
            algorithm = row.algorithm
            print(f"\n{algorithm} ({row.module})")
        print(
            f"  {row.name} = {row.value:g}"
            if isinstance(row.value, float)
            else f"  {row.name} = {row.value}"
        )
        print(f"      {row.meaning}")
    return 0
