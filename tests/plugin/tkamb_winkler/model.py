"""A Winkler foundation: springs along the insert's normal, with a uniform stiffness per area."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tkamb.contact.model import ContactModel
from tkamb.contact.result import ContactResult
from tkamb.contact.samples import gaps_along_normals


@dataclass(frozen=True)
class Winkler(ContactModel):
    """Pressure = modulus times penetration, for any material and thickness."""

    name: ClassVar[str] = "winkler"
    assumes: ClassVar[str] = "springs of one stiffness per area"
    needs: ClassVar[str] = "a closed insert"

    resolution: float = 1e-3  # m, of the map
    modulus: float = 2e11  # Pa/m

    def evaluate(self, state, pose, guess=None):
        """Return the contact at a pose."""
        gap = gaps_along_normals(state.surface, state.pair.femoral, pose)
        return ContactResult.of(state, pose, self.modulus * np.maximum(-gap, 0.0), gap)
