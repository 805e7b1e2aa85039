"""`tkamb new`: a folder with a commented scene and its files, which runs as it is."""

import argparse
import shutil
import tempfile
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from tkamb.errors import InputError


def lay_out(directory: Path) -> Path:
    """Write the starter scene with its files into a new or empty folder; return the scene.

    The folder appears whole or not at all.

    Raises:
        InputError: the folder holds something, or cannot be written.
    """
    directory = Path(directory)
    try:
        if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
            mend = "give a new folder: nothing of yours is overwritten"
            raise InputError("is there already and not empty", directory, mend)
        directory.parent.mkdir(parents=True, exist_ok=True)
        with (
            as_file(files("tkamb.starter") / "files") as source,
            tempfile.TemporaryDirectory(dir=directory.parent, prefix=".tkamb-new-") as beside,
        ):
            whole = Path(beside) / directory.name
            shutil.copytree(source, whole)
            whole.replace(directory)  # an empty folder of that name is replaced too
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", directory) from None
    return directory / "scene.toml"


def add_new(commands: Any) -> None:
    """Add the command `new` to the parser's commands."""
    new = commands.add_parser("new", help="a commented scene with its files, to start from")
    new.add_argument("folder", type=Path, metavar="FOLDER", help="new or empty")
    new.set_defaults(command=_new)


def _new(options: argparse.Namespace) -> int:
    scene = lay_out(options.folder)
    print(f"written: {scene}\nnext: tkamb check {scene}")
    return 0
