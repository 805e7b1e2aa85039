"""A model's coordinates over time, with their rates and accelerations."""

from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.recordings.filtering import Cutoff, differentiate_coordinates
from tkamb.io.recordings.tables import Table
from tkamb.units import DEGREE


@dataclass(frozen=True)
class AngleUnitSettings:
    """How angles in degrees are told from angles in radians."""

    max_radians: float = 6.5
    """rad: largest joint angle that can be in radians. Chosen: a joint never exceeds a whole turn,
    6.28; in degrees the number is larger in most movements."""
    min_rotation_deg: float = 0.2
    """deg; a joint that rotates by less in a whole recording stands still, in either unit. Chosen:
    noise of a recording is of this size."""
    max_angle: float = 2.0 * np.pi
    """rad; no joint of a leg rotates further. Chosen: a whole turn."""


ANGLE_UNIT = AngleUnitSettings()


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
    result = {name: _column_of(name, recorded) for name in model.coordinates}
    missing = tuple(name for name, column in result.items() if column is None)
    columns = {name: recorded.complete_column(c) for name, c in result.items() if c is not None}
    angles = {name: v for name, v in columns.items() if model.coordinates[name].rotational}
    scale = _angle_scale(angles, recorded) if angles else 1.0
    for name, values in columns.items():
        q[:, kinematics.coordinates[name]] = values * (scale if name in angles else 1.0)
    return q, missing


def _column_of(name: str, recorded: Table) -> str | None:
    """Return the column of a coordinate's value: its name, or its path in a states file.

    There `/jointset/knee/flexion/value` stands beside `/jointset/knee/flexion/speed`.
    """
    paths = [column.split("/") for column in recorded.columns]
    readings = (
        lambda path: path == [name],
        lambda path: path[-2:] == [name, "value"],
        lambda path: len(path) > 1 and path[-1] == name,
    )
    for reading in readings:
        for path in paths:
            if reading(path):
                return "/".join(path)
    return None


def _angle_scale(angles: dict[str, Array], recorded: Table) -> float:
    """Return radians per unit of the angles, as the file's header says.

    Raises:
        InputError: it does not, or their size contradicts it.
    """
    largest = max(float(np.abs(values).max()) for values in angles.values())
    worst = max(angles, key=lambda name: np.abs(angles[name]).max())
    if recorded.in_degrees is None:
        likely = "yes" if largest > ANGLE_UNIT.max_radians else "no (radians) or inDegrees=yes"
        raise InputError(
            f"does not say inDegrees ('{worst}' reaches {largest:.3g})",
            recorded.path,
            f"add the line inDegrees={likely} above its endheader",
        )
    if not recorded.in_degrees and largest > ANGLE_UNIT.max_radians:
        raise InputError(
            f"says inDegrees=no, but '{worst}' reaches {largest:.4g}, which no joint does in "
            "radians",
            recorded.path,
            "write inDegrees=yes where it is in degrees",
        )
    return DEGREE if recorded.in_degrees else 1.0


def angle_lines(kinematics: Kinematics, recorded: Table, q: Array) -> tuple[str, ...]:
    """Return lines on the unit of the angles where their size contradicts it.

    Args:
        kinematics: of the model.
        recorded: the file.
        q: (f, n) coordinates that were read from it, rad and m.
    """
    coordinates = kinematics.model.coordinates
    own = [kinematics.coordinates[name] for name in coordinates if coordinates[name].rotational]
    turns = np.ptp(q[:, own], axis=0) / DEGREE
    small = np.abs(q[:, own]).max() < ANGLE_UNIT.max_radians * DEGREE
    if recorded.in_degrees and small and turns.max() > ANGLE_UNIT.min_rotation_deg:
        return (
            "ATTENTION: by inDegrees=yes no joint of the whole motion bends or turns by more than "
            f"{turns.max():.2g} deg: check whether the file is in radians",
        )
    return ()


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
