"""Knee and shank poses: recorded poses of the components, or coordinates of an OpenSim model.

Fluoroscopy or biplane X-ray gives no pose of the leg in the laboratory. The shank's pose comes from
its markers, and from joint centres fixed to the neighbouring segments' markers.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import (
    Array,
    inverse,
    knee_coordinates,
    knee_pose,
    mirrored_pose,
    pose,
    transform,
)
from tkamb.geometry.surface import Surface
from tkamb.io.importing.anatomy import OTHER, find_leg
from tkamb.io.importing.links import Links
from tkamb.io.importing.markers import ModelSegment
from tkamb.io.importing.plates import Feet
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.motion import angle_lines, read_coordinates
from tkamb.io.recordings.filtering import check_spacing
from tkamb.io.recordings.meshes import axes_rotation
from tkamb.io.recordings.motion import KneeMotion, load_motion
from tkamb.io.recordings.recording_tables import MotionTable
from tkamb.io.recordings.tables import Table
from tkamb.units import DEGREE, MILLIMETRE

MOTION_FILE = "motion.csv"
COLUMNS = (
    *("ap_mm", "si_mm", "ml_mm", "axial_rotation_deg", "adduction_deg", "flexion_deg"),
    *(f"tibia_rotation_{k}_deg" for k in (1, 2, 3)),
    *(f"tibia_translation_{k}_mm" for k in (1, 2, 3)),
)
"""Columns of `motion.csv` after time_s: the knee coordinates, and the pose of the tibia link in the
model's ground with intrinsic rotations about x, y, z."""


@dataclass(frozen=True, eq=False)
class ModelMotion:
    """Motion of knee and shank.

    Args:
        time: times, s, (n,).
        values: values of `COLUMNS`, mm and deg, (n, 12).
        missing: coordinates of the model that the file lacks. They have their default values.
    """

    time: Array
    values: Array
    missing: tuple[str, ...]
    remarks: tuple[str, ...] = ()

    def part(self, start: float, end: float) -> "ModelMotion":
        """Return the rows between two times (s).

        Raises:
            InputError: there are fewer than two rows.
        """
        inside = (self.time >= start - 1e-9) & (self.time <= end + 1e-9)
        if inside.sum() < 2:
            raise InputError(
                f"has no two frames between {start:g} and {end:g} s, the motion lasts from "
                f"{self.time[0]:g} to {self.time[-1]:g} s",
                "--interval",
                "choose another interval",
            )
        return replace(self, time=self.time[inside], values=self.values[inside])

    def text(self) -> str:
        """Return the table as CSV."""
        rows = np.column_stack([self.time, self.values])
        lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
        return "\n".join([",".join(("time_s", *COLUMNS)), *lines, ""])


def model_motion(links: Links, recorded: Table) -> ModelMotion:
    """Return the motion of knee and shank from coordinates of the model.

    Args:
        recorded: table whose columns have a coordinate's name or path in the model.
    """
    leg = links.leg
    kinematics = Kinematics(leg.model)
    time = recorded.time()
    check_spacing(recorded.path, time)
    q, missing = read_coordinates(kinematics, recorded)
    if leg.flexion is None or leg.flexion in missing:
        raise InputError(f"has no column '{leg.flexion}' for the knee's flexion", recorded.path)
    poses = kinematics.poses(kinematics.coupled(q))
    tibia = poses[:, kinematics.bodies[leg.tibia[0]]] @ links.tibia
    femur = poses[:, kinematics.bodies[leg.femur[0]]] @ links.femur
    knee_pose = inverse(tibia @ links.insert_in_tibia) @ femur
    is_left = leg.side == "left"
    knee = knee_coordinates(mirrored_pose(knee_pose) if is_left else knee_pose)
    knee[:, 2] *= -1.0 if is_left else 1.0  # the file's ML points to the right on both sides
    turns = np.unwrap(Rotation.from_matrix(tibia[:, :3, :3]).as_euler("XYZ"), axis=0)
    values = np.concatenate(
        [
            knee[:, :3] / MILLIMETRE,
            knee[:, 3:] / DEGREE,
            turns / DEGREE,
            tibia[:, :3, 3] / MILLIMETRE,
        ],
        axis=1,
    )
    return ModelMotion(time, values, missing, angle_lines(kinematics, recorded, q))


def model_feet(links: Links, recorded: Table) -> Feet:
    """Return the feet's positions, the mean origin of each foot's bodies."""
    leg = links.leg
    kinematics = Kinematics(leg.model)
    q, _ = read_coordinates(kinematics, recorded)
    poses = kinematics.poses(kinematics.coupled(q))
    bodies = {leg.side: leg.foot}
    try:
        bodies[OTHER[leg.side]] = find_leg(leg.model, OTHER[leg.side]).foot
    except InputError:
        bodies[OTHER[leg.side]] = ()  # a model of one leg
    middles = {
        side: np.mean([poses[:, kinematics.bodies[body], :3, 3] for body in names], axis=0)
        if names
        else np.full((recorded.rows, 3), np.nan)
        for side, names in bodies.items()
    }
    return Feet(recorded.path, recorded.time(), middles)


@dataclass(frozen=True, eq=False)
class JointCentre:
    """A joint centre that stands for a marker of the shank.

    Args:
        markers: label of a marker of the neighbouring segment -> its place there, m, (3,).
        place: the centre in the same frame, m, (3,).
        in_tibia: the centre in the tibia link, m, (3,).
    """

    markers: Mapping[str, Array]
    place: Array
    in_tibia: Array


@dataclass(frozen=True, eq=False)
class ShankMarkers:
    """Markers that give the pose of the tibia link in the laboratory.

    Args:
        axes: axes of the file that point forward, up and right.
        points: label of a marker -> its position in the tibia link, m, (3,).
    """

    path: Path
    axes: str
    points: dict[str, Array]
    centres: dict[str, JointCentre]
    remarks: tuple[str, ...]


def shank_markers(
    links: Links,
    segments: Mapping[str, ModelSegment],
    femur: Array,
    recording: Path,
    axes: str,
) -> ShankMarkers:
    """Return the points that give the shank's pose.

    They are the shank's markers if there are three. Otherwise joint centres are added: the ankle's
    from three markers of the foot, the knee's from three of the thigh. The knee centre's place in
    the shank is its mean over the recorded poses.

    Args:
        segments: segment -> its visible markers.
        femur: poses of the femur's body in the tibia link, m, (n, 4, 4).
    """
    points = segments["shank"].points
    centres: dict[str, JointCentre] = {}
    text: list[str] = []
    if len(points) < 3:
        centres, text = _joint_centres(links, segments, femur)
    if len(points) + len(centres) < 3:
        raise InputError(
            f"shows {len(points)} markers of the shank and joint centres for {len(centres)} more; "
            "three are needed",
            recording,
            "three markers of the foot give the ankle's centre, three of the thigh the knee's",
        )
    return ShankMarkers(recording, axes, points, centres, tuple(text))


def _joint_centres(
    links: Links, segments: Mapping[str, ModelSegment], femur: Array
) -> tuple[dict[str, JointCentre], list[str]]:
    """Return joint centres by markers of foot and thigh, and remarks."""
    foot, thigh, leg = segments["foot"], segments["thigh"], links.leg
    centres: dict[str, JointCentre] = {}
    text = []
    if len(foot.points) >= 3 and foot.centre is not None:
        centres["ankle_centre"] = JointCentre(foot.points, foot.centre, np.zeros(3))
        text.append(f"shank: the foot's {len(foot.points)} markers give its ankle centre")
    if len(thigh.points) >= 3:
        markers = {name: transform(links.femur, point) for name, point in thigh.points.items()}
        centre = transform(inverse(leg.neutral[leg.femur[0]]), leg.knee_centre)
        places = transform(femur, centre)
        mean = places.mean(axis=0)
        spread = np.sqrt(((places - mean) ** 2).sum(axis=1).mean()) / MILLIMETRE
        centres["knee_centre"] = JointCentre(markers, centre, mean)
        text.append(
            f"shank: the thigh's {len(markers)} markers give its knee centre, at the mean of "
            f"{len(places)} recorded poses ({spread:.1f} mm rms about it)"
        )
    return centres, text


ROLES = tuple(f"{kind}_{k}" for kind in ("rotation", "translation") for k in (1, 2, 3))
"""Roles of the columns of a table of poses, in the order of `PoseRecording.columns`."""


@dataclass(frozen=True)
class PoseRecording:
    """A table of poses of the femoral mesh in the insert mesh's axes, and its reading options.

    Args:
        columns: names of the columns with the `ROLES`: three angles in the order of `sequence`,
            then x, y, z.
        sequence: axes of the rotations, as in scipy: "XYZ" is Rx Ry Rz.
        angle_unit: "deg" or "rad".
        length_unit: "m", "cm" or "mm".
        turned: roles of the columns that are read with the opposite sign.
        stride: times of the marker recording at 0 and 100 % of the file's time column, s; None:
            the file's times are those of the marker recording.
        stance: start and end of the loaded part, in the unit of the file's time column; None: the
            foot is loaded in all poses.
    """

    file: Path
    columns: tuple[str, ...]
    sequence: str
    angle_unit: str
    length_unit: str
    turned: tuple[str, ...] = ()
    stride: tuple[float, float] | None = None
    stance: tuple[float, float] | None = None

    @property
    def roles(self) -> dict[str, str]:
        """Role of a column -> its name."""
        return dict(zip(ROLES, self.columns, strict=True))

    def keys(self) -> dict[str, Any]:
        """Return [motion] without file, cut-off frequency, interval, columns."""
        result: dict[str, Any] = {
            "interpretation": "pose",
            "sequence": self.sequence,
            "angle_unit": self.angle_unit,
            "length_unit": self.length_unit,
        }
        if self.turned:
            result["signs_turned"] = list(self.turned)
        if self.stride:
            result["cycle_s"] = list(self.stride)
        return result


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """Recorded poses after reading.

    Args:
        interval: start and end of the part to compute, s; None: the whole recording.
        time: times in the recording of markers, s, (n,).
        femur: poses of the femur's body in the tibia link, m, (n, 4, 4).
        in_stance: mask of the poses with a loaded foot, (n,).
    """

    given: PoseRecording
    interval: tuple[float, float] | None
    time: Array
    femur: Array
    in_stance: Array
    remarks: tuple[str, ...]


def read_poses(
    recording: PoseRecording,
    links: Links,
    insert: Surface,
    axes: str,
    cutoff_Hz: float,
    interval: tuple[float, float] | None,
) -> RecordedPoses:
    """Return recorded poses, converted to poses of the femur's body in the tibia link.

    With the recorded pose P of the femoral mesh in the insert mesh, T_femur_in_tibia =
    T_insert_in_tibia T_insert_mesh_in_insert P T_femur_in_femoral_mesh.

    Args:
        insert: mesh of the insert about its own origin, in anatomical axes.
        axes: axes of the meshes that point anterior, superior and right.
        cutoff_Hz: cut-off frequency of the scene's low-pass filter, Hz.
        interval: start and end of the part to compute, s; None: the whole recording.
    """
    turn = pose(axes_rotation(axes), np.zeros(3))
    placement = insert_placement(insert, axes_rotation(axes)) @ turn
    side: Literal["right", "left"] = "left" if links.leg.side == "left" else "right"
    motion = load_motion(_motion_table(recording, cutoff_Hz, interval), side, placement, turn)
    knee = knee_pose(motion.raw_coordinates)
    # The coordinates are of a right knee.
    femur_in_insert = mirrored_pose(knee) if side == "left" else knee
    femur = links.insert_in_tibia @ femur_in_insert @ inverse(links.femur)
    stance = _in_stance(recording, motion)
    return RecordedPoses(
        recording, interval, motion.time, femur, stance, _remarks(recording, motion)
    )


def _motion_table(
    recording: PoseRecording, cutoff_Hz: float, interval: tuple[float, float] | None
) -> MotionTable:
    keys = recording.keys() | {
        "file": recording.file,
        "cutoff_Hz": cutoff_Hz,
        "interval_s": interval,
    }
    keys["columns"] = recording.roles
    return MotionTable.model_validate(keys)


def _in_stance(recording: PoseRecording, motion: KneeMotion) -> Array:
    clock = motion.time if motion.cycle_percent is None else motion.cycle_percent
    if recording.stance is None:
        return np.ones(len(clock), bool)
    start, end = recording.stance
    inside = (clock >= start - 1e-9) & (clock <= end + 1e-9)
    if not inside.any():
        raise InputError(
            f"holds no pose: the file's time runs from {clock[0]:g} to {clock[-1]:g}",
            "--stance",
            "give the part in which the foot is loaded, in the unit of the file's time",
        )
    return np.asarray(inside)


def _remarks(recording: PoseRecording, motion: KneeMotion) -> tuple[str, ...]:
    flexion = motion.raw_coordinates[:, 5] / DEGREE
    angles, places = ", ".join(recording.columns[:3]), ", ".join(recording.columns[3:])
    text = [
        f"knee: {len(flexion)} poses of the femoral mesh in the insert mesh from "
        f"{recording.file.name}, rotations {recording.sequence} = {angles} in "
        f"{recording.angle_unit}, x, y, z = {places} in {recording.length_unit}: flexion "
        f"{flexion.min():.1f} to {flexion.max():.1f} deg; all six coordinates as recorded"
    ]
    if recording.turned:
        text.append(f"read with the other sign, as given: {', '.join(recording.turned)}")
    if recording.stride:
        closed = "a closed cycle" if motion.closed_cycle else "not closed"
        text.append(
            f"phase: 0 and 100 % of the poses are assumed at {recording.stride[0]:g} and "
            f"{recording.stride[1]:g} s of the recording, as given ({closed})"
        )
    return tuple(text)
