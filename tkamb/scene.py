"""The scene: what exists and what is to be modelled. An absent table is not modelled.

A scene is a TOML file. Units are in the key names, paths are relative to the file, an
unknown key is an error. `load_scene` reads and validates it; nothing else is opened.
"""

import os
import tomllib
from pathlib import Path
from typing import Any, Self

from pydantic import Field, ValidationError, model_validator

from tkamb.errors import InputError
from tkamb.scene_tables import (
    ContactTable,
    GenericLigamentsTable,
    GroundReactionTable,
    ImplantTable,
    LigamentTable,
    MotionTable,
    OutputTable,
    PatellarLigamentTable,
    PatellaTable,
    PatientTable,
    QuadricepsTable,
    SceneTable,
    TibiaTable,
)


class Scene(SceneTable):
    """Everything a run needs to know; see the tables."""

    base: str | None = Field(
        None,
        description=(
            "name of another scene file in the same folder: its keys hold where this file does "
            "not give them, table by table; lists are replaced whole"
        ),
    )
    patient: PatientTable
    motion: MotionTable
    tibia: TibiaTable | None = None
    ground_reaction: GroundReactionTable | None = None
    implant: ImplantTable = ImplantTable()
    ligament: tuple[LigamentTable, ...] = ()
    generic_ligaments: GenericLigamentsTable | None = None
    quadriceps: QuadricepsTable | None = None
    patellar_ligament: PatellarLigamentTable | None = None
    patella: PatellaTable | None = None
    contact: ContactTable | None = None
    output: OutputTable = OutputTable()

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        names = [ligament.name for ligament in self.ligament]
        if len(names) != len(set(names)):
            raise ValueError("two [[ligament]] tables have the same name")
        generic = self.generic_ligaments.ligaments if self.generic_ligaments else ()
        for name in names:
            if name.removeprefix("generic_").startswith(generic):
                raise ValueError(f"'{name}' is in [generic_ligaments] and in [[ligament]]")
        parts = (self.quadriceps, self.patellar_ligament, self.patella)
        if any(parts) and not all(parts):
            raise ValueError(
                "[quadriceps], [patellar_ligament] and [patella] go together: give all or none"
            )
        ligament = self.patellar_ligament
        solved = self.patella is not None and self.patella.motion == "solved"
        if solved and (ligament is None or ligament.length_mm is None):
            raise ValueError("[patella] motion = 'solved' needs [patellar_ligament] length_mm")
        needs_implant = {
            "[contact]": self.contact is not None,
            "[generic_ligaments]": bool(generic),
            "[motion] motion = 'roll-slip'": self.motion.motion == "roll-slip",
        }
        for name, asked in needs_implant.items():
            if asked and not (self.implant.femoral and self.implant.insert):
                raise ValueError(f"{name} needs [implant.femoral] and [implant.insert]")
        if self.ground_reaction and not self.tibia:
            raise ValueError("[ground_reaction] needs [tibia]: how the shank stands in the lab")
        return self


def load_scene(path: str | Path, overrides: dict[str, Any] | None = None) -> Scene:
    """Read and validate a scene file.

    Args:
        path: a TOML file; paths inside it are relative to its folder.
        overrides: dotted key ("contact.model") -> value, applied before validation.

    Raises:
        InputError: unreadable file, unknown key, missing unit, value out of range.
    """
    path = Path(path)
    content = _content(path)
    for key, value in (overrides or {}).items():
        _override(content, key, value)
    try:
        scene = Scene.model_validate(content)
    except ValidationError as error:
        raise InputError(_first_complaint(error), path, _count(error)) from None
    return _resolved(scene, path.parent)


def _content(path: Path) -> dict[str, Any]:
    """Return what a scene file says, on top of what its base says."""
    content = _parsed(path)
    if "base" not in content:
        return content
    name = content["base"]
    if not isinstance(name, str) or name != Path(name).name:
        raise InputError("'base' is no file name", path, "name a scene file in the same folder")
    base = _parsed(path.parent / name)
    if "base" in base:
        raise InputError(f"its base {name} has a base itself", path, "name that one")
    return _merged(base, content)


def _merged(base: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return the base's keys with one's own in their place; tables are merged."""
    merged = base | own
    for key, value in own.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            merged[key] = _merged(base[key], value)
    return merged


def _parsed(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError("no such scene file", path, "check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read ({error})", path) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not TOML ({error})", path) from None


def scene_schema() -> dict[str, Any]:
    """Return the JSON schema of the scene file."""
    return Scene.model_json_schema()


def _override(content: dict[str, Any], dotted: str, value: Any) -> None:
    *tables, key = dotted.split(".")
    for name in tables:
        content = content.setdefault(name, {})
        if not isinstance(content, dict):
            raise InputError(f"'{dotted}' does not lead through tables", "--set")
    content[key] = value


def _first_complaint(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"unknown key '{where}'"
    if first["type"] == "missing":
        return f"missing key '{where}'"
    message = first["msg"].removeprefix("Value error, ")
    return f"'{where}': {message}" if where else message


def _count(error: ValidationError) -> str:
    more = error.error_count() - 1
    advice = "`tkamb scene --schema` lists every key"
    return advice if more == 0 else f"{advice} ({more} more after this one)"


def _resolved(model: Any, folder: Path) -> Any:
    """Return the model with its paths made absolute against the scene's folder."""
    changed: dict[str, Any] = {}
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, Path):
            changed[name] = Path(os.path.abspath(folder / value))
        elif isinstance(value, SceneTable):
            changed[name] = _resolved(value, folder)
    return model.model_copy(update=changed) if changed else model
