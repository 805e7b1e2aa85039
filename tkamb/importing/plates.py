"""Which foot stood on which plate, and while which part of a recording all of its load is known."""

from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.inputs.c3d import Recording
from tkamb.inputs.laboratory import laboratory_rotation
from tkamb.inputs.markers import marker_trajectories
from tkamb.inputs.tables import Table, read_table

LOADED_N = 40.0
"""Vertical force at which a plate counts as stood upon."""
SHORTEST_S = 0.1
"""A load that lasts less is a knock."""
UNDER_FOOT = 0.25
"""m; horizontally, between a centre of pressure and the middle of the foot's markers."""
ON_A_STEP = 0.15
"""m; a foot whose markers are this far above the plate stands on something."""
MIDDLE = 0.055
"""m; the middle of a foot's markers is about as high above what it stands on."""
SAME_STEP = 0.05
"""m; heights that differ by less are those of one step."""
STILL = 0.15
"""m/s; a foot that moves less, off the plates, stands on something that nobody measured."""


@dataclass(frozen=True)
class Load:
    """A plate under a foot.

    Args:
        plate: number of the plate.
        side: whose foot.
        start: s.
        end: s.
        distance: m, median, between the centre of pressure and that foot's markers.
        other: m, the same to the other foot's; NaN if that has no markers.
        surface: m, about how high above the plate that foot stands: zero, or a step.
    """

    plate: int
    side: str
    start: float
    end: float
    distance: float
    other: float
    surface: float


def plate_loads(recording: Recording, axes: str, feet: dict[str, list[str]]) -> list[Load]:
    """Return every load of every plate, with the foot whose markers are nearest.

    Args:
        recording: with plates.
        axes: the file's that point forward, up and right.
        feet: side -> labels of the foot's markers.

    Raises:
        InputError: a plate under no foot.
    """
    rotation = laboratory_rotation(axes, recording.path)
    table = read_table(recording.path)
    time = recording.analog_time
    middles = {
        side: _interpolated(_middle(table, labels) @ rotation.T, recording.time, time)
        for side, labels in feet.items()
    }
    loads = []
    for plate in recording.plates:
        force, moment = plate.force @ rotation.T, plate.moment @ rotation.T
        loaded = force[:, 1] > LOADED_N
        point = (
            rotation @ plate.centre
            + np.stack([moment[:, 2], 0 * moment[:, 2], -moment[:, 0]], axis=1)
            / np.where(loaded, force[:, 1], np.nan)[:, None]
        )
        for first, last in _runs(loaded):
            if time[last] - time[first] >= SHORTEST_S:
                part = slice(first, last + 1)
                line = (time[part], point[part], force[part])
                loads.append(
                    _load(plate.number, *line, {s: m[part] for s, m in middles.items()}, recording)
                )
    return sorted(loads, key=lambda load: load.start)


def _load(
    number: int,
    time: Array,
    point: Array,
    force: Array,
    middles: dict[str, Array],
    recording: Recording,
) -> Load:
    """Return a load; a foot on a step is compared with the force's line on the step's level."""
    away, surface = {}, {}
    for side, middle in middles.items():
        above = middle[:, 1] - point[:, 1]
        height = float(np.nanmedian(above)) if np.isfinite(above).any() else 0.0
        surface[side] = height - MIDDLE if height > ON_A_STEP else 0.0
        there = point + force / force[:, 1:2] * surface[side]
        distance = np.linalg.norm((there - middle)[:, [0, 2]], axis=1)
        away[side] = float(np.nanmedian(distance)) if np.isfinite(distance).any() else np.nan
    nearest = min(away, key=lambda side: np.nan_to_num(away[side], nan=np.inf))
    if not away[nearest] < UNDER_FOOT:
        raise InputError(
            f"force plate {number} is stood upon from {time[0]:.2f} to {time[-1]:.2f} s, but no "
            f"foot's markers are within {UNDER_FOOT:g} m of its centre of pressure",
            recording.path,
            "check --laboratory-axes and the foot's labels, or give --plates",
        )
    rest = [distance for side, distance in away.items() if side != nearest]
    start, end = float(time[0]), float(time[-1])
    return Load(number, nearest, start, end, away[nearest], rest[0], surface[nearest])


def own_plates(loads: list[Load], side: str, recording: Recording) -> tuple[int, ...]:
    """Return the plates that one foot stood on, and no other.

    Raises:
        InputError: none, or a plate that both feet stood on.
    """
    own = sorted({load.plate for load in loads if load.side == side})
    shared = sorted({load.plate for load in loads if load.side != side} & set(own))
    if shared or not own:
        what = f"both feet stood on force plate {shared[0]}" if shared else "no force plate was"
        what += "" if shared else f" under the {side} foot"
        raise InputError(
            what, recording.path, "give --plates and --interval, or take another trial"
        )
    return tuple(own)


def common_surface(loads: list[Load], plates: tuple[int, ...]) -> float:
    """Return how high (m) the foot stands above its plates; zero where that differs."""
    heights = [load.surface for load in loads if load.plate in plates]
    return float(np.mean(heights)) if np.ptp(heights) < SAME_STEP else 0.0


def known_interval(
    loads: list[Load], plates: tuple[int, ...], recording: Recording
) -> tuple[float, float]:
    """Return the frames' times (s) from the first to the last load of the foot's plates."""
    own = [load for load in loads if load.plate in plates]
    start, end = min(load.start for load in own), max(load.end for load in own)
    time = recording.time
    inside = time[(time >= start - 1e-9) & (time <= end + 1e-9)]
    return float(inside[0]), float(inside[-1])


def unmeasured(
    loads: list[Load],
    plates: tuple[int, ...],
    recording: Recording,
    labels: list[str],
    interval: tuple[float, float],
) -> Array:
    """Return the times (s) in an interval at which the foot is still but on none of the plates."""
    middle = _middle(read_table(recording.path), labels)
    time = recording.time
    speed = np.linalg.norm(np.gradient(middle, time, axis=0), axis=1)
    on = np.zeros(len(time), bool)
    for load in loads:
        if load.plate in plates:
            on |= (time >= load.start - 0.02) & (time <= load.end + 0.02)
    inside = (time >= interval[0]) & (time <= interval[1])
    return np.asarray(time[inside & ~on & (speed < STILL)])


def _middle(table: Table, labels: list[str]) -> Array:
    """Return the mean (n, 3) m of the markers that are seen; NaN without any."""
    rows = table.rows
    if not labels:
        return np.full((rows, 3), np.nan)
    points = marker_trajectories(table, labels, 1.0)
    seen = np.asarray(np.isfinite(points).all(axis=2))
    total = np.where(seen[:, :, None], points, 0.0).sum(axis=1)
    count = seen.sum(axis=1).astype(float)
    count[count == 0] = np.nan
    return np.asarray(total / count[:, None])


def _interpolated(values: Array, time: Array, at: Array) -> Array:
    return np.stack([np.interp(at, time, values[:, k]) for k in range(3)], axis=1)


def _runs(loaded: np.ndarray) -> list[tuple[int, int]]:
    """Return first and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], loaded, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]
