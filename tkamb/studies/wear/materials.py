"""Wear properties of the insert's material: wear laws with parameters, density, creep."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array
from tkamb.io.toml_text import read_toml
from tkamb.studies.wear.laws import WearLaw, law_class, wear_law
from tkamb.units import MEGAPASCAL

MINUTE = 60.0


@dataclass(frozen=True)
class LogarithmicCreep:
    """Creep strain proportional to pressure, and to the logarithm of time under it.

        strain(t) = p (c + b log10(t / t_ref)),        depth = strain times thickness

    p the time-mean pressure of the cycle. Before the time at which the bracket is zero the
    strain is zero. Where the pressure changes from block to block, each block adds the strain of
    the law between its own two times (time hardening).

    Args:
        compliance_per_MPa: c, strain per MPa at the reference time.
        per_decade_per_MPa: b, strain per MPa and tenfold time.
        reference_min: t_ref, minutes.
    """

    compliance_per_MPa: float
    per_decade_per_MPa: float
    reference_min: float

    def __post_init__(self) -> None:
        for key, lowest in (("compliance_per_MPa", 0.0), ("per_decade_per_MPa", 0.0)):
            value = getattr(self, key)
            if not (math.isfinite(value) and lowest <= value < 1.0):
                raise InputError(f"cannot be {value}", f"[creep] {key}", "give 0 to 1 per MPa")
        if not (math.isfinite(self.reference_min) and self.reference_min > 0):
            raise InputError(
                f"cannot be {self.reference_min}", "[creep] reference_min", "give minutes above 0"
            )

    def times(self, factor: float) -> "LogarithmicCreep":
        """Return the law with both constants times a factor."""
        compliance, per_decade = self.compliance_per_MPa, self.per_decade_per_MPa
        return LogarithmicCreep(compliance * factor, per_decade * factor, self.reference_min)

    def strain_per_pascal(self, time: float) -> float:
        """Return the strain per Pa of constant pressure after `time` (s)."""
        if time <= 0:
            return 0.0
        decades = math.log10(time / (self.reference_min * MINUTE))
        rise = self.compliance_per_MPa + self.per_decade_per_MPa * decades
        return max(rise, 0.0) / MEGAPASCAL

    def depth(self, pressure: Array, thickness: Array, begin: float, end: float) -> Array:
        """Return the depth (n,) m that creep adds between two times (s).

        Args:
            pressure: (n,) Pa, mean over time.
            thickness: (n,) m, of the insert under each point, along its normal.
            begin: s since the first load.
            end: s since the first load.
        """
        rise = self.strain_per_pascal(end) - self.strain_per_pascal(begin)
        return np.asarray(rise * pressure * thickness)


DEFAULT_MATERIAL = "conventional"
DENSITY_RANGE = (500.0, 3000.0)
"""kg/m³ that a bearing polymer may have."""
TWO_EITHER_WAY = (0.5, 2.0)
ASSUMED_RANGE = "a factor of two either way: by that much and more laboratories differ (assumption)"


@dataclass(frozen=True)
class WearMaterial:
    """A wear material with where its numbers come from.

    Args:
        name: name in messages.
        text: in words.
        density_kg_per_m3: turns volume into mass.
        law: the default law.
        laws: law -> its parameters.
        sources: one line per number.
        caution: what a reader must know before using the numbers; may be empty.
        creep: parameters of `LogarithmicCreep`; None: creep is not modelled.
        factor_range: lowest and highest factor on every law's depth that its sources allow.
        range_source: where that range comes from.
    """

    name: str
    text: str
    density_kg_per_m3: float
    law: str
    laws: Mapping[str, Mapping[str, Any]]
    sources: tuple[str, ...]
    caution: str = ""
    creep: LogarithmicCreep | None = None
    factor_range: tuple[float, float] = TWO_EITHER_WAY
    range_source: str = ASSUMED_RANGE

    def with_own_factor(self) -> "WearMaterial":
        """Return the material with the range of a wear factor that the user gives."""
        return replace(self, factor_range=TWO_EITHER_WAY, range_source=ASSUMED_RANGE, caution="")

    def all_laws(self) -> dict[str, WearLaw]:
        """Return every law that the material has parameters for."""
        return {name: wear_law(name, table, self.name) for name, table in self.laws.items()}

    def wear_law(self, name: str | None = None, wear_factor: float | None = None) -> WearLaw:
        """Return one of its laws.

        Args:
            name: of the law; None: the material's own choice.
            wear_factor: mm³/(N m), in place of the material's `wear_factor_mm3_per_Nm`.

        Raises:
            InputError: no such law, the material has no parameters for it, or the law has no
                single wear factor.
        """
        name = name or self.law
        parameters = dict(self.laws.get(name, {}))
        if wear_factor is not None:
            key = "wear_factor_mm3_per_Nm"
            if name != "archard" and not isinstance(parameters.get(key), float):
                raise InputError(
                    f"law '{name}' of material '{self.name}' has no single wear factor",
                    "--wear-factor",
                    "give a material file",
                )
            parameters[key] = wear_factor
        elif name not in self.laws:
            law_class(name)  # an unknown name is another mistake, with its own message
            raise InputError(
                f"material '{self.name}' has no parameters for the law '{name}'",
                hint=f"it has: {', '.join(self.laws)}; give the others in a material file",
            )
        return wear_law(name, parameters, self.name)


def material_names() -> tuple[str, ...]:
    """Return the names of the built-in wear materials."""
    return tuple(_built_in())


def wear_material(name: str | Path) -> WearMaterial:
    """Return a built-in wear material, or what a TOML file says.

    Raises:
        InputError: no such name or file, an unknown key, or a bad value.
    """
    built_in = _built_in()
    if str(name) in built_in:
        return _material(str(name), built_in[str(name)], f"wear material '{name}'")
    if Path(name).suffix != ".toml":
        hint = f"{names_near(str(name), built_in)}; or give a material file (.toml)"
        raise InputError(f"no wear material '{name}'", hint=hint)
    content = read_toml(name, what="wear material")
    return _material(str(content.pop("name", Path(name).stem)), content, name)


def _built_in() -> dict[str, Any]:
    text = files("tkamb.studies.wear").joinpath("materials.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def _material(name: str, content: dict[str, Any], where: object) -> WearMaterial:
    own = [field.name for field in fields(WearMaterial) if field.name != "name"]
    for key in content:
        if key not in own:
            raise InputError(f"unknown key '{key}'", where, names_near(key, own))
    for key in ("density_kg_per_m3", "law", "laws", "sources"):
        if key not in content:
            raise InputError(
                f"'{key}' is missing", where, f"add it; a material has the keys {', '.join(own)}"
            )
    density, laws = content["density_kg_per_m3"], content["laws"]
    low, high = DENSITY_RANGE
    if not (isinstance(density, int | float) and low <= density <= high):
        raise InputError(
            f"density_kg_per_m3 cannot be {density}", where, f"give {low:g} to {high:g}"
        )
    if not (isinstance(laws, dict) and all(isinstance(table, dict) for table in laws.values())):
        raise InputError("laws are not tables", where, "write [laws.archard] and its parameters")
    for law, parameters in laws.items():
        wear_law(law, parameters, where)
    if content["law"] not in laws:
        raise InputError(f"law '{content['law']}' has no parameters", where, names_near("", laws))
    return WearMaterial(
        name=name,
        text=str(content.get("text", name)),
        density_kg_per_m3=float(density),
        law=str(content["law"]),
        laws=laws,
        sources=_sources(content["sources"], where),
        caution=str(content.get("caution", "")),
        creep=_creep(content.get("creep"), where),
        factor_range=_factor_range(content, where),
        range_source=str(content.get("range_source", ASSUMED_RANGE)),
    )


def _factor_range(content: dict[str, Any], where: object) -> tuple[float, float]:
    limits = content.get("factor_range")
    if limits is None:
        return TWO_EITHER_WAY
    sound = (
        isinstance(limits, list)
        and len(limits) == 2
        and all(isinstance(one, int | float) and math.isfinite(one) for one in limits)
        and 0 < limits[0] <= 1 <= limits[1]
    )
    if not sound:
        hint = "give two factors, at most 1 and at least 1, e.g. [0.5, 2.0]"
        raise InputError(f"cannot be {limits}", f"{where}: factor_range", hint)
    if "range_source" not in content:
        raise InputError("'range_source' is missing", where, "say where the range comes from")
    return float(limits[0]), float(limits[1])


def _sources(value: Any, where: object) -> tuple[str, ...]:
    if not (isinstance(value, list) and value and all(isinstance(line, str) for line in value)):
        raise InputError(
            "sources is not a list of texts", where, "say where each number comes from"
        )
    return tuple(value)


def _creep(table: Any, where: object) -> LogarithmicCreep | None:
    if table is None:
        return None
    own = [field.name for field in fields(LogarithmicCreep)]
    if not isinstance(table, dict) or sorted(table) != sorted(own):
        raise InputError("[creep] is not complete", where, f"it needs: {', '.join(own)}")
    for key, value in table.items():
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"cannot be {value}", f"{where}: [creep] {key}", "give a number")
    return LogarithmicCreep(**{key: float(value) for key, value in table.items()})
