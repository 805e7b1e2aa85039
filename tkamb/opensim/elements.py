"""Values out of an OpenSim document's elements, with the file's own defaults."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.opensim.functions import (
    Function,
    Linear,
    Polynomial,
    Scaled,
    piecewise_linear,
    simm_spline,
)

Element = ElementTree.Element


@dataclass(frozen=True, eq=False)
class Document:
    """An OpenSim document: where it lies, and what its <defaults> say for each class.

    OpenSim leaves out what equals the defaults, so that a missing element is looked up there.
    """

    path: Path
    defaults: dict[str, Element]

    def where(self, element: Element) -> str:
        """Return the file and the element for a message."""
        return f"{self.path}: {element.tag} '{element.get('name', '')}'"

    def find(self, element: Element, *tags: str) -> Element | None:
        """Return the first child with one of these tags, here or in the defaults."""
        for source in (element, self.defaults.get(element.tag)):
            for tag in tags if source is not None else ():
                found = source.find(tag)  # type: ignore[union-attr]
                if found is not None:
                    return found
        return None

    def text(self, element: Element, *tags: str, default: str | None = None) -> str:
        """Return the text of a child.

        Raises:
            InputError: there is none and no default.
        """
        found = self.find(element, *tags)
        text = "" if found is None else (found.text or "").strip()
        if text or default is not None:
            return text or str(default)
        raise InputError(f"has no <{tags[0]}>", self.where(element))

    def numbers(
        self, element: Element, *tags: str, count: int | None = None, default: str | None = None
    ) -> Array:
        """Return the numbers (count,) of a child.

        Raises:
            InputError: missing, not numbers, not finite or not as many.
        """
        text = self.text(element, *tags, default=default)
        try:
            values = np.array(text.split(), float)
        except ValueError:
            values = np.array([np.nan])
        if not np.isfinite(values).all() or count not in (None, len(values)):
            wanted = "numbers" if count is None else f"{count} number{'s' * (count > 1)}"
            raise InputError(
                f"<{tags[0]}>{text[:60]}</{tags[0]}> is not {wanted}", self.where(element)
            )
        return values

    def number(self, element: Element, *tags: str, default: float | None = None) -> float:
        """Return the one number of a child."""
        written = None if default is None else repr(default)
        return float(self.numbers(element, *tags, count=1, default=written)[0])

    def flag(self, element: Element, tag: str, default: bool) -> bool:
        """Return a child's true or false."""
        text = self.text(element, tag, default=str(default)).lower()
        if text not in ("true", "false"):
            raise InputError(
                f"<{tag}>{text}</{tag}> is neither true nor false", self.where(element)
            )
        return text == "true"

    def name(self, element: Element) -> str:
        """Return an element's name.

        Raises:
            InputError: it has none.
        """
        name = element.get("name", "").strip()
        if not name:
            raise InputError("has no name", self.where(element))
        return name

    def objects(self, owner: Element, set_tag: str) -> Iterator[Element]:
        """Yield what stands in <set_tag><objects>."""
        for holder in owner.findall(f"{set_tag}/objects"):
            yield from holder

    def function(self, element: Element) -> Function:
        """Return the function that an element describes.

        Raises:
            InputError: a function class that is not read, or a malformed one.
        """
        match element.tag:
            case "Constant":
                return Linear(0.0, self.number(element, "value", default=0.0))
            case "LinearFunction":
                gradient, offset = self.numbers(element, "coefficients", count=2)
                return Linear(float(gradient), float(offset))
            case "PolynomialFunction":
                return Polynomial(self.numbers(element, "coefficients"))
            case "MultiplierFunction":
                inner = self.held_function(element, "function")
                if inner is None:
                    raise InputError("has no <function>", self.where(element))
                return Scaled(inner, self.number(element, "scale", default=1.0))
            case "PiecewiseLinearFunction":
                return piecewise_linear(*self._knots(element))
            case "SimmSpline" | "NaturalCubicSpline" | "natCubicSpline":
                return simm_spline(*self._knots(element))
        raise InputError(
            "is a function that is not read",
            self.where(element),
            "Constant, LinearFunction, PolynomialFunction, PiecewiseLinearFunction, SimmSpline "
            "and MultiplierFunction are",
        )

    def held_function(self, element: Element, tag: str) -> Function | None:
        """Return the function in <tag>, or the one that stands beside it with that name."""
        holder = self.find(element, tag)
        if holder is not None and len(holder):
            return self.function(holder[0])
        for child in element:
            if child.get("name") == tag:
                return self.function(child)
        return None

    def _knots(self, element: Element) -> tuple[Array, Array]:
        x, y = self.numbers(element, "x"), self.numbers(element, "y")
        if len(x) != len(y) or len(x) < 2 or not (np.diff(x) > 0.0).all():
            raise InputError(
                "needs as many y as x, two at least, and x increasing", self.where(element)
            )
        return x, y
