"""The interface of every contact model (docs/contact_model.md), and its probe.

It computes pressure and wrench from the pose of the femoral component in the insert. All vectors
are in the insert frame (x anterior, y superior, z to the right), in SI units.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from tkamb.contact.pair import ContactPair
from tkamb.contact.pressing import press_by_search
from tkamb.contact.result import (
    ContactResult,
    ContactStatus,
    Guess,
    WarmStart,
    medial_points,
    wrench_of,
)
from tkamb.contact.samples import SampledContact, sample_surface
from tkamb.geometry.frames import Array, Mask, cross


class ContactModel(ABC):
    """Base class of the contact models.

    A subclass is a frozen dataclass, and its fields are its options. Every model has `resolution`
    (m), the spacing of its map points. A `guess` saves time, and changes the result by no more than
    the tolerance. A model stores nothing between calls. `mobile_bearing` is True if the bottom of a
    mobile bearing slides. If it is False, the model presses it like a fixed one, and presses and
    runs state this in a note. `differentiable` is False if the forces jump between neighbouring
    poses; their derivative is then refused.
    """

    name: ClassVar[str]
    assumes: ClassVar[str]
    needs: ClassVar[str]
    mobile_bearing: ClassVar[bool] = False
    differentiable: ClassVar[bool] = True

    resolution: float

    def prepare(self, pair: ContactPair) -> Any:
        """Return the state of a pair: the work that depends on geometry and material alone.

        By default this is the sampled surface of the insert. A model may return any subclass of
        `tkamb.contact.pair.PreparedContact`.
        """
        pair.touch_at(np.eye(4))
        return SampledContact(pair, sample_surface(pair.insert, self.resolution))

    @abstractmethod
    def evaluate(self, state: Any, pose: Array, guess: Guess | None = None) -> ContactResult:
        """Return the contact at a pose_femoral_in_insert (4, 4)."""

    def press(
        self, state: Any, load: float, pose: Array, guess: Guess | None = None
    ) -> ContactResult:
        """Return the contact at the approach along -y that carries `load` (N).

        The load is the superior-inferior force on the insert; only y of the pose changes. The
        search calls `evaluate`; a model may override it with a faster one.
        """
        return press_by_search(self, state, load, pose, guess)

    def evaluate_from(
        self, state: Any, pose: Array, start: Guess | None = None
    ) -> tuple[ContactResult, WarmStart]:
        """Return the result of `evaluate`, and a warm start for a neighbouring pose."""
        result = self.evaluate(state, pose, start)
        return result, WarmStart.after(result)

    def press_from(
        self, state: Any, load: float, pose: Array, start: Guess | None = None
    ) -> tuple[ContactResult, WarmStart]:
        """Return the result of `press`, and a warm start for a neighbouring pose.

        A model whose solver uses a warm start overrides this and `evaluate_from`.
        """
        result = self.press(state, load, pose, start)
        return result, WarmStart.after(result)

    def probe(self, state: Any, guess: Guess | None = None) -> Any:
        """Return a `Probe`; a model may return a faster one with stiffness."""
        return Probe(self, state, guess)


@dataclass(frozen=True, eq=False)
class CondyleWrench:
    """The wrench of one condyle on the insert.

    Args:
        wrench: (6,) force (N) and moment about the insert's origin (N·m), on the insert.
        centre: (3,) m, centre of pressure.
        stiffness: (6, 6) derivative of the wrench by a small displacement of the femoral component;
            None if it is unknown. The displacement is the translation (m) of the component's point
            at the insert's origin, then the rotation (rad).
        centre_slope: (3, 6) derivative of the centre by the same displacement; None if it is
            unknown. Only friction needs it.
    """

    wrench: Array
    centre: Array
    stiffness: Array | None = None
    centre_slope: Array | None = None

    @cached_property
    def force(self) -> float:
        """N, magnitude of the resultant."""
        return math.sqrt(self.wrench[:3] @ self.wrench[:3])

    @cached_property
    def normal(self) -> Array:
        """(3,) unit, from the insert to the femur: opposite to the force on the insert."""
        return -self.wrench[:3] / self.force

    @property
    def force_slope(self) -> Array:
        """(6,) derivative of the magnitude of the resultant by a displacement, N/m and N/rad."""
        assert self.stiffness is not None
        return -self.normal @ self.stiffness[:3]

    @cached_property
    def point(self) -> Array:
        """(3,) m, the point on the resultant's line of action nearest to the centre.

        Forces of a curved contact are not parallel and have a small moment about their centre of
        pressure. About this point the moment is parallel to the resultant.
        """
        force = self.wrench[:3]
        moment = self.wrench[3:] - cross(self.centre, force)
        return self.centre + cross(force, moment) / (force @ force)


@dataclass(frozen=True, eq=False)
class ProbedContact:
    """The wrenches of a contact at one pose.

    Args:
        condyles: side -> wrench of that condyle; an unloaded condyle is absent.
        known: False if the model is out of range or has not converged.
        tangent: True if the wrenches have a stiffness.
        exact: True if this is the exact tangent.
        accuracy: 1, relative error of the contact force.
        post: wrench of a cam on the insert's post; None if unloaded.
    """

    condyles: dict[str, CondyleWrench]
    known: bool = True
    tangent: bool = False
    exact: bool = True
    accuracy: float = 0.0
    post: CondyleWrench | None = None

    @property
    def loads(self) -> tuple[CondyleWrench, ...]:
        """Wrenches of the loaded condyles and of a loaded post."""
        return (*self.condyles.values(), *(() if self.post is None else (self.post,)))

    @property
    def wrench(self) -> Array:
        """(6,) force (N) and moment about the insert's origin (N·m), on the insert."""
        return sum((load.wrench for load in self.loads), np.zeros(6))


@dataclass(frozen=True, eq=False)
class LoadedPoints:
    """The pressures of the m map points in contact at one pose.

    Args:
        pressure: (m,) Pa.
        area: (m,) m², area of each point.
        medial: (m,) whether a point is under the medial condyle.
        slope: (m, 6) derivative of `pressure` by a displacement, as in `CondyleWrench`; None: not
            asked for.
    """

    pressure: Array
    area: Array
    medial: Mask
    slope: Array | None


class Probe:
    """Evaluates a contact model at neighbouring poses, each with the warm start of the last one.

    `start` is an earlier result or the warm start of the next evaluation. `exact` is True if every
    result contains the tangent and costs less than a press.
    """

    exact: ClassVar[bool] = False

    def __init__(self, model: ContactModel, state: Any, start: Guess | None = None) -> None:
        self._model, self._state, self.start = model, state, start

    def at(self, pose: Array) -> ProbedContact:
        """Return the contact at a pose_femoral_in_insert (4, 4)."""
        result, start = self.evaluated(pose)
        if result.status is not ContactStatus.OK:
            return ProbedContact({}, known=False)
        self.start = start
        return self.seen(result, start)

    def evaluated(self, pose: Array) -> tuple[ContactResult, WarmStart]:
        """Return the contact and a warm start at a pose (4, 4); only its forces must be correct."""
        return self._model.evaluate_from(self._state, pose, self.start)

    def pressed(
        self,
        load: float,
        pose: Array,
        start: Guess | None,
    ) -> tuple[ContactResult, WarmStart]:
        """Return the contact and a warm start under a load (N); only the forces must be correct."""
        return self._model.press_from(self._state, load, pose, start)

    def smoothed(self, pose: Array, contact: ProbedContact) -> ProbedContact:
        """Return the contact with its stiffness averaged over a finite displacement.

        A model without an averaged stiffness returns the contact unchanged.
        """
        return contact

    def exact_tangent(self, contact: ProbedContact) -> ProbedContact:
        """Return a contact of this probe with its exact tangent, if the model has one."""
        return contact

    def seen(self, result: ContactResult, start: WarmStart | None = None) -> ProbedContact:
        """Return the wrenches of the condyles from a result and its warm start."""
        return ProbedContact(condyle_wrenches(result, self._state.pair.split))


def condyle_wrenches(result: ContactResult, split: float | None) -> dict[str, CondyleWrench]:
    """Return the wrench of each loaded condyle on the insert; `split` as in `ContactPair`."""
    magnitude = np.linalg.norm(result.nodal_force, axis=1)
    medial = medial_points(result.points, result.pose, split)
    wrenches = {}
    for side, under_side in (("medial", medial), ("lateral", ~medial)):
        chosen = under_side & (magnitude > 0)
        if chosen.any():
            weight = magnitude[chosen]
            centre = weight @ result.points[chosen] / weight.sum()
            wrench = wrench_of(result.places[chosen], result.nodal_force[chosen])
            wrenches[side] = CondyleWrench(wrench, centre)
    return wrenches
