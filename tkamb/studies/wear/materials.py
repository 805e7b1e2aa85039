"""Wear properties of the insert's material: parameters of wear laws, density and creep."""

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
    """Creep strain proportional to pressure and linear in the logarithm of time.

        strain(t) = p (c + b log10(t / t_ref)),        depth = strain times thickness

    p is the time-mean pressure of the cycle. The strain is zero while the bracket is negative. If
    the pressure changes between blocks of cycles, each block adds the strain of the law between its
    first and last time (time hardening).

    Args:
        compliance_per_MPa: c, strain at the reference time, 1/MPa.
        per_decade_per_MPa: b, strain per tenfold time, 1/MPa.
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
        """Return the strain per constant pressure, 1/Pa, after `time`, s."""
        if time <= 0:
            return 0.0
        decades = math.log10(time / (self.reference_min * MINUTE))
        strain_per_MPa = self.compliance_per_MPa + self.per_decade_per_MPa * decades
        return max(strain_per_MPa, 0.0) / MEGAPASCAL

    def depth(self, pressure: Array, thickness: Array, begin: float, end: float) -> Array:
        """Return the depth that creep adds between two times, m, shape (n,).

        Args:
            pressure: time-mean pressure, Pa, shape (n,).
            thickness: thickness of the insert under each point, m, shape (n,).
            begin: first time, s since the first load.
            end: last time, s since the first load.
        """
        strain = self.strain_per_pascal(end) - self.strain_per_pascal(begin)
        return np.asarray(strain * pressure * thickness)


DEFAULT_MATERIAL = "conventional"
DENSITY_RANGE = (500.0, 3000.0)
"""kg/m³: accepted densities of a bearing polymer."""
TWO_EITHER_WAY = (0.5, 2.0)
ASSUMED_RANGE = "a factor of two either way, an assumption: laboratories differ by this and more"


@dataclass(frozen=True)
class WearMaterial:
    """A wear material with the sources of its numbers.

    Args:
        density_kg_per_m3: density, kg/m³.
        law: name of the default law.
        laws: name of a law -> its parameters.
        sources: sources of the numbers, one line per number.
        caution: warning that is printed with the results; may be empty.
        creep: creep law; None: creep is not modelled.
        factor_range: lowest and highest factor on the worn depth within the uncertainty of the
            sources.
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
        """Return the material for a user's wear factor, with the default range and no caution."""
        return replace(self, factor_range=TWO_EITHER_WAY, range_source=ASSUMED_RANGE, caution="")

    def all_laws(self) -> dict[str, WearLaw]:
        """Return name -> wear law for every law with parameters in the material."""
        return {name: wear_law(name, table, self.name) for name, table in self.laws.items()}

    def wear_law(self, name: str | None = None, wear_factor: float | None = None) -> WearLaw:
        """Return a wear law with the parameters of the material.

        Args:
            name: name of the law; None: the default law of the material.
            wear_factor: wear factor that replaces the one of the material, mm³/(N m).

        Raises:
            InputError: the law is unknown, the material has no parameters for it, or a wear factor
                is given for a law that does not have exactly one.
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
            law_class(name)  # an unknown name has another message
            raise InputError(
                f"material '{self.name}' has no parameters for the law '{name}'",
                hint=f"it has: {', '.join(self.laws)}; give the others in a material file",
            )
        return wear_law(name, parameters, self.name)


def material_names() -> tuple[str, ...]:
    """Return the names of the built-in wear materials."""
    return tuple(_built_in())


def wear_material(name: str | Path) -> WearMaterial:
    """Return a built-in wear material, or the material of a TOML file.

    Raises:
        InputError: the name or file does not exist, a key is unknown, or a value is invalid.
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
    keys = [field.name for field in fields(WearMaterial) if field.name != "name"]
    for key in content:
        if key not in keys:
            raise InputError(f"unknown key '{key}'", where, names_near(key, keys))
    for key in ("density_kg_per_m3", "law", "laws", "sources"):
        if key not in content:
            raise InputError(
                f"'{key}' is missing", where, f"add it; a material has the keys {', '.join(keys)}"
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
    valid = (
        isinstance(limits, list)
        and len(limits) == 2
        and all(isinstance(limit, int | float) and math.isfinite(limit) for limit in limits)
        and 0 < limits[0] <= 1 <= limits[1]
    )
    if not valid:
        hint = "give a first factor of at most 1 and a second of at least 1, e.g. [0.5, 2.0]"
        raise InputError(f"cannot be {limits}", f"{where}: factor_range", hint)
    if "range_source" not in content:
        raise InputError("'range_source' is missing", where, "give the source of the range")
    return float(limits[0]), float(limits[1])


def _sources(value: Any, where: object) -> tuple[str, ...]:
    if not (isinstance(value, list) and value and all(isinstance(line, str) for line in value)):
        raise InputError("sources is not a list of texts", where, "give the source of each number")
    return tuple(value)


def _creep(table: Any, where: object) -> LogarithmicCreep | None:
    if table is None:
        return None
    keys = [field.name for field in fields(LogarithmicCreep)]
    if not isinstance(table, dict) or sorted(table) != sorted(keys):
        raise InputError("[creep] is not complete", where, f"it needs: {', '.join(keys)}")
    for key, value in table.items():
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"cannot be {value}", f"{where}: [creep] {key}", "give a number")
    return LogarithmicCreep(**{key: float(value) for key, value in table.items()})
