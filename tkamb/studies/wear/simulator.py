"""A virtual knee simulator: profiles of loads and displacements, springs, and force control.

A profile is a CSV file with loads and displacements against the percentage of the cycle. Flexion
and the knee coordinates q (`tkamb.geometry.frames`) that the profile prescribes are given. The
other coordinates, always including the superior-inferior one, follow from equilibrium:

    r_i(q) = F_i - S_i(q_i) - J_i(q) . w_contact(q) = 0

with

- F_i: force (N, along the axis of the insert through the origin of the femoral mesh) or torque
  (N·m, about the axis of the coordinate through that origin) of the machine on the femoral
  component. The axial force acts on the superior-inferior coordinate as -F;
- S_i: force of the spring that stands for the ligaments;
- J: see `knee_axes`;
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
"""Coordinate -> key of stiffness and of gap, unit, and the largest value of both."""


@dataclass(frozen=True)
class Spring:
    """A linear spring with a gap.

        force = -k sign(q) max(|q| - g, 0)

    Args:
        stiffness: k, N/m or N·m/rad.
        gap: g, m or rad: how far it goes either way before the spring is met.
    """

    stiffness: float
    gap: float


@dataclass(frozen=True)
class Springs:
    """The springs of a simulator.

    Args:
        springs: coordinate, "ap" or "axial_rotation", -> spring.
        sources: where the numbers come from.
        table: as the file gives them, in its units.
    """

    springs: Mapping[str, Spring]
    sources: tuple[str, ...]
    table: Mapping[str, Mapping[str, float]]


def read_springs(path: str | Path) -> Springs:
    """Read springs from a TOML file: [ap], [axial_rotation], either or both, and `sources`.

    Raises:
        InputError: an unknown or missing key, or a stiffness or gap that is none.
    """
    content = read_toml(path, what="springs")
    sources = content.pop("sources", None)
    if not (isinstance(sources, list) and sources and all(isinstance(s, str) for s in sources)):
        raise InputError("sources is not a list of texts", path, "say where each number comes from")
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
"""Coordinate -> unit as a profile has it, and its size."""


@dataclass(frozen=True, eq=False)
class ForceDrive:
    """Loads of a force-controlled machine on the knee, for each row of the profile.

    Args:
        coordinates: (f, 6) m and rad; the free ones are where the first search begins.
        applied: (f, 6) N and N·m on the femoral component, along each free coordinate.
        free: indices of the free coordinates, the superior-inferior one among them.
        zero: (6,) m and rad, origin of AP, ML and the springs.
        springs: of the machine; None: it has none.
        percent: (f,) of the cycle at each row; None: the rows are evenly spaced.
    """

    coordinates: Array
    applied: Array
    free: tuple[int, ...]
    zero: Array
    springs: Springs | None = None
    percent: Array | None = None

    @property
    def names(self) -> list[str]:
        """The coordinates that are found, but the superior-inferior one."""
        return [KNEE_COORDINATES[i] for i in self.free if i != SI]

    def joint(self, k: int) -> "MachineJoint":
        """Return what acts at row k."""
        stiffness, gap = np.zeros(6), np.zeros(6)
        for name, spring in (self.springs.springs if self.springs else {}).items():
            place = KNEE_COORDINATES.index(name)
            stiffness[place], gap[place] = spring.stiffness, spring.gap
        return MachineJoint(self.free, self.applied[k], stiffness, gap, self.zero)

    def ranges(self, poses: Array, failed: Mapping[int, str]) -> dict[str, float]:
        """Return the lowest and highest place of each coordinate that is found, mm and deg.

        Args:
            poses: (f, 4, 4) that were found.
            failed: row -> why it has none; they are counted.
        """
        counted = self._counted(poses)
        good = [k for k in range(len(poses)) if k not in failed]
        ranges: dict[str, float] = {"failed_rows": len(failed)}
        for name in self.names:
            unit = UNITS[name][0]
            ranges[f"{name}_low_{unit}"] = float(counted[f"{name}_{unit}"][good].min())
            ranges[f"{name}_high_{unit}"] = float(counted[f"{name}_{unit}"][good].max())
        return ranges

    def rows(self, poses: Array, failed: Mapping[int, str]) -> list[dict[str, Any]]:
        """Return each row's position as a profile counts it; None where the row failed."""
        counted = self._counted(poses)
        percent = np.linspace(0.0, 100.0, len(poses)) if self.percent is None else self.percent
        return [
            {
                "cycle_percent": float(percent[k]),
                "status": f"failed: {failed[k]}" if k in failed else "ok",
                **{key: None if k in failed else float(v[k]) for key, v in counted.items()},
            }
            for k in range(len(poses))
        ]

    def _counted(self, poses: Array) -> dict[str, Array]:
        off = knee_coordinates(poses) - self.zero
        return {
            f"{name}_{unit}": off[:, KNEE_COORDINATES.index(name)] / size
            for name, (unit, size) in UNITS.items()
        }


@dataclass(frozen=True, eq=False)
class MachineJoint:
    """Loads on the free coordinates at one row, beside the contact; see the module.

    Args:
        released: indices of the n free coordinates.
        applied: (6,) N and N·m.
        stiffness: (6,) N/m and N·m/rad; zero where there is no spring.
        gap: (6,) m and rad.
        zero: (6,) m and rad, where the springs are in the middle of their gaps.
    """

    released: tuple[int, ...]
    applied: Array
    stiffness: Array
    gap: Array
    zero: Array

    def imbalance(self, coordinates: Array, contact: Array) -> Array:
        """Return r (..., n) at coordinates (..., 6) with w_contact (6,)."""
        off = coordinates - self.zero
        spring = self.stiffness * np.sign(off) * np.maximum(np.abs(off) - self.gap, 0.0)
        driven = self.applied - spring - knee_axes(coordinates) @ contact
        return np.asarray(driven[..., list(self.released)])

    def contact_gain(self, coordinates: Array) -> Array:
        """Return d r / d w_contact (n, 6) at coordinates (6,)."""
        return np.asarray(-knee_axes(coordinates)[list(self.released)])


class RestingPoses:
    """Finds the poses of a drive's rows on one insert, in order, each from the last one found.

    Args:
        model: of the contact.
        state: what its `prepare` returned for the insert.
        drive: what the machine does.
    """

    def __init__(self, model: ContactModel, state: Any, drive: ForceDrive) -> None:
        self._model, self._state, self._drive = model, state, drive
        self._found: Array | None = None
        self._stiffness: Array | None = None

    def at(self, k: int, load: float, start: Guess | None) -> tuple[Array, str]:
        """Return the equilibrium pose (4, 4) of row k, and why there is none; empty: there is one.

        Args:
            k: row.
            load: N, axial.
            start: an earlier contact, or its warm start.
        """
        place = self._drive.coordinates[k].copy()
        if self._found is not None:
            free = list(self._drive.free)
            place[free] = self._found[free]
        first, start = self._model.press_from(self._state, load, knee_pose(place), start)
        if first.status is not ContactStatus.OK:
            why = "; ".join(first.flags) or first.status.value
            return knee_pose(place), f"where the search begins: {why}"
        place[SI] = first.pose[1, 3]
        forces = FreeForces(self._drive.joint(k), self._model.probe(self._state, start), place)
        balance = forces.balance(self._stiffness)
        if balance.status is not BalanceStatus.OK:
            return knee_pose(place), f"no equilibrium: {balance.status.value}"
        self._found, self._stiffness = forces.at(balance), balance.stiffness
        return knee_pose(self._found), ""


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
