"""Profiles of a knee simulator: load and displacements per cent of the cycle, from a CSV file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, knee_pose
from tkamb.inputs.tables import Table, read_table
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
LIMITS = {"ap_mm": 30.0, "ml_mm": 20.0, "axial_rotation_deg": 45.0, "adduction_deg": 20.0}
"""Largest size of a column's values."""
FLEXION_LIMITS = (-30.0, 170.0)
LARGEST_FORCE = 1e4
"""N, fifteen body weights."""
CLOSES_WITHIN = 0.01
"""Share of a column's range by which its last row may differ from its first."""


@dataclass(frozen=True, eq=False)
class Profile:
    """One cycle of a simulator in displacement control, at even steps.

    Args:
        load: (f,) N, axial.
        coordinates: (f, 6) knee coordinates (`tkamb.geometry.frames`), m and rad; AP and ML from
            the dwell position, SI zero: the load finds it.
        source: the file.
    """

    load: Array
    coordinates: Array
    source: str

    def poses(self, dwell: tuple[float, float]) -> Array:
        """Return pose_femoral_in_insert (f, 4, 4), AP and ML counted from `dwell` (x, z), m."""
        shifted = self.coordinates.copy()
        shifted[:, [0, 2]] += dwell
        return knee_pose(shifted)


def read_profile(path: str | Path, frames: int) -> Profile:
    """Read a profile and lay it on `frames` even steps, the first and last at 0 and 100 %.

    The file has a header and rows from 0 to 100 % of the cycle: cycle_percent, axial_force_N,
    flexion_deg, and any of ap_mm, ml_mm, axial_rotation_deg, adduction_deg; what is not given is
    zero. Signs and frames are tkamb's: the femoral component's motion on the insert. Between
    rows it is linear.

    Raises:
        InputError: a column that is missing or unknown, a gap, a value out of range, per cents
            that do not run from 0 to 100, or a cycle that does not close.
    """
    table = read_table(Path(path), "csv")
    known = (PERCENT, LOAD, *COORDINATES)
    for name in table.columns:
        if name not in known:
            raise InputError(f"unknown column '{name}'", path, f"there are: {', '.join(known)}")
    percent = _percent(table)
    columns = {
        name: table.complete_column(name)
        for name in known[1:]
        if name in table.columns or name in (LOAD, "flexion_deg")
    }
    for name, values in columns.items():
        _check_range(name, values, path)
        _check_closed(name, values, path)
    even = np.linspace(0.0, 100.0, frames)
    coordinates = np.zeros((frames, 6))
    for name, values in columns.items():
        if name in COORDINATES:
            unit, place = COORDINATES[name]
            coordinates[:, place] = np.interp(even, percent, values) * unit
    return Profile(np.interp(even, percent, columns[LOAD]), coordinates, str(path))


def _percent(table: Table) -> Array:
    percent = table.time(PERCENT)
    if percent[0] != 0 or percent[-1] != 100 or len(percent) < 3:
        what = f"'{PERCENT}' runs from {percent[0]:g} to {percent[-1]:g} in {len(percent)} rows"
        raise InputError(what, table.path, "give at least three rows from 0 to 100")
    return percent


def _check_range(name: str, values: Array, path: str | Path) -> None:
    low, high = -LIMITS.get(name, 0.0), LIMITS.get(name, 0.0)
    if name == LOAD:
        low, high = 0.0, LARGEST_FORCE
    elif name == "flexion_deg":
        low, high = FLEXION_LIMITS
    wrong = np.flatnonzero((values < low) | (values > high))
    if wrong.size:
        row = int(wrong[0])
        what = f"'{name}' is {values[row]:g} in data row {row + 1}"
        raise InputError(what, path, f"it lies within {low:g} to {high:g}; unit and sign?")


def _check_closed(name: str, values: Array, path: str | Path) -> None:
    if abs(values[-1] - values[0]) > CLOSES_WITHIN * np.ptp(values):
        what = f"does not close: '{name}' is {values[0]:g} at 0 % and {values[-1]:g} at 100 %"
        raise InputError(what, path, "the last row repeats the first")
