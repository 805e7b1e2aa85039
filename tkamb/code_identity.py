"""Identity of the computing code: the hash of the package's own source."""

import hashlib
from functools import lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parent
NO_NUMBERS = ("show", "commands")
"""Subpackages that change the presentation of results, not their values."""


@lru_cache(maxsize=4)
def code_identity(part: str = "") -> str:
    """Return the SHA-256 of the source of a subpackage, by default of the whole package.

    Code that only shows results, reads arguments or writes tables is left out.

    Args:
        part: path of the subpackage below the package, like "contact/lattice".
    """
    digest = hashlib.sha256()
    for path in sorted((PACKAGE / part).rglob("*.py")):
        name = path.relative_to(PACKAGE)
        shows = name.parts[0] in NO_NUMBERS or name.stem == "cli" or name.stem.endswith("command")
        if not shows and not name.stem.endswith("_report"):
            digest.update(name.as_posix().encode() + path.read_bytes())
    return digest.hexdigest()
