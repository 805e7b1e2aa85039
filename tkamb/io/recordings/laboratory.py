"""Unit words of recordings, and columns in the laboratory (x forward, y up, z right) in SI.

Case, blanks, dots, hyphens and asterisks are ignored, and only the listed words are units. No unit
is guessed: a reader that needs the quantity raises an error.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array, pose
from tkamb.units import ANGLE, LENGTH, MILLIMETRE, STANDARD_GRAVITY

if TYPE_CHECKING:
    from tkamb.io.recordings.tables import Table

POUND_FORCE = 0.45359237 * STANDARD_GRAVITY
"""N; the international avoirdupois pound (1959) under standard gravity."""

LENGTH_WORDS = {
    **dict.fromkeys(("m", "mete", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("cm", "cent", "centimeter", "centimeters", "centimetre", "centimetres"), 1e-2),
    **dict.fromkeys(
        ("mm", "mill", "millimeter", "millimeters", "millimetre", "millimetres"), MILLIMETRE
    ),
    **dict.fromkeys(("in", "inch", "inches"), LENGTH["inch"]),
    **dict.fromkeys(("ft", "foot", "feet"), 12 * LENGTH["inch"]),
}
"""Metres per unit. Some programs shorten a word to four letters."""
FORCE_WORDS = {
    **dict.fromkeys(("n", "nt", "newt", "newton", "newtons"), 1.0),
    **dict.fromkeys(("dan", "decanewton", "decanewtons"), 10.0),
    **dict.fromkeys(("kn", "kilonewton", "kilonewtons"), 1e3),
    **dict.fromkeys(("kgf", "kp", "kilopond", "kiloponds"), STANDARD_GRAVITY),
    **dict.fromkeys(("lb", "lbs", "lbf", "pound", "pounds"), POUND_FORCE),
}
"""Newtons per unit."""
LENGTH_FIRST = ("in", "inch", "ft", "foot")
"""Units of length that may precede the force, as in `in-lb`. `mN` is a millinewton."""

_SEPARATORS = str.maketrans("", "", " .*-·⋅_\x00\t")


@dataclass(frozen=True)
class GivenUnits:
    """Units that the user states for lengths, force channels and moment channels, like mm, N and
    Nmm; None: those of the recording.
    """

    length: str | None = None
    force: str | None = None
    moment: str | None = None


def plain_unit(word: str) -> str:
    """Return a unit word without case, blanks and separators."""
    return word.translate(_SEPARATORS).lower()


def metres(word: str) -> float | None:
    """Return metres per unit of length; None for a word that is not a unit."""
    return LENGTH_WORDS.get(plain_unit(word))


def newtons(word: str) -> float | None:
    """Return newtons per unit of force; None for a word that is not a unit."""
    return FORCE_WORDS.get(plain_unit(word))


def newton_metres(word: str) -> float | None:
    """Return newton metres per unit of moment; None for a word that is not a unit.

    It is a unit of force, then one of length, or inches or feet first.
    """
    plain = plain_unit(word)
    for first in LENGTH_FIRST:
        if plain.startswith(first) and plain[len(first) :] in FORCE_WORDS:
            return LENGTH_WORDS[first] * FORCE_WORDS[plain[len(first) :]]
    for cut in range(1, len(plain)):
        force_unit, length_unit = FORCE_WORDS.get(plain[:cut]), LENGTH_WORDS.get(plain[cut:])
        if force_unit is not None and length_unit is not None:
            return force_unit * length_unit
    return None


def laboratory_rotation(axes: str, path: Path) -> Array:
    """Return R (3, 3) with v_laboratory = R v_file.

    Args:
        axes: the file's axes that point forward, up and right, like "-x,+y,-z".
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


def angle_scale(table: "Table", angle_unit: str | None) -> float:
    """Return radians per unit of angle."""
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
    table: "Table",
    columns: dict[str, str],
    sequence: str,
    angle_unit: str | None,
    length_unit: str | None,
) -> Array:
    """Return the poses (n, 4, 4) of columns rotation_1..3 and translation_1..3, m."""
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
