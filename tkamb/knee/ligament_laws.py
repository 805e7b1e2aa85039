"""Laws of ligament bundles: tension by length. A bundle pulls and never pushes.

L is the length, L0 the slack length, eps = (L - L0)/L0 the strain, and eps1 = 0.03:

    `TwoLine` (k in N/m)                        `QuadraticToe` (k in N per unit strain)
    F = 0                      eps <= 0         F = 0                      eps <= 0
    F = (k/2) (L - L0)         eps <= 2 eps1    F = k eps²/(4 eps1)        eps <= 2 eps1
    F = k (L - (1 + eps1) L0)  otherwise        F = k (eps - eps1)         otherwise

The slope of the two-line law jumps at 2 eps1. Another package offers a law through the entry-point
group `tkamb.ligaments`:

    [project.entry-points."tkamb.ligaments"]
    my-law = "my_package.my_module:MyLaw"

References: Shin et al., Med Sci Sports Exerc 39:1338 (2007); Blankevoort & Huiskes, J Biomech Eng
113:263 (1991), doi:10.1115/1.2894883.
"""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.named_classes import NamedClasses

# 1: eps1 of every ligament. The toe region ends at twice this strain. Source: Blankevoort &
# Huiskes (1991).
TOE_STRAIN = 0.03


@dataclass(frozen=True)
class LigamentLaw(ABC):
    """Base class of the laws; a subclass is a frozen dataclass whose fields are numbers.

    `tension` and `slope` use each field as a number or as an array, elementwise: bundles of one
    class are computed together.

    Args:
        stiffness: stiffness of the bundle, in the unit of the class.

    Attributes:
        unit: unit of `stiffness`.
        words: the law in a sentence, for the report.
        source: where the law was published.

    Raises:
        InputError: a number is not finite, or the stiffness is not positive.
    """

    stiffness: float
    unit: ClassVar[Literal["N/m", "N per strain"]]
    words: ClassVar[str] = "a law without a description"
    source: ClassVar[str] = "no source stated"

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            is_bad = isinstance(value, bool) or not isinstance(value, int | float | np.number)
            if is_bad or not math.isfinite(value) or (field.name == "stiffness" and value <= 0):
                raise InputError(
                    f"{field.name} {value!r}",
                    type(self).__name__,
                    f"give a finite number; stiffness is above 0, in {self.unit}",
                )

    @abstractmethod
    def tension(self, length: ArrayLike, slack_length: ArrayLike) -> Array:
        """Return the tension (N), never negative, at a length (m) with a slack length (m)."""

    @abstractmethod
    def slope(self, length: ArrayLike, slack_length: ArrayLike) -> Array:
        """Return the derivative (N/m) of `tension` by the length."""

    def stiffened(self, factor: float) -> Self:
        """Return the law with its stiffness times a factor."""
        return replace(self, stiffness=self.stiffness * factor)

    def scaled(self, size: float) -> Self:
        """Return the law of a knee that is `size` times as large, of the same tissue.

        Tensions become size² times as large, lengths size times; strains do not change.
        """
        return self.stiffened(size if self.unit == "N/m" else size**2)


@dataclass(frozen=True)
class TwoLine(LigamentLaw):
    """Two lines with half the slope below twice the toe strain; `stiffness` in N/m."""

    unit = "N/m"
    words = "F = (k/2)(L - L0) up to a strain of 0.06 and F = k(L - 1.03 L0) beyond it"
    source = "Shin 2007"

    def tension(self, length: ArrayLike, slack_length: ArrayLike) -> Array:
        """Return the tension, N."""
        length, slack = np.asarray(length, float), np.asarray(slack_length, float)
        # The first line has half the slope of the second line. They meet at twice the toe strain.
        toe = 0.5 * np.asarray(self.stiffness) * (length - slack)
        line = np.asarray(self.stiffness) * (length - (1.0 + TOE_STRAIN) * slack)
        return _by_region((length - slack) / slack, toe, line)

    def slope(self, length: ArrayLike, slack_length: ArrayLike) -> Array:
        """Return the slope, N/m."""
        strain = np.asarray(length, float) / np.asarray(slack_length, float) - 1.0
        return _by_region(strain, 0.5 * np.asarray(self.stiffness), np.asarray(self.stiffness))


@dataclass(frozen=True)
class QuadraticToe(LigamentLaw):
    """A parabola below twice the toe strain, then a line; `stiffness` in N per unit strain."""

    unit = "N per strain"
    words = "F = k eps^2/0.12 up to a strain of 0.06 and F = k(eps - 0.03) beyond it"
    source = "Blankevoort and Huiskes 1991"

    def tension(self, length: ArrayLike, slack_length: ArrayLike) -> Array:
        """Return the tension, N."""
        length, slack = np.asarray(length, float), np.asarray(slack_length, float)
        strain = (length - slack) / slack
        # Force and slope are continuous where the parabola meets the line, at twice the toe strain.
        toe = np.asarray(self.stiffness) * strain**2 / (4.0 * TOE_STRAIN)
        line = np.asarray(self.stiffness) * (strain - TOE_STRAIN)
        return _by_region(strain, toe, line)

    def slope(self, length: ArrayLike, slack_length: ArrayLike) -> Array:
        """Return the slope, N/m."""
        slack = np.asarray(slack_length, float)
        strain = np.asarray(length, float) / slack - 1.0
        share = np.clip(strain / (2.0 * TOE_STRAIN), 0.0, 1.0)
        return np.asarray(share * np.asarray(self.stiffness) / slack)


def _by_region(strain: Array, toe: Array, line: Array) -> Array:
    return np.where(strain <= 0.0, 0.0, np.where(strain <= 2.0 * TOE_STRAIN, toe, line))


LIGAMENT_LAWS = NamedClasses(
    "ligament law",
    LigamentLaw,  # type: ignore[type-abstract]
    "tkamb.ligaments",
    {
        "two-line": "tkamb.knee.ligament_laws:TwoLine",
        "quadratic-toe": "tkamb.knee.ligament_laws:QuadraticToe",
    },
)


def ligament_law(name: str, stiffness: float, **numbers: float) -> LigamentLaw:
    """Return the ligament law of a name.

    Args:
        name: "two-line", "quadratic-toe" or the name of another package's law.
        stiffness: stiffness in the unit of the law (`unit` of its class).
        numbers: other fields of the class.

    Raises:
        InputError: the name is unknown, or a number is missing, unknown or impossible.
    """
    cls = LIGAMENT_LAWS.find(name)
    try:
        return cls(stiffness, **numbers)
    except TypeError as error:
        raise InputError(str(error), f"ligament law '{name}'") from None


def law_name(law: LigamentLaw) -> str:
    """Return the name of a law; that of its class if no package offers it by name."""
    for name in LIGAMENT_LAWS.names():
        if LIGAMENT_LAWS.find(name) is type(law):
            return name
    return type(law).__name__


@dataclass(frozen=True, eq=False)
class StackedLaws:
    """The laws of m bundles, computed together: indices of each class, and its law with arrays."""

    groups: tuple[tuple[NDArray[np.intp], Any], ...]

    @classmethod
    def of(cls, laws: Sequence[LigamentLaw]) -> "StackedLaws":
        """Return the laws together."""
        indices: dict[type, list[int]] = {}
        for k, law in enumerate(laws):
            indices.setdefault(type(law), []).append(k)
        return cls(
            tuple((np.array(own), _stacked([laws[k] for k in own])) for own in indices.values())
        )

    def tension(self, length: Array, slack_length: Array) -> Array:
        """Return the tensions (..., m), N, at lengths (..., m) with slack lengths (m,), m."""
        return self._each("tension", length, slack_length)

    def slope(self, length: Array, slack_length: Array) -> Array:
        """Return the slopes (..., m), N/m."""
        return self._each("slope", length, slack_length)

    def _each(self, name: str, length: Array, slack_length: Array) -> Array:
        if len(self.groups) == 1:
            return np.asarray(getattr(self.groups[0][1], name)(length, slack_length))
        result = np.zeros(np.shape(length))
        for own, law in self.groups:
            result[..., own] = getattr(law, name)(length[..., own], slack_length[own])
        return result


def _stacked(laws: Sequence[LigamentLaw]) -> LigamentLaw:
    law = copy.copy(laws[0])
    for field in fields(law):
        object.__setattr__(law, field.name, np.array([getattr(one, field.name) for one in laws]))
    return law
