"""The scene: the TOML file that says what exists and what is modelled.

Units are in the key names, paths are relative to the file, and an unknown key is an error. The
subject of an absent table is not modelled. `load_scene` does not read the files that the scene
names.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, get_args

from pydantic import BaseModel, Field, PrivateAttr, ValidationError, model_validator
from pydantic_core import ErrorDetails

from tkamb.errors import InputError, must_be, names_near
from tkamb.io.recordings.recording_tables import (
    GroundReactionTable,
    MeasuredTable,
    MotionTable,
    PatientTable,
    SceneTable,
    TibiaTable,
)
from tkamb.io.scene.tables import (
    ContactTable,
    GenericLigamentsTable,
    ImplantTable,
    LigamentTable,
    MaterialTable,
    MusclesTable,
    MuscleTable,
    OutputTable,
    PatellarLigamentTable,
    PatellaTable,
    QuadricepsTable,
    WearTable,
)
from tkamb.io.scene.uncertainty import UncertaintyTable
from tkamb.io.toml_text import read_toml

if TYPE_CHECKING:
    from tkamb.io.presets import AppliedPreset


class Scene(SceneTable):
    """The content of a scene file."""

    base: str | None = Field(
        None,
        description=(
            "name of another scene file in the same folder. Its keys apply unless this file gives "
            "them. Tables are merged; lists are replaced as a whole"
        ),
    )
    patient: PatientTable
    motion: MotionTable
    tibia: TibiaTable | None = None
    ground_reaction: GroundReactionTable | None = None
    implant: ImplantTable = ImplantTable()
    ligament: tuple[LigamentTable, ...] = ()
    generic_ligaments: GenericLigamentsTable | None = None
    muscle: tuple[MuscleTable, ...] = ()
    quadriceps: QuadricepsTable | None = None
    muscles: MusclesTable | None = None
    patellar_ligament: PatellarLigamentTable | None = None
    patella: PatellaTable | None = None
    contact: ContactTable | None = None
    material: MaterialTable | None = None
    measured: MeasuredTable | None = None
    wear: WearTable | None = None
    output: OutputTable = OutputTable()
    uncertainty: UncertaintyTable | None = None
    _overrides: dict[str, Any] = PrivateAttr(default_factory=dict)
    _preset: "AppliedPreset | None" = PrivateAttr(default=None)

    @property
    def overrides(self) -> dict[str, Any]:
        """Dotted key -> value that replaces the file's value."""
        return dict(self._overrides)

    @property
    def insert_material(self) -> dict[str, Any]:
        """Material of the insert, as argument of `tkamb.io.given_material`."""
        if self.material is not None:
            return self.material.model_dump()
        return {} if self.contact is None else {"base": self.contact.material}

    @property
    def yield_stress_MPa(self) -> float:
        """Yield stress of the insert, from [material] or else [output]."""
        stress = self.material.yield_stress_MPa if self.material else None
        return self.output.yield_stress_MPa if stress is None else stress

    @property
    def preset(self) -> "AppliedPreset | None":
        """The preset that was applied to the scene, or None."""
        return self._preset

    def __repr__(self) -> str:
        """Return patient, motion and contact model in one line."""
        contact = self.contact
        parts = [
            f"{self.patient.side} knee",
            f"{self.patient.mass_kg:g} kg",
            f"motion of {self.motion.file.name}",
            f"{contact.model} at {contact.resolution_mm:g} mm" if contact else "no contact",
        ]
        return f"<tkamb.Scene: {', '.join(parts)}>"

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        names = [ligament.name for ligament in self.ligament]
        if len(names) != len(set(names)):
            raise ValueError("two [[ligament]] tables have the same name")
        for name in [one.name for one in self.patella.ligament] if self.patella else []:
            if name in names:
                raise ValueError(f"'{name}' is in [[ligament]] and in [[patella.ligament]]")
        generic = self.generic_ligaments.ligaments if self.generic_ligaments else ()
        for name in names:
            if name.removeprefix("generic_").startswith(generic):
                raise ValueError(f"'{name}' is in [generic_ligaments] and in [[ligament]]")
        muscles = [muscle.name for muscle in self.muscle] + ["quadriceps"] * bool(self.quadriceps)
        if len(muscles) != len(set(muscles)):
            raise ValueError("two muscles have the same name; [quadriceps] is named quadriceps")
        parts = (muscles, self.patellar_ligament, self.patella)
        if any(parts) and not all(parts):
            raise ValueError(
                "[quadriceps] (or [[muscle]]), [patellar_ligament] and [patella] go together: "
                "give all or none"
            )
        if self.muscles and not self.patella:
            raise ValueError("[muscles] needs [quadriceps], [patellar_ligament] and [patella]")
        ligament = self.patellar_ligament
        solved = self.patella is not None and self.patella.motion == "solved"
        if solved and (ligament is None or ligament.length_mm is None):
            raise ValueError("[patella] motion = 'solved' needs [patellar_ligament] length_mm")
        needs_implant = {
            "[contact]": self.contact is not None,
            "[generic_ligaments]": bool(generic),
            "[motion] motion = 'roll-slip'": self.motion.motion == "roll-slip",
        }
        for name, wish in needs_implant.items():
            if wish and not (self.implant.femoral and self.implant.insert):
                raise ValueError(f"{name} needs [implant.femoral] and [implant.insert]")
        contact = self.contact
        if contact and contact.patellofemoral and not (self.implant.patella and self.patella):
            raise ValueError("[contact.patellofemoral] needs [implant.patella] and [patella]")
        if self.patella and self.patella.released and not (contact and contact.patellofemoral):
            raise ValueError("[patella] released needs [contact.patellofemoral]")
        if self.material and contact and "material" in contact.model_fields_set:
            raise ValueError("[material] and [contact] material name two materials: give one")
        own_yield = self.material is not None and self.material.yield_stress_MPa is not None
        if own_yield and "yield_stress_MPa" in self.output.model_fields_set:
            raise ValueError("[material] and [output] both give yield_stress_MPa: give one")
        if self.material and not contact:
            raise ValueError("[material] needs [contact], which uses it")
        if self.output.cycle_s and self.motion.cycle_s:
            raise ValueError("[motion] cycle_s already states the cycle: drop [output] cycle_s")
        if self.tibia and self.motion.markers:
            raise ValueError("[motion.markers] places the shank too: drop [tibia]")
        if self.ground_reaction and not (self.tibia or self.motion.markers):
            raise ValueError("[ground_reaction] needs [tibia], the shank's pose in the laboratory")
        return self


def load_scene(
    path: str | Path, overrides: dict[str, Any] | None = None, preset: str | None = None
) -> Scene:
    """Read and validate a scene file.

    Args:
        path: a TOML file; paths inside it are relative to its folder.
        overrides: dotted key ("contact.model") -> value, applied before validation.
        preset: name of a preset (`tkamb.io.presets`), applied before the overrides.

    Raises:
        InputError: the file cannot be read, a key is unknown or missing, a value is out of range,
            the preset does not exist, or the scene lacks data for it.
    """
    must_be(path, (str, os.PathLike), "load_scene", "give the path of a scene file")
    path = Path(path)
    if os.path.isfile(path / "scene.toml"):  # also False for an invalid name, unlike Path.is_file
        raise InputError("is a folder, not a file", path, f"give {path / 'scene.toml'}")
    content = _content(path)
    applied = None if preset is None else _apply_preset(content, preset, overrides or {}, path)
    _apply_overrides(content, overrides or {})
    try:
        scene = Scene.model_validate(content)
    except ValidationError as error:
        raise _complaint(error, path, overrides or {}) from None
    resolved: Scene = _resolve_paths(scene, path.parent)
    resolved._overrides = dict(overrides or {})
    resolved._preset = applied
    return resolved


def with_preset(scene: Scene, preset: str, overrides: dict[str, Any] | None = None) -> Scene:
    """Return a scene with a preset applied. Its overrides stay, and replace the preset's values."""
    content = scene.model_dump(exclude_unset=True)
    more = scene.overrides | (overrides or {})
    applied = _apply_preset(content, preset, more, "scene")
    result = _changed(content, more)
    result._preset = applied
    return result


def with_overrides(scene: Scene, overrides: dict[str, Any]) -> Scene:
    """Return a scene with overrides applied, as `load_scene` applies them to a file.

    Args:
        scene: the scene; its overrides and its preset stay.
        overrides: dotted key -> value; a relative path is relative to the working directory.
    """
    result = _changed(scene.model_dump(exclude_unset=True), scene.overrides | overrides)
    result._preset = scene.preset
    return result


def _changed(content: dict[str, Any], overrides: dict[str, Any]) -> Scene:
    _apply_overrides(content, overrides)
    try:
        result = Scene.model_validate(content)
    except ValidationError as error:
        raise _complaint(error, Path("scene"), overrides) from None
    result._overrides = overrides
    return result


def _apply_overrides(content: dict[str, Any], overrides: Mapping[str, Any]) -> None:
    """An override of a material or yield stress removes the quantity from its other table."""
    for key, value in overrides.items():
        _override(content, key, value)
    tables = {key.partition(".")[0] for key in overrides}
    if "material" in tables and "contact.material" not in overrides:
        _drop(content, "contact", "material")
    elif "contact.material" in overrides and "material" not in tables:
        content.pop("material", None)
    material = content.get("material")
    has_yield = isinstance(material, dict) and "yield_stress_MPa" in material
    if "material" in tables and has_yield and "output.yield_stress_MPa" not in overrides:
        _drop(content, "output", "yield_stress_MPa")


def _drop(content: dict[str, Any], table: str, key: str) -> None:
    if isinstance(content.get(table), dict):
        content[table].pop(key, None)


def _apply_preset(
    content: dict[str, Any], name: str, overrides: dict[str, Any], where: object
) -> "AppliedPreset":
    from tkamb.io.presets import find_preset

    return find_preset(name).apply(content, overrides, where)


def scene_files(path: Path) -> list[Path]:
    """Return a readable scene file and its base file, if it has one."""
    base = _parse(path).get("base")
    return [path] if base is None else [path, path.parent / base]


def _content(path: Path) -> dict[str, Any]:
    content = _parse(path)
    if "base" not in content:
        return content
    name = content["base"]
    if not isinstance(name, str) or name != Path(name).name:
        raise InputError("'base' is not a file name", path, "name a scene file in the same folder")
    base = _parse(path.parent / name)
    if "base" in base:
        raise InputError(f"its base {name} has a base itself", path, "name that base instead")
    return _merge(base, content)


def _merge(base: dict[str, Any], content: dict[str, Any]) -> dict[str, Any]:
    merged = base | content
    for key, value in content.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            merged[key] = _merge(base[key], value)
    return merged


def _parse(path: Path) -> dict[str, Any]:
    return read_toml(path, what="scene file")


def scene_schema() -> dict[str, Any]:
    """Return the JSON schema of the scene file."""
    return Scene.model_json_schema()


def _override(content: dict[str, Any], dotted: str, value: Any) -> None:
    *tables, key = dotted.split(".")
    for k, name in enumerate(tables):
        content = content.setdefault(name, {})
        if not isinstance(content, dict):
            what, hint = "is a list: an option sets it as a whole", "change it in the scene file"
            if not isinstance(content, list):
                what, hint = "has no keys", "`tkamb scene --schema` lists every key"
            table = ".".join(tables[: k + 1])
            raise InputError(f"'{table}' {what}", f"overrides {dotted}", hint)
    content[key] = value


def _complaint(error: ValidationError, path: Path, overrides: dict[str, Any]) -> InputError:
    """Return the error to correct first: unknown keys may be misspelt ones."""
    result = error.errors()
    rank = {"extra_forbidden": 0, "missing": 2}
    first = min(result, key=lambda complaint: rank.get(complaint["type"], 1))
    key = ".".join(str(part) for part in first["loc"])
    option = next((o for o in overrides if f"{o}.".startswith(f"{key}.") or o == key), None)
    where = path if option is None else f"overrides {option}"
    more = f" ({len(result) - 1} more after this one)" if len(result) > 1 else ""
    if first["type"] == "extra_forbidden":
        model = _model_at(first["loc"][:-1])
        keys = [] if model is None else list(model.model_fields)
        advice = names_near(str(first["loc"][-1]), keys)
        return InputError(f"unknown key '{key}'", where, f"{advice}{_tables_with(first)}{more}")
    advice = f"`tkamb scene --schema` lists every key{more}"
    if first["type"] == "missing":
        return InputError(f"missing key '{key}'", where, advice)
    message = first["msg"].removeprefix("Value error, ")
    message = message.removeprefix("Input ")
    if first["type"] in ("float_type", "int_type", "bool_type"):
        message += f", not {_shown(first['input'])}"
    elif first["type"] == "literal_error":
        message += f", not {first['input']!r}"
    if first["type"] in ("tuple_type", "list_type"):
        message = _as_list(key, first["input"], option == key)
    return InputError(f"'{key}': {message}" if key and option != key else message, where, advice)


def _as_list(key: str, value: Any, from_command_line: bool) -> str:
    """Return how to write a single value as a list."""
    if isinstance(value, dict):
        return f"is one table; write [[{key}]], with two brackets, above each"
    words = json.dumps(value, default=str)
    written = (
        f"--set '{key}=[{words}]'" if from_command_line else f"{key.split('.')[-1]} = [{words}]"
    )
    return f"{words} is not a list; write it in brackets: {written}"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}" in quotes' if isinstance(value, str) else str(value)


def _model_at(place: tuple[int | str, ...]) -> type[BaseModel] | None:
    model: type[BaseModel] | None = Scene
    for part in place:
        if isinstance(part, int):
            continue
        field = None if model is None else model.model_fields.get(part)
        model = None if field is None else _table_in(field.annotation)
    return model


def _table_in(annotation: Any) -> type[BaseModel] | None:
    """Return the class in `T`, `T | None` or `tuple[T, ...]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((t for a in get_args(annotation) if (t := _table_in(a)) is not None), None)


def _tables_with(complaint: ErrorDetails) -> str:
    """Return which other tables have an unknown key, or ""."""
    key = complaint["loc"][-1]
    table = _model_at(complaint["loc"][:-1])
    tables = {name: _model_at((name,)) for name in Scene.model_fields}
    named = [f"[{n}]" for n, m in tables.items() if m and m is not table and key in m.model_fields]
    return f"; '{key}' is a key of {', '.join(named)}" if named else ""


def _resolve_paths(model: Any, folder: Path) -> Any:
    """Make paths relative to the scene's folder absolute."""
    changed: dict[str, Any] = {}
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, Path):
            changed[name] = Path(os.path.abspath(folder / value))
        elif isinstance(value, SceneTable):
            changed[name] = _resolve_paths(value, folder)
        elif isinstance(value, tuple) and value and isinstance(value[0], SceneTable):
            changed[name] = tuple(_resolve_paths(table, folder) for table in value)
    return model.model_copy(update=changed) if changed else model
