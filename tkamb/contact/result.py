"""What a contact model finds at one pose: pressure map, wrench, and what each condyle carries."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

from tkamb.geometry.frames import Array


class ContactStatus(Enum):
    """How an evaluation ended."""

    OK = "ok"
    NOT_CONVERGED = "not_converged"
    OUT_OF_RANGE = "out_of_range"


@dataclass(frozen=True, eq=False)
class CondyleContact:
    """What one condyle carries.

    Args:
        force: N, magnitude of the summed normal forces on the insert.
        area: m², area in contact.
        mean_pressure: Pa, force / area.
        peak_pressure: Pa.
        centre_of_pressure: (3,) m, insert frame.
        thickness: m, insert under the centre of pressure, along y.
    """

    force: float
    area: float
    mean_pressure: float
    peak_pressure: float
    centre_of_pressure: Array
    thickness: float


class _WhenRead:
    """A field that may be given as a function, which is called when the field is first read."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = f"_{name}"

    def __get__(self, instance: Any, owner: type) -> float:
        if instance is None:
            raise AttributeError("no default")
        value = instance.__dict__[self._name]
        if callable(value):
            value = instance.__dict__[self._name] = float(value())
        return float(value)

    def __set__(self, instance: Any, value: float | Callable[[], float]) -> None:
        instance.__dict__[self._name] = value


@dataclass(frozen=True, eq=False)
class ContactResult:
    """Pressure map and wrench at one pose.

    The map has the same n points in every result of one state. Arrays are in the insert
    frame, SI.

    Args:
        pose: (4, 4) pose_femoral_in_insert at which it holds (after pressing in).
        points: (n, 3) map points on the undeformed insert.
        normals: (n, 3) outward unit normals of the insert there.
        pressure: (n,) Pa, >= 0.
        area: (n,) m², tributary area of each point (true surface, not projected).
        gap: (n,) m, positive when apart.
        nodal_force: (n, 3) N on the insert.
        wrench_on_insert: (6,) force (N) and moment about the insert origin (N·m).
        medial: what the medial condyle (or the only one) carries; None when nothing.
        lateral: what the lateral condyle carries; None when nothing, or no such condyle.
        approach: m, travel along -y since first touch; 0 when apart. A model that does not
            need it may give a function of no argument, called when it is first read.
        status: how the evaluation ended.
        iterations: of the model's own solver.
        residual: relative residual of that solver.
        flags: plain words for what a reader must know (strain below -0.4, ...).
    """

    pose: Array
    points: Array
    normals: Array
    pressure: Array
    area: Array
    gap: Array
    nodal_force: Array
    wrench_on_insert: Array
    medial: CondyleContact | None
    lateral: CondyleContact | None
    approach: float = _WhenRead()  # type: ignore[assignment]
    status: ContactStatus = ContactStatus.OK
    iterations: int = 0
    residual: float = 0.0
    flags: tuple[str, ...] = ()
