"""The two bodies of a contact, and what a model prepares of them."""

from abc import ABC
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.materials import Material
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import Array
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

Bearing = Literal["fixed", "mobile"]


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
        return self.femoral.rays

    @cached_property
    def insert_rays(self) -> RayCaster:
        """Rays against the insert."""
        return self.insert.rays

    @cached_property
    def first_touch(self) -> FirstTouch:
        """How far the femoral component travels until either condyle touches."""
        return FirstTouch(self.femoral, self.insert)


class PreparedContact(ABC):
    """What `prepare` returns: read-only, holds the map's points and their triangles."""

    pair: ContactPair
    points: Array
    triangles: NDArray[np.int64]

    @property
    def node_count(self) -> int:
        """Nodes that the model solves for; the map's points where it has no others."""
        return len(self.points)
