"""Force control of the virtual simulator: equilibrium of applied forces, springs and contact.

Of the knee coordinates q (`tkamb.geometry.frames`), flexion and the ones that the profile
prescribes are given. The others, always including the superior-inferior one, follow from
equilibrium:

    r_i(q) = F_i - S_i(q_i) - J_i(q) . w_contact(q) = 0

F_i is the force (N, along the insert's axis through the origin of the femoral mesh) or torque (N·m,
about the coordinate's axis through that origin) that the machine applies to the femoral component,
S_i the spring's, J of `knee_axes`, w_contact the wrench on the insert. The axial force is -F on the
superior-inferior coordinate. Quasi-static and without friction.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tkamb.contact.model import ContactModel
from tkamb.contact.result import ContactStatus, Guess
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_axes, knee_coordinates, knee_pose
from tkamb.knee.balance import BalanceStatus
from tkamb.knee.released_forces import FreeForces
from tkamb.studies.wear.springs import Springs
from tkamb.units import DEGREE, MILLIMETRE

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
