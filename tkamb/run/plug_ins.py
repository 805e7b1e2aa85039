"""Which code of another package computes contact or wear: the hash of that package.

The hash is part of a run's identity, as that of tkamb's code: a changed default in that package
changes numbers, but neither the scene nor tkamb.
"""

import hashlib
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

CONTACT_CODE = "code of the contact model"
"""Its name in a run's identity."""
SUFFIXES = (".py", ".so", ".pyd")


def contact_code(model: str) -> str | None:
    """Return the SHA-256 of the package that offers a contact model; None for a built-in one.

    Raises:
        InputError: no such name, or it cannot be loaded.
    """
    from tkamb.contact.registry import BUILT_IN, contact_class  # only where contact is modelled

    return None if model in BUILT_IN else package_code(contact_class(model).__module__)


def foreign_code(thing: object) -> str | None:
    """Return the SHA-256 of the package of an object's class; None for one of tkamb's."""
    module = type(thing).__module__
    return None if module.partition(".")[0] == "tkamb" else package_code(module)


def package_code(module: str) -> str:
    """Return the SHA-256 of the package of a module: its source, and what is compiled.

    Args:
        module: dotted name; a module without a package stands for its one file.

    Raises:
        ImportError: there is no such package.
    """
    spec = find_spec(module.partition(".")[0])
    if spec is None:
        raise ImportError(f"no package of module '{module}'")
    digest = hashlib.sha256()
    for root in spec.submodule_search_locations or ():
        for path in sorted(_code_in(Path(root))):
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    if spec.submodule_search_locations is None and spec.origin is not None:
        digest.update(Path(spec.origin).read_bytes())
    return digest.hexdigest()


def _code_in(folder: Path) -> Iterable[Path]:
    return (path for path in folder.rglob("*") if path.suffix in SUFFIXES and path.is_file())
