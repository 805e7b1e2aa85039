"""A preset, and how it is applied to the content of a scene file."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from tkamb.errors import InputError

MODEL, OPTIONS = "contact.model", "contact.options"
"""Options belong to the contact model that the preset names."""


@dataclass(frozen=True)
class Change:
    """One key that a preset set.

    Args:
        key: dotted, as for `--set`.
        before: value in the scene; None: not given, so that the default would hold.
        after: value of the preset; None: the table is left out.
    """

    key: str
    before: Any
    after: Any


@dataclass(frozen=True)
class AppliedPreset:
    """A preset as it was applied to a scene.

    Args:
        name: as given to `--as`.
        source: of the study.
        changes: keys whose value in the scene was different.
        overridden: keys of the preset that `--set` or another option replaced.
        departures: in words, remaining differences between the scene and the study.
    """

    name: str
    source: str
    changes: tuple[Change, ...]
    overridden: tuple[str, ...]
    departures: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return what summary.json holds."""
        return {
            "name": self.name,
            "source": self.source,
            "changes": [vars(change) for change in self.changes],
            "overridden": list(self.overridden),
            "departures": list(self.departures),
        }

    def sentences(self) -> list[str]:
        """Return what the report says about it."""
        changed = "; ".join(
            f"{change.key} = {_words(change.after, 'left out')} "
            f"(scene: {_words(change.before, 'not given')})"
            for change in self.changes
        )
        result = [
            f"Run as {self.name} ({self.source}): {changed or 'no change of the scene needed'}."
        ]
        if self.overridden:
            names = ", ".join(self.overridden)
            result.append(f"Not as {self.name}, because the run's options replaced it: {names}.")
        return result + [f"Not as {self.name}: {words}." for words in self.departures]


def _words(value: Any, none: str) -> str:
    if value is None:
        return none
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {item}" for key, item in value.items()) or "none"
    return str(value).lower() if isinstance(value, bool) else str(value)


class Preset:
    """The choices of a study. Subclass it, and name the class in the registry.

    Attributes:
        name: as given to `--as`.
        source: of the study, to cite.
        settings: dotted key of the scene -> value; None leaves out a table.
        needs: dotted key of a table -> why the study cannot be run without it.
    """

    name: ClassVar[str]
    source: ClassVar[str]
    settings: ClassVar[Mapping[str, Any]]
    needs: ClassVar[Mapping[str, str]] = {}

    def lacks(self, content: Mapping[str, Any]) -> str | None:
        """Return in words why the study cannot use a scene, beside missing tables; None: it can.

        Args:
            content: of the scene, as its file is written.
        """
        del content
        return None

    def departures(self, content: Mapping[str, Any]) -> tuple[str, ...]:
        """Return in words the differences between a scene and the study that remain.

        Args:
            content: of the scene, as its file is written.
        """
        del content
        return ()

    def apply(
        self, content: dict[str, Any], overrides: Mapping[str, Any], where: object
    ) -> AppliedPreset:
        """Lay the preset over a scene's content, which is changed in place.

        Args:
            content: of the scene, as its file is written.
            overrides: dotted key -> value that replaces the preset's afterwards.
            where: of the scene, for messages.

        Raises:
            InputError: the scene lacks what the study needs.
        """
        self._check_needs(content, where)
        other_model = overrides.get(MODEL, self.settings.get(MODEL)) != self.settings.get(MODEL)
        changes, overridden = [], []
        for key, value in self.settings.items():
            if key in overrides or (key == OPTIONS and other_model):
                overridden.append(key)
                continue
            before = _value_at(content, key)
            if before != value and (before is not None or value):
                changes.append(Change(key, before, value))
            _put(content, key, dict(value) if isinstance(value, Mapping) else value)
        overridden += [key for key in overrides if key.startswith(f"{OPTIONS}.")]
        return AppliedPreset(
            self.name, self.source, tuple(changes), tuple(overridden), self.departures(content)
        )

    def _check_needs(self, content: Mapping[str, Any], where: object) -> None:
        hint = "add what is missing to the scene, or run it without --as"
        lacking = self.lacks(content)
        if lacking:
            raise InputError(f"preset '{self.name}' needs {lacking}", where, hint)
        missing = [key for key in self.needs if not _value_at(content, key)]
        if missing:
            key = missing[0]
            more = f"; it also needs {', '.join(f'[{k}]' for k in missing[1:])}" * bool(missing[1:])
            raise InputError(
                f"preset '{self.name}' needs [{key}]: {self.needs[key]}{more}",
                where,
                hint,
            )


def _value_at(content: Mapping[str, Any], dotted: str) -> Any:
    """Return the value of a dotted key, None where it is not given."""
    value: Any = content
    for part in dotted.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _put(content: dict[str, Any], dotted: str, value: Any) -> None:
    """Set a dotted key, or remove it for None; a table that is not there is made."""
    *tables, last = dotted.split(".")
    for name in tables:
        if not isinstance(content.get(name), dict):
            if value is None:
                return
            content[name] = {}
        content = content[name]
    if value is None:
        content.pop(last, None)
    else:
        content[last] = value
