"""The command `tkamb new`, which writes a folder with a commented scene and its files."""

import argparse
import re
import shutil
import tempfile
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb.errors import InputError

if TYPE_CHECKING:
    from tkamb.io.starter.person import Person


def lay_out(directory: Path, person: "Person | None" = None) -> Path:
    """Write the starter scene into a new or empty folder, completely or not at all; return its
    path.

    Args:
        person: the patient; None: a man of 75 kg and 1.75 m, right knee.
    """
    directory = Path(directory)
    try:
        if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
            hint = "give a new folder: tkamb does not overwrite your files"
            raise InputError("exists already and is not empty", directory, hint)
        directory.parent.mkdir(parents=True, exist_ok=True)
        with (
            as_file(files("tkamb.io.starter") / "files") as source,
            tempfile.TemporaryDirectory(dir=directory.parent, prefix=".tkamb-new-") as scratch,
        ):
            copy = Path(scratch) / directory.name
            shutil.copytree(source, copy)
            if person is not None:
                from tkamb.io.starter.person import write_person

                write_person(copy, person)
            copy.replace(directory)  # This also replaces an empty folder of that name.
    except OSError as error:
        reason = error.strerror or _reason_of_copy(error)
        raise InputError(f"cannot be written ({reason})", directory) from None
    return directory / "scene.toml"


def _reason_of_copy(error: OSError) -> str:
    causes = error.args[0] if error.args else ()
    texts = [str(cause[-1]) for cause in causes if isinstance(cause, tuple) and cause]
    return re.sub(r"^\[Errno \d+\] |: '.*$", "", texts[0]) if texts else str(error)


def add_new(commands: Any) -> None:
    """Add the command `new` to the parser's commands."""
    new = commands.add_parser(
        "new",
        help="a commented scene with its files, to start from; a patient from mass and height",
    )
    new.add_argument("folder", type=Path, metavar="FOLDER", help="new or empty")
    new.add_argument("--side", choices=("left", "right"), help="of the knee; default right")
    new.add_argument("--mass-kg", type=float, metavar="KG", help="of the body; default 75")
    new.add_argument("--height-mm", type=float, metavar="MM", help="of the body; default 1750")
    new.add_argument(
        "--sex", choices=("female", "male"), help="which table of de Leva (1996); default male"
    )
    new.set_defaults(command=_new)


def _new(options: argparse.Namespace) -> int:
    scene = lay_out(options.folder, _person(options))
    print(f"written: {scene}\nnext: tkamb check {scene}")
    return 0


def _person(options: argparse.Namespace) -> "Person | None":
    values = {
        "side": options.side,
        "mass": options.mass_kg,
        "height": None if options.height_mm is None else options.height_mm * 1e-3,
        "sex": options.sex,
    }
    values = {key: value for key, value in values.items() if value is not None}
    if not values:
        return None
    from tkamb.io.starter.person import Person

    return Person(**values)
