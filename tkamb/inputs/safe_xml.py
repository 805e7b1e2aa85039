"""XML read as a tree, with every entity declaration refused (expansion bombs, outside files)."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from xml.parsers import expat

from tkamb.errors import InputError


def parse_xml(path: Path, kind: str, mend: str | None = None) -> ElementTree.Element:
    """Return the root element of an XML file.

    Args:
        path: the file.
        kind: what it should be, for messages: "URDF".
        mend: what to do where the file is missing.

    Raises:
        InputError: missing, unreadable or malformed file, or one that declares entities.
    """
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data

    def refuse_entity(name: str, *_: object) -> None:
        raise InputError(
            f"declares an entity '{name}', which is refused", path, "write its text out"
        )

    parser.EntityDeclHandler = refuse_entity
    try:
        parser.Parse(path.read_bytes(), True)
        return builder.close()
    except FileNotFoundError:
        raise InputError(f"no such {kind}", path, mend) from None
    except (OSError, expat.ExpatError, ValueError, LookupError) as error:
        raise InputError(f"is not a readable {kind} ({error})", path) from None
