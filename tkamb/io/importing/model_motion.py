"""Knee and shank poses from a motion in an OpenSim model's coordinates (`.mot`, `.sto`)."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    Array,
    inverse,
    knee_coordinates,
    mirrored_pose,
)
from tkamb.io.importing.anatomy import OTHER, find_leg
from tkamb.io.importing.links import Links
from tkamb.io.importing.plates import Feet
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.motion import angle_lines, read_coordinates
from tkamb.io.recordings.samples import check_spacing
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
        time: times, s, shape (n,).
        values: values of `COLUMNS`, mm and deg, shape (n, 12).
        missing: coordinates of the model that the file lacks. They have their default values.
        remarks: lines for the report on how the file was read.
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
    """Return the motion of knee and shank from a motion in the model's coordinates.

    Args:
        recorded: table of the coordinates. A column has the coordinate's name or path in the model.

    Raises:
        InputError: the column of knee flexion is missing, or the unit of angles is unknown.
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
    """Return the positions of the feet in a motion, as mean origin of each foot's bodies."""
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


def motion_tables(flexion_alone: bool) -> list[str]:
    """Return the scene's tables [motion.columns] and [tibia] for `motion.csv`.

    Args:
        flexion_alone: whether the scene reads only flexion; otherwise it reads six coordinates.
    """
    columns = dict(zip(KNEE_COORDINATES, COLUMNS, strict=False))
    names = ("flexion",) if flexion_alone else KNEE_COORDINATES
    lines = ["[motion.columns]", 'time = "time_s"']
    lines += [f'{role} = "{columns[role]}"' for role in names]
    lines += [
        "",
        "[tibia]",
        'kind = "pose"',
        f'file = "{MOTION_FILE}"',
        'sequence = "XYZ"',
        'angle_unit = "deg"',
        'length_unit = "mm"',
        "",
        "[tibia.columns]",
        'time = "time_s"',
    ]
    kinds = [f"{kind}_{k}" for kind in ("rotation", "translation") for k in (1, 2, 3)]
    return lines + [f'{role} = "{name}"' for role, name in zip(kinds, COLUMNS[6:], strict=True)]
