"""The ground reaction on the foot, from one force plate or from plates that share the load.

The centre of pressure is a quotient, M/F, that means nothing near F = 0. So force and
moment about the fixed laboratory origin are filtered, which is linear, and the centre of
pressure is recomputed from them on the plate's level h:

    x = (M_z + h F_x) / F_y,   z = (h F_z - M_x) / F_y,   T_y = M_y - (z F_x - x F_z)

Below `unloaded_N` of vertical force the point is carried over linearly in time between the
loaded frames on either side and the moment is whatever the wrench needs about that point:
force and moment stay exactly as measured and filtered, only their point is conventional.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, Array
from tkamb.inputs.c3d import read_c3d
from tkamb.inputs.filtering import differentiate_coordinates
from tkamb.inputs.laboratory import check_roles, laboratory_rotation
from tkamb.inputs.recordings import ForceRecording, Side
from tkamb.inputs.samples import OddSample, check_range, check_spacing, odd_samples
from tkamb.inputs.tables import Table, read_table
from tkamb.units import MILLIMETRE

DIRECTIONS = ("forward", "upward", "rightward")
"""The laboratory's axes, for the reader: a file's own may be others."""
LEVEL_TOLERANCE = 0.01
"""m; a centre of pressure that rises by more than this is not on a level plate."""
LARGEST = {"force": (20000.0, "N"), "moment": (1000.0, "N·m")}
"""Twice what a triple jumper's foot bears; many times any free moment, and plates that give it
about their own origin stay below it."""
ODD_FORCE, LEAST_ODD_FORCE, ODD_POINT = 0.05, 0.01, 5e-3
"""Of a component's own peak, of the whole force's, and m: as near to its neighbours' curve as the
larger of the forces, or as the last, no sample is odd."""
WINDOW = 0.5
"""s: samples farther from the frames than this do not reach them through the filter."""
FARTHEST_FROM_ANKLE = 0.5
"""m; a centre of pressure farther from the ankle than this is under no foot of that leg."""


@dataclass(frozen=True, eq=False)
class GroundReaction:
    """Force on the foot in the laboratory (x forward, y up, z right), a right foot's.

    Args:
        force: (f, 3) N.
        point: (f, 3) m, the centre of pressure.
        moment: (f, 3) N·m about that point; vertical while the foot is loaded.
        loaded: (f,) whether the vertical force is at or above `unloaded_N`.
        odd: recorded samples around the frames that lie off their neighbours' curve.
        level_assumed: no column says the plate's height, so it is the laboratory's 0.
    """

    force: Array
    point: Array
    moment: Array
    loaded: np.ndarray
    odd: tuple[OddSample, ...] = ()
    level_assumed: bool = False


def load_ground_reaction(source: ForceRecording, time: Array, side: Side) -> GroundReaction:
    """Return the ground reaction at the frames of the knee's motion.

    Args:
        source: what to read, and how.
        time: (f,) s of the frames, on the file's clock.
        side: of the knee; a left foot is mirrored.

    Raises:
        InputError: file or columns cannot be used, do not cover `time`, the force is not
            mainly upwards, or a centre of pressure is missing or not level while the plate is
            loaded.
    """
    from_plates = (source.format or source.file.suffix.lower().lstrip(".")) == "c3d"
    read = _read_plates if from_plates else _read_table
    stamps, force, point, moment, level_assumed = read(source)
    path = source.file
    check_spacing(path, stamps)
    _check_upward(force, source)
    loaded = force[:, 1] >= source.unloaded
    point = _hold_point(stamps, point, loaded, path)
    near = (stamps >= time[0] - WINDOW) & (stamps <= time[-1] + WINDOW)
    # of plates the wrench was recorded: their point is a quotient, which small forces shake
    points = None if from_plates else point[near]
    odd = _odd_samples(path, stamps[near], force[near], points, loaded[near])
    level = float(np.median(point[loaded, 1])) if loaded.any() else 0.0
    if loaded.any() and np.abs(point[loaded, 1] - level).max() > LEVEL_TOLERANCE:
        raise InputError(
            "the centre of pressure leaves the plate's level while it is loaded",
            path,
            "check columns point_1..3, length_unit and laboratory_axes",
        )
    if side == "left":
        force, point, moment = force @ MIRROR, point @ MIRROR, -moment @ MIRROR
    wrench = np.concatenate([force, np.cross(point, force) + moment], axis=1)
    filtered, _, _ = differentiate_coordinates(stamps, wrench, source.cutoff, time, name=str(path))
    reaction = _at_centre_of_pressure(filtered, level, source.unloaded, time, stamps, point)
    return replace(reaction, odd=odd, level_assumed=level_assumed)


def _read_table(source: ForceRecording) -> tuple[Array, Array, Array, Array, bool]:
    """Return what `_read_plates` does; a table without the points' heights has them at zero."""
    if source.surface:
        raise InputError(
            "is for plates of a .c3d: a table states its points itself",
            "[ground_reaction] surface_mm",
            "leave it out",
        )
    recorded = read_table(source.file, source.format)
    stamps = recorded.time(source.columns.get("time", "time"))
    level_assumed = _upright_point(source) not in {*source.columns, *recorded.columns}
    return stamps, *_read_columns(source, recorded), level_assumed


def _odd_samples(
    path: Path, stamps: Array, force: Array, point: Array | None, loaded: np.ndarray
) -> tuple[OddSample, ...]:
    """Return the odd samples of force and recorded point (n, 3), where the plate stays loaded."""
    if not loaded.any():
        return ()
    peaks = np.abs(force).max(axis=0)
    floors = np.maximum(ODD_FORCE * peaks, LEAST_ODD_FORCE * peaks.max())
    inside = loaded.copy()  # two samples away from where the foot comes down or leaves
    for shift in (1, 2):
        inside[shift:] &= loaded[:-shift]
        inside[:-shift] &= loaded[shift:]
    kept = set(stamps[inside].tolist())
    odd: list[OddSample] = []
    for axis in range(3):
        one = (path, f"{DIRECTIONS[axis]} force", stamps, force[:, axis])
        odd += odd_samples(*one, float(floors[axis]), 1.0, "N")
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
    if farthest > FARTHEST_FROM_ANKLE:
        raise InputError(
            f"the centre of pressure lies up to {farthest:.3g} m from the ankle",
            path,
            "check [ground_reaction] length_unit, columns and laboratory_axes, and [tibia]",
        )


def _upright_point(source: ForceRecording) -> str:
    """Return the role of the centre of pressure's height: a plate need not record its own."""
    return f"point_{'xyz'.index(source.laboratory_axes.split(',')[1][-1]) + 1}"


def _read_columns(source: ForceRecording, recorded: Table) -> tuple[Array, Array, Array]:
    """Return force (N), point (m) and free moment (N·m), each (n, 3), in the laboratory."""
    roles = [f"{kind}_{k}" for kind in ("force", "point", "moment") for k in (1, 2, 3)]
    check_roles(source.columns, ("time", *roles), recorded.path, "ground_reaction")
    rotation = laboratory_rotation(source.laboratory_axes, recorded.path)
    columns = []
    for role in roles:
        column = source.columns.get(role, role)
        given = role in source.columns or column in recorded.columns
        if role.startswith("point") and (given or role != _upright_point(source)):
            columns.append(recorded.column(column))  # undefined while unloaded
        elif role.startswith("force") or given:
            columns.append(recorded.complete_column(column))
            _check_size(recorded.path, role[:-2], column, columns[-1])
        else:
            columns.append(np.zeros_like(columns[0]))
    values = np.stack(columns, axis=1).reshape(-1, 3, 3) @ rotation.T
    scale = recorded.unit_scale(source.length_unit, "length_unit")
    return source.sign * values[:, 0], values[:, 1] * scale, source.sign * values[:, 2]


def _check_size(path: Path, kind: str, column: str, values: Array) -> None:
    """Raise an InputError where a column (n,) of a kind holds more than a foot exerts."""
    largest, unit = LARGEST[kind]
    question = f"is a cell mistyped, or the {kind} not in {unit}?"
    check_range(path, f"foot: column '{column}'", values, (-largest, largest), unit, question)


def _read_plates(source: ForceRecording) -> tuple[Array, Array, Array, Array, bool]:
    """Return times (k,) s, force, point and free moment, each (k, 3), of a recording's plates.

    And False: how high the plates lie is recorded.

    The wrenches are summed about the laboratory's origin and kept: the point lies on the level
    of the plates' surface or that of a step on them, `surface_mm` above it, and is carried over
    in time while the vertical force is below `unloaded_N`.
    """
    recording = read_c3d(source.file)
    check_roles(source.columns, (), source.file, "ground_reaction")
    there = {plate.number: plate for plate in recording.plates}
    missing = [number for number in source.plates if number not in there]
    if missing or not source.plates:
        asked = f"has no force plate {missing[0]}" if missing else "holds several force plates"
        raise InputError(
            asked if there else "holds no force plate",
            source.file,
            f"give [ground_reaction] plates, of {', '.join(map(str, there)) or 'none'}",
        )
    rotation = laboratory_rotation(source.laboratory_axes, source.file)
    plates = [there[number] for number in dict.fromkeys(source.plates)]
    wrench = source.sign * np.sum([plate.wrench for plate in plates], axis=0)
    force, about_origin = wrench[:, :3] @ rotation.T, wrench[:, 3:] @ rotation.T
    levels = [float((rotation @ plate.centre)[1]) for plate in plates]
    if np.ptp(levels) > LEVEL_TOLERANCE:
        raise InputError("the plates lie at different levels", source.file, "give them one by one")
    point = np.full_like(force, np.nan)
    loaded = force[:, 1] >= source.unloaded
    level = levels[0] + source.surface
    point[loaded] = _centre_of_pressure(force[loaded], about_origin[loaded], level)
    point = _hold_point(recording.analog_time, point, loaded, source.file)
    moment = about_origin - np.cross(point, force)
    return recording.analog_time, force, point, moment, False


def _centre_of_pressure(force: Array, about_origin: Array, level: float) -> Array:
    """Return the point (k, 3) m at a level where the moment is vertical; see the module."""
    fx, fy, fz = force.T
    x = (about_origin[:, 2] + level * fx) / fy
    z = (level * fz - about_origin[:, 0]) / fy
    return np.stack([x, np.full_like(x, level), z], axis=1)


def _check_upward(force: Array, source: ForceRecording) -> None:
    """Raise where the largest force on the foot points down or sideways."""
    up, down = float(force[:, 1].max()), float(-force[:, 1].min())
    aside = float(np.hypot(force[:, 0], force[:, 2]).max())
    if max(down, aside) > max(up, source.unloaded):
        word, size = ("down", down) if down > aside else ("sideways", aside)
        raise InputError(
            f"the ground pushes the foot up with {max(up, 0.0):.4g} N at most, but {word} with "
            f"{size:.4g} N",
            source.file,
            "check [ground_reaction] columns and laboratory_axes; is it the force on the "
            f"{'foot' if source.sign < 0 else 'plate'}? Then "
            + ("leave out force" if source.sign < 0 else 'say force = "on the plate"'),
        )


def _hold_point(stamps: Array, point: Array, loaded: np.ndarray, path: Path) -> Array:
    """Return the points with those of the unloaded plate carried over in time."""
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
