"""The finished frames of a run that is under way: one file each, whole or not there.

They lie in the folder `.frames` of the output folder, beside a file that says which run they
belong to, and go when the run's results are written. A kill at any moment leaves the frames
before it; a file that cannot be read whole counts as absent.
"""

import hashlib
import io
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.output.atomic import remove_parts, replaced_file, write_text

FOLDER = ".frames"
IDENTITY_NAME = "run.json"

Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Shard:
    """One finished frame.

    Args:
        row: column of results.csv -> value.
        contact: arrays of the contact result by name; None if it failed or is not modelled.
    """

    row: Row
    contact: dict[str, Array] | None


class Shards:
    """The finished frames in a folder.

    Args:
        directory: output folder of the run.
        identity: what makes two runs the same: name -> text or numbers.
        resume: keep what an earlier run with the same identity left; else it is removed.

    Raises:
        InputError: the earlier run was another one, or the folder cannot be written.
    """

    def __init__(self, directory: Path, identity: Mapping[str, Any], resume: bool) -> None:
        self.folder = directory / FOLDER
        remove_parts(directory)
        if resume:
            check_same_run(self._earlier(), identity, directory)
        else:
            remove_shards(directory)
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be made ({error.strerror})", self.folder) from None
        write_text(self.folder / IDENTITY_NAME, json.dumps(dict(identity), indent=1))

    def put(self, frame: int, shard: Shard) -> None:
        """Write a frame, whole or not at all."""
        buffer = io.BytesIO()
        row = np.frombuffer(json.dumps(shard.row).encode(), np.uint8)
        arrays: dict[str, Any] = {"row": row, **(shard.contact or {})}
        np.savez(buffer, **arrays)
        content = buffer.getvalue()
        with replaced_file(self._path(frame)) as temporary:
            temporary.write_bytes(hashlib.sha256(content).digest() + content)

    def get(self, frame: int) -> Shard | None:
        """Return a frame; None if there is none, or not a whole one."""
        try:
            packed = self._path(frame).read_bytes()
        except FileNotFoundError:
            return None
        digest, content = packed[:32], packed[32:]
        if hashlib.sha256(content).digest() != digest:
            return None
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            row = json.loads(arrays["row"].tobytes())
            contact = {name: arrays[name] for name in arrays.files if name != "row"}
        return Shard(row, contact or None)

    def _path(self, frame: int) -> Path:
        return self.folder / f"{frame:06d}.frame"

    def _earlier(self) -> dict[str, Any] | None:
        try:
            return dict(json.loads((self.folder / IDENTITY_NAME).read_text(encoding="utf-8")))
        except (FileNotFoundError, ValueError):
            return None


def check_same_run(
    earlier: Mapping[str, Any] | None, identity: Mapping[str, Any], directory: Path
) -> None:
    """Raise an InputError when the folder holds another run than the one to go on with.

    Args:
        earlier: identity of the run in the folder; None if there is none.
        identity: of the run to go on with.
        directory: the folder, for the message.
    """
    if earlier is None:
        return
    plain = json.loads(json.dumps(dict(identity)))
    other = [name for name in plain if earlier.get(name) != plain[name]]
    if other:
        raise InputError(
            f"cannot resume: the run in this folder has another {', another '.join(other)}",
            directory,
            "give the same scene and options, or leave out --resume to begin again",
        )


def remove_shards(directory: Path) -> None:
    """Remove the finished frames; what says whose they are goes first."""
    folder = directory / FOLDER
    (folder / IDENTITY_NAME).unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
