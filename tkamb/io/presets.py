"""Presets: named choices of a study, which `tkamb run SCENE --as NAME` applies to a scene.

`BUILT_IN` lists the built-in presets. Another package can offer a preset through the entry-point
group `tkamb.io.presets`:

    [project.entry-points."tkamb.io.presets"]
    my-study-2026 = "my_package.my_module:MyStudy"

where `MyStudy` is a subclass of `tkamb.io.presets.Preset`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

from tkamb.errors import InputError
from tkamb.named_classes import NamedClasses

MODEL, OPTIONS = "contact.model", "contact.options"
"""Keys of the contact model and of its options."""


@dataclass(frozen=True)
class Change:
    """A key of the scene whose value a preset has changed.

    Args:
        before: value in the scene; None: absent, so that the default applies.
        after: value of the preset; None: the table is left out.
    """

    key: str
    before: Any
    after: Any


@dataclass(frozen=True)
class AppliedPreset:
    """The result of applying a preset.

    Args:
        changes: keys that had another value in the scene.
        overridden: keys of the preset that `--set` or another option overrides.
        departures: remaining differences between the scene and the study, in words.
    """

    name: str
    source: str
    changes: tuple[Change, ...]
    overridden: tuple[str, ...]
    departures: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the entry for summary.json."""
        return {
            "name": self.name,
            "source": self.source,
            "changes": [vars(change) for change in self.changes],
            "overridden": list(self.overridden),
            "departures": list(self.departures),
        }

    def sentences(self) -> list[str]:
        """Return the sentences for the report."""
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
    """The choices of a study; a subclass that `BUILT_IN` or an entry point names.

    Attributes:
        name: name of the preset, as in `--as`.
        settings: dotted key of the scene -> value; None: the table is left out.
        needs: dotted key of a required table -> reason for which the study needs it.
    """

    name: ClassVar[str]
    source: ClassVar[str]
    settings: ClassVar[Mapping[str, Any]]
    needs: ClassVar[Mapping[str, str]] = {}

    def lacks(self, content: Mapping[str, Any]) -> str | None:
        """Return words on what the study needs and the scene lacks, apart from `needs`, or None."""
        del content
        return None

    def departures(self, content: Mapping[str, Any]) -> tuple[str, ...]:
        """Return words on each remaining difference between a scene and the study."""
        del content
        return ()

    def apply(
        self, content: dict[str, Any], overrides: Mapping[str, Any], where: object
    ) -> AppliedPreset:
        """Apply the preset to a scene's content, in place.

        Args:
            overrides: dotted key -> value that replaces the preset's value later.
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
    value: Any = content
    for part in dotted.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _put(content: dict[str, Any], dotted: str, value: Any) -> None:
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


class Sharma2008(Preset):
    """Sharma, dissertation, University of Tennessee, Knoxville (2008), chapter 4.

    The preset sets each choice that a key can express; comments name the section.
    """

    name: ClassVar[str] = "sharma-2008"
    source: ClassVar[str] = "Sharma, dissertation, University of Tennessee (2008), chapter 4"
    settings: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {
            # 4.4: "modeled to roll with slip"; slip of the lowest points of the condyles.
            "motion.motion": "roll-slip",
            # 4.4: the ground reaction, "obtained from a force plate, was applied at the ankle".
            "ground_reaction.applied": "ankle",
            # 4.4: the quadriceps is the only muscle; wrapping "was taken into account".
            "muscles": None,
            "quadriceps.wrap": True,
            "patellar_ligament.wrap": True,
            # 4.5.1, 4.5.2: 26 neighbours, one stiffness E C. 5.1: cells below 1.5 mm.
            "contact.model": "lattice-source",
            "contact.resolution_mm": 1.5,
            # 4.5.5: the loops; 4.5.6: total area by number of nodes in contact.
            "contact.options": {"loops": "source", "law": "nonlinear", "pressure_rule": "source"},
            # 4.5.2, 5.2: Halloran's curve by the fit that the source gives (E, alpha, sigma0, n).
            "contact.material": "polyethylene",
            "contact.friction": 0.05,
            # 4.3: at most 0.5 mm, 0.5 deg; the rotation is undone if penetration and angle after
            # the press both exceed the adjustment.
            "contact.adjust": True,
            "contact.adjust_restore_when": "both",
            # 4.4, 4.5.5: the total force of the bodies loads the lattice; the contact does not
            # change the equations of motion.
            "contact.coupling": "none",
            "contact.released": [],
            "contact.post": False,
        }
    )
    needs: ClassVar[Mapping[str, str]] = MappingProxyType(
        {
            "implant.femoral": "the study presses the femoral component into the insert",
            "implant.insert": "the lattice is made from the insert's mesh",
            "tibia": "the shank turns about the ankle in the sagittal plane",
            "ground_reaction": "the force plate's force acts at the ankle",
            "quadriceps": "its tension is solved from the equations of motion",
            "patellar_ligament": "its tension is solved from the equations of motion",
            "patella": "quadriceps and patellar ligament meet at the patella",
        }
    )

    def lacks(self, content: Mapping[str, Any]) -> str | None:
        """Return words on the missing pose if the motion is from skin markers, or None."""
        if content.get("motion", {}).get("interpretation") != "markers":
            return None
        return (
            "the femur's recorded pose on the insert (fluoroscopy): skin markers "
            "([motion] interpretation = 'markers') do not give it"
        )

    def departures(self, content: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the remaining differences from the study, in words."""
        result = []
        kind = content["tibia"].get("kind")
        if kind != "sagittal":
            result.append(f"the shank moves as recorded ([tibia] kind = '{kind}'), in 3D")
        laws = {table.get("law") for table in content.get("ligament", ())} - {"two-line"}
        if laws:
            result.append(f"ligaments follow the law {', '.join(sorted(map(repr, laws)))}")
        if content.get("generic_ligaments"):
            result.append("ligaments are a generic set scaled to the implant")
        if not content.get("ligament") and not content.get("generic_ligaments"):
            result.append("no ligaments are modelled")
        return tuple(result)


BUILT_IN = {
    "sharma-2008": "tkamb.io.presets:Sharma2008",
}

PRESETS = NamedClasses("preset", Preset, "tkamb.io.presets", BUILT_IN)


def find_preset(name: str) -> Preset:
    """Return the preset with a name."""
    return PRESETS.find(name)()
