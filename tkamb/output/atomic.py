"""Files that are whole or not there: written beside their place, then renamed."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tkamb.errors import InputError


@contextmanager
def replaced_file(path: Path) -> Iterator[Path]:
    """Give a temporary path in the same folder that takes the place of `path` at the end.

    When the block raises, `path` is left as it was.

    Raises:
        InputError: the folder cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror or error})", path) from None
    finally:
        temporary.unlink(missing_ok=True)


def remove_parts(directory: Path) -> None:
    """Remove what a killed process left of files that it did not finish."""
    for path in directory.glob(".*.part"):
        path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, whole or not at all.

    Raises:
        InputError: the folder cannot be written.
    """
    with replaced_file(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def claim_directory(path: str | Path) -> Path:
    """Make the output folder and prove that it can be written, before anything is computed.

    Raises:
        InputError: it is a file, or cannot be made or written.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path) as probe:
            probe.write(b"tkamb")
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(
            f"output folder cannot be written ({reason})", path, "choose another with --out"
        ) from None
    return path


@contextmanager
def claimed_directory(path: str | Path) -> Iterator[Path]:
    """Claim the output folder; after bad input the folders made for it are gone again.

    Raises:
        InputError: as `claim_directory`, or from the block.
    """
    path = Path(path)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield claim_directory(path)
    except InputError:
        with suppress(OSError):  # not there, or no longer empty
            for folder in made:
                folder.rmdir()
        raise
