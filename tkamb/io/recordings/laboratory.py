"""Conversion of a file's columns to the laboratory (x forward, y up, z right) and SI."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array, pose
from tkamb.io.recordings.tables import Table
from tkamb.units import ANGLE


def laboratory_rotation(axes: str, path: Path) -> Array:
    """Return R (3, 3) with v_laboratory = R v_file.

    Args:
        axes: the file's axes that point forward, up and right, like "-x,+y,-z".

    Raises:
        InputError: the axes are left-handed.
    """
    rotation = np.zeros((3, 3))
    for row, axis in enumerate(axes.split(",")):
        rotation[row, "xyz".index(axis[-1])] = -1.0 if axis[0] == "-" else 1.0
    if np.linalg.det(rotation) < 0:
        raise InputError(
            f"laboratory_axes '{axes}' are left-handed", path, "turn the sign of one axis"
        )
    return rotation


def check_roles(columns: dict[str, str], roles: tuple[str, ...], path: Path, table: str) -> None:
    """Raise an InputError if the scene's `columns` names a role that does not exist."""
    for role in columns:
        if role not in roles:
            raise InputError(
                f"unknown role '{role}' in [{table}] columns", path, names_near(role, roles)
            )


def angle_scale(table: Table, angle_unit: str | None) -> float:
    """Return radians per unit of angle.

    Raises:
        InputError: the file's header states another unit than the scene.
    """
    if table.in_degrees is not None and table.in_degrees != (angle_unit == "deg"):
        stated = "degrees" if table.in_degrees else "radians"
        raise InputError(
            f"is in {stated} by its own header, but the scene says angle_unit = '{angle_unit}'",
            table.path,
            "correct angle_unit",
        )
    assert angle_unit is not None
    return ANGLE[angle_unit]


def poses_of_columns(
    table: Table,
    columns: dict[str, str],
    sequence: str,
    angle_unit: str | None,
    length_unit: str | None,
) -> Array:
    """Return the poses (n, 4, 4) of columns rotation_1..3 and translation_1..3, m.

    Raises:
        InputError: missing column, a gap, or a sequence with the same axis twice in a row.
    """
    angles, places = (
        np.stack(
            [table.complete_column(columns.get(f"{kind}_{k}", f"{kind}_{k}")) for k in (1, 2, 3)],
            axis=1,
        )
        for kind in ("rotation", "translation")
    )
    try:
        rotation = Rotation.from_euler(sequence, angles * angle_scale(table, angle_unit))
    except ValueError as error:
        raise InputError(f"sequence '{sequence}' is not valid ({error})", table.path) from None
    return pose(rotation.as_matrix(), places * table.unit_scale(length_unit, "length_unit"))
