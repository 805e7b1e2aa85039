"""The pressure maps of a run, in contact.h5 or in memory.

The file is written a few frames at a time, first their maps, then their times. The length of
`/time_s` is therefore the number of complete frames, even if the run was killed. Each frame is a
compressed chunk of its own, so that a write does not alter earlier frames. Readers take a few
frames at a time (`ContactMaps.rows`, `ContactMaps.blocks`), so that memory does not depend on the
length of the recording.

The HDF5 library cannot close a file after a failed write: it tries again, fails, and ends the
process. tkamb's writes go through a Python file object, which records the first failure and ignores
later writes. The library can then close the file, and `new_hdf5` raises.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tkamb.errors import InputError, not_installed
from tkamb.files import check_file, replaced_file, undamaged
from tkamb.geometry.frames import Array
from tkamb.geometry.memory import available_memory

if TYPE_CHECKING:
    from pyvista import MultiBlock


class NotingFile(io.FileIO):
    """A file object for HDF5 that records a failed write and raises no error.

    Args:
        path: the file. A file or link of this name is removed first, so that nothing is written
            through a link.

    Attributes:
        failure: error of the first failed write; None if every write has succeeded.

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(self, path: str | Path) -> None:
        Path(path).unlink(missing_ok=True)
        super().__init__(path, "x+b")
        self.failure: OSError | None = None

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from the current position; bytes beyond the end of the file are zero."""
        view = memoryview(buffer).cast("B")
        count = super().readinto(view) or 0
        view[count:] = bytes(len(view) - count)
        self.seek(len(view) - count, io.SEEK_CUR)
        return len(view)

    def write(self, content: Any) -> int:
        """Write all bytes; after a failure, only move the position."""
        view = memoryview(content).cast("B")
        written = 0
        while written < len(view) and self.failure is None:
            try:
                written += super().write(view[written:]) or 0
            except OSError as error:
                self.failure = error
        self.seek(len(view) - written, io.SEEK_CUR)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file, bytes; default: the current position."""
        size = self.tell() if size is None else size
        try:
            return size if self.failure is not None else super().truncate(size)
        except OSError as error:
            self.failure = error
            return size


@contextmanager
def new_hdf5(path: Path) -> Iterator[Any]:
    """Provide a new HDF5 file.

    Args:
        path: path of a temporary file; after a failure its content is incomplete.
    """
    try:
        stream = NotingFile(path)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", path) from None
    with stream:
        with h5py.File(stream, "w") as file:
            yield file
        check_written(stream, path)


def check_written(stream: NotingFile, path: object) -> None:
    """Raise an InputError if a write has failed."""
    if stream.failure is not None:
        raise InputError(f"cannot be written ({stream.failure.strerror})", path)


UNITS = "SI: m, s, Pa, N; poses 4x4"
COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
PER_FRAME = (
    *("pressure_Pa", "gap_m", "nodal_force_N", "femoral_pose"),
    *("contact_points_m", "contact_normals", "time_s"),
)

BLOCK_BYTES = 16e6
"""bytes: size of the maps that are read at a time. Smaller blocks cost more calls of HDF5."""
SHARE_OF_MEMORY = 0.25
"""1: largest whole array, as a share of the available memory. Not studied."""


# bytes: size of the maps that are collected for one write. A write takes as long as
# the maps of a frame.
BUFFER_BYTES = 4e6


class MapWriter:
    """Writes contact.h5; flushed frames remain readable if the process is killed.

    Args:
        path: path of the file, which is replaced if it exists; None: the file is in memory only.
        points: map points in the insert frame, m, (n, 3).
        triangles: indices into the points, (k, 3).
        attributes: texts and numbers, such as frame, model, version and scene hash.
    """

    def __init__(
        self,
        path: str | Path | None,
        points: ArrayLike,
        triangles: ArrayLike,
        attributes: Mapping[str, Any],
    ) -> None:
        self.path = None if path is None else Path(path)
        self._written_frames, self._waiting = 0, list[tuple[Array, ...]]()
        points = np.asarray(points, float)
        self._stream: NotingFile | None = None
        with self._written():
            if self.path is None:
                self._file = h5py.File(
                    f"memory {id(self)}", "w", driver="core", backing_store=False
                )
            else:
                self._stream = NotingFile(self.path)
                self._file = h5py.File(self._stream, "w")
        try:
            with self._written():
                self._begin(points, np.asarray(triangles, np.int64), attributes)
        except BaseException:
            self._close_file()  # HDF5 fails at the interpreter's end if the file is open
            raise

    def _begin(
        self, points: Array, triangles: NDArray[np.int64], attributes: Mapping[str, Any]
    ) -> None:
        self._file.attrs["units"] = UNITS
        for name, value in attributes.items():
            self._file.attrs[name] = value
        self._file.create_dataset("points_m", data=points)
        self._file.create_dataset("triangles", data=triangles)
        n = len(points)
        shapes = ((n,), (n,), (n, 3), (4, 4), (3, 3), (3, 3))
        for name, shape in zip(PER_FRAME, shapes, strict=False):
            self._grow(name, shape)
        self._file.create_dataset("time_s", (0,), float, maxshape=(None,), chunks=(256,))
        self._file.flush()

    def _grow(self, name: str, shape: tuple[int, ...]) -> None:
        self._file.create_dataset(
            name,
            (0, *shape),
            float,
            maxshape=(None, *shape),
            chunks=(1, *shape),
            **(COMPRESSION if self.path else {}),
        )

    def append(
        self,
        time: float,
        pressure: ArrayLike,
        gap: ArrayLike,
        nodal_force: ArrayLike,
        femoral_pose: ArrayLike,
        contact_points: ArrayLike = np.nan,
        contact_normals: ArrayLike = np.nan,
    ) -> None:
        """Add one frame. It is written when the buffer is full, by `flush` or by `close`.

        Args:
            time: time, s.
            pressure: pressure at the map points, Pa, (n,).
            gap: gap at the map points, m, (n,).
            nodal_force: forces on the insert, N, (n, 3).
            femoral_pose: pose_femoral_in_insert, (4, 4).
            contact_points: contact points of medial condyle, lateral condyle and patella in the
                insert frame, m, (3, 3); NaN: unknown.
            contact_normals: unit normals at these points, out of the insert or into the patella,
                (3, 3).
        """
        values = (pressure, gap, nodal_force, femoral_pose, contact_points, contact_normals, time)
        shapes = (dataset.shape[1:] for dataset in self._datasets)
        frame = tuple(
            np.array(np.broadcast_to(value, shape), float)
            for value, shape in zip(values, shapes, strict=True)
        )
        self._waiting.append(frame)
        if len(self._waiting) * sum(values.nbytes for values in frame) > BUFFER_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the appended frames, their times last."""
        if not self._waiting:
            return
        begin, end = self._written_frames, len(self)
        with self._written():
            for dataset, values in zip(
                self._datasets, zip(*self._waiting, strict=True), strict=True
            ):
                if dataset is self._datasets[-1]:
                    self._file.flush()
                dataset.resize(end, axis=0)
                dataset[begin:] = np.array(values)
            self._file.flush()
        self._written_frames, self._waiting = end, []

    def append_failed(self, time: float) -> None:
        """Add a failed frame: a time, and NaN for all else."""
        nan = float("nan")
        self.append(time, nan, nan, nan, nan)

    @cached_property
    def _datasets(self) -> list[Any]:
        return [self._file[name] for name in PER_FRAME]

    def __len__(self) -> int:
        return self._written_frames + len(self._waiting)

    @property
    def maps(self) -> "ContactMaps":
        """The maps of all appended frames."""
        self.flush()
        if self.path is not None:
            return ContactMaps(self.path)
        arrays = {name: dataset[()] for name, dataset in self._file.items()}
        return ContactMaps(arrays, dict(self._file.attrs))

    def close(self) -> None:
        """Write the appended frames and close the file.

        Raises:
            InputError: the file cannot be written.
        """
        with self._written():
            try:
                self.flush()
            finally:
                self._close_file()

    def _close_file(self) -> None:
        self._file.close()
        if self._stream is not None:
            self._stream.close()

    @contextmanager
    def _written(self) -> Iterator[None]:
        """Raise an InputError for an error of HDF5, such as on a full disk."""
        try:
            yield
            if self._stream is not None:
                check_written(self._stream, self.path)
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
            raise InputError(f"cannot be written ({reason})", self.path) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except InputError:
            if error is None:  # otherwise the error of the block is raised
                raise


@dataclass(frozen=True, eq=False)
class ContactMaps:
    """The pressure maps of a run, from memory or from contact.h5.

    Each array of the file is read on first access. Shapes are given with f frames, n points and k
    triangles. All arrays are in SI units and the insert frame. They are NaN in failed frames.

    Args:
        source: path of contact.h5, or the arrays by their names in the file.
        given_attributes: attributes of arrays in memory. They are ignored with a file.
    """

    source: Path | Mapping[str, ArrayLike]
    given_attributes: Mapping[str, Any] | None = None

    def __repr__(self) -> str:
        """Return a line with the numbers of frames and points."""
        return f"<tkamb.ContactMaps: {len(self)} frames of {len(self.points_m)} points>"

    @cached_property
    def points_m(self) -> Array:
        """(n, 3) map points."""
        return self._array("points_m")

    @cached_property
    def triangles(self) -> NDArray[np.int64]:
        """(k, 3) indices into the points."""
        return np.asarray(self._array("triangles"), np.int64)

    @cached_property
    def time_s(self) -> Array:
        """(f,) times of the complete frames."""
        return self._array("time_s")

    @cached_property
    def pressure_Pa(self) -> Array:
        """(f, n) pressure."""
        return self._array("pressure_Pa", len(self.time_s))

    @cached_property
    def gap_m(self) -> Array:
        """(f, n) gap, positive when apart."""
        return self._array("gap_m", len(self.time_s))

    @cached_property
    def nodal_force_N(self) -> Array:
        """(f, n, 3) force on the insert."""
        return self._array("nodal_force_N", len(self.time_s))

    @cached_property
    def femoral_pose(self) -> Array:
        """(f, 4, 4) pose_femoral_in_insert of each map."""
        return self._array("femoral_pose", len(self.time_s))

    @cached_property
    def contact_points_m(self) -> Array:
        """(f, 3, 3) contact points of medial condyle, lateral condyle and patella in the equations.

        NaN without contact, and in files of early releases.
        """
        return self._optional_array("contact_points_m")

    @cached_property
    def contact_normals(self) -> Array:
        """(f, 3, 3) unit normals at these points, out of the insert or into the patella.

        NaN like the contact points.
        """
        return self._optional_array("contact_normals")

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the file: units, frame, model, version, scene hash."""
        if not isinstance(self.source, Path):
            return {"units": UNITS, **(self.given_attributes or {})}
        with _opened(self.source) as file:
            plain = str | int | float | np.number | np.bool_
            return {name: one for name, one in file.attrs.items() if isinstance(one, plain)}

    def __len__(self) -> int:
        return len(self.time_s)

    def to_pyvista(self) -> "MultiBlock":
        """Return the maps as a PyVista MultiBlock with one block per frame, "frame 0" first.

        A block is the insert's articular surface (m, insert frame). It has point data pressure_Pa,
        gap_m and nodal_force_N, and field data time_s. A failed frame is NaN.

        Raises:
            InputError: PyVista is not installed.
        """
        try:
            from pyvista import MultiBlock, PolyData
        except ImportError:
            raise not_installed("PyVista", "to_pyvista", "notebook") from None
        faces = np.insert(self.triangles, 0, 3, axis=1)
        blocks = MultiBlock()
        for k, time in enumerate(self.time_s):
            block = PolyData(self.points_m, faces)
            for name, values in self.frame_data(k).items():
                block.point_data[name] = values
            block.field_data["time_s"] = [time]
            blocks.append(block, f"frame {k}")
        return blocks

    def frame_data(self, k: int) -> dict[str, Array]:
        """Return pressure_Pa (n,), gap_m (n,) and nodal_force_N (n, 3) of frame k by name."""
        names = ("pressure_Pa", "gap_m", "nodal_force_N")
        return {name: self.rows(name, [range(len(self))[k]])[0] for name in names}

    def rows(self, name: str, frames: Sequence[int] | slice) -> Array:
        """Return an array of some frames, (len(frames), ...).

        Args:
            name: name of the array, such as "pressure_Pa".
        """
        if not isinstance(self.source, Path):
            return np.asarray(self.source[name], float)[frames]
        with _opened(self.source) as file:
            if isinstance(frames, slice):
                return np.asarray(file[name][frames], float)
            return np.array([file[name][k] for k in frames], float)

    def blocks(self, name: str) -> Iterator[Array]:
        """Yield an array in blocks of successive frames."""
        step = max(1, int(BLOCK_BYTES // (24 * max(len(self.points_m), 1))))
        for begin in range(0, len(self), step):
            yield self.rows(name, slice(begin, min(begin + step, len(self))))

    @cached_property
    def peaks_Pa(self) -> Array:
        """(f,) largest pressure of each frame; NaN in failed frames."""
        peaks = [block.max(axis=1, initial=0.0) for block in self.blocks("pressure_Pa")]
        return np.concatenate([np.zeros(0), *peaks])

    @cached_property
    def forces_N(self) -> Array:
        """(f, 3) sum of the forces on the insert; NaN in failed frames."""
        forces = [block.sum(axis=1) for block in self.blocks("nodal_force_N")]
        return np.concatenate([np.zeros((0, 3)), *forces])

    def _optional_array(self, name: str) -> Array:
        """Return (f, 3, 3), NaN if an early file lacks it."""
        missing = np.full((len(self.time_s), 3, 3), np.nan)
        if not isinstance(self.source, Path):
            return np.asarray(self.source.get(name, missing), float)
        with _opened(self.source) as file:
            return file[name][: len(missing)] if name in file else missing

    def _array(self, name: str, frames: int | None = None) -> Any:
        if not isinstance(self.source, Path):
            return np.asarray(self.source[name])
        with _opened(self.source) as file:
            size, most = 8.0 * file[name].size, SHARE_OF_MEMORY * available_memory()
            if size > most:
                what = f"'{name}' has {size / 1e9:.3g} GB; the limit is {most / 1e9:.3g} GB"
                raise InputError(what, self.source, "free memory, or read some frames by `rows`")
            return np.asarray(file[name][:frames], None if name == "triangles" else float)


def read_maps(path: str | Path) -> ContactMaps:
    """Open a contact.h5 of a finished or killed run."""
    maps = ContactMaps(Path(path))
    check_file(path, float("inf"), what="contact.h5")
    len(maps)  # opens the file
    return maps


def write_maps(maps: ContactMaps, path: Path) -> None:
    """Write maps from memory as a complete contact.h5."""
    points, triangles, attributes = maps.points_m, maps.triangles, maps.attributes
    with (
        replaced_file(path) as temporary,
        MapWriter(temporary, points, triangles, attributes) as writer,
    ):
        for k, time in enumerate(maps.time_s):
            data = maps.frame_data(k)
            frame = (data["pressure_Pa"], data["gap_m"], data["nodal_force_N"])
            places = (maps.contact_points_m[k], maps.contact_normals[k])
            writer.append(time, *frame, maps.femoral_pose[k], *places)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    with undamaged(path):
        try:
            file = h5py.File(path, "r")
        except FileNotFoundError:
            raise InputError("no such file", path) from None
        with file:
            check_maps_file(file)
            yield file


FILTERS = frozenset({h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE})
"""Compression filters that tkamb uses. Any other filter could load a library."""


def check_maps_file(file: Any) -> None:
    """Raise unless an open HDF5 file itself contains the arrays that tkamb writes.

    HDF5 can refer to arrays in other files (external storage, external links, virtual datasets), so
    that someone else's results folder could make tkamb read private files.

    Raises:
        ValueError: an array is missing, stored in another file, or has another length.
    """
    for name in ("points_m", "triangles", *PER_FRAME):
        if name not in file and name in ("contact_points_m", "contact_normals"):
            continue  # files of early releases lack them
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"'{name}' is absent, or a link, which tkamb does not follow")
        properties = file[name].id.get_create_plist()
        if file[name].is_virtual or properties.get_external_count():
            raise ValueError(f"'{name}' is stored in another file, which is not read")
        filters = {properties.get_filter(k)[0] for k in range(properties.get_nfilters())}
        if not filters <= FILTERS:
            raise ValueError(f"'{name}' has a compression that tkamb does not use")
        if name in PER_FRAME and len(file[name]) < len(file["time_s"]):
            raise ValueError(f"'{name}' has {len(file[name])} of {len(file['time_s'])} frames")
        if name in PER_FRAME[:3] and file[name].shape[1] != len(file["points_m"]):
            raise ValueError(f"'{name}' has the shape {file[name].shape}")
