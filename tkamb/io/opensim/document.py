"""XML of an OpenSim file and of the files that it includes.

OpenSim's reader accepts a bare `&` in a text, bytes that are not UTF-8, `--` within a comment and
text after the last element. So does tkamb, with a notice. An element with `file="other.xml"` is
replaced by the element in the other file. If an element lacks a value, the value is read from the
file's <defaults>.
"""

import copy
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.files import parse_xml, read_bytes
from tkamb.geometry.frames import Array
from tkamb.io.opensim.model import (
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
    """An OpenSim document, with the default values of its classes.

    Args:
        defaults: name of a class -> element with the default values of the class.
        partial: whether an element that cannot be read is added to `unread`, with the reason;
            otherwise it is an error.
    """

    path: Path
    defaults: dict[str, Element]
    partial: bool = False
    unread: list[tuple[Element, str]] = field(default_factory=list)

    @contextmanager
    def reading(self, element: Element) -> Iterator[None]:
        """Read an element in a block; if `partial`, its error is added to `unread`."""
        try:
            yield
        except InputError as error:
            if not self.partial:
                raise
            self.unread.append((element, str(error)))

    def where(self, element: Element) -> str:
        """Return the file, class and name of an element, for messages."""
        return f"{self.path}: {element.tag} '{element.get('name', '')}'"

    def find(self, element: Element, *tags: str) -> Element | None:
        """Return the first child with one of these tags, in the element or in the defaults."""
        for source in (element, self.defaults.get(element.tag)):
            for tag in tags if source is not None else ():
                result = source.find(tag)  # type: ignore[union-attr]
                if result is not None:
                    return result
        return None

    def text(self, element: Element, *tags: str, default: str | None = None) -> str:
        """Return the text of the first child with one of these tags."""
        result = self.find(element, *tags)
        text = "" if result is None else (result.text or "").strip()
        if text or default is not None:
            return text or str(default)
        raise InputError(f"has no <{tags[0]}>", self.where(element))

    def socket(self, element: Element, name: str, *old_tags: str, default: str = "") -> str:
        """Return the path or name of the object at a socket.

        The tag depends on the file's version. Version 4 has <socket_NAME>. Versions 30508 to 30515
        have <connector_NAME_connectee_name> or <socket_NAME_connectee_name>. Earlier ones have
        <connectors> with one <connectee_name> per socket. Version 3 has a tag per kind of socket.

        Args:
            name: name of the socket, such as "parent_frame".
            old_tags: tags of the socket in version 3.
            default: value for an unconnected socket; "": an unconnected socket is an error.
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
        """Return the numbers (count,) in a child's text, which may have brackets and commas."""
        text = self.text(element, *tags, default=default)
        try:
            values = np.array(_number_words(text, count), float)
        except ValueError:
            values = np.array([np.nan])
        if not np.isfinite(values).all() or count not in (None, len(values)):
            needed = "numbers" if count is None else f"{count} number{'s' * (count > 1)}"
            raise InputError(
                f"<{tags[0]}>{text[:60]}</{tags[0]}> is not {needed}", self.where(element)
            )
        return values

    def number(self, element: Element, *tags: str, default: float | None = None) -> float:
        """Return the number in a child's text."""
        written = None if default is None else repr(default)
        return float(self.numbers(element, *tags, count=1, default=written)[0])

    def flag(self, element: Element, tag: str, default: bool) -> bool:
        """Return whether the text of a child is "true"."""
        text = self.text(element, tag, default=str(default)).lower()
        if text not in ("true", "false"):
            raise InputError(
                f"<{tag}>{text}</{tag}> is neither true nor false", self.where(element)
            )
        return text == "true"

    def name(self, element: Element) -> str:
        """Return an element's name.

        Raises:
            InputError: the element has no name.
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
        """Return the function that an element describes."""
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
            "tkamb reads Constant, LinearFunction, PolynomialFunction, PiecewiseLinearFunction, "
            "SimmSpline and MultiplierFunction",
        )

    def held_function(self, element: Element, tag: str) -> Function | None:
        """Return the function in <tag>, or else a child function with the name `tag`, or None."""
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


def _number_words(text: str, count: int | None) -> list[str]:
    """Split a list of numbers into words.

    Like OpenSim's reader, this function also splits `(0 1 0)`, `~[0,1,0]` and `0, 1, 0`. Commas
    separate numbers only if they give `count` numbers. Otherwise they may be decimal commas.
    """
    if count is None or count < 2:
        return text.split()
    plain = text.strip().lstrip("~([").rstrip(")]")
    return plain.split(",") if plain.count(",") == count - 1 else plain.split()


WHAT = "OpenSim model"


# Largest depth of files that include further files. OpenSim's own models have depth 1.
MAX_NESTED_FILES = 5


NOT_NEEDED = ("ControllerSet", "ProbeSet", "ContactGeometrySet", "AnalysisSet")
"""Sets that tkamb does not model. Their files may be absent."""

_BARE_AMPERSAND = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#[0-9]+|#x[0-9a-fA-F]+);)")
_COMMENT = re.compile(r"<!--(.*?)-->", re.S)
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")
_DECLARATION = re.compile(r"^\s*<\?xml[^>]*\?>")
_END = re.compile(r"</OpenSimDocument\s*>")


def open_document(path: Path) -> tuple[Element, list[str]]:
    """Return a file's root element with included files, and notices."""
    notices: list[str] = []
    root = _read(path, notices)
    for element in root:
        _include(element, path, (path.resolve(),), notices)
    return root, notices


def _read(path: Path, notices: list[str]) -> Element:

    content = read_bytes(path, what=WHAT)
    try:
        return parse_xml(content, path, what=WHAT)
    except InputError as error:
        text, repairs = _lenient(content)
        if not repairs:
            raise
        try:
            root = parse_xml(text.encode("utf-8"), path, what=WHAT)
        except InputError:
            raise error from None  # this error has the line number of the unchanged file
    notices.append(
        f"{path.name} is not strict XML ({', '.join(repairs)}), read as OpenSim reads it"
    )
    return root


def _lenient(content: bytes) -> tuple[str, list[str]]:
    """Return strict XML without a declaration, and words on each repair."""
    repairs = []
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        repairs.append(f"line {line} is not UTF-8, taken as Latin-1")
        text = content.decode("cp1252", errors="replace")
    text, count = _DECLARATION.subn("", text)
    if not count and content.lstrip()[:5] == b"<?xml":
        repairs.append("its XML declaration")
    if content[:1].isspace():
        repairs.append("blanks before its first line")
    if "<!DOCTYPE" not in text and (result := _BARE_AMPERSAND.search(text)):
        repairs.append(f"a bare & in line {text.count(chr(10), 0, result.start()) + 1}")
        text = _BARE_AMPERSAND.sub("&amp;", text)
    plain = _COMMENT.sub(lambda m: f"<!--{re.sub('-+', '-', m[1]).strip('-')}-->", text)
    if "--" in "".join(_COMMENT.findall(text)):
        repairs.append("-- within a comment")
        text = plain
    if _CONTROL.search(text):
        repairs.append("control characters")
        text = _CONTROL.sub("", text)
    if (end := _END.search(text)) and text[end.end() :].strip():
        repairs.append("text after its last element")
        text = text[: end.end()]
    return text, repairs


def _include(element: Element, path: Path, opened: tuple[Path, ...], notices: list[str]) -> None:
    while (name := element.attrib.pop("file", "").strip()) and name.lower() != "unassigned":
        path, opened = _replace(element, name, path, opened, notices)
    for child in element:
        _include(child, path, opened, notices)


def _replace(
    element: Element, name: str, path: Path, opened: tuple[Path, ...], notices: list[str]
) -> tuple[Path, tuple[Path, ...]]:
    """Return the included file, and all opened files."""
    where = f"{path}: {element.tag} file='{name}'"
    included = path.parent / name.replace("\\", "/")
    if not included.is_file() and element.tag in NOT_NEEDED:
        notices.append(f"{element.tag} is left out: its file {name} does not exist")
        return path, opened
    if included.resolve() in opened or len(opened) > MAX_NESTED_FILES:
        raise InputError("names a file that includes this one, or nests files too deep", where)
    if not included.exists():
        raise InputError(
            f"names a file that does not exist ({included})", where, "put it beside the model"
        )
    root = _read(included, notices)
    target = root
    if root.tag == "OpenSimDocument":
        matches = [child for child in root if child.tag == element.tag]
        if not matches:
            raise InputError(f"names a file without a <{element.tag}> ({included})", where)
        target = matches[0]
    if target.tag != element.tag:
        raise InputError(f"names a file with a <{target.tag}> instead of a <{element.tag}>", where)
    for source in (target, root):
        _apply_defaults(target, source.find("defaults"))
    element[:] = [child for child in target if child.tag != "defaults"]
    element.text = target.text
    for key, value in target.attrib.items():
        element.attrib.setdefault(key, value)
    notices.append(f"{element.tag} read from {name}")
    return included, (*opened, included.resolve())


def _apply_defaults(target: Element, defaults: Element | None) -> None:
    by_tag = {} if defaults is None else {entry.tag: entry for entry in defaults}
    inside = set() if defaults is None else set(defaults.iter())
    for element in [e for e in target.iter() if e.tag in by_tag and e not in inside]:
        tags = {child.tag for child in element}
        element.extend(copy.deepcopy(c) for c in by_tag[element.tag] if c.tag not in tags)
