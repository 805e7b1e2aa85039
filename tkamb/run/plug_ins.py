"""Plug-ins, which compute contact or wear: the hash of their code, and which one raised an error.

The hash is part of a run's identity, as that of tkamb's code: a changed default in that package
changes numbers, but neither the scene nor tkamb.
"""

import hashlib
from collections.abc import Iterable
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

CONTACT_CODE = "code of the contact model"
"""Its name in a run's identity."""
GROUPS = {"tkamb.contact": "contact model", "tkamb.wear": "wear law"}
"""Group of entry points -> what a plug-in of that group is."""
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


def raised_in(error: BaseException) -> str | None:
    """Return the plug-in that raised an error, with the line of its code; None: no plug-in did.

    The deepest call of the traceback decides that is of tkamb or of a plug-in: a plug-in may have
    raised the error by way of NumPy, say.
    """
    plug_ins = {
        point.value.partition(":")[0].partition(".")[0]: f"{kind} '{point.name}'"
        for group, kind in GROUPS.items()
        for point in entry_points(group=group)
    }
    result, trace = None, error.__traceback__
    while trace is not None:
        package = str(trace.tb_frame.f_globals.get("__name__")).partition(".")[0]
        if package == "tkamb":
            result = None
        elif package in plug_ins:
            file = Path(trace.tb_frame.f_code.co_filename).name
            result = f"{plug_ins[package]} ({package}, {file}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return result


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
