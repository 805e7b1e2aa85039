"""Recorders keep the finished frames of a run in memory, or in a folder that survives a kill.

In a folder, every finished frame is a file of its own before the next frame begins. contact.h5
grows beside these files. Every few seconds a copy of it takes its place together with summary.json
and results.csv, in which the remaining frames are not computed.

The files of the frames lie in `.frames` of the output folder, beside a file that identifies their
run. They are removed when the run's results are written. Each has a SHA-256 over the run's
identity, its number and its content: a frame of another run, or one that cannot be read whole,
counts as absent. A frame with the right SHA-256 whose content no frame of this run has was forged:
it is refused. Until the first frame is finished, nothing is written and nothing of an earlier
run is removed.
"""

import hashlib
import io
import json
import os
import shutil
import signal
import threading
import time as clock
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile, ZipFile

import numpy as np

from tkamb.errors import InputError
from tkamb.files import read_bytes, read_json, replaced_file, replaced_together, write_text
from tkamb.geometry.frames import Array
from tkamb.run.results_folder import (
    FOLDER,
    IDENTITY_NAME,
    MAPS_NAME,
    REPORT_NAME,
    SUMMARY_NAME,
    put_numbers,
    read_results,
    remove_shards,
)

if TYPE_CHECKING:
    from tkamb.run.maps import ContactMaps, MapWriter
    from tkamb.run.results import Results


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


ANY = -1
"""A length of an array that may be any."""


def have(arrays: Mapping[str, Array], expected: Mapping[str, tuple[str, tuple[int, ...]]]) -> bool:
    """Return whether arrays have exactly the expected names, kinds and shapes.

    Args:
        arrays: name -> array.
        expected: name -> allowed letters of `numpy.dtype.kind`, and the shape with `ANY` for a
            length that is free.
    """
    return arrays.keys() == expected.keys() and all(
        arrays[name].dtype.kind in kinds
        and arrays[name].ndim == len(shape)
        and all(wanted in (ANY, n) for n, wanted in zip(arrays[name].shape, shape, strict=True))
        for name, (kinds, shape) in expected.items()
    )


def read_arrays(content: bytes) -> dict[str, Array]:
    """Return the arrays of a .npz file; nothing of it is unpickled.

    Raises:
        UNREADABLE: the bytes are damaged, or the arrays are larger than `LARGEST`.
    """
    with ZipFile(io.BytesIO(content)) as packed:
        if sum(part.file_size for part in packed.infolist()) > LARGEST:
            raise ValueError("unpacked, it is too large")
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)


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

    def get(
        self, frame: int, is_whole: Callable[[Shard], bool] = lambda shard: True
    ) -> Shard | None:
        """Return a frame; None if there is none, or not a whole one of this run.

        Args:
            frame: its number.
            is_whole: whether the content has the names, kinds and shapes of a frame of this run.

        Raises:
            InputError: somebody forged the frame: it has the right SHA-256 and another content.
        """
        path = self._path(frame)
        try:
            packed = read_bytes(path, LARGEST)
        except InputError:
            return None
        digest, content = packed[:32], packed[32:]
        if self._digest(frame, content) != digest:
            return None
        try:  # the digest finds accidents; who forged a frame has written its digest too
            arrays = read_arrays(content)
            row = dict(json.loads(arrays.pop("row").tobytes()))
            shard = Shard(row, arrays or None)
            whole = is_whole(shard)
        except UNREADABLE:
            whole = False
        if not whole:
            what = "holds what no result of this computation holds: somebody changed it"
            raise InputError(what, path, "remove it, or leave out resume=True to begin again")
        return shard

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


MAPS = ("pressure", "gap", "nodal_force", "pose", *CONTACT_PLACES)


@dataclass(frozen=True)
class RecorderSettings:
    """How often finished frames are written."""

    shortest_pause_seconds: float = 1.0
    """s to the first copy of the finished frames, and between two copies. Chosen: a killed run
    loses little."""
    largest_time_share: float = 0.02
    """1: share of the computing time that the copies may take. Chosen: a run is not noticeably
    slower."""


RECORDER = RecorderSettings()


class Recorder:
    """Keeps the frames of a run in memory.

    Attributes:
        rows: frame -> column -> value, of the finished frames.
    """

    def __init__(self) -> None:
        self.rows: dict[int, Row] = {}
        self._writer: MapWriter | None = None
        self._stack = ExitStack()

    def begin_maps(self, points: Array, triangles: Array, labels: Mapping[str, Any]) -> None:
        """Prepare to record pressure maps on these points; not called without contact."""
        from tkamb.run.maps import MapWriter

        self._writer = MapWriter(self._maps_path, points, triangles, labels)
        self._stack.enter_context(self._writer)

    def record(self, frame: int, row: Row, contact: dict[str, Array] | None) -> None:
        """Keep a finished frame.

        Args:
            frame: its number.
            row: column of results.csv -> value.
            contact: the contact's arrays (`tkamb.run.contact_side`); None if it failed or is not
                modelled.
        """
        self.rows[frame] = row
        if self._writer is None:
            return
        if contact is None:
            self._writer.append_failed(float(row["time_s"]))
        else:
            self._writer.append(float(row["time_s"]), *(contact[name] for name in MAPS))

    def take_earlier(self, frames: range) -> dict[int, dict[str, Array] | None]:
        """Take over what an earlier run finished; return frame -> the contact's arrays."""
        return {}

    keeps_files = False
    """Whether what is finished survives the process."""

    def due(self) -> bool:
        """Say whether it is time to write the finished frames for readers."""
        return False

    def publish(self, make_results: "Callable[[], Results]") -> "Results":
        """Write the finished frames for readers, and return them.

        Args:
            make_results: function that makes the results.
        """
        return make_results()

    def finish(self) -> None:
        """Close the maps: every frame is there."""

    @property
    def maps(self) -> "ContactMaps | None":
        """The pressure maps of the finished frames."""
        return None if self._writer is None else self._writer.maps

    def close(self) -> None:
        """Nothing can be recorded after it."""
        self._stack.close()

    _maps_path: Path | None = None
    """Where contact.h5 grows; None: in memory."""


class FolderRecorder(Recorder):
    """Keeps the frames of a run in its output folder.

    Nothing in the folder changes before the first frame is finished.

    Args:
        directory: a folder that this process has claimed (`tkamb.io.claim`).
        identity: what two equal runs have in common.
        resume: go on with the frames that an earlier run left there.

    Raises:
        InputError: the earlier run was another one, or the folder cannot be written.
    """

    def __init__(self, directory: Path, identity: Mapping[str, Any], resume: bool) -> None:
        super().__init__()
        self._directory = directory
        self._shards = Shards(directory, identity, resume)
        self._maps_path = self._shards.folder / MAPS_NAME
        self._pause, self._shown = RECORDER.shortest_pause_seconds, clock.perf_counter()
        self._map_arguments: tuple[Any, ...] | None = None

    def begin_maps(self, points: Array, triangles: Array, labels: Mapping[str, Any]) -> None:
        """See `Recorder`; the file is made with the first frame."""
        self._map_arguments = (points, triangles, labels)

    def take_earlier(self, frames: range) -> dict[int, dict[str, Array] | None]:
        """See `Recorder`; in order, up to the first gap."""
        shards = {}
        points = None if self._map_arguments is None else len(self._map_arguments[0])
        for frame in frames if self._shards.resumed else ():
            shard = self._shards.get(frame, lambda one: _is_frame(one, points))
            if shard is None:
                break
            shards[frame] = shard.contact
            self._record(frame, shard.row, shard.contact)
        return shards

    def record(self, frame: int, row: Row, contact: dict[str, Array] | None) -> None:
        """See `Recorder`; an interrupt waits until the frame is written."""
        with interrupt_later():
            self._shards.put(frame, Shard(row, contact))
            self._record(frame, row, contact)

    def _record(self, frame: int, row: Row, contact: dict[str, Array] | None) -> None:
        self._shards.begin()
        if self._map_arguments is not None and self._writer is None:
            super().begin_maps(*self._map_arguments)
        super().record(frame, row, contact)

    keeps_files = True

    def due(self) -> bool:
        """See `Recorder`."""
        return clock.perf_counter() - self._shown > self._pause

    @property
    def maps(self) -> "ContactMaps | None":
        """See `Recorder`; as they stand in the output folder."""
        from tkamb.run.maps import ContactMaps

        return None if self._writer is None else ContactMaps(self._directory / MAPS_NAME)

    def finish(self) -> None:
        """See `Recorder`; all frames are then published."""
        with interrupt_later():
            self.close()

    def publish(self, make_results: "Callable[[], Results]") -> "Results":
        """Put results.csv, summary.json and contact.h5 in place together; remove an old report."""
        start = clock.perf_counter()
        results = make_results()
        with interrupt_later(), replaced_together(self._directory) as files:
            if self._writer is not None:
                self._writer.flush()
                shutil.copyfile(self._shards.folder / MAPS_NAME, files.path(MAPS_NAME))
            put_numbers(results, files)
            files.remove(REPORT_NAME)
        self._shown = clock.perf_counter()
        self._pause = max(
            RECORDER.shortest_pause_seconds, (self._shown - start) / RECORDER.largest_time_share
        )
        return results


def _is_frame(shard: Shard, points: int | None) -> bool:
    """Return whether what was kept has the kinds and shapes of a frame of this run.

    Args:
        shard: read from a folder that may be somebody else's.
        points: of the pressure map; None where there is none.
    """
    row = shard.row
    numbers = [value for name, value in row.items() if name != "status"]
    plain = all(value is None or type(value) in (int, float, bool) for value in numbers)
    if not plain or not isinstance(row.get("status"), str) or type(row.get("time_s")) is not float:
        return False
    if shard.contact is None:
        return True
    if points is None:
        return False
    kept, n = shard.contact, points
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(CONTACT_PLACES, (3, 3))
    shapes |= {"pressure": (n,), "gap": (n,), "nodal_force": (n, 3), "pose": (4, 4)}
    whole = all(array.dtype.kind == "f" for array in kept.values())
    return whole and all(name in kept and kept[name].shape == shapes[name] for name in shapes)


@contextmanager
def interrupt_later() -> Iterator[None]:
    """Hold Ctrl-C back until the block is done; only the main thread gets it at all."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[Any] = []
    usual = signal.signal(signal.SIGINT, lambda *seen: came.append(seen))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
    if came and callable(usual):
        usual(*came[0])


def finished_results(directory: Path, identity: Mapping[str, Any]) -> "Results | None":
    """Return the results in a folder if they are all of that run's; None if there are none.

    Raises:
        InputError: they are another run's, or no longer what was written.
    """
    if not os.path.exists(directory / SUMMARY_NAME):
        return None
    results = read_results(directory)
    check_same_run(results.summary.get("identity"), identity, directory)
    return None if results.summary.get("unfinished_frames", 1) else results
