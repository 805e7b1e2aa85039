"""Recorded poses of the femoral component in the insert (fluoroscopy, biplane X-ray)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import Array, inverse, knee_pose, mirrored_pose, pose
from tkamb.geometry.surface import Surface
from tkamb.io.importing.links import Links
from tkamb.io.importing.toml_text import toml_text
from tkamb.io.recordings.meshes import axes_rotation
from tkamb.io.recordings.motion import KneeMotion, load_motion
from tkamb.io.recordings.recording_tables import MotionTable
from tkamb.units import DEGREE

ROLES = tuple(f"{kind}_{k}" for kind in ("rotation", "translation") for k in (1, 2, 3))
"""Of the columns, in their order."""


@dataclass(frozen=True)
class PoseRecording:
    """Poses of the femoral mesh in the insert mesh's own axes, and what is known of them.

    Args:
        file: the table.
        columns: of `ROLES`: three angles in the order of the sequence, then x, y, z.
        sequence: of the rotations, as in scipy: "XYZ" is Rx Ry Rz.
        angle_unit: "deg" or "rad".
        length_unit: "m", "cm" or "mm".
        turned: roles that are read with the other sign.
        stride: s, where 0 and 100 % of the file's time column lie on the recording's clock;
            None: the file has that clock itself.
        stance: part of the file's time column, in which the foot is loaded; None: all of it.
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
        """Return the keys of the scene's [motion] but its file, cut-off and columns."""
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
    """Poses after reading.

    Args:
        given: the table of poses and its units.
        interval: s, the part that is computed; None: all of it.
        time: (n,) s, on the recording's clock.
        femur: (n, 4, 4) m, the femur's body in the tibia link.
        in_stance: (n,) whether the foot is loaded.
        said: lines for the report.
    """

    given: PoseRecording
    interval: tuple[float, float] | None
    time: Array
    femur: Array
    in_stance: Array
    said: tuple[str, ...]

    def motion_lines(self, path: str, cutoff_Hz: float) -> list[str]:
        """Return the scene's [motion]; `path` is the file's, as TOML."""
        lines = ["[motion]", f"file = {path}", f"cutoff_Hz = {cutoff_Hz:g}"]
        for key, value in self.given.keys().items():
            if key == "cycle_s":
                lines.append("# 0 and 100 % on the recording's clock: an assumption, as given")
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
    """Return recorded poses as those of the femur's body in the tibia link.

    With P the recorded pose of the femoral mesh in the insert mesh,
    T_femur_in_tibia = T_insert_in_tibia T_insert_mesh_in_insert P T_femur_in_femoral_mesh.

    Args:
        recording: the table of poses and its units.
        links: of the leg.
        insert: its mesh about its own origin, in anatomical axes.
        axes: the meshes' axes that point anterior, superior and right.
        cutoff_Hz: low-pass of the scene.
        interval: s, the part that is computed; None: all of it.

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
    return RecordedPoses(recording, interval, motion.time, femur, stance, _said(recording, motion))


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


def _said(recording: PoseRecording, motion: KneeMotion) -> tuple[str, ...]:
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
