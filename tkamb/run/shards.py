"""The finished frames of a run in progress: one file each, written whole or not at all.

They lie in the folder `.frames` of the output folder, beside a file that says which run they
belong to, and go when the run's results are written. Each carries a SHA-256 over the run's
identity, its number and its content: a frame of another run, of another place, or that cannot
be read whole counts as absent. Nothing is written, and nothing of an earlier run removed, before
the first frame is there.
"""

import hashlib
import io
import json
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from tkamb.errors import InputError
from tkamb.files import read_bytes, read_json, replaced_file, write_text
from tkamb.geometry.frames import Array

FOLDER = ".frames"
IDENTITY_NAME = "run.json"
OWN_NAMES = (IDENTITY_NAME, "contact.h5", "*.frame", ".tkamb-*.part")
"""What the folder holds, and all that is ever removed from it."""
LARGEST = 2e9
"""Bytes of a frame; a map of 100,000 points has 5 MB."""

UNREADABLE = (
    *(ValueError, TypeError, OSError, EOFError, KeyError, NotImplementedError, RuntimeError),
    *(MemoryError, BadZipFile, zlib.error),
)
"""What numpy, zipfile and json raise for damaged bytes."""

CONTACT_PLACES = ("contact_points", "contact_normals")
"""(3, 3) m and unit: where medial condyle, lateral condyle and patella touch; NaN without."""

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
        resume: keep what an earlier run with the same identity left; else it is removed with
            the first frame.
        name: of the folder in it.

    Raises:
        InputError: the earlier run was another one, or the folder is a symbolic link.
    """

    def __init__(
        self, directory: Path, identity: Mapping[str, Any], resume: bool, name: str = FOLDER
    ) -> None:
        self.folder = directory / name
        self._directory, self._begun = directory, False
        self._identity = json.dumps(dict(identity), indent=1)
        if self.folder.is_symlink():
            raise InputError("is a symbolic link", self.folder, "remove it")
        self.resumed = False
        if resume and (earlier := self._earlier()) is not None:
            check_same_run(earlier, identity, directory)
            self.resumed = True

    def begin(self) -> None:
        """Make the folder ready to be written into, once.

        Raises:
            InputError: it cannot be written.
        """
        if self._begun:
            return
        if not self.resumed:
            remove_shards(self._directory, self.folder.name)
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be made ({error.strerror})", self.folder) from None
        write_text(self.folder / IDENTITY_NAME, self._identity)
        self._begun = True

    def put(self, frame: int, shard: Shard) -> None:
        """Write a frame, whole or not at all."""
        self.begin()
        buffer = io.BytesIO()
        row = np.frombuffer(json.dumps(shard.row).encode(), np.uint8)
        arrays: dict[str, Any] = {"row": row, **(shard.contact or {})}
        np.savez(buffer, **arrays)
        content = buffer.getvalue()
        with replaced_file(self._path(frame)) as temporary:
            temporary.write_bytes(self._digest(frame, content) + content)

    def get(self, frame: int) -> Shard | None:
        """Return a frame; None if there is none, or not a whole one of this run."""
        try:
            packed = read_bytes(self._path(frame), LARGEST)
        except InputError:
            return None
        digest, content = packed[:32], packed[32:]
        if self._digest(frame, content) != digest:
            return None
        try:  # the digest finds accidents; who forged a frame has written its digest too
            with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
                row = dict(json.loads(arrays["row"].tobytes()))
                contact = {name: arrays[name] for name in arrays.files if name != "row"}
        except UNREADABLE:
            return None
        return Shard(row, contact or None)

    def _digest(self, frame: int, content: bytes) -> bytes:
        digest = hashlib.sha256(f"{frame}\n{self._identity}\n".encode())
        digest.update(content)
        return digest.digest()

    def _path(self, frame: int) -> Path:
        return self.folder / f"{frame:06d}.frame"

    def _earlier(self) -> dict[str, Any] | None:
        path = self.folder / IDENTITY_NAME
        if not path.exists():
            return None
        try:
            return dict(read_json(path))
        except (ValueError, TypeError, InputError) as error:
            what = f"does not say which run the frames beside it belong to ({error})"
            raise InputError(what, path, "leave out resume=True to begin again") from None


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
            "give the same scene and options, or leave out resume=True to begin again",
        )


def remove_shards(directory: Path, name: str = FOLDER) -> None:
    """Remove the finished frames, and first the file that says which run they belong to."""
    folder = directory / name
    if folder.is_symlink():
        return
    for name in OWN_NAMES:
        for path in folder.glob(name):
            path.unlink(missing_ok=True)
    with suppress(OSError):  # not there, or somebody else's things are in it
        folder.rmdir()
