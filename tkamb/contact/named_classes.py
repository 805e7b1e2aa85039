"""Classes by name: built-in ones and those that other packages offer by an entry point."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from tkamb.errors import InputError, names_near

Base = TypeVar("Base")


@dataclass(frozen=True)
class NamedClasses(Generic[Base]):
    """Classes of one kind by name; each is imported only when asked for.

    Attributes:
        kind: what they are, in the singular, for messages.
        base: the class that each of them is a subclass of.
        group: the entry-point group through which another package offers one.
        built_in: name -> "module:Class".
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
        """Return the class behind a name.

        Raises:
            InputError: no such name, a name clash, or the class cannot be loaded or is of
                another kind.
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
        """Return name -> "module:Class"."""
        offers = dict(self.built_in)
        for point in sorted(entry_points(group=self.group), key=lambda p: p.name):
            first = offers.setdefault(point.name, point.value)
            if first != point.value:
                raise InputError(
                    f"two {self.kind}s are called '{point.name}': {first} and {_origin(point)}",
                    hint="uninstall or rename one",
                )
        return offers


def _origin(point: EntryPoint) -> str:
    return point.value if point.dist is None else f"{point.value} of {point.dist.name}"
