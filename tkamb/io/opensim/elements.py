"""Values out of an OpenSim document's elements, with the file's own defaults."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.opensim.functions import (
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

    OpenSim omits values that equal the defaults, so that a missing element is looked up there.

    Args:
        path: the file.
        defaults: class -> the element that holds its default values.
        partial: whether what cannot be read is collected in `unread` instead of being refused.
        unread: elements that could not be read, and why.
    """

    path: Path
    defaults: dict[str, Element]
    partial: bool = False
    unread: list[tuple[Element, str]] = field(default_factory=list)

    @contextmanager
    def reading(self, element: Element) -> Iterator[None]:
        """Read one element; where that fails in a partial reading, it is left out and recorded."""
        try:
            yield
        except InputError as error:
            if not self.partial:
                raise
            self.unread.append((element, str(error)))

    def where(self, element: Element) -> str:
        """Return the file and the element for a message."""
        return f"{self.path}: {element.tag} '{element.get('name', '')}'"

    def find(self, element: Element, *tags: str) -> Element | None:
        """Return the first child with one of these tags, here or in the defaults."""
        for source in (element, self.defaults.get(element.tag)):
            for tag in tags if source is not None else ():
                result = source.find(tag)  # type: ignore[union-attr]
                if result is not None:
                    return result
        return None

    def text(self, element: Element, *tags: str, default: str | None = None) -> str:
        """Return the text of a child.

        Raises:
            InputError: there is none and no default.
        """
        result = self.find(element, *tags)
        text = "" if result is None else (result.text or "").strip()
        if text or default is not None:
            return text or str(default)
        raise InputError(f"has no <{tags[0]}>", self.where(element))

    def socket(self, element: Element, name: str, *old_tags: str, default: str = "") -> str:
        """Return what a socket is connected to, as any version since 2.3 writes it.

        Version 4 has <socket_NAME>, documents 30508 to 30515 <connector_NAME_connectee_name> or
        <socket_NAME_connectee_name>, those before <connectors> with a <connectee_name> for each,
        and version 3 a tag of its own.

        Args:
            element: whose socket it is.
            name: of the socket, such as "parent_frame".
            old_tags: what version 3 calls it.
            default: what is returned where it is connected to nothing; "" refuses that.

        Raises:
            InputError: there is none and no default.
        """
        for holder in element.findall("connectors/*"):
            if holder.get("name") == name:
                text = (holder.findtext("connectee_name") or "").strip()
                if text:
                    return text
        tags = (
            f"socket_{name}",
            f"socket_{name}_connectee_name",
            f"connector_{name}_connectee_name",
            *old_tags,
        )
        return self.text(element, *tags, default=default or None)

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
            needed = "numbers" if count is None else f"{count} number{'s' * (count > 1)}"
            raise InputError(
                f"<{tags[0]}>{text[:60]}</{tags[0]}> is not {needed}", self.where(element)
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
        """Yield the elements in <set_tag><objects>."""
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
