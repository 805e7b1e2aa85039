"""The knee's recorded motion: read, turned into knee coordinates, filtered, resampled.

Recorded angles of any order become the six coordinates of Grood and Suntay through the
rotation matrix. A left knee is mirrored here: medial-lateral translation changes sign,
the clinical angles and the patella's sagittal coordinates keep theirs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    Array,
    inverse,
    knee_coordinates,
    knee_pose,
    mirrored_pose,
)
from tkamb.inputs.filtering import differentiate_coordinates
from tkamb.inputs.laboratory import angle_scale, check_roles, poses_of_columns
from tkamb.inputs.tables import Table, read_table
from tkamb.scene_tables import MotionTable
from tkamb.units import DEGREE, MILLIMETRE

PATELLA_COORDINATES = ("patella_ap", "patella_si", "patella_rotation")
LIMITS_DEG = {"axial_rotation": (-90, 90), "adduction": (-45, 45), "flexion": (-45, 180)}
"""Beyond these, columns, axes or units are mistaken; adduction also stays off its gimbal."""
FARTHEST_M = 0.2
"""The femoral origin lies within a hand's breadth of the insert; beyond, units are mistaken."""
SLOWEST_S = 5.0
"""Samples farther apart than this are no record of a movement: the time is in another unit."""


@dataclass(frozen=True, eq=False)
class KneeMotion:
    """The knee's motion as a right knee's, SI.

    Args:
        time: (f,) s.
        coordinates: (f, 6) in the order of `KNEE_COORDINATES`, filtered; m and rad.
        velocity: (f, 6) their first derivative.
        acceleration: (f, 6) their second derivative.
        raw_coordinates: (f, 6) as recorded, at the same times (between samples: quintic
            interpolation).
        deviation_translation: (f,) m, between the raw and the filtered femoral origin.
        deviation_rotation: (f,) rad, angle between raw and filtered orientation.
        patella: (f, 3) patella_ap, patella_si (m), patella_rotation (rad), if recorded.
        patella_velocity: (f, 3) its first derivative.
        patella_acceleration: (f, 3) its second derivative.
        cycle_percent: (f,) per cent of the cycle, if the motion is one.
        closed_cycle: the cycle's ends agree, so it was filtered as periodic.
        unrecorded: coordinates without a column, held at zero here.
    """

    time: Array
    coordinates: Array
    velocity: Array
    acceleration: Array
    raw_coordinates: Array
    deviation_translation: Array
    deviation_rotation: Array
    patella: Array | None = None
    patella_velocity: Array | None = None
    patella_acceleration: Array | None = None
    cycle_percent: Array | None = None
    closed_cycle: bool = False
    unrecorded: tuple[str, ...] = ()


def load_motion(
    table: MotionTable,
    side: Literal["right", "left"],
    pose_insert_mesh_in_insert: Array,
    pose_femoral_mesh_in_femur: Array,
    released: Sequence[str] = (),
) -> KneeMotion:
    """Read the recorded motion of the scene.

    With `interpretation = "pose"` and P the recorded pose of the femoral mesh in the
    insert mesh, T_femur_in_insert = T_insert_mesh_in_insert P T_femur_in_femoral_mesh.

    Args:
        table: the scene's [motion].
        side: the knee's side; a left one is mirrored.
        pose_insert_mesh_in_insert: (4, 4) m; the file's axes into the insert frame, whose
            z points to the subject's right on both sides (not mirrored).
        pose_femoral_mesh_in_femur: (4, 4) m; likewise for the femur link.
        released: knee coordinates that will be solved for: they need no column.

    Raises:
        InputError: file, columns, times, filter or cycle cannot be used.
    """
    recorded = read_table(table.file, table.format)
    _check_roles(table, recorded)
    recorded = _with_signs_turned(recorded, table)
    unrecorded: tuple[str, ...] = ()
    time = recorded.time(table.columns.get("time", "time"))
    if table.interpretation == "pose":
        assert table.sequence is not None
        mesh = poses_of_columns(
            recorded, table.columns, table.sequence, table.angle_unit, table.length_unit
        )
        poses = pose_insert_mesh_in_insert @ mesh @ inverse(pose_femoral_mesh_in_femur)
        knee = knee_coordinates(mirrored_pose(poses) if side == "left" else poses)
    else:
        unrecorded = _unrecorded(recorded, table, released)
        knee = _recorded_coordinates(recorded, table, KNEE_COORDINATES, unrecorded)
        knee[:, 3:] = np.unwrap(knee[:, 3:], axis=0)
        if side == "left":
            knee[:, KNEE_COORDINATES.index("ml")] *= -1.0
    _check_angles(knee, recorded)
    _check_places(knee, recorded)
    named = [c for c in PATELLA_COORDINATES if c in table.columns or c in recorded.columns]
    patella = _recorded_coordinates(recorded, table, PATELLA_COORDINATES) if named else None
    motion = _differentiated(time, knee, patella, table, recorded)
    return replace(motion, unrecorded=unrecorded)


def _unrecorded(recorded: Table, table: MotionTable, released: Sequence[str]) -> tuple[str, ...]:
    """Return the coordinates without a column, all of which must be released."""
    missing = [
        role
        for role in KNEE_COORDINATES
        if role not in table.columns and role not in recorded.columns
    ]
    needed = [role for role in missing if role not in released]
    if needed:
        more = "" if needed == ["flexion"] else ", or let the knee find it: [contact] released"
        raise InputError(
            f"has no column for {', '.join(needed)} (it has {', '.join(recorded.columns)})",
            recorded.path,
            f"name it in [motion] columns{more}",
        )
    return tuple(missing)


def _recorded_coordinates(
    recorded: Table, table: MotionTable, roles: tuple[str, ...], unrecorded: tuple[str, ...] = ()
) -> Array:
    length = recorded.unit_scale(table.length_unit, "length_unit")
    angle = angle_scale(recorded, table.angle_unit)
    units = {
        role: length if role.rsplit("_")[-1] in ("ap", "si", "ml") else angle for role in roles
    }
    values = np.zeros((recorded.rows, len(roles)))
    for i, role in enumerate(roles):
        if role not in unrecorded:
            name = table.columns.get(role, role)
            values[:, i] = recorded.complete_column(name) * units[role]
    return values


def _check_roles(table: MotionTable, recorded: Table) -> None:
    if table.interpretation == "pose":
        kinds = ("rotation", "translation")
        own = tuple(f"{kind}_{k}" for kind in kinds for k in (1, 2, 3))
    else:
        own = KNEE_COORDINATES
    check_roles(table.columns, ("time", *own, *PATELLA_COORDINATES), recorded.path, "motion")
    for role in table.signs_turned:
        if role not in own:
            raise InputError(
                f"unknown role '{role}' in [motion] signs_turned",
                recorded.path,
                f"one of {', '.join(own)}",
            )


def _with_signs_turned(recorded: Table, table: MotionTable) -> Table:
    """Return the recording with the columns of the roles in `signs_turned` negated."""
    names = {table.columns.get(role, role) for role in table.signs_turned}
    turned = {name: -recorded.column(name) for name in names}
    return replace(recorded, columns=recorded.columns | turned)


def _check_angles(knee: Array, recorded: Table) -> None:
    for name, (low, high) in LIMITS_DEG.items():
        angle = knee[:, KNEE_COORDINATES.index(name)] / DEGREE
        if angle.min() < low or angle.max() > high:
            raise InputError(
                f"{name} runs from {angle.min():.1f} to {angle.max():.1f} deg, which no knee "
                f"does ({low} to {high})",
                recorded.path,
                "check [motion] columns, sequence, angle_unit and the meshes' axes",
            )


def _check_places(knee: Array, recorded: Table) -> None:
    for name in ("ap", "si", "ml"):
        place = knee[:, KNEE_COORDINATES.index(name)]
        if np.abs(place).max() > FARTHEST_M:
            raise InputError(
                f"{name} runs from {place.min() / MILLIMETRE:.4g} to "
                f"{place.max() / MILLIMETRE:.4g} mm off the insert, which no knee does",
                recorded.path,
                "check [motion] columns, length_unit and where the meshes have their origin",
            )


def _check_rate(time: Array, recorded: Table) -> None:
    spacing = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if spacing > SLOWEST_S:
        raise InputError(
            f"samples are {spacing:g} s apart, too far to be a movement",
            recorded.path,
            "is the time in seconds?",
        )


def _differentiated(
    time: Array, knee: Array, patella: Array | None, table: MotionTable, recorded: Table
) -> KneeMotion:
    """Return the filtered motion at the scene's frames."""
    values = knee if patella is None else np.concatenate([knee, patella], axis=1)
    cycle = Cycle.of(time, knee, table, recorded) if table.cycle_s else None
    sampled = cycle.seconds(time) if cycle else time
    _check_rate(sampled, recorded)
    at = _frames(sampled, table.frames, cycle)
    inside = cycle.wrapped(at, sampled) if cycle else at
    closed = cycle is not None and cycle.closed
    name = str(recorded.path)
    x, v, a = differentiate_coordinates(sampled, values, table.cutoff_Hz, inside, closed, name)
    raw, _, _ = differentiate_coordinates(sampled, knee, "none", inside, name=name)
    filtered_pose, raw_pose = knee_pose(x[:, :6]), knee_pose(raw)
    turn = inverse(raw_pose)[:, :3, :3] @ filtered_pose[:, :3, :3]
    has_patella = patella is not None
    return KneeMotion(
        time=at,
        coordinates=x[:, :6],
        velocity=v[:, :6],
        acceleration=a[:, :6],
        raw_coordinates=raw,
        deviation_translation=np.linalg.norm(x[:, :3] - raw[:, :3], axis=1),
        deviation_rotation=Rotation.from_matrix(turn).magnitude(),
        patella=x[:, 6:] if has_patella else None,
        patella_velocity=v[:, 6:] if has_patella else None,
        patella_acceleration=a[:, 6:] if has_patella else None,
        cycle_percent=cycle.percent(at) if cycle else None,
        closed_cycle=closed,
    )


def _frames(sampled: Array, frames: int | None, cycle: "Cycle | None") -> Array:
    if cycle:
        return cycle.frames(sampled, frames)
    return np.linspace(sampled[0], sampled[-1], frames) if frames else sampled


@dataclass(frozen=True)
class Cycle:
    """A cycle recorded over its per cent, laid on an interval of time.

    Args:
        start: s.
        period: s.
        offset_percent: per cent of the cycle at `start`.
        closed: 0 and 100 % were recorded and agree.
    """

    start: float
    period: float
    offset_percent: float
    closed: bool

    @staticmethod
    def of(percent: Array, knee: Array, table: MotionTable, recorded: Table) -> "Cycle":
        """Return the scene's cycle.

        It is closed if 100 % was recorded too and no coordinate differs there from 0 % by
        more than its largest step between neighbouring samples.

        Raises:
            InputError: not per cent, not an interval, or an offset into an open cycle.
        """
        assert table.cycle_s is not None
        start, end = table.cycle_s
        if not start < end:
            raise InputError("[motion] cycle_s does not rise", recorded.path)
        if percent[0] < -1e-9 or percent[-1] > 100 + 1e-9 or percent[-1] - percent[0] < 2:
            raise InputError(
                f"time runs from {percent[0]:g} to {percent[-1]:g}, which is not per cent",
                recorded.path,
                "drop cycle_s, or give per cent of the cycle",
            )
        whole = percent[-1] - percent[0] > 100 - 1e-9
        steps = np.abs(np.diff(knee, axis=0)).max(axis=0)
        closed = bool(whole and np.all(np.abs(knee[-1] - knee[0]) <= steps))
        if table.cycle_offset_percent and not closed:
            raise InputError(
                "is not a closed cycle, so it has no frame before or after its ends",
                recorded.path,
                "set cycle_offset_percent to 0",
            )
        return Cycle(start, end - start, table.cycle_offset_percent, closed)

    def seconds(self, percent: Array) -> Array:
        """Return the times of per cents, not wrapped into the interval."""
        return self.start + (percent - self.offset_percent) / 100.0 * self.period

    def percent(self, time: Array) -> Array:
        """Return per cent of the cycle, rising from the offset."""
        return self.offset_percent + (time - self.start) / self.period * 100.0

    def frames(self, sampled: Array, count: int | None) -> Array:
        """Return the times of the frames: evenly `count`, or those recorded."""
        if not self.closed:
            return np.linspace(sampled[0], sampled[-1], count) if count else sampled
        if count:
            return np.linspace(self.start, self.start + self.period, count)
        if not self.offset_percent:
            return sampled
        turn = np.mod(sampled[:-1] - self.start, self.period)
        return self.start + np.append(np.unique(np.round(turn, 12)), self.period)

    def wrapped(self, at: Array, sampled: Array) -> Array:
        """Return times inside the recorded cycle, whole periods away from `at`."""
        if not self.closed or not self.offset_percent:
            return np.clip(at, sampled[0], sampled[-1])
        return np.clip(sampled[0] + np.mod(at - sampled[0], self.period), sampled[0], sampled[-1])
