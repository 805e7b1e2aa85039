"""The knee's recorded motion: read, converted to knee coordinates, filtered, resampled.

Recorded angles of any sequence are converted to the six coordinates of Grood and Suntay through the
rotation matrix. A left knee is mirrored: the medial-lateral translation changes its sign, clinical
angles and the patella's sagittal coordinates do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    PATELLA_COORDINATES,
    Array,
    inverse,
    knee_coordinates,
    knee_pose,
    mirrored_pose,
)
from tkamb.io.recordings.filtering import (
    OddSample,
    check_range,
    check_spacing,
    check_steps,
    differentiate_coordinates,
    odd_samples,
)
from tkamb.io.recordings.gait_cycle import Cycle
from tkamb.io.recordings.laboratory import angle_scale, check_roles, poses_of_columns
from tkamb.io.recordings.recording_tables import MotionTable, Side
from tkamb.io.recordings.tables import Table, read_table
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.io.recordings.marker_motion import MarkerKinematics


LIMITS_DEG = {"axial_rotation": (-90, 90), "adduction": (-45, 45), "flexion": (-45, 180)}
"""deg: limits of the angles; beyond them, columns, axes or units are wrong. The limits of adduction
also exclude its singularity."""
FARTHEST_MM = (-200, 200)
"""mm: limits of the translations; beyond them, units are wrong. The femoral origin lies within a
hand's breadth of the insert, and the patella within a hand's breadth of the femoral origin."""


# deg: largest rotation of the patella against the femur, in either direction. No
# patella turns by half a turn.
MAX_ROTATION_DEG = 180


FASTEST = {"turn": 100.0, "move": 10.0}
"""rad/s and m/s: largest speeds, five times those of the fastest kick and above the noise of a
recording."""
ODD = {"turn": 0.5 * DEGREE, "move": 0.5 * MILLIMETRE}
"""rad and m: smallest deviation of an odd sample from its neighbours' curve: the error of
fluoroscopy."""


@dataclass(frozen=True, eq=False)
class KneeMotion:
    """The knee's motion, SI. A left knee is mirrored to a right one.

    Args:
        time: (f,) s.
        coordinates: (f, 6) in the order of `KNEE_COORDINATES`, filtered; m and rad.
        velocity: (f, 6) their first derivative.
        acceleration: (f, 6) their second derivative.
        raw_coordinates: (f, 6) as recorded, at the same times, by quintic interpolation.
        deviation_translation: (f,) m, distance between raw and filtered femoral origin.
        deviation_rotation: (f,) rad, angle between raw and filtered orientation.
        patella: (f, 3) patella_ap, patella_si (m), patella_rotation (rad), if recorded.
        patella_velocity: (f, 3) its first derivative.
        patella_acceleration: (f, 3) its second derivative.
        cycle_percent: (f,) per cent of the cycle, if the motion is a cycle.
        closed_cycle: whether the cycle's ends agree, so that the filter is periodic.
        unrecorded: coordinates without a column; they are zero.
        markers: kinematics by skin markers, if the motion comes from markers.
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
    odd: tuple[OddSample, ...] = ()
    markers: "MarkerKinematics | None" = None
    remarks: tuple[str, ...] = ()


def load_motion(
    source: MotionTable,
    side: Side,
    pose_insert_mesh_in_insert: Array,
    pose_femoral_mesh_in_femur: Array,
    released: Sequence[str] = (),
    pose_insert_in_tibia: Array | None = None,
) -> KneeMotion:
    """Read the recorded motion of the scene.

    With `interpretation = "pose"` and P the recorded pose of the femoral mesh in the
    insert mesh, T_femur_in_insert = T_insert_mesh_in_insert P T_femur_in_femoral_mesh.

    Args:
        side: side of the knee; a left knee is mirrored.
        pose_insert_mesh_in_insert: (4, 4) m; z of the insert frame points to the subject's right,
            also for a left knee (not mirrored).
        pose_femoral_mesh_in_femur: (4, 4) m; not mirrored.
        released: names of the released coordinates; they need no column.
        pose_insert_in_tibia: (4, 4) m, needed for markers; mirrored for a left knee.
    """
    if source.markers is not None:
        assert pose_insert_in_tibia is not None
        return _from_markers(source, side, pose_insert_in_tibia, released)
    recorded = read_table(source.file, source.format)
    _check_roles(source, recorded)
    recorded = _turn_signs(recorded, source)
    unrecorded: tuple[str, ...] = ()
    time = recorded.time(source.columns.get("time", "time"))
    if source.interpretation == "pose":
        assert source.sequence is not None
        mesh = poses_of_columns(
            recorded, source.columns, source.sequence, source.angle_unit, source.length_unit
        )
        poses = pose_insert_mesh_in_insert @ mesh @ inverse(pose_femoral_mesh_in_femur)
        knee = knee_coordinates(mirrored_pose(poses) if side == "left" else poses)
    else:
        unrecorded = _find_unrecorded(recorded, source, released)
        knee = _read_coordinates(recorded, source, KNEE_COORDINATES, unrecorded)
        if side == "left":
            knee[:, KNEE_COORDINATES.index("ml")] *= -1.0
    _check_knee(knee, recorded.path, _bending_role(recorded, source))
    patella_columns = [
        c for c in PATELLA_COORDINATES if c in source.columns or c in recorded.columns
    ]
    patella = _read_coordinates(recorded, source, PATELLA_COORDINATES) if patella_columns else None
    if patella is not None:
        _check_patella(patella, recorded.path)
    motion = _differentiate(time, knee, patella, source, recorded.path)
    return replace(motion, unrecorded=unrecorded, remarks=recorded.remarks)


def _from_markers(
    source: MotionTable, side: Side, insert: Array, released: Sequence[str]
) -> KneeMotion:
    from tkamb.io.recordings.marker_motion import load_marker_motion

    assert source.markers is not None
    names = source.markers.coordinates
    unrecorded = tuple(name for name in KNEE_COORDINATES if name not in names)
    if needed := [name for name in unrecorded if name not in released]:
        raise InputError(
            f"coordinates lack {', '.join(needed)}",
            "[motion.markers]",
            "add them to coordinates, or release them: [contact] released",
        )
    result = load_marker_motion(source, side, insert)
    knee = result.coordinates.copy()
    for name in unrecorded:
        knee[:, KNEE_COORDINATES.index(name)] = 0.0
    _check_knee(knee, source.file)
    motion = _differentiate(result.time, knee, None, source, source.file)
    return replace(motion, unrecorded=unrecorded, markers=result, remarks=result.remarks)


def _find_unrecorded(
    recorded: Table, source: MotionTable, released: Sequence[str]
) -> tuple[str, ...]:
    missing = [
        role
        for role in KNEE_COORDINATES
        if role not in source.columns and role not in recorded.columns
    ]
    needed = [role for role in missing if role not in released]
    if needed:
        release_hint = "" if needed == ["flexion"] else ", or release it: [contact] released"
        raise InputError(
            f"has no column for {', '.join(needed)} (it has {', '.join(recorded.columns)})",
            recorded.path,
            f"name it in [motion] columns{release_hint}",
        )
    return tuple(missing)


def _read_coordinates(
    recorded: Table,
    source: MotionTable,
    roles: tuple[str, ...],
    unrecorded: tuple[str, ...] = (),
) -> Array:
    length = recorded.unit_scale(source.length_unit, "length_unit")
    angle = angle_scale(recorded, source.angle_unit)
    units = {
        role: length if role.rsplit("_")[-1] in ("ap", "si", "ml") else angle for role in roles
    }
    values = np.zeros((recorded.rows, len(roles)))
    for i, role in enumerate(roles):
        if role not in unrecorded:
            name = source.columns.get(role, role)
            values[:, i] = recorded.complete_column(name) * units[role]
    return values


def _check_roles(source: MotionTable, recorded: Table) -> None:
    if source.interpretation == "pose":
        kinds = ("rotation", "translation")
        roles = tuple(f"{kind}_{k}" for kind in kinds for k in (1, 2, 3))
    else:
        roles = KNEE_COORDINATES
    check_roles(source.columns, ("time", *roles, *PATELLA_COORDINATES), recorded.path, "motion")
    for role in source.signs_turned:
        if role not in roles:
            raise InputError(
                f"unknown role '{role}' in [motion] signs_turned",
                recorded.path,
                f"one of {', '.join(roles)}",
            )


def _turn_signs(recorded: Table, source: MotionTable) -> Table:
    names = {source.columns.get(role, role) for role in source.signs_turned}
    negated = {name: -recorded.column(name) for name in names}
    return replace(recorded, columns=recorded.columns | negated)


def _bending_role(recorded: Table, source: MotionTable) -> str:
    """Return the role that shows flexion; for a pose, the rotation with the largest range."""
    if source.interpretation != "pose":
        return "flexion"

    def range_of(role: str) -> float:
        return float(np.ptp(recorded.column(source.columns.get(role) or role)))

    return max((f"rotation_{k}" for k in (1, 2, 3)), key=range_of)


def _check_knee(knee: Array, path: Path, bending: str | None = None) -> None:
    for i, name in enumerate(KNEE_COORDINATES):
        if name in LIMITS_DEG:
            hint = "check [motion] columns, sequence, angle_unit and the meshes' axes"
            values, limits, unit = knee[:, i] / DEGREE, LIMITS_DEG[name], "deg"
            low, high = limits
            is_flexion = name == "flexion" and bending is not None
            if is_flexion and values.min() < low <= -values.max() and -values.min() <= high:
                hint = f'if bending is negative in it, set [motion] signs_turned = ["{bending}"]'
        else:
            hint = "check [motion] columns, length_unit and the origins of the meshes"
            values, limits, unit = knee[:, i] / MILLIMETRE, FARTHEST_MM, "mm"
        check_range(path, f"knee: {name}", values, limits, unit, hint)


def _check_patella(patella: Array, path: Path) -> None:
    turn = (-MAX_ROTATION_DEG, MAX_ROTATION_DEG)
    for name, values, limits, unit, key in (
        ("patella_ap", patella[:, 0] / MILLIMETRE, FARTHEST_MM, "mm", "length_unit"),
        ("patella_si", patella[:, 1] / MILLIMETRE, FARTHEST_MM, "mm", "length_unit"),
        ("patella_rotation", patella[:, 2] / DEGREE, turn, "deg", "angle_unit"),
    ):
        hint = f"check [motion] columns, {key}, and whether a cell is mistyped"
        check_range(path, f"knee: {name}", values, limits, unit, hint)


def _find_odd_steps(time: Array, values: Array, path: Path) -> tuple[OddSample, ...]:
    """Return the odd samples of coordinates (n, 6 or 9). Raise if a coordinate changes too fast."""
    odd: list[OddSample] = []
    for i, name in enumerate((*KNEE_COORDINATES, *PATELLA_COORDINATES)[: values.shape[1]]):
        moves = name.rsplit("_")[-1] in ("ap", "si", "ml")
        kind, scale, unit = ("move", MILLIMETRE, "mm") if moves else ("turn", DEGREE, "deg")
        series = (path, name, time, values[:, i])
        check_steps(*series, FASTEST[kind], scale, unit)
        odd += odd_samples(*series, ODD[kind], scale, unit)
    return tuple(odd)


def _differentiate(
    time: Array, knee: Array, patella: Array | None, source: MotionTable, path: Path
) -> KneeMotion:
    values = knee if patella is None else np.concatenate([knee, patella], axis=1)
    cycle = None
    if source.cycle_s:
        cycle = Cycle.of(time, knee, source.cycle_s, source.cycle_offset_percent, path)
    sampled = cycle.seconds(time) if cycle else time
    check_spacing(path, sampled)
    odd = _find_odd_steps(sampled, values, path)
    at = _frames(sampled, source, cycle)
    inside = cycle.wrapped(at, sampled) if cycle else at
    closed = cycle is not None and cycle.closed
    name = str(path)
    x, v, a = differentiate_coordinates(sampled, values, source.cutoff_Hz, inside, closed, name)
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
        odd=odd,
    )


def _frames(sampled: Array, source: MotionTable, cycle: Cycle | None) -> Array:
    if cycle:
        return cycle.frames(sampled, source.frames)
    if len(sampled) < 2:
        hint = "give two rows or more: rates need them"
        raise InputError(f"holds {len(sampled)} row of motion", source.file, hint)
    start, end = source.interval_s or (sampled[0], sampled[-1])
    inside = sampled[(sampled >= start - 1e-9) & (sampled <= end + 1e-9)]
    if len(inside) < 2 or start < sampled[0] - 1e-9 or end > sampled[-1] + 1e-9:
        raise InputError(
            f"covers {sampled[0]:g} to {sampled[-1]:g} s, but interval_s is {start:g} to {end:g}",
            source.file,
            "choose [motion] interval_s inside the recording",
        )
    return np.linspace(start, end, source.frames) if source.frames else inside
