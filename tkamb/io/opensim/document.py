"""An OpenSim file and the files that it names, opened as OpenSim opens them.

OpenSim's XML reader is lenient: a bare `&` in a text, bytes that are not UTF-8, `--` within a
comment and text after the last element are read. The same is read here, with a notice. An
element with `file="other.xml"` is replaced by the element that the other file holds.
"""

import copy
import re
from dataclasses import dataclass
from pathlib import Path

from tkamb.errors import InputError
from tkamb.files import parse_xml, read_bytes
from tkamb.io.opensim.elements import Element

WHAT = "OpenSim model"


@dataclass(frozen=True)
class DocumentSettings:
    """Limits of reading an OpenSim file."""

    max_nested_files: int = 5
    """Files that name files in turn; OpenSim's own models nest one deep."""


DOCUMENT = DocumentSettings()

NOT_NEEDED = ("ControllerSet", "ProbeSet", "ContactGeometrySet", "AnalysisSet")
"""Sets of which tkamb reads only the names; their file may be absent."""

_BARE_AMPERSAND = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#[0-9]+|#x[0-9a-fA-F]+);)")
_COMMENT = re.compile(r"<!--(.*?)-->", re.S)
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")
_DECLARATION = re.compile(r"^\s*<\?xml[^>]*\?>")
_END = re.compile(r"</OpenSimDocument\s*>")


def open_document(path: Path) -> tuple[Element, list[str]]:
    """Return the root of an OpenSim file with its included files, and notices.

    Args:
        path: the file.

    Raises:
        InputError: it, or a file that it names and that is needed, cannot be read.
    """
    notices: list[str] = []
    root = _read(path, notices)
    for element in root:
        _include(element, path, (path.resolve(),), notices)
    return root, notices


def _read(path: Path, notices: list[str]) -> Element:
    """Return the root of one file, read strictly, and if that fails as OpenSim reads it."""
    content = read_bytes(path, what=WHAT)
    try:
        return parse_xml(content, path, what=WHAT)
    except InputError as error:
        text, mended = _lenient(content)
        if not mended:
            raise
        try:
            root = parse_xml(text.encode("utf-8"), path, what=WHAT)
        except InputError:
            raise error from None  # the place in the file as it is
    notices.append(f"{path.name} is not strict XML ({', '.join(mended)}), read as OpenSim reads it")
    return root


def _lenient(content: bytes) -> tuple[str, list[str]]:
    """Return the text as strict XML without its declaration, and what was done to it."""
    mended = []
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        mended.append(f"line {line} is not UTF-8, taken as Latin-1")
        text = content.decode("cp1252", errors="replace")
    text, count = _DECLARATION.subn("", text)
    if not count and content.lstrip()[:5] == b"<?xml":
        mended.append("its XML declaration")
    if content[:1].isspace():
        mended.append("blanks before its first line")
    if "<!DOCTYPE" not in text and (result := _BARE_AMPERSAND.search(text)):
        mended.append(f"a bare & in line {text.count(chr(10), 0, result.start()) + 1}")
        text = _BARE_AMPERSAND.sub("&amp;", text)
    plain = _COMMENT.sub(lambda m: f"<!--{re.sub('-+', '-', m[1]).strip('-')}-->", text)
    if "--" in "".join(_COMMENT.findall(text)):
        mended.append("-- within a comment")
        text = plain
    if _CONTROL.search(text):
        mended.append("control characters")
        text = _CONTROL.sub("", text)
    if (end := _END.search(text)) and text[end.end() :].strip():
        mended.append("text after its last element")
        text = text[: end.end()]
    return text, mended


def _include(element: Element, path: Path, opened: tuple[Path, ...], notices: list[str]) -> None:
    """Replace every element that names a file by what the file holds, in place."""
    while (name := element.attrib.pop("file", "").strip()) and name.lower() != "unassigned":
        path, opened = _replace(element, name, path, opened, notices)
    for child in element:
        _include(child, path, opened, notices)


def _replace(
    element: Element, name: str, path: Path, opened: tuple[Path, ...], notices: list[str]
) -> tuple[Path, tuple[Path, ...]]:
    """Take over one element from its file; return that file and all that lead to it."""
    where = f"{path}: {element.tag} file='{name}'"
    other = path.parent / name.replace("\\", "/")
    if not other.is_file() and element.tag in NOT_NEEDED:
        notices.append(f"{element.tag} left out: its file {name} is not there")
        return path, opened
    if other.resolve() in opened or len(opened) > DOCUMENT.max_nested_files:
        raise InputError("names a file that leads back to it", where)
    if not other.exists():
        raise InputError(
            f"names a file that is not there ({other})", where, "put it beside the model"
        )
    root = _read(other, notices)
    target = root
    if root.tag == "OpenSimDocument":
        of_tag = [child for child in root if child.tag == element.tag]
        if not of_tag:
            raise InputError(f"names a file that holds no <{element.tag}> ({other})", where)
        target = of_tag[0]
    if target.tag != element.tag:
        raise InputError(f"names a file that holds no <{element.tag}> but <{target.tag}>", where)
    for source in (target, root):
        _apply_defaults(target, source.find("defaults"))
    element[:] = [child for child in target if child.tag != "defaults"]
    element.text = target.text
    for key, value in target.attrib.items():
        element.attrib.setdefault(key, value)
    notices.append(f"{element.tag} read from {name}")
    return other, (*opened, other.resolve())


def _apply_defaults(target: Element, defaults: Element | None) -> None:
    """Write a file's own defaults into its elements; they do not apply to other files."""
    by_tag = {} if defaults is None else {entry.tag: entry for entry in defaults}
    inside = set() if defaults is None else set(defaults.iter())
    for element in [e for e in target.iter() if e.tag in by_tag and e not in inside]:
        tags = {child.tag for child in element}
        element.extend(copy.deepcopy(c) for c in by_tag[element.tag] if c.tag not in tags)
