"""Wear laws by name: the built-in ones and those of other packages.

[project.entry-points."tkamb.wear"]
my-law = "my_package.my_module:MyLaw"
"""

from collections.abc import Mapping
from dataclasses import fields
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from tkamb.errors import InputError, names_near
from tkamb.wear.laws import WearLaw

ENTRY_POINT_GROUP = "tkamb.wear"

BUILT_IN = {
    "archard": "tkamb.wear.laws:Archard",
    "cross-shear": "tkamb.wear.laws:CrossShear",
    "pressure-cross-shear": "tkamb.wear.laws:PressureCrossShear",
    "contact-area": "tkamb.wear.laws:ContactArea",
}


def law_names() -> tuple[str, ...]:
    """Return the names of all wear laws, built-in ones first."""
    return tuple(_offers())


def law_class(name: str) -> type[WearLaw]:
    """Return the class behind a name.

    Raises:
        InputError: no such name, a name clash, or the class cannot be loaded or is no law.
    """
    offers = _offers()
    if name not in offers:
        raise InputError(f"no wear law '{name}'", mend=names_near(name, offers))
    where = f"wear law '{name}' ({offers[name]})"
    module, _, attribute = offers[name].partition(":")
    try:
        found = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise InputError(f"cannot be loaded ({error})", where, "install what it needs") from error
    if not (isinstance(found, type) and issubclass(found, WearLaw)):
        raise InputError("is not a subclass of tkamb.wear.laws.WearLaw", where)
    return found


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


def _offers() -> dict[str, str]:
    """Return name -> "module:Class"."""
    offers = dict(BUILT_IN)
    for point in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda p: p.name):
        known = offers.setdefault(point.name, point.value)
        if known != point.value:
            raise InputError(
                f"two wear laws are called '{point.name}': {known} and {point.value}",
                mend="uninstall or rename one",
            )
    return offers
