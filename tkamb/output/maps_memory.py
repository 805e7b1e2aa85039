"""Pressure maps kept in memory, with the interface of the file's writer."""

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from tkamb.geometry.frames import Array
from tkamb.output.maps_file import FILE_NAME, PER_FRAME, ContactMaps, MapWriter


class MapKeeper:
    """Collects maps frame by frame; see `tkamb.output.maps_file.MapWriter`."""

    def __init__(self, points: Array, triangles: Array, attributes: Mapping[str, Any]) -> None:
        self._fixed = {"points_m": points, "triangles": triangles}
        self._attributes = attributes
        self._frames: dict[str, list[Array]] = {name: [] for name in PER_FRAME}

    def append(
        self,
        time: float,
        pressure: ArrayLike,
        gap: ArrayLike,
        nodal_force: ArrayLike,
        femoral_pose: ArrayLike,
    ) -> None:
        """Add one frame."""
        values = (pressure, gap, nodal_force, femoral_pose, time)
        for name, value in zip(PER_FRAME, values, strict=True):
            self._frames[name].append(np.array(value, float))

    def append_failed(self, time: float) -> None:
        """Add a frame without a result: NaN everywhere but the time."""
        n, nan = len(self._fixed["points_m"]), np.nan
        self.append(time, *(np.full(shape, nan) for shape in ((n,), (n,), (n, 3), (4, 4))))

    @property
    def maps(self) -> ContactMaps:
        """What was collected."""
        frames = {name: np.stack(values) for name, values in self._frames.items()}
        return ContactMaps(self._fixed | frames, self._attributes)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Keep what was collected."""


def map_sink(
    directory: str | Path | None, points: Array, triangles: Array, attributes: Mapping[str, Any]
) -> MapWriter | MapKeeper:
    """Return what collects a run's maps: contact.h5 in a folder, or memory for None."""
    if directory is None:
        return MapKeeper(points, triangles, attributes)
    return MapWriter(Path(directory) / FILE_NAME, points, triangles, attributes)
