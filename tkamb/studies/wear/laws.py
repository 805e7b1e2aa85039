"""Wear laws: depth that the pressures and the sliding of a cycle remove at each point of the
insert.

A law is a frozen dataclass of its parameters. `wear_law` finds it by name, the built-in ones and
those of other packages:

    [project.entry-points."tkamb.wear"]
    my-law = "my_package.my_module:MyLaw"
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from tkamb.contact.named_classes import NamedClasses
from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array
from tkamb.studies.wear.sliding import SlidingHistory
from tkamb.units import MEGAPASCAL

PER_NEWTON_METRE = 1e-9
"""m³/(N m) per mm³/(N m)."""


@dataclass(frozen=True)
class WearLawSettings:
    """Which wear factors are accepted."""

    max_wear_factor: float = 1e-3
    """mm³/(N m); a hundred times the largest that was measured for polyethylene in a joint."""


WEAR_LAW = WearLawSettings()


class WearLaw(ABC):
    """Worn depth per cycle from the history of one cycle.

    A subclass is a frozen dataclass whose fields are its parameters, with their units in their
    names: they are the keys of a material's table.
    """

    name: ClassVar[str]
    assumes: ClassVar[str]
    geometry: ClassVar[str] = "the law does not say how its volume follows the insert's geometry"
    """How the worn volume depends on the insert's geometry, in words that are printed beside it."""

    @abstractmethod
    def depth(self, history: SlidingHistory) -> Array:
        """Return the depth that one cycle wears off along the insert's normal, (n,) m."""


@dataclass(frozen=True)
class Archard(WearLaw):
    """Archard: h = k sum over steps of p s, whatever the direction.

    Args:
        wear_factor_mm3_per_Nm: k.

    Reference: Archard, J Appl Phys 24:981 (1953), doi:10.1063/1.1721448.
    """

    name: ClassVar[str] = "archard"
    assumes: ClassVar[str] = "h = k sum p s; one k, whatever the direction"
    geometry: ClassVar[str] = (
        "volume = k x sum of load x sliding path: the contact area cancels, so the volume hardly "
        "follows conformity and not thickness; they show in the depth"
    )

    wear_factor_mm3_per_Nm: float

    def __post_init__(self) -> None:
        check_factor(self.wear_factor_mm3_per_Nm, "wear_factor_mm3_per_Nm")

    def depth(self, history: SlidingHistory) -> Array:
        """Return k sum p s, (n,) m."""
        return self.wear_factor_mm3_per_Nm * PER_NEWTON_METRE * history.total_work


@dataclass(frozen=True)
class CrossShear(WearLaw):
    """Work across the principal direction wears `ratio` times as much as work along it.

        h = k(CS) sum p s,      k(CS) = k_iso 2 (1 + (ratio - 1) CS) / (1 + ratio)

    which is k_along W_along + k_across W_across with k_across = ratio k_along. The wear factor
    is what a test on a circular path finds, where CS = 1/2; k(0) is 2/(1 + ratio) of it.

    Args:
        wear_factor_mm3_per_Nm: k_iso, in multidirectional sliding with CS = 1/2.
        across_to_along: ratio, at least 1.
    """

    name: ClassVar[str] = "cross-shear"
    assumes: ClassVar[str] = "h = k(CS) sum p s; work across the principal direction wears more"
    geometry: ClassVar[str] = (
        "volume = k(CS) x sum of load x sliding path: the contact area cancels, so the volume "
        "follows the insert's geometry only by the path and the cross-shear ratio; conformity and "
        "thickness show in the depth"
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
        """Return k(CS) sum p s, (n,) m."""
        ratio = self.across_to_along
        share = 2.0 * (1.0 + (ratio - 1.0) * history.cross_shear) / (1.0 + ratio)
        return self.wear_factor_mm3_per_Nm * PER_NEWTON_METRE * share * history.total_work


@dataclass(frozen=True)
class PressureCrossShear(WearLaw):
    """A measured table k(CS, p): h = sum over steps of k(CS, p) p s.

    Bilinear between the table's points; beyond them the value at its edge holds.

    Args:
        cross_shear: rising, within 0 to 0.5.
        pressure_MPa: rising, not negative.
        wear_factor_mm3_per_Nm: one row per cross-shear ratio, one column per pressure.
    """

    name: ClassVar[str] = "pressure-cross-shear"
    assumes: ClassVar[str] = "h = sum k(CS, p) p s; k by a measured table"
    geometry: ClassVar[str] = (
        "volume = sum of k(CS, p) x load x sliding path: it follows the insert's geometry as far "
        "as the table's k follows the pressure"
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
        """Return sum k(CS, p) p s, (n,) m."""
        axes = (np.array(self.cross_shear), np.array(self.pressure_MPa) * MEGAPASCAL)
        table = RegularGridInterpolator(axes, np.array(self.wear_factor_mm3_per_Nm))
        shear = np.broadcast_to(history.cross_shear, history.pressure.shape)
        places = np.stack(
            [np.clip(v, a[0], a[-1]) for v, a in zip((shear, history.pressure), axes, strict=True)],
            axis=-1,
        )
        depth = (table(places) * history.work).sum(axis=0)
        return np.asarray(history.passes * PER_NEWTON_METRE * depth)


@dataclass(frozen=True)
class ContactArea(WearLaw):
    """Volume by area and path, whatever the pressure: W = C(CS) A s, so h = C(CS) sum s.

    The path counts while there is contact. C is linear between the given ratios and constant
    beyond them.

    Args:
        cross_shear: rising, within 0 to 0.5.
        coefficient: C at those ratios, m of depth per m of path.

    Reference: Liu, Fisher & Jin, Proc Inst Mech Eng J 226:552 (2012),
    doi:10.1177/1350650112441908.
    """

    name: ClassVar[str] = "contact-area"
    assumes: ClassVar[str] = "W = C(CS) A s; wear by area and path, whatever the pressure"
    geometry: ClassVar[str] = (
        "volume = C(CS) x contact area x sliding path: a more conforming or softer insert wears "
        "more, and the load counts only by the area"
    )

    cross_shear: tuple[float, ...]
    coefficient: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_cross_shears(self.cross_shear)
        if len(check_factors(self.coefficient, "coefficient")) != len(self.cross_shear):
            raise InputError("has another length than cross_shear", "coefficient")

    def depth(self, history: SlidingHistory) -> Array:
        """Return C(CS) sum s, (n,) m."""
        return np.interp(history.cross_shear, self.cross_shear, self.coefficient) * history.distance


def check_factor(value: Any, where: str) -> float:
    """Return a wear factor or coefficient.

    Raises:
        InputError: it is negative, not finite, or beyond all that was measured.
    """
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and math.isfinite(value) and 0 <= value <= WEAR_LAW.max_wear_factor):
        hint = f"give a number from 0 to {WEAR_LAW.max_wear_factor:g} in mm³/(N m)"
        raise InputError(f"cannot be {value}", where, hint)
    return float(value)


def check_factors(values: Any, where: str) -> list[float]:
    """Return each of a row of wear factors; see `check_factor`."""
    if not isinstance(values, tuple | list):
        raise InputError(f"cannot be {values}", where, "give a list of numbers")
    return [check_factor(value, where) for value in values]


def _rows(law: PressureCrossShear) -> Any:
    rows = law.wear_factor_mm3_per_Nm
    if not isinstance(rows, tuple | list):
        raise InputError(f"cannot be {rows}", "wear_factor_mm3_per_Nm", "give rows of numbers")
    return rows


def _check_cross_shears(values: Any) -> None:
    _check_rising(values, "cross_shear")
    if values[-1] > 0.5:
        raise InputError(f"holds {values[-1]}", "cross_shear", "the ratio lies within 0 to 0.5")


def _check_rising(values: Any, where: str) -> None:
    sound = (
        isinstance(values, tuple | list)
        and len(values) >= 2
        and all(isinstance(v, int | float) and math.isfinite(v) for v in values)
        and values[0] >= 0
        and all(a < b for a, b in pairwise(values))
    )
    if not sound:
        raise InputError(f"cannot be {values}", where, "give at least two rising numbers from 0")


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
    """Return the names of all wear laws, built-in ones first."""
    return WEAR_LAWS.names()


def law_class(name: str) -> type[WearLaw]:
    """Return the class behind a name.

    Raises:
        InputError: no such name, a name clash, or the class cannot be loaded or is no law.
    """
    return WEAR_LAWS.find(name)


def wear_law(name: str, parameters: Mapping[str, Any], where: object = None) -> WearLaw:
    """Return the law of that name with its parameters.

    Args:
        name: one of `law_names()`.
        parameters: the law's fields by name; all of them.
        where: the file or material they come from, for messages.

    Raises:
        InputError: no such law, a parameter that is missing or unknown, or a bad value.
    """
    result = law_class(name)
    own = [field.name for field in fields(result)]  # type: ignore[arg-type]
    table = f"[laws.{name}]" if where is None else f"{where}: [laws.{name}]"
    for key in parameters:
        if key not in own:
            raise InputError(f"has no parameter '{key}'", table, names_near(key, own))
    for key in own:
        if key not in parameters:
            raise InputError(f"does not give '{key}'", table, f"it needs: {', '.join(own)}")
    try:
        return result(**parameters)
    except InputError as error:
        raise InputError(error.what, f"{table}: {error.where}", error.hint) from None
