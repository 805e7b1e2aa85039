"""Settings of the algorithms: documented meanings, and a record of changed settings."""

import ast
from dataclasses import dataclass, fields
from importlib import import_module
from types import ModuleType

from tkamb.cli import main
from tkamb.commands.settings import PACKAGE, all_settings, field_docstrings
from tkamb.settings import changed_settings


def settings_classes():
    """Return module and name of every settings class of the package."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if (
                isinstance(node, ast.ClassDef)
                and node.name.endswith("Settings")
                and node.name != "Settings"
            ):
                module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
                yield module, node.name


def test_every_field_of_every_settings_object_has_a_meaning():
    listed = {(row.module, row.name.split(".")[1]): row for row in all_settings()}
    for module, name in settings_classes():
        for field in fields(getattr(import_module(module), name)):
            assert listed[module, field.name].meaning, f"{module}.{name}.{field.name}"
            assert "TODO" not in listed[module, field.name].meaning, f"{name}.{field.name}"


def test_the_docstring_below_a_field_is_its_meaning():
    text = 'class A:\n    x: float = 1.0\n    """m; how\n    far."""\n    y: int = 2\n'
    assert field_docstrings(ast.parse(text), "A") == {"x": "m; how far."}


@dataclass(frozen=True)
class SearchSettings:
    """A search."""

    tolerance: float = 1e-3
    steps: int = 5


def test_only_settings_that_differ_from_the_default_are_recorded(monkeypatch):
    module = ModuleType("tkamb.invented")
    monkeypatch.setattr(SearchSettings, "__module__", "tkamb.invented")
    monkeypatch.setitem(__import__("sys").modules, "tkamb.invented", module)
    module.SEARCH = SearchSettings()
    assert "search.tolerance" not in changed_settings()
    module.SEARCH = SearchSettings(tolerance=1e-4)
    changed = changed_settings()
    assert changed["search.tolerance"] == 1e-4
    assert "search.steps" not in changed


def test_the_command_prints_the_settings(capsys):
    assert main(["settings"]) == 0
    assert capsys.readouterr().out.count(" = ") >= len(all_settings())


def test_a_word_that_no_setting_contains_is_refused(capsys):
    assert main(["settings", "blub"]) == 2
    assert "no setting contains blub" in capsys.readouterr().err
