"""Measured data for the shipped scenes, which only `tkamb data get` downloads.

Each data set lists files with published address and SHA-256, which is checked before a file is
written. A repeated download loads only missing files.
"""

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path, PurePosixPath
from urllib.parse import quote

from tkamb.errors import InputError
from tkamb.files import claim_directory, replaced_file, sha256_of

NAMES = ("dm",)
"""Names of the data sets of `tkamb data get`."""


@dataclass(frozen=True)
class DataFile:
    """A file of a data set.

    Args:
        name: path in the data set's folder.
        commit: commit of the repository; None, also in `path`: no published address is known.
    """

    name: str
    sha256: str
    commit: str | None = None
    path: str | None = None

    def url(self, base: str) -> str | None:
        """Return the file's address below `base`, the address of all raw files, or None."""
        if self.commit is None or self.path is None:
            return None
        return f"{base.rstrip('/')}/{self.commit}/{quote(self.path)}"

    def places(self, folder: Path) -> list[Path]:
        """Return the file's possible paths in a folder of downloads.

        They are its names in the data set and in the repository, with or without folders.
        """
        names = [self.name, PurePosixPath(self.name).name]
        if self.path:
            names += [self.path, PurePosixPath(self.path).name]
        return [folder / name for name in dict.fromkeys(names)]


@dataclass(frozen=True)
class Dataset:
    """A data set: description, licence, repository, address of raw files, folder and files."""

    says: str
    licence: str
    repository: str
    url: str
    folder: Path
    files: tuple[DataFile, ...]


def read_dataset(name: str) -> Dataset:
    """Return the data set with a name from `NAMES`."""
    text = (files("tkamb.io.datasets") / f"{name}.json").read_text(encoding="utf-8")
    content = json.loads(text)
    return Dataset(
        content["says"],
        content["licence"],
        content["repository"],
        content["url"],
        Path(content["folder"]),
        tuple(
            DataFile(file, entry["sha256"], entry.get("commit"), entry.get("path"))
            for file, entry in content["files"].items()
        ),
    )


TIMEOUT_S = 30
"""s: a download fails if the server sends nothing for this time."""


@dataclass
class Got:
    """Result of fetching a data set.

    Args:
        absent: names of files that were not found.
    """

    kept: list[str] = field(default_factory=list)
    written: list[str] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)


def download(dataset: Dataset, to: Path, url: str | None = None) -> Got:
    """Download the missing files of a data set.

    Args:
        to: its folder; it is made if it does not exist.
        url: address of a mirror with the same paths; None: the data set's own address.

    Returns:
        Names of the files. A file without a known address counts as absent.
    """
    try:
        import pooch
    except ImportError:
        raise InputError(
            "needs pooch, which is not installed",
            "tkamb data get",
            "pip install 'tkamb[data]', or give what you downloaded by hand with --from DIR",
        ) from None
    pooch.get_logger().setLevel("ERROR")
    base = url or dataset.url

    def fetch(file: DataFile, scratch: Path) -> Path | None:
        address = file.url(base)
        return _retrieved(address, file, scratch) if address else None

    return _get(dataset, to, fetch)


def take_from(dataset: Dataset, to: Path, folder: Path) -> Got:
    """Copy the missing files of a data set from a folder of downloads or a clone.

    Returns:
        Names of the files. A file that is not in the folder counts as absent.
    """
    if not folder.is_dir():
        raise InputError("is not a folder", folder, "give the folder of what you downloaded")

    sources = {
        file.name: _verified_copy(file, folder) for file in dataset.files
    }  # search all files before copying any
    if not any(sources.values()):
        hint = f"download or clone {dataset.repository} first"
        raise InputError("holds none of the files of this data set", folder, hint)
    return _get(dataset, to, lambda file, _: sources[file.name])


def _get(dataset: Dataset, to: Path, fetch: Callable[[DataFile, Path], Path | None]) -> Got:
    missing = [file for file in dataset.files if not _is_there(file, to)]
    got = Got(kept=[file.name for file in dataset.files if file not in missing])
    for file in missing:
        with tempfile.TemporaryDirectory(prefix="tkamb-data-") as scratch:
            source = fetch(file, Path(scratch))
            if source is None:
                got.absent.append(file.name)
                continue
            target = to / file.name
            claim_directory(target.parent)
            with replaced_file(target) as temporary:
                shutil.copyfile(source, temporary)
                if sha256_of(temporary) != file.sha256:
                    raise _other_content(source, file)
        got.written.append(file.name)
    return got


def _retrieved(address: str, file: DataFile, folder: Path) -> Path:
    import pooch
    from requests.exceptions import HTTPError, RequestException

    fetch = pooch.HTTPDownloader(timeout=TIMEOUT_S)
    digest = f"sha256:{file.sha256}"
    hint = "run it again: complete files are kept; or give --from DIR with files you downloaded"
    try:
        return Path(pooch.retrieve(address, digest, "whole", folder, downloader=fetch))
    except HTTPError as error:
        status = error.response.status_code if error.response is not None else "unknown"
        raise InputError(f"cannot be downloaded (HTTP status {status})", address, hint) from None
    except RequestException as error:
        what = type(error).__name__  # The error's text is a page of nested causes.
        raise InputError(f"cannot be downloaded (no network? {what})", address, hint) from None
    except OSError as error:
        raise InputError(f"cannot be downloaded ({error.strerror})", address, hint) from None
    except ValueError as error:
        if "hash" not in str(error):
            raise InputError(f"cannot be downloaded ({error})", address, hint) from None
        raise _other_content(address, file) from None


def _verified_copy(file: DataFile, folder: Path) -> Path | None:
    copies = [place for place in file.places(folder) if place.is_file()]
    for place in copies:
        if sha256_of(place) == file.sha256:
            return place
    if copies:
        raise _other_content(copies[0], file)
    return None


def _other_content(where: str | Path, file: DataFile) -> InputError:
    what = f"is not {file.name} as registered: its SHA-256 is not {file.sha256[:12]}..."
    return InputError(what, where, "it is cut short or another version; the file was not kept")


def _is_there(file: DataFile, to: Path) -> bool:
    target = to / file.name
    if not target.exists() and not target.is_symlink():
        return False
    if sha256_of(target) == file.sha256:
        return True
    hint = "move it away: tkamb does not replace your files"
    raise InputError("exists with another content than the published file", target, hint)
