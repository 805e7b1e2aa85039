"""Wear laws, and their parameters of materials: worn depth from pressure and sliding in a cycle.

A law is a frozen dataclass of its parameters. `wear_law` finds built-in laws by name, and those
that other packages register:

    [project.entry-points."tkamb.wear"]
    my-law = "my_package.my_module:MyLaw"
"""

import math
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array
from tkamb.io.toml_text import read_toml
from tkamb.named_classes import NamedClasses
from tkamb.studies.wear.engine import SlidingHistory
from tkamb.units import MEGAPASCAL

PER_NEWTON_METRE = 1e-9
"""Factor from mm³/(N m) to m³/(N m)."""


@dataclass(frozen=True)
class WearLawSettings:
    """Accepted parameters of wear laws."""

    max_wear_factor: float = 1e-3
    """mm³/(N m): largest accepted wear factor. A hundred times the largest value measured
    for polyethylene in a joint."""


WEAR_LAW = WearLawSettings()


class WearLaw(ABC):
    """Worn depth per cycle from the sliding history of one cycle.

    A subclass is a frozen dataclass. Its fields are the parameters of the law and the keys in the
    table of a material. The name of a field includes its unit.
    """

    name: ClassVar[str]
    assumes: ClassVar[str]
    geometry: ClassVar[str] = (
        "the law does not state how the volume depends on the geometry of the insert"
    )
    """Printed sentence on how the worn volume depends on the geometry of the insert."""

    @abstractmethod
    def depth(self, history: SlidingHistory) -> Array:
        """Return the worn depth of one cycle along the insert's normal, m, shape (n,)."""


@dataclass(frozen=True)
class Archard(WearLaw):
    """Archard's law: depth h = k sum p s over the steps, for any direction of sliding.

    Args:
        wear_factor_mm3_per_Nm: wear factor k, mm³/(N m).

    Reference: Archard, J Appl Phys 24:981 (1953), doi:10.1063/1.1721448.
    """

    name: ClassVar[str] = "archard"
    assumes: ClassVar[str] = "h = k sum p s; the same k for any direction of sliding"
    geometry: ClassVar[str] = (
        "volume = k x sum of load x sliding path: the contact area cancels, so conformity hardly "
        "affects the volume and thickness does not; they affect the depth"
    )

    wear_factor_mm3_per_Nm: float

    def __post_init__(self) -> None:
        check_factor(self.wear_factor_mm3_per_Nm, "wear_factor_mm3_per_Nm")

    def depth(self, history: SlidingHistory) -> Array:
        """Return k sum p s, m, shape (n,)."""
        return self.wear_factor_mm3_per_Nm * PER_NEWTON_METRE * history.total_work


@dataclass(frozen=True)
class CrossShear(WearLaw):
    """Wear factor that increases with the cross-shear ratio CS.

        h = k(CS) sum p s,      k(CS) = k_iso 2 (1 + (ratio - 1) CS) / (1 + ratio)

    This is h = k_along W_along + k_across W_across with k_across = ratio k_along and the work W of
    friction along and across the principal direction of sliding. A test on a circular path
    (CS = 1/2) gives k_iso.

    Args:
        wear_factor_mm3_per_Nm: wear factor k_iso at CS = 1/2, mm³/(N m).
        across_to_along: ratio of the wear factors across and along, at least 1.
    """

    name: ClassVar[str] = "cross-shear"
    assumes: ClassVar[str] = "h = k(CS) sum p s; work across the principal direction wears more"
    geometry: ClassVar[str] = (
        "volume = k(CS) x sum of load x sliding path: the contact area cancels, so the geometry of "
        "the insert affects the volume only through the path and the cross-shear ratio; "
        "conformity and thickness affect the depth"
    )

    wear_factor_mm3_per_Nm: float
    across_to_along: float

    def __post_init__(self) -> None:
        check_factor(self.wear_factor_mm3_per_Nm, "wear_factor_mm3_per_Nm")
        if not 1 <= self.across_to_along < 1e4:
            raise InputError(
                f"is {self.across_to_along}", "across_to_along", "give a number of at least 1"
            )

    def depth(self, history: SlidingHistory) -> Array:
        """Return k(CS) sum p s, m, shape (n,)."""
        ratio = self.across_to_along
        share = 2.0 * (1.0 + (ratio - 1.0) * history.cross_shear) / (1.0 + ratio)
        return self.wear_factor_mm3_per_Nm * PER_NEWTON_METRE * share * history.total_work


@dataclass(frozen=True)
class PressureCrossShear(WearLaw):
    """Measured table of wear factors k(CS, p): depth h = sum k(CS, p) p s over the steps.

    The table is interpolated bilinearly. Outside its range the value at its edge is used.

    Args:
        cross_shear: increasing cross-shear ratios between 0 and 0.5.
        pressure_MPa: increasing pressures, MPa, at least 0.
        wear_factor_mm3_per_Nm: wear factors, mm³/(N m), with one row per cross-shear ratio and one
            column per pressure.
    """

    name: ClassVar[str] = "pressure-cross-shear"
    assumes: ClassVar[str] = "h = sum k(CS, p) p s; k from a measured table"
    geometry: ClassVar[str] = (
        "volume = sum of k(CS, p) x load x sliding path: the geometry of the insert affects the "
        "volume as far as k depends on pressure"
    )

    cross_shear: tuple[float, ...]
    pressure_MPa: tuple[float, ...]
    wear_factor_mm3_per_Nm: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        _check_cross_shears(self.cross_shear)
        _check_rising(self.pressure_MPa, "pressure_MPa")
        table = [check_factors(row, "wear_factor_mm3_per_Nm") for row in _rows(self)]
        shape = (len(self.cross_shear), len(self.pressure_MPa))
        if len(table) != shape[0] or any(len(row) != shape[1] for row in table):
            raise InputError(
                f"is not a table of {shape[0]} rows and {shape[1]} columns",
                "wear_factor_mm3_per_Nm",
                "give a row per cross-shear ratio and a column per pressure",
            )

    def depth(self, history: SlidingHistory) -> Array:
        """Return sum k(CS, p) p s, m, shape (n,)."""
        axes = (np.array(self.cross_shear), np.array(self.pressure_MPa) * MEGAPASCAL)
        table = RegularGridInterpolator(axes, np.array(self.wear_factor_mm3_per_Nm))
        shear = np.broadcast_to(history.cross_shear, history.pressure.shape)
        table_points = np.stack(
            [np.clip(v, a[0], a[-1]) for v, a in zip((shear, history.pressure), axes, strict=True)],
            axis=-1,
        )
        depth = (table(table_points) * history.work).sum(axis=0)
        return np.asarray(history.passes * PER_NEWTON_METRE * depth)


@dataclass(frozen=True)
class ContactArea(WearLaw):
    """Wear volume proportional to contact area and path: W = C(CS) A s, so depth h = C(CS) sum s.

    Only the path in contact counts. C is linear between the given cross-shear ratios and constant
    outside them.

    Args:
        cross_shear: increasing cross-shear ratios between 0 and 0.5.
        coefficient: C at these ratios, m of depth per m of path.

    Reference: Liu, Fisher & Jin, Proc Inst Mech Eng J 226:552 (2012),
    doi:10.1177/1350650112441908.
    """

    name: ClassVar[str] = "contact-area"
    assumes: ClassVar[str] = "W = C(CS) A s; pressure has no effect"
    geometry: ClassVar[str] = (
        "volume = C(CS) x contact area x sliding path: a more conforming or softer insert wears "
        "more, and the load has an effect only through the area"
    )

    cross_shear: tuple[float, ...]
    coefficient: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_cross_shears(self.cross_shear)
        coefficients = check_factors(self.coefficient, "coefficient", "m per m")
        if len(coefficients) != len(self.cross_shear):
            raise InputError("has another length than cross_shear", "coefficient")

    def depth(self, history: SlidingHistory) -> Array:
        """Return C(CS) sum s, m, shape (n,)."""
        return np.interp(history.cross_shear, self.cross_shear, self.coefficient) * history.distance


def check_factor(value: Any, where: str, unit: str = "mm³/(N m)") -> float:
    """Return a wear factor or coefficient after a check; `unit` is named in the message."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and math.isfinite(value) and 0 <= value <= WEAR_LAW.max_wear_factor):
        hint = f"give a number from 0 to {WEAR_LAW.max_wear_factor:g} in {unit}"
        raise InputError(f"cannot be {value}", where, hint)
    return float(value)


def check_factors(values: Any, where: str, unit: str = "mm³/(N m)") -> list[float]:
    """Return a list of wear factors after a check; see `check_factor`."""
    if not isinstance(values, tuple | list):
        raise InputError(f"cannot be {values}", where, "give a list of numbers")
    return [check_factor(value, where, unit) for value in values]


def _rows(law: PressureCrossShear) -> Any:
    rows = law.wear_factor_mm3_per_Nm
    if not isinstance(rows, tuple | list):
        raise InputError(f"cannot be {rows}", "wear_factor_mm3_per_Nm", "give rows of numbers")
    return rows


def _check_cross_shears(values: Any) -> None:
    _check_rising(values, "cross_shear")
    if values[-1] > 0.5:
        raise InputError(f"contains {values[-1]}", "cross_shear", "give ratios from 0 to 0.5")


def _check_rising(values: Any, where: str) -> None:
    valid = (
        isinstance(values, tuple | list)
        and len(values) >= 2
        and all(isinstance(v, int | float) and math.isfinite(v) for v in values)
        and values[0] >= 0
        and all(a < b for a, b in pairwise(values))
    )
    if not valid:
        raise InputError(
            f"cannot be {values}", where, "give at least two increasing numbers, none below 0"
        )


BUILT_IN = {
    "archard": "tkamb.studies.wear.laws:Archard",
    "cross-shear": "tkamb.studies.wear.laws:CrossShear",
    "pressure-cross-shear": "tkamb.studies.wear.laws:PressureCrossShear",
    "contact-area": "tkamb.studies.wear.laws:ContactArea",
}

WEAR_LAWS = NamedClasses(
    "wear law",
    WearLaw,  # type: ignore[type-abstract]
    "tkamb.wear",
    BUILT_IN,
)


def law_names() -> tuple[str, ...]:
    """Return the names of all wear laws. Built-in laws come first."""
    return WEAR_LAWS.names()


def law_class(name: str) -> type[WearLaw]:
    """Return the class of a wear law."""
    return WEAR_LAWS.find(name)


def wear_law(name: str, parameters: Mapping[str, Any], where: object = None) -> WearLaw:
    """Return the wear law with a name and parameters.

    Args:
        name: name of the law, one of `law_names()`.
        parameters: parameter -> value, for all parameters of the law.
    """
    result = law_class(name)
    names = [field.name for field in fields(result)]  # type: ignore[arg-type]
    table = f"[laws.{name}]" if where is None else f"{where}: [laws.{name}]"
    for key in parameters:
        if key not in names:
            raise InputError(f"has no parameter '{key}'", table, names_near(key, names))
    for key in names:
        if key not in parameters:
            raise InputError(f"does not give '{key}'", table, f"it needs: {', '.join(names)}")
    try:
        return result(**parameters)
    except InputError as error:
        raise InputError(error.what, f"{table}: {error.where}", error.hint) from None


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
    """Return a built-in wear material, or the material of a TOML file."""
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
