"""Classes with names: built-in classes, and classes of other packages with an entry point."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from tkamb.errors import InputError, names_near

Base = TypeVar("Base")


@dataclass(frozen=True)
class NamedClasses(Generic[Base]):
    """Named classes of one kind; `find` imports a class.

    Attributes:
        kind: singular noun for these classes in messages, e.g. "contact model".
        group: entry-point group of the classes in other packages.
        built_in: name -> "module:Class" of the built-in classes.
    """

    kind: str
    base: type[Base]
    group: str
    built_in: Mapping[str, str]

    def names(self) -> tuple[str, ...]:
        """Return all names, built-in ones first.

        Raises:
            InputError: two packages offer the same name.
        """
        return tuple(self._offers())

    def find(self, name: str) -> type[Base]:
        """Return the class of a name.

        Raises:
            InputError: the name is unknown or used twice, or the class cannot be imported or is no
                subclass of `base`.
        """
        offers = self._offers()
        if name not in offers:
            raise InputError(f"no {self.kind} '{name}'", hint=names_near(name, offers))
        where = f"{self.kind} '{name}' ({offers[name]})"
        module, _, attribute = offers[name].partition(":")
        try:
            cls = getattr(import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            hint = "install what it needs"
            raise InputError(f"cannot be loaded ({error})", where, hint) from error
        if not (isinstance(cls, type) and issubclass(cls, self.base)):
            base = f"{self.base.__module__}.{self.base.__name__}"
            raise InputError(f"is not a subclass of {base}", where)
        return cls

    def _offers(self) -> dict[str, str]:
        offers = dict(self.built_in)
        for point in installed(self.group, tuple(sys.path)):
            first = offers.setdefault(point.name, point.value)
            if first != point.value:
                raise InputError(
                    f"two {self.kind}s are called '{point.name}': {first} and {_origin(point)}",
                    hint="uninstall or rename one",
                )
        return offers


@cache
def installed(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, by name; the search of a long path takes 10 ms.

    Args:
        path: folders of the packages, `sys.path`.
    """
    return tuple(sorted(entry_points(group=group), key=lambda point: point.name))


def _origin(point: EntryPoint) -> str:
    return point.value if point.dist is None else f"{point.value} of {point.dist.name}"
