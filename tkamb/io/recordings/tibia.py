"""The pose of the shank in the laboratory: from a sagittal lean, poses, or shank markers.

The laboratory is x forward, y up, z to the subject's right, the tibia link's origin the ankle
centre; a left shank is mirrored.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import MIRROR, Array, mirrored_pose, pose, transform
from tkamb.io.recordings.filtering import (
    Cutoff,
    OddSample,
    check_range,
    check_spacing,
    check_steps,
    differentiate_coordinates,
    differentiate_poses,
    odd_samples,
)
from tkamb.io.recordings.laboratory import (
    angle_scale,
    check_roles,
    laboratory_rotation,
    poses_of_columns,
)
from tkamb.io.recordings.markers import check_fit, complete_run, fit_rigid, shank_points
from tkamb.io.recordings.recording_tables import Side, TibiaTable
from tkamb.io.recordings.tables import Table, read_table
from tkamb.units import DEGREE, MILLIMETRE

# deg: largest lean of a shank from the vertical, in either direction. A sprinter's
# shank swings back by 110 deg.
MAX_LEAN_DEG = 150.0
# m: largest distance from the laboratory's origin. It is beyond the view of any
# camera.
MAX_DISTANCE = 100.0
# m: distance from the ankle to the proximal point that is checked. It is about the
# length of an adult's shank.
SHANK_LENGTH = 0.4
# s: time before and after the frames in which samples are checked. The filter's
# response is several times shorter.
WINDOW = 0.5


FASTEST_TURN, FASTEST_MOVE = 100.0, 30.0
"""rad/s and m/s: largest speeds, twice those of the shank of the fastest sprinters and kickers."""
ODD_TURN, ODD_MOVE = 0.5 * DEGREE, 3.0 * MILLIMETRE
"""rad and m: smallest deviation of an odd sample from its neighbours' curve, the noise of skin
markers."""


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """The motion of a body in the laboratory, SI.

    Args:
        time: (f,) s.
        pose: (f, 4, 4) pose_tibia_in_laboratory, m.
        velocity: (f, 6) spatial velocity in the body's axes at its origin, linear (m/s)
            then angular (rad/s): Pinocchio's free flyer.
        acceleration: (f, 6) time derivative of each component of `velocity`.
        residual: (f,) m, root mean square distance of the marker fit before filtering; None
            without a marker fit.
        odd: samples around the frames that lie off their neighbours' curve.
    """

    time: Array
    pose: Array
    velocity: Array
    acceleration: Array
    residual: Array | None = None
    odd: tuple[OddSample, ...] = ()
    remarks: tuple[str, ...] = ()


def load_tibia(source: TibiaTable, time: Array, side: Side, cutoff_Hz: Cutoff) -> BodyMotion:
    """Return the tibia's motion at the frames of the knee's motion.

    The recording is filtered first, so that the filter's errors at the ends of a longer one are
    outside `time`.

    Args:
        time: (f,) s of the frames, on the file's clock.
        cutoff_Hz: cut-off of the motion, used if `source` states none.
    """
    cutoff: Cutoff = cutoff_Hz if source.cutoff_Hz is None else source.cutoff_Hz
    recorded = read_table(source.file)
    if source.kind == "sagittal":
        return _sagittal(source, recorded, time, side, cutoff)
    stamps = recorded.time(source.columns.get("time", "time"))
    rotation = pose(laboratory_rotation(source.laboratory_axes, recorded.path), np.zeros(3))
    residual = None
    if source.kind == "markers":
        stamps, poses, residual = _fit_markers(source, recorded, stamps, time)
    else:
        poses = _read_poses(source, recorded)
    poses = rotation @ poses
    if side == "left":
        poses = mirrored_pose(poses)
    name = str(recorded.path)
    check_spacing(recorded.path, stamps)
    odd = _odd_poses(recorded, stamps, poses, time)
    filtered, velocity, acceleration = differentiate_poses(stamps, poses, cutoff, time, name)
    at_frames = None if residual is None else np.interp(time, stamps, residual)
    return BodyMotion(time, filtered, velocity, acceleration, at_frames, odd, recorded.remarks)


def _odd_poses(recorded: Table, stamps: Array, poses: Array, time: Array) -> tuple[OddSample, ...]:
    """Return the odd samples of the shank's two ends."""
    near = (stamps >= time[0] - WINDOW) & (stamps <= time[-1] + WINDOW)
    ends = {
        "ankle": np.zeros(3),
        "proximal end of the shank": np.array([0.0, SHANK_LENGTH, 0.0]),
    }
    odd: list[OddSample] = []
    for end, point in ends.items():
        places = transform(poses[near], point)
        for axis, values in zip("xyz", places.T, strict=True):
            what = f"{axis} of the {end}"
            limits, hint = (
                (-MAX_DISTANCE, MAX_DISTANCE),
                "check [tibia] columns and length_unit",
            )
            check_range(recorded.path, f"shank: {what}", values, limits, "m", hint)
            series = (recorded.path, what, stamps[near], values)
            check_steps(*series, FASTEST_MOVE, MILLIMETRE, "mm")
            odd += odd_samples(*series, ODD_MOVE, MILLIMETRE, "mm")
    return tuple(odd)


def _sagittal(
    source: TibiaTable, recorded: Table, time: Array, side: str, cutoff: Cutoff
) -> BodyMotion:
    """The shank leans about the laboratory's z over a fixed ankle."""
    check_roles(source.columns, ("time", "angle"), recorded.path, "tibia")
    stamps = recorded.time(source.columns.get("time", "time"))
    lean = recorded.complete_column(source.columns.get("angle", "angle"))
    lean = lean * angle_scale(recorded, source.angle_unit)
    limits = (-MAX_LEAN_DEG, MAX_LEAN_DEG)
    hint = "check [tibia] columns and angle_unit: the angle is the lean from the vertical"
    check_range(recorded.path, "shank: angle", lean / DEGREE, limits, "deg", hint)
    check_spacing(recorded.path, stamps)
    series = (recorded.path, "the shank's lean", stamps, lean)
    check_steps(*series, FASTEST_TURN, DEGREE, "deg")
    odd = odd_samples(*series, ODD_TURN, DEGREE, "deg")
    angle, rate, rate_of_rate = differentiate_coordinates(
        stamps, -lean, cutoff, time, name=str(recorded.path)
    )
    ankle = np.array(source.ankle_mm) * MILLIMETRE
    if side == "left":
        ankle = MIRROR @ ankle
    velocity, acceleration = np.zeros((len(time), 6)), np.zeros((len(time), 6))
    velocity[:, 5], acceleration[:, 5] = rate, rate_of_rate
    rotation = Rotation.from_euler("z", angle[:, None]).as_matrix()
    result = BodyMotion(time, pose(rotation, ankle), velocity, acceleration, odd=odd)
    return replace(result, remarks=recorded.remarks)


def _read_poses(source: TibiaTable, recorded: Table) -> Array:
    assert source.sequence is not None
    kinds = ("rotation", "translation")
    roles = tuple(f"{kind}_{k}" for kind in kinds for k in (1, 2, 3))
    check_roles(source.columns, ("time", *roles), recorded.path, "tibia")
    return poses_of_columns(
        recorded, source.columns, source.sequence, source.angle_unit, source.length_unit
    )


def _fit_markers(
    source: TibiaTable, recorded: Table, stamps: Array, time: Array
) -> tuple[Array, Array, Array]:
    check_roles(source.columns, ("time",), recorded.path, "tibia")
    points, reference = shank_points(source, recorded)
    names = [*source.markers_mm, *(joint.name for joint in source.joint_centre)]
    run = complete_run(points, names, stamps, time[0], time[-1], recorded)
    poses, residual = fit_rigid(points[run], reference)
    check_fit(residual, "shank markers", recorded)
    return stamps[run], poses, residual
