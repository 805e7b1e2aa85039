"""Recorders store the finished frames of a run in memory or in the output folder.

In the output folder, each finished frame is a file in `.frames`, and contact.h5 grows beside it.
Every few seconds it is copied to the output folder, with summary.json and results.csv, in which the
remaining frames have the status "failed: not computed". A resumed run reads the frames; they are
removed when all results are written. Before the first frame is finished, nothing in the output
folder changes.

`.frames` also has the run's identity. A frame whose SHA-256 over identity, frame number and content
differs counts as absent.
"""

import hashlib
import io
import json
import os
import shutil
import signal
import threading
import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from tkamb.errors import InputError
from tkamb.files import (
    read_bytes,
    read_json,
    replaced_file,
    replaced_together,
    undamaged,
    write_text,
)
from tkamb.geometry.frames import Array
from tkamb.io.claim import settle
from tkamb.run.guard import interrupt_as_such
from tkamb.run.recording import BUTTON, CONTACT_PLACES
from tkamb.run.results_folder import (
    BUTTON_NAME,
    FOLDER,
    IDENTITY_NAME,
    MAPS_NAME,
    REPORT_NAME,
    SUMMARY_NAME,
    put_numbers,
    read_results,
    remove_shards,
)
from tkamb.run.tabulate import RowTable

if TYPE_CHECKING:
    from tkamb.run.maps import ContactMaps, MapWriter
    from tkamb.run.results import Results


LARGEST = 2e9
"""bytes: largest frame; a map of 100,000 points has 5 MB."""

Row = dict[str, Any]
T = TypeVar("T")
FORGET_FRAME = "remove it, or leave out resume=True to begin again"


@dataclass(frozen=True, eq=False)
class Shard:
    """One finished frame.

    Args:
        row: column of results.csv -> value.
        contact: name -> array of the contact result; None: contact failed or is not modelled.
    """

    row: Row
    contact: dict[str, Array] | None


def read_arrays(content: bytes) -> dict[str, Array]:
    """Return the arrays of a .npz file without unpickling."""
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)


class Shards:
    """The files of the finished frames.

    Args:
        resume: whether to continue an earlier run with the same identity. Otherwise its frames are
            removed when the first frame is written.
        name: name of the folder of the frames in the output folder.
    """

    def __init__(
        self, directory: Path, identity: Mapping[str, Any], resume: bool, name: str = FOLDER
    ) -> None:
        self.folder = directory / name
        self._directory, self._is_ready = directory, False
        self._identity = json.dumps(dict(identity), indent=1)
        if self.folder.is_symlink():
            raise InputError("is a symbolic link", self.folder, "remove it")
        self.resumed = False
        if resume and (earlier := self._earlier()) is not None:
            check_same_run(earlier, identity, directory)
            self.resumed = True

    def begin(self) -> None:
        """Create the folder with the identity, once."""
        if self._is_ready:
            return
        if not self.resumed:
            remove_shards(self._directory, self.folder.name)
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be made ({error.strerror})", self.folder) from None
        write_text(self.folder / IDENTITY_NAME, self._identity)
        self._is_ready = True

    def put(self, frame: int, shard: Shard) -> None:
        """Write a frame, completely or not at all."""
        self.begin()
        buffer = io.BytesIO()
        row = np.frombuffer(json.dumps(shard.row).encode(), np.uint8)
        arrays: dict[str, Any] = {"row": row, **(shard.contact or {})}
        np.savez(buffer, **arrays)
        content = buffer.getvalue()
        with replaced_file(self._path(frame)) as temporary:
            temporary.write_bytes(self._digest(frame, content) + content)

    def get(self, frame: int) -> Shard | None:
        """Return a frame; None: it is absent, incomplete or of another run."""
        path = self._path(frame)
        try:
            packed = read_bytes(path, LARGEST)
        except InputError:
            return None
        digest, content = packed[:32], packed[32:]
        if self._digest(frame, content) != digest:
            return None
        with undamaged(path, FORGET_FRAME):
            arrays = read_arrays(content)
            return Shard(dict(json.loads(arrays.pop("row").tobytes())), arrays or None)

    def read(self, frame: int, make: Callable[[Shard], T]) -> T | None:
        """Return what `make` returns for a frame; None: as `get`."""
        shard = self.get(frame)
        with undamaged(self._path(frame), FORGET_FRAME):
            return None if shard is None else make(shard)

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
        with undamaged(path, "leave out resume=True to begin again"):
            return dict(read_json(path))


def stored(
    folders: Sequence[Shards], numbers: Iterable[int], make: Callable[[Shard], T]
) -> dict[int, T]:
    """Return number -> object of each job that an earlier run finished."""
    numbers, result = list(numbers), dict[int, T]()
    for shards in folders:
        for number in numbers if shards.resumed else ():
            if (one := shards.read(number, make)) is not None:
                result[number] = one
    return result


def completed(
    done: dict[int, T],
    answers: Iterable[tuple[int, T]],
    keep: Callable[[int, T], None] | None,
    total: str,
) -> dict[int, T]:
    """Return the stored (`done`) and the new answers, by number of the job.

    Args:
        keep: function that stores an answer; None: answers are not stored.
        total: number and name of all jobs, like "256 samples".

    Raises:
        KeyboardInterrupt: interrupted; the message states how many answers are stored.
    """
    try:
        with interrupt_as_such():
            for number, answer in answers:
                if keep is not None:
                    keep(number, answer)
                done[number] = answer
    except KeyboardInterrupt:
        if keep is None or not done:
            raise
        words = f"{len(done)} of {total} are kept; go on with resume=True"
        raise KeyboardInterrupt(words) from None
    return done


def check_same_run(
    earlier: Mapping[str, Any] | None, identity: Mapping[str, Any], directory: Path
) -> None:
    """Raise an InputError if the run in a folder has another identity.

    Args:
        earlier: identity of the run in the folder; None: no run.
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


_MAP = ("pressure", "gap", "nodal_force", "pose")
MAPS = {
    MAPS_NAME: (*_MAP, *CONTACT_PLACES),
    BUTTON_NAME: tuple(BUTTON + name for name in _MAP),
}
"""File of pressure maps -> names of its arrays (`frame_arrays`)."""


# s: least time before the first and between later copies of the results. Chosen so that the
# results of a killed run lack few frames.
SHORTEST_PAUSE_SECONDS = 1.0
# 1: largest share of the computing time for these copies. Not studied.
LARGEST_TIME_SHARE = 0.02


class Recorder:
    """Stores the finished frames of a run in memory."""

    def __init__(self) -> None:
        self.rows = RowTable()
        self._writers: dict[str, MapWriter] = {}
        self._stack = ExitStack()

    def begin_maps(
        self, name: str, points: Array, triangles: Array, labels: Mapping[str, Any]
    ) -> None:
        """Prepare to record pressure maps, in a run with contact.

        Args:
            points: map points, m, (n, 3).
            triangles: indices of neighbouring map points, (k, 3).
        """
        from tkamb.run.maps import MapWriter

        path = None if self._maps_folder is None else self._maps_folder / name
        self._writers[name] = MapWriter(path, points, triangles, labels)
        self._stack.enter_context(self._writers[name])

    def record(self, frame: int, row: Row, contact: dict[str, Array] | None) -> None:
        """Store a finished frame.

        Args:
            contact: arrays of the contact result (`frame_arrays`); None: contact failed or is not
                modelled.
        """
        self.rows.add(frame, row)
        time, arrays = float(row["time_s"]), contact or {}
        for file, writer in self._writers.items():
            names = MAPS[file]
            if names[0] in arrays:
                writer.append(time, *(arrays[name] for name in names))
            else:
                writer.append_failed(time)

    def take_earlier(self, frames: range) -> dict[int, dict[str, Array] | None]:
        """Read an earlier run's finished frames; return frame -> arrays of its contact."""
        return {}

    keeps_files = False
    """Whether finished frames are stored in files."""

    def due(self) -> bool:
        """Return whether it is time to publish."""
        return False

    def publish(self, make_results: "Callable[[], Results]") -> "Results":
        """Write the results of the finished frames to the output folder, and return them."""
        return make_results()

    def finish(self) -> None:
        """Close the maps after the last frame."""

    def maps(self, name: str) -> "ContactMaps | None":
        """Return the finished frames' maps of a file in `MAPS`; None: not begun."""
        writer = self._writers.get(name)
        return None if writer is None else writer.maps

    def close(self) -> None:
        """Close the maps."""
        self._stack.close()

    _maps_folder: Path | None = None
    """Folder of the growing maps; None: in memory."""


class FolderRecorder(Recorder):
    """Stores the finished frames of a run in its output folder.

    It does not change before the first frame is finished.

    Args:
        directory: folder that this process has claimed (`tkamb.io.claim`).
        resume: whether to continue an earlier run in the folder.
    """

    def __init__(self, directory: Path, identity: Mapping[str, Any], resume: bool) -> None:
        super().__init__()
        self._directory = directory
        self._shards = Shards(directory, identity, resume)
        self._maps_folder = self._shards.folder
        self._pause, self._published_at = SHORTEST_PAUSE_SECONDS, clock.perf_counter()
        self._map_arguments: dict[str, tuple[Any, ...]] = {}

    def begin_maps(
        self, name: str, points: Array, triangles: Array, labels: Mapping[str, Any]
    ) -> None:
        """See `Recorder`. The file is created with the first frame."""
        self._map_arguments[name] = (points, triangles, labels)

    def take_earlier(self, frames: range) -> dict[int, dict[str, Array] | None]:
        """See `Recorder`. Only frames before the first absent frame are read."""
        shards = {}
        for frame in frames if self._shards.resumed else ():
            shard = self._shards.get(frame)
            if shard is None:
                break
            shards[frame] = shard.contact
            self._record(frame, shard.row, shard.contact)
        return shards

    def record(self, frame: int, row: Row, contact: dict[str, Array] | None) -> None:
        """See `Recorder`. An interrupt is delayed until the frame is written."""
        with interrupt_later():
            self._shards.put(frame, Shard(row, contact))
            self._record(frame, row, contact)

    def _record(self, frame: int, row: Row, contact: dict[str, Array] | None) -> None:
        self._shards.begin()
        for name, arguments in self._map_arguments.items():
            if name not in self._writers:
                super().begin_maps(name, *arguments)
        super().record(frame, row, contact)

    keeps_files = True

    def due(self) -> bool:
        """See `Recorder`."""
        return clock.perf_counter() - self._published_at > self._pause

    def maps(self, name: str) -> "ContactMaps | None":
        """Return the published pressure maps in the output folder; None: not begun."""
        from tkamb.run.maps import ContactMaps

        return ContactMaps(self._directory / name) if name in self._writers else None

    def finish(self) -> None:
        """See `Recorder`."""
        with interrupt_later():
            self.close()

    def publish(self, make_results: "Callable[[], Results]") -> "Results":
        """Replace results.csv, summary.json and contact.h5 together, and remove an old report."""
        start = clock.perf_counter()
        results = make_results()
        with interrupt_later(), replaced_together(self._directory) as files:
            for name, writer in self._writers.items():
                writer.flush()
                shutil.copyfile(self._shards.folder / name, files.path(name))
            put_numbers(results, files)
            files.remove(REPORT_NAME)
        self._published_at = clock.perf_counter()
        seconds = self._published_at - start
        self._pause = max(SHORTEST_PAUSE_SECONDS, seconds / LARGEST_TIME_SHARE)
        return results


@contextmanager
def interrupt_later() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the end of the block."""
    if threading.current_thread() is not threading.main_thread():  # only it receives signals
        yield
        return
    received: list[Any] = []
    handlers = {
        number: signal.signal(number, lambda *arguments: received.append(arguments))
        for number in (signal.SIGINT, signal.SIGTERM)
        if callable(signal.getsignal(number))
    }
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    for number, frame in received[:1]:
        if callable(handler := handlers[number]):
            handler(number, frame)


def finished_results(directory: Path, identity: Mapping[str, Any]) -> "Results | None":
    """Return a run's complete results in a folder; None: none, or not all frames."""
    settle(directory)
    if not os.path.exists(directory / SUMMARY_NAME):
        return None
    results = read_results(directory)
    check_same_run(results.summary.get("identity"), identity, directory)
    return None if results.summary.get("unfinished_frames", 1) else results
