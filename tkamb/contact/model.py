"""The contract that every contact model answers.

*Given this pose of the femoral component in the insert, what pressure and what wrench?*
What depends on geometry alone is paid once, in `prepare`. All vectors are in the insert
frame (x anterior, y superior, z to the subject's right), SI units.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.materials import Material
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import Array
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

Bearing = Literal["fixed", "mobile"]


class ContactStatus(Enum):
    """How an evaluation ended."""

    OK = "ok"
    NOT_CONVERGED = "not_converged"
    OUT_OF_RANGE = "out_of_range"


@dataclass(frozen=True, eq=False)
class ContactPair:
    """The two bodies and what the insert is made of.

    Args:
        femoral: rigid femoral component, in the femoral frame.
        insert: closed insert, in the insert frame, flat bottom in y = 0 facing -y.
        material: the insert's material.
        bearing: "fixed" (bottom glued) or "mobile" (bottom slides in x and z).
    """

    femoral: Surface
    insert: Surface
    material: Material
    bearing: Bearing = "fixed"

    @cached_property
    def femoral_rays(self) -> RayCaster:
        """Rays against the femoral component, in its own frame."""
        return RayCaster(self.femoral)

    @cached_property
    def insert_rays(self) -> RayCaster:
        """Rays against the insert."""
        return RayCaster(self.insert)

    @cached_property
    def first_touch(self) -> FirstTouch:
        """How far the femoral component travels until either condyle touches."""
        return FirstTouch(self.femoral, self.insert, rays=(self.femoral_rays, self.insert_rays))


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


class PreparedContact(ABC):
    """What `prepare` returns: read-only, holds the map's points and their triangles."""

    pair: ContactPair
    points: Array
    triangles: NDArray[np.int64]

    @property
    def node_count(self) -> int:
        """Nodes that the model solves for; the map's points where it has no others."""
        return len(self.points)


class ContactModel(ABC):
    """A frozen set of parameters that answers the contract.

    A subclass is a frozen dataclass whose fields are its options; every model takes
    `resolution` (m), the spacing of its map points. `guess` may change the time that an
    answer takes, never the answer beyond tolerance.
    """

    name: ClassVar[str]
    assumes: ClassVar[str]
    needs: ClassVar[str]

    @abstractmethod
    def prepare(self, pair: ContactPair) -> Any:
        """Do the work that depends on geometry and material alone."""

    @abstractmethod
    def evaluate(
        self, state: Any, pose: Array, guess: ContactResult | None = None
    ) -> ContactResult:
        """Return the contact at a given pose_femoral_in_insert (4, 4)."""

    def press(
        self, state: Any, load: float, pose: Array, guess: ContactResult | None = None
    ) -> ContactResult:
        """Find the approach along -y (rotation, x and z as given) that carries `load` (N).

        The load is the superior-inferior force on the insert. This generic search calls
        `evaluate`; a model may bring a faster one.
        """
        from tkamb.contact.pressing import press_by_search

        return press_by_search(self, state, load, pose, guess)

    def probe(self, state: Any, guess: ContactResult | None = None) -> Any:
        """Return a `tkamb.contact.probe.Probe`: wrenches at many neighbouring poses.

        The generic one calls `evaluate`; a model may bring a faster one, with stiffness.
        """
        from tkamb.contact.probe import Probe

        return Probe(self, state, guess)
