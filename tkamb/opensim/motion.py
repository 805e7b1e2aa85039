"""A model's coordinates over time, with their rates and accelerations."""

from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.inputs.filtering import Cutoff, differentiate_coordinates
from tkamb.inputs.tables import Table
from tkamb.opensim.kinematics import Kinematics
from tkamb.units import DEGREE


@dataclass(frozen=True, eq=False)
class CoordinateMotion:
    """Coordinates in the model's order, rad and m.

    Args:
        time: (f,) s.
        q: (f, n).
        rates: (f, n) per s.
        accelerations: (f, n) per s².
    """

    time: Array
    q: Array
    rates: Array
    accelerations: Array


LARGEST_ANGLE = 2.0 * np.pi
"""rad; no joint of a leg turns further."""


def read_coordinates(kinematics: Kinematics, recorded: Table) -> tuple[Array, tuple[str, ...]]:
    """Return coordinates (f, n) rad and m, and those that a `.mot` or `.sto` does not hold.

    Those are at their defaults.

    Args:
        kinematics: of the model.
        recorded: with a column per coordinate, named as in the model or by its path.

    Raises:
        InputError: angles of unknown or impossible unit, or a gap.
    """
    model = kinematics.model
    q = np.tile(kinematics.vector({}), (recorded.rows, 1))
    missing = []
    for name, coordinate in model.coordinates.items():
        column = _column(recorded, name)
        if column is None:
            missing.append(name)
            continue
        values = recorded.complete_column(column)
        if coordinate.rotational:
            if recorded.in_degrees is None:
                hint = "add inDegrees=yes or inDegrees=no to its header"
                raise InputError("does not say inDegrees", recorded.path, hint)
            values = values * (DEGREE if recorded.in_degrees else 1.0)
            largest = float(np.abs(values).max(initial=0.0))
            if largest > LARGEST_ANGLE and not _turns(name):
                said = "yes" if recorded.in_degrees else "no"
                raise InputError(
                    f"column '{column}' reaches {largest:.3g} rad with inDegrees={said}",
                    recorded.path,
                    "are its angles in degrees? then write inDegrees=yes",
                )
        q[:, kinematics.coordinates[name]] = values
    return q, tuple(missing)


def _turns(name: str) -> bool:
    """Say whether a coordinate may turn without end: the body in the laboratory."""
    return any(word in name.lower() for word in ("pelvis", "ground", "root"))


def _column(recorded: Table, name: str) -> str | None:
    """Return the column of a coordinate's values: its name, or its path, not that of its speed."""
    if name in recorded.columns:
        return name
    for column in recorded.columns:
        *above, last = column.strip("/").split("/")
        if above and (last == name or (last == "value" and above[-1] == name)):
            return column
    return None


def coordinate_motion(
    kinematics: Kinematics,
    time: Array,
    q: Array,
    cutoff_Hz: Cutoff,
    at: Array | None = None,
    name: str = "motion",
) -> CoordinateMotion:
    """Low-pass filter coordinates and differentiate them twice; followers follow exactly.

    A coordinate c = f(q) that a coupler moves has c' = f' q' and c'' = f' q'' + f'' q'².

    Args:
        kinematics: of the model.
        time: (m,) s.
        q: (m, n) coordinates; those that follow others are not looked at.
        cutoff_Hz: as in `differentiate_coordinates`, which states the errors too.
        at: (f,) s, where they are wanted; default: at `time`.
        name: what to call the data in messages.
    """
    values, rates, second = differentiate_coordinates(time, q, cutoff_Hz, at, name=name)
    for coupler in kinematics.model.couplers:
        dependent = kinematics.coordinates[coupler.dependent]
        own = kinematics.coordinates[coupler.independent]
        slope = coupler.function.slope(values[:, own])
        bend = coupler.function.curvature(values[:, own])
        values[:, dependent] = coupler.function(values[:, own])
        rates[:, dependent] = slope * rates[:, own]
        second[:, dependent] = slope * second[:, own] + bend * rates[:, own] ** 2
    return CoordinateMotion(time if at is None else np.asarray(at, float), values, rates, second)
