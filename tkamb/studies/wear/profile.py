"""Profiles of a knee simulator: loads and displacements per cent of the cycle, from a CSV file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_pose
from tkamb.io.recordings.tables import Table, read_table
from tkamb.studies.wear.force_control import SI, ForceDrive
from tkamb.studies.wear.springs import Springs
from tkamb.units import DEGREE, MILLIMETRE

PERCENT, LOAD = "cycle_percent", "axial_force_N"
COORDINATES = {
    "ap_mm": (MILLIMETRE, 0),
    "ml_mm": (MILLIMETRE, 2),
    "axial_rotation_deg": (DEGREE, 3),
    "adduction_deg": (DEGREE, 4),
    "flexion_deg": (DEGREE, 5),
}
"""Column -> unit, and its place among the knee coordinates."""
FORCES = {
    "ap_force_N": "ap_mm",
    "ml_force_N": "ml_mm",
    "axial_torque_Nm": "axial_rotation_deg",
    "adduction_torque_Nm": "adduction_deg",
}
"""Column of force control -> the column whose place it takes."""
LIMITS = {
    "ap_mm": 30.0,
    "ml_mm": 20.0,
    "axial_rotation_deg": 45.0,
    "adduction_deg": 20.0,
    "ap_force_N": 2e3,
    "ml_force_N": 2e3,
    "axial_torque_Nm": 50.0,
    "adduction_torque_Nm": 100.0,
}
"""Largest size of a column's values."""
FLEXION_LIMITS = (-30.0, 170.0)


@dataclass(frozen=True)
class WearProfileSettings:
    """Which load profiles of a simulator are accepted."""

    max_force: float = 1e4
    """N: largest force. Chosen: fifteen body weights."""
    step_tolerance: float = 1e-9
    """Share of a step by which it may exceed the longest one. Chosen: above rounding."""
    closure_tolerance: float = 0.01
    """Share of a column's range by which its last row may differ from its first. Chosen: noise of a
    profile is smaller."""


WEAR_PROFILE = WearProfileSettings()


@dataclass(frozen=True, eq=False)
class Profile:
    """One cycle of a simulator: all rows of its file, and more between them.

    Args:
        percent: (f,) of the cycle, from 0 to 100.
        load: (f,) N, axial.
        coordinates: (f, 6) knee coordinates (`tkamb.geometry.frames`), m and rad; AP and ML from
            the dwell position, SI zero: the load finds it; zero where a force is given instead.
        applied: (f, 6) N and N·m on the femoral component along each coordinate that is found,
            the axial force on SI among them.
        free: indices of the coordinates that a force or torque is given for; none: displacement
            control.
        source: the file.
    """

    percent: Array
    load: Array
    coordinates: Array
    applied: Array
    free: tuple[int, ...]
    source: str

    @property
    def rotation(self) -> Array:
        """The femoral component's rotation (3, 3) in the first row."""
        return np.asarray(knee_pose(self.coordinates[0])[:3, :3])

    def poses(self, dwell: tuple[float, float]) -> Array:
        """Return pose_femoral_in_insert (f, 4, 4), AP and ML counted from `dwell` (x, z), m."""
        return knee_pose(self.coordinates + zero_at(dwell))

    def drive(self, dwell: tuple[float, float], springs: Springs | None) -> ForceDrive | None:
        """Return the force control, with `dwell` (x, z), m, as origin; None: displacement control.

        Raises:
            InputError: a spring on a coordinate that is not found from a force.
        """
        names = [KNEE_COORDINATES[i] for i in self.free]
        for name in springs.springs if springs else ():
            if name not in names:
                what = f"there is a spring for '{name}', but the profile gives no force or torque"
                raise InputError(what, self.source, "a spring acts under force control alone")
        if not self.free:
            return None
        zero = zero_at(dwell)
        free = tuple(sorted((*self.free, SI)))
        places = self.coordinates + zero
        return ForceDrive(places, self.applied, free, zero, springs, self.percent)


def zero_at(dwell: tuple[float, float]) -> Array:
    """Return the knee coordinates (6,) of a dwell position (x, z), m."""
    return np.array([dwell[0], 0.0, dwell[1], 0.0, 0.0, 0.0])


def read_profile(path: str | Path, frames: int) -> Profile:
    """Read a profile: all of its rows, and rows between them where they lie far apart.

    A row's values are the file's own, so that no turning point is lost. Between two rows of the
    file the profile is linear; evenly spaced rows are put there until no step is longer than
    100/(frames - 1) per cent.

    The file has a header and rows from 0 to 100 % of the cycle: cycle_percent, axial_force_N,
    flexion_deg, and any of ap_mm, ml_mm, axial_rotation_deg, adduction_deg; what is not given is
    zero. In place of each of these there may be its force or torque: ap_force_N, ml_force_N,
    axial_torque_Nm, adduction_torque_Nm. Signs and frames are tkamb's: the femoral component's
    motion on the insert, and what acts on the femoral component.

    Args:
        path: the file.
        frames: smallest number of frames of a cycle, at least 2.

    Raises:
        InputError: a column that is missing or unknown, a displacement and its force together,
            a gap, a value out of range, per cents that do not run from 0 to 100, a cycle that
            does not close, or force control without axial force.
    """
    table = read_table(Path(path), "csv")
    names = (PERCENT, LOAD, *COORDINATES, *FORCES)
    for name in table.columns:
        if name not in names:
            raise InputError(f"unknown column '{name}'", path, f"there are: {', '.join(names)}")
    free = _free(table)
    percent = _percent(table)
    columns = {
        name: table.complete_column(name)
        for name in names[1:]
        if name in table.columns or name in (LOAD, "flexion_deg")
    }
    for name, values in columns.items():
        _check_range(name, values, path)
        _check_closed(name, values, path)
    rows = _divided(percent, 100.0 / (frames - 1))
    load = np.interp(rows, percent, columns[LOAD])
    if free and not (columns[LOAD] > 0).all():
        row = int(np.flatnonzero(columns[LOAD] <= 0)[0])
        what = f"'{LOAD}' is 0 in data row {row + 1}: without contact there is no equilibrium"
        raise InputError(what, path, "force control needs more than 0 N in each row")
    coordinates, applied = np.zeros((2, len(rows), 6))
    applied[:, SI] = -load
    for name, values in columns.items():
        steps = np.interp(rows, percent, values)
        if name in COORDINATES:
            unit, place = COORDINATES[name]
            coordinates[:, place] = steps * unit
        elif name in FORCES:
            applied[:, COORDINATES[FORCES[name]][1]] = steps
    return Profile(rows, load, coordinates, applied, free, str(path))


def _divided(rows: Array, longest: float) -> Array:
    """Return rising numbers with others evenly between them, so that no step exceeds `longest`."""
    pieces = np.maximum(1, np.ceil(np.diff(rows) / longest - WEAR_PROFILE.step_tolerance)).astype(
        int
    )
    parts = [
        np.linspace(begin, end, count, endpoint=False)
        for begin, end, count in zip(rows[:-1], rows[1:], pieces, strict=True)
    ]
    return np.append(np.concatenate(parts), rows[-1])


def _free(table: Table) -> tuple[int, ...]:
    """Return the indices of the coordinates that a force or torque is given for."""
    forces = [name for name in FORCES if name in table.columns]
    for name in forces:
        if FORCES[name] in table.columns:
            what = f"both '{name}' and '{FORCES[name]}' are given"
            raise InputError(what, table.path, "prescribe the position or apply the force")
    return tuple(COORDINATES[FORCES[name]][1] for name in forces)


def _percent(table: Table) -> Array:
    percent = table.time(PERCENT)
    if percent[0] != 0 or percent[-1] != 100 or len(percent) < 3:
        what = f"'{PERCENT}' runs from {percent[0]:g} to {percent[-1]:g} in {len(percent)} rows"
        raise InputError(what, table.path, "give at least three rows from 0 to 100")
    return percent


def _check_range(name: str, values: Array, path: str | Path) -> None:
    low, high = -LIMITS.get(name, 0.0), LIMITS.get(name, 0.0)
    if name == LOAD:
        low, high = 0.0, WEAR_PROFILE.max_force
    elif name == "flexion_deg":
        low, high = FLEXION_LIMITS
    wrong = np.flatnonzero((values < low) | (values > high))
    if wrong.size:
        row = int(wrong[0])
        what = f"'{name}' is {values[row]:g} in data row {row + 1}"
        raise InputError(what, path, f"give {low:g} to {high:g}; check unit and sign")


def _check_closed(name: str, values: Array, path: str | Path) -> None:
    if abs(values[-1] - values[0]) > WEAR_PROFILE.closure_tolerance * np.ptp(values):
        what = f"does not close: '{name}' is {values[0]:g} at 0 % and {values[-1]:g} at 100 %"
        raise InputError(what, path, "the last row repeats the first")
