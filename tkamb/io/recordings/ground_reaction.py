"""The ground reaction on the foot, from one force plate or from plates that share the load.

The centre of pressure is a quotient, M/F, so force and moment about the laboratory's origin are
filtered instead. It follows from the filtered values, at the plate's level h:

    x = (M_z + h F_x) / F_y,   z = (h F_z - M_x) / F_y,   T_y = M_y - (z F_x - x F_z)

While the vertical force is below `unloaded_N`, the point is interpolated linearly in time between
the loaded samples before and after. The moment is then about this point; the wrench itself does not
change.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, Array
from tkamb.io.recordings.c3d import read_c3d
from tkamb.io.recordings.filtering import (
    Cutoff,
    OddSample,
    check_range,
    check_spacing,
    differentiate_coordinates,
    odd_samples,
)
from tkamb.io.recordings.force_plates import DRIFT_N, around_load, unloaded_level
from tkamb.io.recordings.gait_cycle import Gait, find_gait
from tkamb.io.recordings.laboratory import GivenUnits, check_roles, laboratory_rotation
from tkamb.io.recordings.recording_tables import GroundReactionTable, Side
from tkamb.io.recordings.tables import Table, read_table
from tkamb.units import MILLIMETRE

DIRECTIONS = ("forward", "upward", "rightward")
"""The laboratory's axes in messages; a file may have others."""


# m: largest change of height of the centre of pressure on a level plate, and largest height
# between plates. Rounding is smaller.
LEVEL_TOLERANCE = 0.01
# s: time before and after the frames in which samples are searched for odd values.
# The filter's response is several times shorter.
WINDOW = 0.5
# N·m: a larger horizontal moment is about a point other than the centre of pressure.
MOMENT_TOLERANCE = 1e-6
# m: largest horizontal distance of the centre of pressure from the ankle. It is
# more than the length of a foot; a farther point is under another foot.
MAX_ANKLE_DISTANCE = 0.5


LARGEST = {"force": (20000.0, "N"), "moment": (1000.0, "N·m")}
"""Largest accepted values. Force: twice the force on a triple jumper's foot. Moment: many times any
free moment, and more than moments about a plate's origin."""
ODD_FORCE, LEAST_ODD_FORCE, ODD_POINT = 0.05, 0.01, 5e-3
"""Smallest deviations of an odd sample from the curve of its neighbours. ODD_FORCE: share of the
component's peak. LEAST_ODD_FORCE: share of the largest component's peak; the larger limit holds.
ODD_POINT: m, of the centre of pressure."""
ODD_SHARE_LEFT = 0.1
"""1: a spike is reported if more than this share of the smallest odd deviation remains after the
low-pass filter. Smaller spikes change results by at most 0.5 % of the peak. Example: of one sample
of 76 N at 1200 Hz, 0.8 N remain at a cut-off of 6 Hz."""


@dataclass(frozen=True, eq=False)
class GroundReaction:
    """Force on a right foot in the laboratory (x forward, y up, z right).

    Args:
        force: (f, 3) N.
        point: (f, 3) m, the centre of pressure.
        moment: (f, 3) N·m about `point`; vertical while the foot is loaded.
        loaded: (f,) whether the vertical force is at least `unloaded_N`.
        odd: recorded samples around the frames that lie off the curve of their neighbours.
        level_assumed: whether the plate's height is assumed to be 0, because no column states it.
        drift: plate's number -> its vertical force when unloaded, N, if large.
        remarks: notices on the file and its used parts.
        gait: stances in the recording; None if not computed.
    """

    force: Array
    point: Array
    moment: Array
    loaded: np.ndarray
    odd: tuple[OddSample, ...] = ()
    level_assumed: bool = False
    drift: dict[int, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    gait: Gait | None = None


@dataclass(frozen=True, eq=False)
class RecordedReaction:
    """A foot's ground reaction as recorded, in the laboratory's axes.

    Args:
        time: (k,) s.
        force: (k, 3) N.
        point: (k, 3) m.
        moment: (k, 3) N·m about `point`.
        drift: as in `GroundReaction`.
    """

    time: Array
    force: Array
    point: Array
    moment: Array
    level_assumed: bool = False
    drift: dict[int, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    def part(self, rows: slice) -> "RecordedReaction":
        """Return the samples of a slice."""
        arrays = {name: getattr(self, name)[rows] for name in ("time", "force", "point", "moment")}
        return replace(self, **arrays)


def load_ground_reaction(source: GroundReactionTable, time: Array, side: Side) -> GroundReaction:
    """Return the ground reaction at the frames of the knee's motion.

    Args:
        time: (f,) s, on the file's clock.
        side: side of the knee; a left foot is mirrored.
    """
    from_plates = _is_c3d(source)
    recorded = _complete_part((_read_plates if from_plates else _read_table)(source), time, source)
    stamps, force, point, moment = recorded.time, recorded.force, recorded.point, recorded.moment
    path = source.file
    check_spacing(path, stamps)
    _check_upward(force, source)
    loaded = force[:, 1] >= source.unloaded_N
    interpolated, point = _reference_points(recorded, loaded, path)
    near = (stamps >= time[0] - WINDOW) & (stamps <= time[-1] + WINDOW)
    # Plates record the wrench. Their centre of pressure is a quotient and noisy at small forces.
    points = None if from_plates else point[near]
    odd = _odd_samples(path, stamps[near], force[near], points, loaded[near], source.cutoff_Hz)
    level = float(np.median(point[loaded, 1])) if loaded.any() else 0.0
    if loaded.any() and np.abs(point[loaded, 1] - level).max() > LEVEL_TOLERANCE:
        raise InputError(
            "the centre of pressure leaves the plate's level while it is loaded",
            path,
            "check columns point_1..3, length_unit and laboratory_axes",
        )
    if side == "left":
        force, point, moment = force @ MIRROR, point @ MIRROR, -moment @ MIRROR
        interpolated = interpolated @ MIRROR
    wrench = np.concatenate([force, np.cross(point, force) + moment], axis=1)
    filtered, _, _ = differentiate_coordinates(
        stamps, wrench, source.cutoff_Hz, time, name=str(path)
    )
    reaction = _at_centre_of_pressure(
        filtered, level, source.unloaded_N, time, stamps, interpolated
    )
    return replace(
        reaction,
        odd=odd,
        level_assumed=recorded.level_assumed,
        drift=recorded.drift,
        remarks=recorded.remarks,
        gait=find_gait(stamps, force[:, 1]),
    )


def recorded_wrench(source: GroundReactionTable) -> tuple[Array, Array, float]:
    """Return times (k,) s, wrench on the foot (k, 6) N and N·m, and plate level (m) of a table.

    The wrench is in the laboratory's axes, about the laboratory's origin.
    """
    recorded = _read_table(source)
    _check_upward(recorded.force, source)
    loaded = recorded.force[:, 1] >= source.unloaded_N
    _, point = _reference_points(recorded, loaded, source.file)
    about = np.cross(point, recorded.force) + recorded.moment
    level = float(np.median(point[loaded, 1])) if loaded.any() else 0.0
    return recorded.time, np.concatenate([recorded.force, about], axis=1), level


def _reference_points(
    recorded: RecordedReaction, loaded: np.ndarray, path: Path
) -> tuple[Array, Array]:
    """Return centres of pressure and reference points of the moments, (k, 3) m.

    Unloaded centres are interpolated and are the reference points, except in rows with a horizontal
    moment: there it is the recorded point.
    """
    interpolated = _interpolate_unloaded(recorded.time, recorded.point, loaded, path)
    horizontal = np.abs(recorded.moment[:, [0, 2]]) > MOMENT_TOLERANCE
    about_recorded: NDArray[np.bool_] = np.asarray(
        np.isfinite(recorded.point).all(axis=1) & horizontal.any(axis=1)
    )
    return interpolated, np.where(about_recorded[:, None], recorded.point, interpolated)


def recorded_span(source: GroundReactionTable) -> tuple[float, float]:
    """Return first and last time (s) of a file's ground reaction."""
    if _is_c3d(source):
        time = read_c3d(source.file, _units(source)).analog_time
    else:
        time = read_table(source.file, source.format).time(source.columns.get("time", "time"))
    return float(time[0]), float(time[-1])


def _is_c3d(source: GroundReactionTable) -> bool:
    return (source.format or source.file.suffix.lower().lstrip(".")) == "c3d"


def _units(source: GroundReactionTable) -> GivenUnits:
    return GivenUnits(source.length_unit, source.force_unit, source.moment_unit)


def _complete_part(
    recorded: RecordedReaction, time: Array, source: GroundReactionTable
) -> RecordedReaction:
    values = np.concatenate([recorded.force, recorded.moment], axis=1)
    gaps: NDArray[np.bool_] = np.asarray(~np.isfinite(values).all(axis=1))
    if not gaps.any():
        return recorded
    stamps = recorded.time
    first = max(int(np.searchsorted(stamps, time[0] + 1e-9, side="right")) - 1, 0)
    last = min(int(np.searchsorted(stamps, time[-1] - 1e-9)), len(stamps) - 1)
    inside = gaps[first : last + 1]
    if inside.any():
        raise InputError(
            f"holds a value that is not a number at {stamps[first + int(np.argmax(inside))]:.4f} s",
            source.file,
            "choose an interval without it, or fill the gap",
        )
    before, after = np.flatnonzero(gaps[:first]), np.flatnonzero(gaps[last:])
    start = int(before[-1]) + 1 if len(before) else 0
    end = last + int(after[0]) if len(after) else len(stamps)
    part = recorded.part(slice(start, end))
    interval = f"{part.time[0]:.4f} to {part.time[-1]:.4f} s"
    remark = f"{source.file.name}: used from {interval}: values before or after are not numbers"
    return replace(part, remarks=(*part.remarks, remark))


def _read_table(source: GroundReactionTable) -> RecordedReaction:
    if source.surface_mm:
        raise InputError(
            "is for plates of a .c3d; a table states its points itself",
            "[ground_reaction] surface_mm",
            "leave it out",
        )
    for key, unit in (("force_unit", source.force_unit), ("moment_unit", source.moment_unit)):
        if unit:
            raise InputError(
                "is for plates of a .c3d: a table is in N and N·m",
                f"[ground_reaction] {key}",
                "leave it out",
            )
    recorded = read_table(source.file, source.format)
    stamps = recorded.time(source.columns.get("time", "time"))
    level_assumed = _upright_point(source) not in {*source.columns, *recorded.columns}
    values = _read_columns(source, recorded)
    return RecordedReaction(stamps, *values, level_assumed, remarks=recorded.remarks)


def _odd_samples(
    path: Path,
    stamps: Array,
    force: Array,
    point: Array | None,
    loaded: np.ndarray,
    cutoff: Cutoff,
) -> tuple[OddSample, ...]:
    """Return the odd samples of force and recorded point (n, 3) under load.

    The low-pass filter spreads one sample over the time 1 / (2 cutoff). Forces that are small
    afterwards are not returned.
    """
    if not loaded.any():
        return ()
    spacing = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    remaining = 1.0 if cutoff == "none" else min(1.0, 2.0 * cutoff * spacing)
    peaks = np.abs(force).max(axis=0)
    floors = np.maximum(ODD_FORCE * peaks, LEAST_ODD_FORCE * peaks.max())
    inside = loaded.copy()  # without two samples after foot strike and before toe-off
    for shift in (1, 2):
        inside[shift:] &= loaded[:-shift]
        inside[:-shift] &= loaded[shift:]
    inside_times = set(stamps[inside].tolist())
    odd: list[OddSample] = []
    for axis in range(3):
        series = (path, f"{DIRECTIONS[axis]} force", stamps, force[:, axis])
        floor = float(floors[axis])
        spikes = odd_samples(*series, floor, 1.0, "N")
        odd += [spike for spike in spikes if remaining * spike.away > ODD_SHARE_LEFT * floor]
        if point is not None:
            series = (path, f"centre of pressure, {DIRECTIONS[axis]}", stamps, point[:, axis])
            odd += odd_samples(*series, ODD_POINT, MILLIMETRE, "mm")
    return tuple(sample for sample in odd if sample.time in inside_times)


def check_under_foot(ground: GroundReaction, ankle: Array, path: Path) -> None:
    """Raise an InputError if the centre of pressure of the loaded foot is not under the foot.

    Args:
        ankle: (f, 3) m, ankle centre in the laboratory at the same frames.
    """
    horizontal = (ground.point - ankle)[ground.loaded][:, [0, 2]]
    farthest = float(np.linalg.norm(horizontal, axis=1).max(initial=0.0))
    if farthest > MAX_ANKLE_DISTANCE:
        raise InputError(
            f"the centre of pressure lies up to {farthest:.3g} m from the ankle",
            path,
            "check [ground_reaction] length_unit, columns and laboratory_axes, [tibia], and the "
            "clocks of both files",
        )


def _upright_point(source: GroundReactionTable) -> str:
    """Return the role of the centre of pressure's height, whose column may be missing."""
    return f"point_{'xyz'.index(source.laboratory_axes.split(',')[1][-1]) + 1}"


def _read_columns(source: GroundReactionTable, recorded: Table) -> tuple[Array, Array, Array]:
    roles = [f"{kind}_{k}" for kind in ("force", "point", "moment") for k in (1, 2, 3)]
    check_roles(source.columns, ("time", *roles), recorded.path, "ground_reaction")
    rotation = laboratory_rotation(source.laboratory_axes, recorded.path)
    roles_present = {role for role in roles if role in source.columns or role in recorded.columns}
    columns = []
    # Without point columns, the moments are about the file's origin, and all three are needed.
    without_points = (
        not any(role.startswith("point") for role in roles_present) and len(roles_present) == 6
    )
    for role in roles:
        column = source.columns.get(role, role)
        present = role in roles_present
        if role.startswith("point") and without_points:
            columns.append(np.zeros(recorded.rows))
            continue
        if role.startswith("point") and (present or role != _upright_point(source)):
            columns.append(recorded.column(column))  # may be NaN while unloaded
        elif role.startswith("force") or present:
            columns.append(recorded.column(column))
            _check_size(recorded.path, role[:-2], column, columns[-1])
        else:
            columns.append(np.zeros_like(columns[0]))
    values = np.stack(columns, axis=1).reshape(-1, 3, 3) @ rotation.T
    scale = recorded.unit_scale(source.length_unit, "length_unit")
    return source.sign * values[:, 0], values[:, 1] * scale, source.sign * values[:, 2]


def _check_size(path: Path, kind: str, column: str, values: Array) -> None:
    largest, unit = LARGEST[kind]
    hint = f"check whether a cell is mistyped, and whether the {kind} is in {unit}"
    filled = np.where(np.isfinite(values), values, 0.0)  # gaps are checked later
    check_range(path, f"foot: column '{column}'", filled, (-largest, largest), unit, hint)


def _read_plates(source: GroundReactionTable) -> RecordedReaction:
    """The loaded plates' wrenches are summed about the laboratory's origin. The point lies on the
    plates' surface, or on a step `surface_mm` higher. It is interpolated in time below
    `unloaded_N`.
    """
    recording = read_c3d(source.file, _units(source))
    check_roles(source.columns, (), source.file, "ground_reaction")
    numbers = [plate.number for plate in recording.plates]
    if not source.plates:
        raise InputError(
            "holds several force plates" if numbers else "holds no force plate",
            source.file,
            f"choose [ground_reaction] plates from: {', '.join(map(str, numbers)) or 'none'}",
        )
    plates = [recording.plate(number) for number in dict.fromkeys(source.plates)]
    rotation = laboratory_rotation(source.laboratory_axes, source.file)
    levels = [float((rotation @ plate.centre)[1]) for plate in plates]
    if np.ptp(levels) > LEVEL_TOLERANCE:
        raise InputError(
            "the plates lie at different levels",
            source.file,
            "use one plate, or plates at one level",
        )
    wrenches, drift = [], {}
    for plate in plates:
        in_file = source.sign * plate.wrench
        wrench = np.concatenate([in_file[:, :3] @ rotation.T, in_file[:, 3:] @ rotation.T], axis=1)
        size = np.linalg.norm(wrench[:, :3], axis=1)  # the axes may still be wrong
        on = around_load(size, recording.analog_time)
        wrenches.append(np.where((on | ~np.isfinite(wrench).all(axis=1))[:, None], wrench, 0.0))
        level = unloaded_level(wrench[:, 1], on, recording.analog_time)
        if abs(level) > DRIFT_N:
            drift[plate.number] = level
    point, moment, force = summed_reaction(
        recording.analog_time,
        wrenches,
        levels[0] + source.surface_mm * MILLIMETRE,
        source.unloaded_N,
        source.file,
    )
    return RecordedReaction(
        recording.analog_time, force, point, moment, drift=drift, remarks=recording.remarks
    )


def summed_reaction(
    time: Array, wrenches: list[Array], level: float, unloaded: float, path: Path
) -> tuple[Array, Array, Array]:
    """Return point (k, 3) m, moment (k, 3) N·m about it and force (k, 3) N of summed wrenches.

    Args:
        time: (k,) s.
        wrenches: each (k, 6), force and moment about the laboratory's origin.
        level: m, height of the point.
        unloaded: N, vertical force below which the point is interpolated in time.
    """
    wrench = np.sum(wrenches, axis=0)
    force, about_origin = wrench[:, :3], wrench[:, 3:]
    point = np.full_like(force, np.nan)
    loaded = force[:, 1] >= unloaded
    point[loaded] = _centre_of_pressure(force[loaded], about_origin[loaded], level)
    point = _interpolate_unloaded(time, point, loaded, path)
    return point, about_origin - np.cross(point, force), force


def _centre_of_pressure(force: Array, about_origin: Array, level: float) -> Array:
    """Return (k, 3) m at a level (m) about which the moment is vertical; see the module."""
    fx, fy, fz = force.T
    x = (about_origin[:, 2] + level * fx) / fy
    z = (level * fz - about_origin[:, 0]) / fy
    return np.stack([x, np.full_like(x, level), z], axis=1)


def _check_upward(force: Array, source: GroundReactionTable) -> None:
    up, down = float(force[:, 1].max()), float(-force[:, 1].min())
    aside = float(np.hypot(force[:, 0], force[:, 2]).max())
    if max(down, aside) > max(up, source.unloaded_N):
        word, size = ("down", down) if down > aside else ("sideways", aside)
        raise InputError(
            f"the ground pushes the foot up with {max(up, 0.0):.4g} N at most, but {word} with "
            f"{size:.4g} N",
            source.file,
            "check [ground_reaction] columns and laboratory_axes; if it is the force on the "
            f"{'foot' if source.sign < 0 else 'plate'}, "
            + ("leave out the key force" if source.sign < 0 else 'say force = "on the plate"'),
        )


def _interpolate_unloaded(stamps: Array, point: Array, loaded: np.ndarray, path: Path) -> Array:
    missing = loaded & ~np.isfinite(point).all(axis=1)
    if missing.any():
        raise InputError(
            f"the centre of pressure is missing at {stamps[np.argmax(missing)]:g} s, "
            "where the plate is loaded",
            path,
            "fill the gap",
        )
    if not loaded.any():
        return np.zeros_like(point)
    return np.stack([np.interp(stamps, stamps[loaded], point[loaded, k]) for k in range(3)], axis=1)


def _at_centre_of_pressure(
    wrench: Array, level: float, unloaded_N: float, time: Array, stamps: Array, interpolated: Array
) -> GroundReaction:
    """Return force, point and moment of wrenches (f, 6) about the laboratory origin."""
    force, about_origin = wrench[:, :3], wrench[:, 3:]
    loaded = force[:, 1] >= unloaded_N
    point = np.stack([np.interp(time, stamps, interpolated[:, k]) for k in range(3)], axis=1)
    point[:, 1] = level
    point[loaded] = _centre_of_pressure(force[loaded], about_origin[loaded], level)
    moment = about_origin - np.cross(point, force)
    return GroundReaction(force, point, moment, loaded)
