"""What a data set consists of: its files, their SHA-256, and where they are published."""

import json
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path, PurePosixPath
from urllib.parse import quote

NAMES = ("dm",)
"""Data sets that `tkamb data get` knows."""


@dataclass(frozen=True)
class DataFile:
    """A file of a data set.

    Args:
        name: its path in the data set's folder.
        sha256: of its content, hexadecimal.
        commit: of the repository; None where it is not known where the file is published.
        path: inside the repository; None as `commit`.
        size: bytes, as registered; None where it is not known.
    """

    name: str
    sha256: str
    commit: str | None = None
    path: str | None = None
    size: int | None = None

    def url(self, base: str) -> str | None:
        """Return its address below that of the repository's raw files; None if unknown."""
        if self.commit is None or self.path is None:
            return None
        return f"{base.rstrip('/')}/{self.commit}/{quote(self.path)}"

    def places(self, folder: Path) -> list[Path]:
        """Return where it may lie in a folder of downloads: by its name here, or as published."""
        names = [self.name, PurePosixPath(self.name).name]
        if self.path:
            names += [self.path, PurePosixPath(self.path).name]
        return [folder / name for name in dict.fromkeys(names)]


@dataclass(frozen=True)
class Dataset:
    """A data set: what it is, its licence, its address, its folder and its files."""

    says: str
    licence: str
    repository: str
    url: str
    folder: Path
    files: tuple[DataFile, ...]


def read_dataset(name: str) -> Dataset:
    """Return a data set of the package by its name, one of `NAMES`."""
    text = (files("tkamb.io.datasets") / f"{name}.json").read_text(encoding="utf-8")
    content = json.loads(text)
    return Dataset(
        content["says"],
        content["licence"],
        content["repository"],
        content["url"],
        Path(content["folder"]),
        tuple(
            DataFile(
                file, entry["sha256"], entry.get("commit"), entry.get("path"), entry.get("bytes")
            )
            for file, entry in content["files"].items()
        ),
    )
