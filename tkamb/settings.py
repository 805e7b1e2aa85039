"""Settings objects that differ from their defaults.

A settings object is an instance of a frozen dataclass with a name that ends in `Settings`. It is at
the top level of the module that uses it. Each field has a docstring with unit, meaning and origin.
`tkamb settings` lists all of them (`tkamb.commands.settings`).
"""

import sys
from dataclasses import fields, is_dataclass
from typing import Any

SUFFIX = "Settings"


def changed_settings() -> dict[str, Any]:
    """Return name -> value of the settings that differ from their defaults in this process.

    Only imported modules count: no other has computed anything.
    """
    changed: dict[str, Any] = {}
    for module_name, module in sorted(sys.modules.items()):
        if not module_name.startswith("tkamb.") or module is None:
            continue
        for name, value in vars(module).items():
            if _is_settings(value) and type(value).__module__ == module_name:
                default = type(value)()
                changed |= {
                    f"{name.lower()}.{field.name}": getattr(value, field.name)
                    for field in fields(value)
                    if getattr(value, field.name) != getattr(default, field.name)
                }
    return changed


def _is_settings(value: Any) -> bool:
    kind = type(value)
    return is_dataclass(value) and kind.__name__.endswith(SUFFIX)
