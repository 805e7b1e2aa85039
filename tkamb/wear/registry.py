"""Wear laws by name: the built-in ones and those of other packages.

[project.entry-points."tkamb.wear"]
my-law = "my_package.my_module:MyLaw"
"""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from tkamb.errors import InputError, names_near
from tkamb.named_classes import NamedClasses
from tkamb.wear.laws import WearLaw

BUILT_IN = {
    "archard": "tkamb.wear.laws:Archard",
    "cross-shear": "tkamb.wear.laws:CrossShear",
    "pressure-cross-shear": "tkamb.wear.laws:PressureCrossShear",
    "contact-area": "tkamb.wear.laws:ContactArea",
}

WEAR_LAWS = NamedClasses(
    "wear law",
    WearLaw,  # type: ignore[type-abstract]
    "tkamb.wear",
    BUILT_IN,
)


def law_names() -> tuple[str, ...]:
    """Return the names of all wear laws, built-in ones first."""
    return WEAR_LAWS.names()


def law_class(name: str) -> type[WearLaw]:
    """Return the class behind a name.

    Raises:
        InputError: no such name, a name clash, or the class cannot be loaded or is no law.
    """
    return WEAR_LAWS.find(name)


def wear_law(name: str, parameters: Mapping[str, Any], where: object = None) -> WearLaw:
    """Return the law of that name with its parameters.

    Args:
        name: one of `law_names()`.
        parameters: the law's fields by name; all of them.
        where: the file or material they come from, for messages.

    Raises:
        InputError: no such law, a parameter that is missing or unknown, or a bad value.
    """
    found = law_class(name)
    own = [field.name for field in fields(found)]  # type: ignore[arg-type]
    table = f"[laws.{name}]" if where is None else f"{where}: [laws.{name}]"
    for key in parameters:
        if key not in own:
            raise InputError(f"has no parameter '{key}'", table, names_near(key, own))
    for key in own:
        if key not in parameters:
            raise InputError(f"does not give '{key}'", table, f"it needs: {', '.join(own)}")
    try:
        return found(**parameters)
    except InputError as error:
        raise InputError(error.what, f"{table}: {error.where}", error.mend) from None
