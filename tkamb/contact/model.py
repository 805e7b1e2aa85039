"""The contract that every contact model answers (see docs/contact_model.md).

*Given this pose of the femoral component in the insert, what pressure and what wrench?*
The work that depends on geometry alone is done once, in `prepare`. All vectors are in the insert
frame (x anterior, y superior, z to the subject's right), SI units.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from tkamb.contact.pair import ContactPair
from tkamb.contact.pressing import press_by_search
from tkamb.contact.probe import Probe
from tkamb.contact.result import ContactResult
from tkamb.contact.samples import SampledContact, sample_surface
from tkamb.contact.warm_start import Guess, WarmStart
from tkamb.geometry.frames import Array


class ContactModel(ABC):
    """A frozen set of parameters that answers the contract.

    A subclass is a frozen dataclass whose fields are its options; every model takes
    `resolution` (m), the spacing of its map points. `guess`, an earlier
    result or a `WarmStart`, may change the time that an answer takes, never the answer beyond
    tolerance; nothing is remembered from call to call. `mobile_bearing`: whether a mobile
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
        """Return a `tkamb.contact.probe.Probe`: wrenches at many neighbouring poses.

        The generic one calls `evaluate`; a model may bring a faster one, with stiffness.
        """
        return Probe(self, state, guess)
