"""A virtual knee simulator: profiles of loads and displacements, springs, and force control.

A profile is a CSV file with loads and displacements over the percentage of the cycle. It prescribes
flexion and some of the knee coordinates q (`tkamb.geometry.frames`). The other coordinates, always
including the superior-inferior one, are released and follow from equilibrium:

    r_i(q) = F_i - S_i(q_i) - J_i(q) . w_contact(q) = 0

- r_i: residual of the released coordinate i.
- F_i: load of the machine on the femoral component through the origin of its mesh. It is a force,
  N, along the axis of the insert or a torque, N·m, about the axis of the coordinate. An axial
  force F is the load -F on the superior-inferior coordinate.
- S_i: force of the spring that replaces the ligaments.
- J_i: twist of the femoral component per unit rate of coordinate i, see `knee_axes`.
- w_contact: contact wrench on the insert.

The equilibrium is quasi-static and without friction.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.contact.model import ContactModel
from tkamb.contact.result import ContactStatus, Guess
from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_axes, knee_coordinates, knee_pose
from tkamb.io.recordings.tables import Table, read_table
from tkamb.io.toml_text import read_toml
from tkamb.knee.balance import BalanceStatus
from tkamb.knee.released_forces import FreeForces
from tkamb.units import DEGREE, MILLIMETRE

KINDS = {
    "ap": ("stiffness_N_per_mm", "gap_mm", MILLIMETRE, 1e3, 30.0),
    "axial_rotation": ("stiffness_Nm_per_deg", "gap_deg", DEGREE, 50.0, 45.0),
}
"""Coordinate -> keys of stiffness and gap, unit in SI, and largest stiffness and gap."""


@dataclass(frozen=True)
class Spring:
    """A linear spring with a gap.

        force = -k sign(q) max(|q| - g, 0)

    Args:
        stiffness: stiffness k, N/m or N·m/rad.
        gap: displacement g in each direction without spring force, m or rad.
    """

    stiffness: float
    gap: float


@dataclass(frozen=True)
class Springs:
    """The springs of a simulator.

    Args:
        springs: coordinate, "ap" or "axial_rotation" -> spring.
        table: coordinate -> key of the file -> value in the units of the file.
    """

    springs: Mapping[str, Spring]
    sources: tuple[str, ...]
    table: Mapping[str, Mapping[str, float]]


def read_springs(path: str | Path) -> Springs:
    """Read a TOML file of springs: `sources`, and [ap], [axial_rotation] or both."""
    content = read_toml(path, what="springs")
    sources = content.pop("sources", None)
    if not (isinstance(sources, list) and sources and all(isinstance(s, str) for s in sources)):
        raise InputError("sources is not a list of texts", path, "give the source of each number")
    if not content:
        raise InputError("has no spring", path, f"give {' or '.join(f'[{k}]' for k in KINDS)}")
    springs = {name: _spring(name, table, path) for name, table in content.items()}
    return Springs(springs, tuple(sources), content)


def _spring(name: str, table: Any, path: str | Path) -> Spring:
    if name not in KINDS:
        raise InputError(f"unknown key '{name}'", path, names_near(name, [*KINDS, "sources"]))
    stiffness, gap, unit, stiffest, widest = KINDS[name]
    if not isinstance(table, dict) or sorted(table) != sorted((stiffness, gap)):
        raise InputError(f"[{name}] is not complete", path, f"it needs: {stiffness}, {gap}")
    for key, least, most in ((stiffness, None, stiffest), (gap, 0.0, widest)):
        value = table[key]
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not math.isfinite(value) or value > most or value < (least or 0.0):
            raise InputError(f"cannot be {value}", f"{path}: [{name}] {key}", f"at most {most:g}")
        if least is None and value == 0:
            raise InputError("cannot be 0", f"{path}: [{name}] {key}", "leave the table out")
    return Spring(float(table[stiffness]) / unit, float(table[gap]) * unit)


SI = KNEE_COORDINATES.index("si")
UNITS = {
    "ap": ("mm", MILLIMETRE),
    "ml": ("mm", MILLIMETRE),
    "axial_rotation": ("deg", DEGREE),
    "adduction": ("deg", DEGREE),
    "flexion": ("deg", DEGREE),
}
"""Coordinate -> unit in a profile, and this unit in SI."""


@dataclass(frozen=True, eq=False)
class ForceDrive:
    """Loads of a force-controlled machine on the knee, for each row of the profile.

    Args:
        coordinates: prescribed coordinates, and initial guesses of the released ones, m and rad,
            shape (f, 6).
        applied: load along each released coordinate, N and N·m, shape (f, 6).
        free: indices of the released coordinates, including the superior-inferior one.
        zero: coordinates of the dwell position, m and rad, shape (6,).
        springs: springs of the machine; None: no springs.
        percent: percentage of the cycle at each row, shape (f,); None: evenly spaced rows.
    """

    coordinates: Array
    applied: Array
    free: tuple[int, ...]
    zero: Array
    springs: Springs | None = None
    percent: Array | None = None

    @property
    def names(self) -> list[str]:
        """Names of the released coordinates without the superior-inferior one."""
        return [KNEE_COORDINATES[i] for i in self.free if i != SI]

    def joint(self, k: int) -> "MachineJoint":
        """Return the loads of the machine at row k."""
        stiffness, gap = np.zeros(6), np.zeros(6)
        for name, spring in (self.springs.springs if self.springs else {}).items():
            i = KNEE_COORDINATES.index(name)
            stiffness[i], gap[i] = spring.stiffness, spring.gap
        return MachineJoint(self.free, self.applied[k], stiffness, gap, self.zero)

    def ranges(self, poses: Array, failed: Mapping[int, str]) -> dict[str, float]:
        """Return the number of failed rows, and the range of each released coordinate, mm and deg.

        Args:
            poses: femoral poses of the rows, shape (f, 4, 4).
            failed: row -> reason why it failed.
        """
        positions = self._positions(poses)
        successful = [k for k in range(len(poses)) if k not in failed]
        ranges: dict[str, float] = {"failed_rows": len(failed)}
        for name in self.names:
            unit = UNITS[name][0]
            ranges[f"{name}_low_{unit}"] = float(positions[f"{name}_{unit}"][successful].min())
            ranges[f"{name}_high_{unit}"] = float(positions[f"{name}_{unit}"][successful].max())
        return ranges

    def rows(self, poses: Array, failed: Mapping[int, str]) -> list[dict[str, Any]]:
        """Return percentage, status and coordinates of each row; None if the row failed.

        The coordinates have the origin and the units of a profile.
        """
        positions = self._positions(poses)
        percent = np.linspace(0.0, 100.0, len(poses)) if self.percent is None else self.percent
        return [
            {
                "cycle_percent": float(percent[k]),
                "status": f"failed: {failed[k]}" if k in failed else "ok",
                **{key: None if k in failed else float(v[k]) for key, v in positions.items()},
            }
            for k in range(len(poses))
        ]

    def _positions(self, poses: Array) -> dict[str, Array]:
        offset = knee_coordinates(poses) - self.zero
        return {
            f"{name}_{unit}": offset[:, KNEE_COORDINATES.index(name)] / size
            for name, (unit, size) in UNITS.items()
        }


@dataclass(frozen=True, eq=False)
class MachineJoint:
    """Loads on the released coordinates at one row, without the contact; see the module.

    Args:
        released: indices of the n released coordinates.
        applied: load of the machine along each coordinate, N and N·m, shape (6,).
        stiffness: stiffness of the springs, N/m and N·m/rad, shape (6,); zero without a spring.
        gap: gaps of the springs, m and rad, shape (6,).
        zero: coordinates in the middle of the gaps, m and rad, shape (6,).
    """

    released: tuple[int, ...]
    applied: Array
    stiffness: Array
    gap: Array
    zero: Array

    def residual(self, coordinates: Array, contact: Array) -> Array:
        """Return the residuals r (..., n) at coordinates (..., 6) with contact wrench (6,)."""
        offset = coordinates - self.zero
        spring = self.stiffness * np.sign(offset) * np.maximum(np.abs(offset) - self.gap, 0.0)
        residual = self.applied - spring - knee_axes(coordinates) @ contact
        return np.asarray(residual[..., list(self.released)])

    def contact_gain(self, coordinates: Array) -> Array:
        """Return the derivative d r / d w_contact (n, 6) at coordinates (6,)."""
        return np.asarray(-knee_axes(coordinates)[list(self.released)])


class EquilibriumPoses:
    """Solves the equilibrium of the rows of a drive on one insert.

    The initial guess of a row is the last equilibrium.

    Args:
        state: prepared contact of the model with the insert.
    """

    def __init__(self, model: ContactModel, state: Any, drive: ForceDrive) -> None:
        self._model, self._state, self._drive = model, state, drive
        self._last: Array | None = None
        self._stiffness: Array | None = None

    def at(self, k: int, load: float, start: Guess | None) -> tuple[Array, str]:
        """Return the equilibrium pose (4, 4) of row k and "", or a pose and the reason of failure.

        Args:
            load: axial load, N.
        """
        coordinates = self._drive.coordinates[k].copy()
        if self._last is not None:
            free = list(self._drive.free)
            coordinates[free] = self._last[free]
        first, start = self._model.press_from(self._state, load, knee_pose(coordinates), start)
        if first.status is not ContactStatus.OK:
            reason = "; ".join(first.flags) or first.status.value
            return knee_pose(coordinates), f"no contact at the initial guess: {reason}"
        coordinates[SI] = first.pose[1, 3]
        probe = self._model.probe(self._state, start)
        forces = FreeForces(self._drive.joint(k), probe, coordinates)
        balance = forces.balance(self._stiffness)
        if balance.status is not BalanceStatus.OK:
            return knee_pose(coordinates), f"no equilibrium: {balance.status.value}"
        self._last, self._stiffness = forces.at(balance), balance.stiffness
        return knee_pose(self._last), ""


PERCENT, LOAD = "cycle_percent", "axial_force_N"
COORDINATES = {
    "ap_mm": (MILLIMETRE, 0),
    "ml_mm": (MILLIMETRE, 2),
    "axial_rotation_deg": (DEGREE, 3),
    "adduction_deg": (DEGREE, 4),
    "flexion_deg": (DEGREE, 5),
}
"""Column -> unit in SI, and index of the knee coordinate."""
FORCES = {
    "ap_force_N": "ap_mm",
    "ml_force_N": "ml_mm",
    "axial_torque_Nm": "axial_rotation_deg",
    "adduction_torque_Nm": "adduction_deg",
}
"""Column of force control -> column of displacement control that it replaces."""
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
"""Column -> largest magnitude of its values."""
FLEXION_LIMITS = (-30.0, 170.0)


@dataclass(frozen=True)
class WearProfileSettings:
    """Checks of the profile of a simulator."""

    max_force: float = 1e4
    """N: largest axial force. Fifteen body weights."""
    step_tolerance: float = 1e-9
    """Share by which a step may exceed the largest step. Above round-off."""
    closure_tolerance: float = 0.01
    """Largest difference between first and last row of a column, relative to its range. Above
    the noise of a profile."""


WEAR_PROFILE = WearProfileSettings()


@dataclass(frozen=True, eq=False)
class Profile:
    """One cycle of a simulator: all rows of its file, and interpolated rows between them.

    Args:
        percent: percentage of the cycle, from 0 to 100, shape (f,).
        load: axial load, N, shape (f,).
        coordinates: knee coordinates, m and rad, shape (f, 6), AP and ML relative to the dwell
            position. Released coordinates and the superior-inferior one are zero.
        applied: load along each released coordinate, including the axial force, N and N·m, shape
            (f, 6).
        free: indices of the coordinates with a force or torque in the file; empty with
            displacement control.
    """

    percent: Array
    load: Array
    coordinates: Array
    applied: Array
    free: tuple[int, ...]
    source: str

    @property
    def rotation(self) -> Array:
        """Orientation of the femoral component in the first row, shape (3, 3)."""
        return np.asarray(knee_pose(self.coordinates[0])[:3, :3])

    def poses(self, dwell: tuple[float, float]) -> Array:
        """Return pose_femoral_in_insert (f, 4, 4) for a dwell position (x, z), m."""
        return knee_pose(self.coordinates + zero_at(dwell))

    def drive(self, dwell: tuple[float, float], springs: Springs | None) -> ForceDrive | None:
        """Return the loads of force control for a dwell position (x, z), m.

        Returns None with displacement control.
        """
        names = [KNEE_COORDINATES[i] for i in self.free]
        for name in springs.springs if springs else ():
            if name not in names:
                what = f"there is a spring for '{name}', but the profile gives no force or torque"
                raise InputError(what, self.source, "springs act only with force control")
        if not self.free:
            return None
        zero = zero_at(dwell)
        free = tuple(sorted((*self.free, SI)))
        coordinates = self.coordinates + zero
        return ForceDrive(coordinates, self.applied, free, zero, springs, self.percent)


def zero_at(dwell: tuple[float, float]) -> Array:
    """Return the knee coordinates (6,) of a dwell position (x, z), m."""
    return np.array([dwell[0], 0.0, dwell[1], 0.0, 0.0, 0.0])


def read_profile(path: str | Path, frames: int) -> Profile:
    """Read a profile from a CSV file.

    The profile contains all rows of the file. Rows are interpolated linearly between them until no
    step is longer than 100/(frames - 1) per cent of the cycle.

    The file has a header and rows from 0 to 100 % of the cycle. The columns are cycle_percent,
    axial_force_N, flexion_deg and optionally ap_mm, ml_mm, axial_rotation_deg and adduction_deg,
    which are otherwise zero. A force or torque may replace each optional column: ap_force_N,
    ml_force_N, axial_torque_Nm or adduction_torque_Nm. Motions and forces are those of the femoral
    component on the insert, with tkamb's signs.

    Args:
        frames: smallest number of frames of a cycle, at least 2.
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
    rows = _subdivided(percent, 100.0 / (frames - 1))
    load = np.interp(rows, percent, columns[LOAD])
    if free and not (columns[LOAD] > 0).all():
        row = int(np.flatnonzero(columns[LOAD] <= 0)[0])
        what = f"'{LOAD}' is 0 in data row {row + 1}: without contact there is no equilibrium"
        raise InputError(what, path, "force control needs more than 0 N in each row")
    coordinates, applied = np.zeros((2, len(rows), 6))
    applied[:, SI] = -load
    for name, values in columns.items():
        interpolated = np.interp(rows, percent, values)
        if name in COORDINATES:
            unit, i = COORDINATES[name]
            coordinates[:, i] = interpolated * unit
        elif name in FORCES:
            applied[:, COORDINATES[FORCES[name]][1]] = interpolated
    return Profile(rows, load, coordinates, applied, free, str(path))


def _subdivided(rows: Array, longest: float) -> Array:
    """Return increasing numbers with evenly inserted ones, so that no step exceeds `longest`."""
    pieces = np.maximum(1, np.ceil(np.diff(rows) / longest - WEAR_PROFILE.step_tolerance)).astype(
        int
    )
    parts = [
        np.linspace(begin, end, count, endpoint=False)
        for begin, end, count in zip(rows[:-1], rows[1:], pieces, strict=True)
    ]
    return np.append(np.concatenate(parts), rows[-1])


def _free(table: Table) -> tuple[int, ...]:
    """Return the indices of the coordinates with a force or torque in the table."""
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
        raise InputError(what, path, "let the last row repeat the first")
