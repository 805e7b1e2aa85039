"""The ground reaction on the foot, from one force plate or from plates that share the load.

The centre of pressure is a quotient, M/F, that means nothing near F = 0. So force and
moment about the fixed laboratory origin are filtered, which is linear, and the centre of
pressure is recomputed from them on the plate's level h:

    x = (M_z + h F_x) / F_y,   z = (h F_z - M_x) / F_y,   T_y = M_y - (z F_x - x F_z)

Below `unloaded_N` of vertical force the point is interpolated linearly in time between the
loaded frames on either side, and the moment is the one about that point. Force and moment stay
exactly as measured and filtered; only their reference point is a convention.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, Array
from tkamb.io.recordings.c3d import read_c3d
from tkamb.io.recordings.filtering import Cutoff, differentiate_coordinates
from tkamb.io.recordings.force_plates import PLATE_LOAD, around_load, unloaded_level
from tkamb.io.recordings.gait_cycle import Gait, find_gait
from tkamb.io.recordings.laboratory import check_roles, laboratory_rotation
from tkamb.io.recordings.recording_tables import GroundReactionTable, Side
from tkamb.io.recordings.samples import OddSample, check_range, check_spacing, odd_samples
from tkamb.io.recordings.tables import Table, read_table
from tkamb.io.recordings.unit_words import GivenUnits
from tkamb.units import MILLIMETRE

DIRECTIONS = ("forward", "upward", "rightward")
"""The laboratory's axes, for the reader: a file's own may be others."""


@dataclass(frozen=True)
class GroundReactionSettings:
    """How a measured ground reaction is read and checked."""

    level_tolerance: float = 0.01
    """m: a centre of pressure whose height varies by more is not on a level plate. Chosen: rounding
    of a level plate is smaller."""
    window: float = 0.5
    """s: samples farther from the frames than this do not affect them through the filter. Chosen:
    several times as long as the filter's response."""
    moment_tolerance: float = 1e-6
    """N·m. Chosen: horizontal moments above this belong to a point other than the centre of
    pressure."""
    max_ankle_distance: float = 0.5
    """m: a centre of pressure farther from the ankle is not under the foot of that leg. Chosen:
    more than the length of a foot."""


GROUND_REACTION = GroundReactionSettings()

LARGEST = {"force": (20000.0, "N"), "moment": (1000.0, "N·m")}
"""Largest values that are accepted. Force: twice that on a triple jumper's foot. Moment: many times
any free moment; moments about a plate's own origin are smaller, too."""
ODD_FORCE, LEAST_ODD_FORCE, ODD_POINT = 0.05, 0.01, 5e-3
"""Smallest deviations of an odd sample from its neighbours' curve: as a share of the component's
peak, as a share of the whole force's peak (the larger of the two holds), and in m for a point."""
ODD_SHARE_LEFT = 0.1
"""Share of the smallest odd force deviation: a spike of which the low-pass leaves less is not
reported. It changes no result by more than 0.5 % of the peak. One sample of 76 N at 1200 Hz leaves
0.8 N at 6 Hz."""


@dataclass(frozen=True, eq=False)
class GroundReaction:
    """Force on a right foot in the laboratory (x forward, y up, z right).

    Args:
        force: (f, 3) N.
        point: (f, 3) m, the centre of pressure.
        moment: (f, 3) N·m about that point; vertical while the foot is loaded.
        loaded: (f,) whether the vertical force is at or above `unloaded_N`.
        odd: recorded samples around the frames that lie off their neighbours' curve.
        level_assumed: whether the plate's height is assumed to be 0, because no column states it.
        drift: number of a plate -> N, its large vertical reading while nobody stands on it.
        notices: remarks on the parts of the file that were used.
        gait: stances that the recording shows; None where there is no recording.
    """

    force: Array
    point: Array
    moment: Array
    loaded: np.ndarray
    odd: tuple[OddSample, ...] = ()
    level_assumed: bool = False
    drift: dict[int, float] = field(default_factory=dict)
    notices: tuple[str, ...] = ()
    gait: Gait | None = None


@dataclass(frozen=True, eq=False)
class RecordedReaction:
    """A foot's ground reaction as a file has it, in the laboratory.

    Args:
        time: (k,) s.
        force: (k, 3) N.
        point: (k, 3) m.
        moment: (k, 3) N·m about that point.
        level_assumed: whether no column states the plate's height.
        drift: as in `GroundReaction`.
        notices: as in `GroundReaction`.
    """

    time: Array
    force: Array
    point: Array
    moment: Array
    level_assumed: bool = False
    drift: dict[int, float] = field(default_factory=dict)
    notices: tuple[str, ...] = ()

    def part(self, rows: slice) -> "RecordedReaction":
        """Return some of the samples."""
        own = {name: getattr(self, name)[rows] for name in ("time", "force", "point", "moment")}
        return replace(self, **own)


def load_ground_reaction(source: GroundReactionTable, time: Array, side: Side) -> GroundReaction:
    """Return the ground reaction at the frames of the knee's motion.

    Args:
        source: the scene's [ground_reaction].
        time: (f,) s of the frames, on the file's clock.
        side: side of the knee; a left foot is mirrored.

    Raises:
        InputError: file or columns cannot be used, do not cover `time`, the force is not
            mainly upwards, or a centre of pressure is missing or not level while the plate is
            loaded.
    """
    from_plates = _is_c3d(source)
    recorded = _complete_part((_read_plates if from_plates else _read_table)(source), time, source)
    stamps, force, point, moment = recorded.time, recorded.force, recorded.point, recorded.moment
    path = source.file
    check_spacing(path, stamps)
    _check_upward(force, source)
    loaded = force[:, 1] >= source.unloaded_N
    held, point = _own_points(recorded, loaded, path)
    near = (stamps >= time[0] - GROUND_REACTION.window) & (
        stamps <= time[-1] + GROUND_REACTION.window
    )
    # Plates record the wrench. Their centre of pressure is a quotient and noisy at small forces.
    points = None if from_plates else point[near]
    odd = _odd_samples(path, stamps[near], force[near], points, loaded[near], source.cutoff_Hz)
    level = float(np.median(point[loaded, 1])) if loaded.any() else 0.0
    if loaded.any() and np.abs(point[loaded, 1] - level).max() > GROUND_REACTION.level_tolerance:
        raise InputError(
            "the centre of pressure leaves the plate's level while it is loaded",
            path,
            "check columns point_1..3, length_unit and laboratory_axes",
        )
    if side == "left":
        force, point, moment = force @ MIRROR, point @ MIRROR, -moment @ MIRROR
        held = held @ MIRROR
    wrench = np.concatenate([force, np.cross(point, force) + moment], axis=1)
    filtered, _, _ = differentiate_coordinates(
        stamps, wrench, source.cutoff_Hz, time, name=str(path)
    )
    reaction = _at_centre_of_pressure(filtered, level, source.unloaded_N, time, stamps, held)
    return replace(
        reaction,
        odd=odd,
        level_assumed=recorded.level_assumed,
        drift=recorded.drift,
        notices=recorded.notices,
        gait=find_gait(stamps, force[:, 1]),
    )


def recorded_wrench(source: GroundReactionTable) -> tuple[Array, Array, float]:
    """Return times (k,) s, wrench on the foot (k, 6) N and N·m, and plate level (m) of a table.

    The wrench is in the laboratory and about its origin.

    Raises:
        InputError: columns that cannot be used, or a force that is not mainly upwards.
    """
    recorded = _read_table(source)
    _check_upward(recorded.force, source)
    loaded = recorded.force[:, 1] >= source.unloaded_N
    _, point = _own_points(recorded, loaded, source.file)
    about = np.cross(point, recorded.force) + recorded.moment
    level = float(np.median(point[loaded, 1])) if loaded.any() else 0.0
    return recorded.time, np.concatenate([recorded.force, about], axis=1), level


def _own_points(recorded: RecordedReaction, loaded: np.ndarray, path: Path) -> tuple[Array, Array]:
    """Return the points with interpolation while unloaded, and the moments' points, each (k, 3) m.

    A row with a horizontal moment states the moment about the recorded point of that row.
    """
    held = _hold_point(recorded.time, recorded.point, loaded, path)
    aside = np.abs(recorded.moment[:, [0, 2]]) > GROUND_REACTION.moment_tolerance
    own: NDArray[np.bool_] = np.asarray(np.isfinite(recorded.point).all(axis=1) & aside.any(axis=1))
    return held, np.where(own[:, None], recorded.point, held)


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
    """Return the longest part around the frames without a value that is not a number.

    Raises:
        InputError: there is such a value among the frames.
    """
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
    line = f"used from {part.time[0]:.4f} to {part.time[-1]:.4f} s: beside it are values that are "
    return replace(part, notices=(*part.notices, line + "not numbers"))


def _read_table(source: GroundReactionTable) -> RecordedReaction:
    """Return the reaction of a table; the points' height is zero if no column states it."""
    if source.surface_mm:
        raise InputError(
            "is for plates of a .c3d: a table states its points itself",
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
    return RecordedReaction(stamps, *_read_columns(source, recorded), level_assumed)


def _odd_samples(
    path: Path,
    stamps: Array,
    force: Array,
    point: Array | None,
    loaded: np.ndarray,
    cutoff: Cutoff,
) -> tuple[OddSample, ...]:
    """Return the odd samples of force and recorded point (n, 3) while the plate is loaded.

    The low-pass (`cutoff`, Hz) spreads one sample over the time 1 / (2 cutoff). Odd forces that
    are small after it are not returned.
    """
    if not loaded.any():
        return ()
    spacing = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    left = 1.0 if cutoff == "none" else min(1.0, 2.0 * cutoff * spacing)
    peaks = np.abs(force).max(axis=0)
    floors = np.maximum(ODD_FORCE * peaks, LEAST_ODD_FORCE * peaks.max())
    inside = loaded.copy()  # two samples after foot strike and before toe-off do not count
    for shift in (1, 2):
        inside[shift:] &= loaded[:-shift]
        inside[:-shift] &= loaded[shift:]
    kept = set(stamps[inside].tolist())
    odd: list[OddSample] = []
    for axis in range(3):
        one = (path, f"{DIRECTIONS[axis]} force", stamps, force[:, axis])
        floor = float(floors[axis])
        spikes = odd_samples(*one, floor, 1.0, "N")
        odd += [spike for spike in spikes if left * spike.away > ODD_SHARE_LEFT * floor]
        if point is not None:
            one = (path, f"centre of pressure, {DIRECTIONS[axis]}", stamps, point[:, axis])
            odd += odd_samples(*one, ODD_POINT, MILLIMETRE, "mm")
    return tuple(sample for sample in odd if sample.time in kept)


def check_under_foot(ground: GroundReaction, ankle: Array, path: Path) -> None:
    """Raise an InputError where the loaded centre of pressure is not under the foot.

    Args:
        ground: the ground reaction.
        ankle: (f, 3) m, ankle centre in the laboratory at the same frames.
        path: file of the ground reaction, for the message.
    """
    away = (ground.point - ankle)[ground.loaded][:, [0, 2]]
    farthest = float(np.linalg.norm(away, axis=1).max(initial=0.0))
    if farthest > GROUND_REACTION.max_ankle_distance:
        raise InputError(
            f"the centre of pressure lies up to {farthest:.3g} m from the ankle",
            path,
            "check [ground_reaction] length_unit, columns and laboratory_axes, and [tibia]",
        )


def _upright_point(source: GroundReactionTable) -> str:
    """Return the role of the centre of pressure's height, whose column may be missing."""
    return f"point_{'xyz'.index(source.laboratory_axes.split(',')[1][-1]) + 1}"


def _read_columns(source: GroundReactionTable, recorded: Table) -> tuple[Array, Array, Array]:
    """Return force (N), point (m) and free moment (N·m), each (n, 3), in the laboratory."""
    roles = [f"{kind}_{k}" for kind in ("force", "point", "moment") for k in (1, 2, 3)]
    check_roles(source.columns, ("time", *roles), recorded.path, "ground_reaction")
    rotation = laboratory_rotation(source.laboratory_axes, recorded.path)
    roles_present = {role for role in roles if role in source.columns or role in recorded.columns}
    columns = []
    # moments about the file's origin need no points: the force then is given there
    pointless = (
        not any(role.startswith("point") for role in roles_present) and len(roles_present) == 6
    )
    for role in roles:
        column = source.columns.get(role, role)
        present = role in roles_present
        if role.startswith("point") and pointless:
            columns.append(np.zeros(recorded.rows))
            continue
        if role.startswith("point") and (present or role != _upright_point(source)):
            columns.append(recorded.column(column))  # undefined while unloaded
        elif role.startswith("force") or present:
            columns.append(recorded.column(column))
            _check_size(recorded.path, role[:-2], column, columns[-1])
        else:
            columns.append(np.zeros_like(columns[0]))
    values = np.stack(columns, axis=1).reshape(-1, 3, 3) @ rotation.T
    scale = recorded.unit_scale(source.length_unit, "length_unit")
    return source.sign * values[:, 0], values[:, 1] * scale, source.sign * values[:, 2]


def _check_size(path: Path, kind: str, column: str, values: Array) -> None:
    """Raise an InputError where a column (n,) of a kind holds more than a foot exerts."""
    largest, unit = LARGEST[kind]
    question = f"check whether a cell is mistyped, and whether the {kind} is in {unit}"
    filled = np.where(np.isfinite(values), values, 0.0)  # a gap is refused where it is needed
    check_range(path, f"foot: column '{column}'", filled, (-largest, largest), unit, question)


def _read_plates(source: GroundReactionTable) -> RecordedReaction:
    """Return the ground reaction of a recording's plates.

    The wrenches are summed about the laboratory's origin and kept, each while its plate is
    loaded: the point lies on the level of the plates' surface or that of a step on them,
    `surface_mm` above it, and is carried over in time while the vertical force is below
    `unloaded_N`.
    """
    recording = read_c3d(source.file, _units(source))
    check_roles(source.columns, (), source.file, "ground_reaction")
    numbers = [plate.number for plate in recording.plates]
    if not source.plates:
        raise InputError(
            "holds several force plates" if numbers else "holds no force plate",
            source.file,
            f"give [ground_reaction] plates, of {', '.join(map(str, numbers)) or 'none'}",
        )
    plates = [recording.plate(number) for number in dict.fromkeys(source.plates)]
    rotation = laboratory_rotation(source.laboratory_axes, source.file)
    levels = [float((rotation @ plate.centre)[1]) for plate in plates]
    if np.ptp(levels) > GROUND_REACTION.level_tolerance:
        raise InputError("the plates lie at different levels", source.file, "give them one by one")
    wrenches, drift = [], {}
    for plate in plates:
        in_file = source.sign * plate.wrench
        wrench = np.concatenate([in_file[:, :3] @ rotation.T, in_file[:, 3:] @ rotation.T], axis=1)
        size = np.linalg.norm(wrench[:, :3], axis=1)  # in any direction: axes are checked below
        on = around_load(size, recording.analog_time)
        wrenches.append(np.where((on | ~np.isfinite(wrench).all(axis=1))[:, None], wrench, 0.0))
        level = unloaded_level(wrench[:, 1], on, recording.analog_time)
        if abs(level) > PLATE_LOAD.drift_N:
            drift[plate.number] = level
    point, moment, force = summed_reaction(
        recording.analog_time,
        wrenches,
        levels[0] + source.surface_mm * MILLIMETRE,
        source.unloaded_N,
        source.file,
    )
    notices = tuple(notice for plate in plates for notice in plate.notices)
    return RecordedReaction(
        recording.analog_time, force, point, moment, drift=drift, notices=notices
    )


def summed_reaction(
    time: Array, wrenches: list[Array], level: float, unloaded: float, path: Path
) -> tuple[Array, Array, Array]:
    """Return point (k, 3) m, moment (k, 3) N·m about it and force (k, 3) N of summed wrenches.

    Args:
        time: (k,) s.
        wrenches: each (k, 6), force and moment about the laboratory's origin.
        level: m, height of the point.
        unloaded: N, vertical force below which the point is carried over in time.
        path: the file, for messages.
    """
    wrench = np.sum(wrenches, axis=0)
    force, about_origin = wrench[:, :3], wrench[:, 3:]
    point = np.full_like(force, np.nan)
    loaded = force[:, 1] >= unloaded
    point[loaded] = _centre_of_pressure(force[loaded], about_origin[loaded], level)
    point = _hold_point(time, point, loaded, path)
    return point, about_origin - np.cross(point, force), force


def _centre_of_pressure(force: Array, about_origin: Array, level: float) -> Array:
    """Return the point (k, 3) m at a level where the moment is vertical; see the module."""
    fx, fy, fz = force.T
    x = (about_origin[:, 2] + level * fx) / fy
    z = (level * fz - about_origin[:, 0]) / fy
    return np.stack([x, np.full_like(x, level), z], axis=1)


def _check_upward(force: Array, source: GroundReactionTable) -> None:
    """Raise where the largest force on the foot points down or sideways."""
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
            + ("leave out force" if source.sign < 0 else 'say force = "on the plate"'),
        )


def _hold_point(stamps: Array, point: Array, loaded: np.ndarray, path: Path) -> Array:
    """Return the points; those of the unloaded plate are interpolated in time."""
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
    wrench: Array, level: float, unloaded_N: float, time: Array, stamps: Array, held: Array
) -> GroundReaction:
    """Return force, point and moment of wrenches (f, 6) about the laboratory origin."""
    force, about_origin = wrench[:, :3], wrench[:, 3:]
    loaded = force[:, 1] >= unloaded_N
    point = np.stack([np.interp(time, stamps, held[:, k]) for k in range(3)], axis=1)
    point[:, 1] = level
    point[loaded] = _centre_of_pressure(force[loaded], about_origin[loaded], level)
    moment = about_origin - np.cross(point, force)
    return GroundReaction(force, point, moment, loaded)
