"""The interface of every contact model (see docs/contact_model.md), and its probe.

*Given this pose of the femoral component in the insert, what pressure and what wrench?*
The work that depends on geometry alone is done once, in `prepare`. All vectors are in the insert
frame (x anterior, y superior, z to the subject's right), SI units.

A `Probe` evaluates many neighbouring poses for a search of equilibrium.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from tkamb.contact.pair import ContactPair
from tkamb.contact.pressing import Presses, press_by_search
from tkamb.contact.result import (
    ContactResult,
    ContactStatus,
    Guess,
    WarmStart,
    medial_points,
    wrench_of,
)
from tkamb.contact.samples import SampledContact, sample_surface
from tkamb.geometry.frames import Array, cross


class ContactModel(ABC):
    """A frozen set of parameters that answers the contract.

    A subclass is a frozen dataclass whose fields are its options; every model takes
    `resolution` (m), the spacing of its map points. `guess`, an earlier result or
    a `WarmStart`, may change the time that an answer takes, but not the answer beyond the
    tolerance; nothing is kept from call to call. `mobile_bearing`: whether a mobile
    bearing's bottom slides; a model that presses it like a fixed one leaves False, and every
    press and run says so.
    """

    name: ClassVar[str]
    assumes: ClassVar[str]
    needs: ClassVar[str]
    mobile_bearing: ClassVar[bool] = False

    resolution: float

    def prepare(self, pair: ContactPair) -> Any:
        """Do the work that depends on geometry and material alone.

        Here: sample the insert's surface, ready the first touch. A model that prepares more
        returns a `tkamb.contact.pair.PreparedContact` of its own.
        """
        pair.touch_at(np.eye(4))
        return SampledContact(pair, sample_surface(pair.insert, self.resolution))

    @abstractmethod
    def evaluate(self, state: Any, pose: Array, guess: Guess | None = None) -> ContactResult:
        """Return the contact at a given pose_femoral_in_insert (4, 4)."""

    def press(
        self, state: Any, load: float, pose: Array, guess: Guess | None = None
    ) -> ContactResult:
        """Find the approach along -y (rotation, x and z as given) that carries `load` (N).

        The load is the superior-inferior force on the insert. This generic search calls
        `evaluate`; a model may bring a faster one.
        """
        return press_by_search(self, state, load, pose, guess)

    def evaluate_from(
        self, state: Any, pose: Array, start: Guess | None = None
    ) -> tuple[ContactResult, WarmStart]:
        """Return what `evaluate` does, and the start for a contact near by."""
        result = self.evaluate(state, pose, start)
        return result, WarmStart.after(result)

    def press_from(
        self, state: Any, load: float, pose: Array, start: Guess | None = None
    ) -> tuple[ContactResult, WarmStart]:
        """Return what `press` does, and the start for a contact near by.

        A model whose solver can begin where another one ended overrides this and
        `evaluate_from`.
        """
        result = self.press(state, load, pose, start)
        return result, WarmStart.after(result)

    def probe(self, state: Any, guess: Guess | None = None) -> Any:
        """Return a `tkamb.contact.model.Probe`: wrenches at many neighbouring poses.

        The generic one calls `evaluate`; a model may bring a faster one, with stiffness.
        """
        return Probe(self, state, guess)


@dataclass(frozen=True, eq=False)
class CondyleWrench:
    """What one condyle does to the insert.

    Args:
        wrench: (6,) force (N) and moment about the insert's origin (N·m), on the insert.
        centre: (3,) m, centre of pressure.
        stiffness: (6, 6) change of the wrench per small displacement of the femoral component
            (of its point at the insert's origin, m, then rotation, rad); None if unknown.
    """

    wrench: Array
    centre: Array
    stiffness: Array | None = None

    @cached_property
    def force(self) -> float:
        """N, magnitude of the resultant."""
        return float(np.linalg.norm(self.wrench[:3]))

    @cached_property
    def normal(self) -> Array:
        """(3,) unit, out of the insert into the femur: against the resultant on the insert."""
        return -self.wrench[:3] / self.force

    @cached_property
    def point(self) -> Array:
        """(3,) m, the point on the resultant's line of action nearest to the centre.

        The nodal forces of a curved contact are not parallel; about their centre of pressure
        they leave a small moment, about this point only its part along the resultant.
        """
        force = self.wrench[:3]
        moment = self.wrench[3:] - cross(self.centre, force)
        # Point of the resultant's line that is nearest to the centre: the moment about it is
        # parallel to the force.
        return self.centre + cross(force, moment) / (force @ force)


@dataclass(frozen=True, eq=False)
class ProbedContact:
    """The contact at one pose, condyle by condyle; an unloaded side is absent.

    Args:
        condyles: side -> wrench.
        known: False where the model is out of range or has not converged.
        tangent: whether the condyles' stiffness is known.
        exact: whether that stiffness is the exact tangent, not an approximation.
        accuracy: share of the contact force to which the model knows it.
        post: what a cam does to the insert's post; None where it carries nothing.
    """

    condyles: dict[str, CondyleWrench]
    known: bool = True
    tangent: bool = False
    exact: bool = True
    accuracy: float = 0.0
    post: CondyleWrench | None = None

    @property
    def loads(self) -> tuple[CondyleWrench, ...]:
        """Wrench of each condyle, and of the post."""
        return (*self.condyles.values(), *(() if self.post is None else (self.post,)))

    @property
    def wrench(self) -> Array:
        """(6,) on the insert."""
        return sum((load.wrench for load in self.loads), np.zeros(6))


class Probe:
    """The probe of any model: `evaluate`, each pose the start of the next.

    Args:
        model: any contact model.
        state: what its `prepare` returned.
        start: an earlier result or warm start.

    Attributes:
        exact: every answer brings the tangent, and it costs less than a press.
        start: where the next evaluation begins.
    """

    exact: ClassVar[bool] = False

    def __init__(self, model: Presses, state: Any, start: Guess | None = None) -> None:
        self._model, self._state, self.start = model, state, start

    def at(self, pose: Array) -> ProbedContact:
        """Return the contact at a pose_femoral_in_insert (4, 4)."""
        result, start = self.evaluated(pose)
        if result.status is not ContactStatus.OK:
            return ProbedContact({}, known=False)
        self.start = start
        return self.seen(result, start)

    def evaluated(self, pose: Array) -> tuple[ContactResult, WarmStart]:
        """Return the contact at a pose (4, 4), of which only the forces need be right."""
        return self._model.evaluate_from(self._state, pose, self.start)

    def pressed(
        self,
        load: float,
        pose: Array,
        start: Guess | None,
    ) -> tuple[ContactResult, WarmStart]:
        """Return the contact under a load (N), of which only the forces need be right.

        Args:
            load: N.
            pose: (4, 4) pose_femoral_in_insert.
            start: of a contact at a neighbouring pose.
        """
        return self._model.press_from(self._state, load, pose, start)

    def smoothed(self, pose: Array, contact: ProbedContact) -> ProbedContact:
        """Return the contact with a stiffness averaged over a finite displacement.

        Args:
            pose: (4, 4) pose_femoral_in_insert.
            contact: contact at that pose. A model without an averaged stiffness returns it.
        """
        return contact

    def seen(self, result: ContactResult, start: WarmStart | None = None) -> ProbedContact:
        """Return what a result, and the warm start that came with it, say of the condyles."""
        return ProbedContact(condyle_wrenches(result, self._state.pair.split))


def condyle_wrenches(result: ContactResult, split: float | None) -> dict[str, CondyleWrench]:
    """Return what each condyle that carries load does to the insert.

    Args:
        result: a contact.
        split: z (m, femoral frame) between the condyles; None: one condyle, medial.
    """
    magnitude = np.linalg.norm(result.nodal_force, axis=1)
    medial = medial_points(result.points, result.pose, split)
    wrenches = {}
    for side, own in (("medial", medial), ("lateral", ~medial)):
        chosen = own & (magnitude > 0)
        if chosen.any():
            weight = magnitude[chosen]
            centre = weight @ result.points[chosen] / weight.sum()
            wrench = wrench_of(result.points[chosen], result.nodal_force[chosen])
            wrenches[side] = CondyleWrench(wrench, centre)
    return wrenches
