"""Recorded poses of the femoral component in the insert, and the markers that place the shank.

Fluoroscopy or biplane X-ray gives the poses. It does not show where the leg is in the laboratory:
markers of the shank do, together with joint centres that the neighbouring segments' markers carry.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import Array, inverse, knee_pose, mirrored_pose, pose, transform
from tkamb.geometry.surface import Surface
from tkamb.io.importing.links import Links
from tkamb.io.importing.markers import ModelSegment
from tkamb.io.recordings.meshes import axes_rotation
from tkamb.io.recordings.motion import KneeMotion, load_motion
from tkamb.io.recordings.recording_tables import MotionTable
from tkamb.io.toml_text import toml_markers, toml_mm, toml_text
from tkamb.units import DEGREE, MILLIMETRE


@dataclass(frozen=True, eq=False)
class ShankMarkers:
    """Markers that give the pose of the tibia link in the laboratory.

    Args:
        path: the recording.
        axes: axes of the file that point forward, up and right.
        points: label of a marker -> its place (3,) m in the tibia link.
        centres: name of a joint centre that is used as a further marker -> the lines of its table
            [[tibia.joint_centre]].
        remarks: lines on the joint centres, for the report.
    """

    path: Path
    axes: str
    points: dict[str, Array]
    centres: dict[str, list[str]]
    remarks: tuple[str, ...]

    def lines(self, path: str) -> list[str]:
        """Return the scene's table [tibia]; `path` is the recording's path as TOML."""
        lines = ["[tibia]", 'kind = "markers"', f"file = {path}"]
        lines += [f'laboratory_axes = "{self.axes}"', f"markers_mm = {toml_markers(self.points)}"]
        for centre in self.centres.values():
            lines += ["", *centre]
        return lines


def shank_markers(
    links: Links,
    segments: Mapping[str, ModelSegment],
    femur: Array,
    recording: Path,
    axes: str,
) -> ShankMarkers:
    """Return the points that give the shank's pose.

    They are the shank's markers. If these are fewer than three, joint centres are added: the
    ankle's centre moves with three or more markers of the foot, the knee's centre with those of the
    thigh. The knee's centre in the shank is the mean over the recorded poses.

    Args:
        links: the links of the leg.
        segments: name of a segment -> its visible markers.
        femur: (n, 4, 4) poses, m, of the femur's body in the tibia link.
        recording: the file of the markers.
        axes: axes of the file that point forward, up and right.

    Raises:
        InputError: there are fewer than three points.
    """
    points = segments["shank"].points
    centres: dict[str, list[str]] = {}
    text: list[str] = []
    if len(points) < 3:
        centres, text = _carried(links, segments, femur)
    if len(points) + len(centres) < 3:
        raise InputError(
            f"shows {len(points)} markers of the shank and joint centres for {len(centres)} more; "
            "three are needed",
            recording,
            "three markers of the foot give the ankle's centre, three of the thigh the knee's",
        )
    return ShankMarkers(recording, axes, points, centres, tuple(text))


def _carried(
    links: Links, segments: Mapping[str, ModelSegment], femur: Array
) -> tuple[dict[str, list[str]], list[str]]:
    """Return the joint centres that move with markers of foot and thigh, and remarks on them."""
    foot, thigh, leg = segments["foot"], segments["thigh"], links.leg
    centres: dict[str, list[str]] = {}
    text = []
    if len(foot.points) >= 3 and foot.centre is not None:
        centres["ankle_centre"] = _centre_lines(
            "ankle_centre", foot.points, foot.centre, np.zeros(3)
        )
        text.append(f"shank: the foot's {len(foot.points)} markers give its ankle centre")
    if len(thigh.points) >= 3:
        own = {name: transform(links.femur, point) for name, point in thigh.points.items()}
        centre = transform(inverse(leg.neutral[leg.femur[0]]), leg.knee_centre)
        places = transform(femur, centre)
        mean = places.mean(axis=0)
        apart = np.sqrt(((places - mean) ** 2).sum(axis=1).mean()) / MILLIMETRE
        centres["knee_centre"] = _centre_lines("knee_centre", own, centre, mean)
        text.append(
            f"shank: the thigh's {len(own)} markers give its knee centre, at the mean of "
            f"{len(places)} recorded poses ({apart:.1f} mm rms about it)"
        )
    return centres, text


def _centre_lines(
    name: str, markers: Mapping[str, Array], centre: Array, tibia: Array
) -> list[str]:
    """Return the lines of a table [[tibia.joint_centre]].

    Args:
        name: name of the joint centre.
        markers: label of a marker of the neighbouring segment -> its place (3,) m in that frame.
        centre: (3,) m, the joint centre in the same frame.
        tibia: (3,) m, the joint centre in the tibia link.
    """
    return [
        "[[tibia.joint_centre]]",
        f"name = {toml_text(name)}",
        f"markers_mm = {toml_markers(markers)}",
        f"centre_mm = {toml_mm(centre)}",
        f"tibia_mm = {toml_mm(tibia)}",
    ]


ROLES = tuple(f"{kind}_{k}" for kind in ("rotation", "translation") for k in (1, 2, 3))
"""Roles of the columns of a table of poses, in their order."""


@dataclass(frozen=True)
class PoseRecording:
    """A table of poses of the femoral mesh in the insert mesh's own axes, and how to read it.

    Args:
        file: the table.
        columns: names of the columns of `ROLES`: three angles in the order of the sequence, then
            x, y, z.
        sequence: axes of the rotations, as in scipy: "XYZ" is Rx Ry Rz.
        angle_unit: "deg" or "rad".
        length_unit: "m", "cm" or "mm".
        turned: roles whose columns are read with the other sign.
        stride: times (s) of the recording at 0 and 100 % of the file's time column; None: the
            file's times are those of the recording.
        stance: start and end, in the file's time column, of the part in which the foot is loaded;
            None: all of it.
    """

    file: Path
    columns: tuple[str, ...]
    sequence: str
    angle_unit: str
    length_unit: str
    turned: tuple[str, ...] = ()
    stride: tuple[float, float] | None = None
    stance: tuple[float, float] | None = None

    def keys(self) -> dict[str, Any]:
        """Return the keys of the scene's [motion], without file, cut-off frequency and columns."""
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
        given: the table of poses.
        interval: start and end (s) of the part that is computed; None: all of it.
        time: (n,) s, times of the recording of markers.
        femur: (n, 4, 4) poses, m, of the femur's body in the tibia link.
        in_stance: (n,) whether the foot is loaded.
        remarks: lines for the report.
    """

    given: PoseRecording
    interval: tuple[float, float] | None
    time: Array
    femur: Array
    in_stance: Array
    remarks: tuple[str, ...]

    def motion_lines(self, path: str, cutoff_Hz: float) -> list[str]:
        """Return the scene's table [motion]; `path` is the file's path as TOML."""
        lines = ["[motion]", f"file = {path}", f"cutoff_Hz = {cutoff_Hz:g}"]
        for key, value in self.given.keys().items():
            if key == "cycle_s":
                lines.append("# times of the recording at 0 and 100 %: given, an assumption")
            lines.append(f"{key} = {_toml(value)}")
        if self.interval:
            lines.append(f"interval_s = {_toml(list(self.interval))}")
        lines += ["", "# the femoral mesh in the insert mesh's own axes", "[motion.columns]"]
        named = zip(ROLES, self.given.columns, strict=True)
        return lines + [f"{role} = {toml_text(column)}" for role, column in named]


def read_poses(
    recording: PoseRecording,
    links: Links,
    insert: Surface,
    axes: str,
    cutoff_Hz: float,
    interval: tuple[float, float] | None,
) -> RecordedPoses:
    """Return recorded poses, converted to poses of the femur's body in the tibia link.

    With the recorded pose P of the femoral mesh in the insert mesh,
    T_femur_in_tibia = T_insert_in_tibia T_insert_mesh_in_insert P T_femur_in_femoral_mesh.

    Args:
        recording: the table of poses.
        links: the links of the leg.
        insert: mesh of the insert about its own origin, in anatomical axes.
        axes: axes of the meshes that point anterior, superior and right.
        cutoff_Hz: cut-off frequency (Hz) of the scene's low-pass filter.
        interval: start and end (s) of the part that is computed; None: all of it.

    Raises:
        InputError: file, columns, units or times cannot be used.
    """
    turn = pose(axes_rotation(axes), np.zeros(3))
    placement = insert_placement(insert, axes_rotation(axes)) @ turn
    side: Literal["right", "left"] = "left" if links.leg.side == "left" else "right"
    motion = load_motion(_motion_table(recording, cutoff_Hz, interval), side, placement, turn)
    knee = knee_pose(motion.raw_coordinates)
    own_side = mirrored_pose(knee) if side == "left" else knee  # the motion is a right knee's
    femur = links.insert_in_tibia @ own_side @ inverse(links.femur)
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
    keys["columns"] = dict(zip(ROLES, recording.columns, strict=True))
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
            "give the part in which the foot is loaded, in the unit of that column",
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
            f"phase: its 0 and 100 % are laid on {recording.stride[0]:g} and "
            f"{recording.stride[1]:g} s of the recording, as given: an assumption ({closed})"
        )
    return tuple(text)


def _toml(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_toml(v) for v in value)}]"
    return toml_text(value) if isinstance(value, str) else f"{value:.9g}"
