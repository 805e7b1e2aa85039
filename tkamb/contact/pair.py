"""The two bodies of a contact, and the state that a contact model prepares from them."""

import copy
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from tkamb.contact.flags import ArticularEdge
from tkamb.contact.materials import Material
from tkamb.errors import InputError
from tkamb.geometry.condyles import condyle_split
from tkamb.geometry.first_touch import FirstTouch, Touch
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.closest import ClosestPointQuery

Bearing = Literal["fixed", "mobile"]

MAX_UNLOADED_APPROACH = 0.5 * MILLIMETRE
"""m: approach above which a contact without load is out of range. A sphere of 20 mm touches between
map points of 3 mm up to 0.06 mm.
"""


@dataclass(frozen=True, eq=False)
class ContactPair:
    """The two bodies of a contact and the insert's material.

    Args:
        femoral: rigid femoral component, in the femoral frame.
        insert: closed insert, in the insert frame; its flat bottom lies in y = 0 and faces -y.
        bearing: "fixed" (the bottom is bonded) or "mobile" (the bottom slides in x and z).
    """

    femoral: Surface
    insert: Surface
    material: Material
    bearing: Bearing = "fixed"

    def __post_init__(self) -> None:
        if self.bearing not in get_args(Bearing):
            raise InputError(f"bearing {self.bearing!r}", "Implant", "give 'fixed' or 'mobile'")

    @cached_property
    def split(self) -> float | None:
        """z (m, femoral frame) between the condyles; None for one condyle, which is medial."""
        return condyle_split(self.femoral)

    @cached_property
    def first_touch(self) -> FirstTouch:
        """Query of the travel along -y to first touch."""
        return FirstTouch(self.femoral, self.insert, self.split)

    @cached_property
    def articular_edge(self) -> ArticularEdge:
        """Edge of the insert's articular surface."""
        return ArticularEdge.of(self.insert)

    @cached_property
    def closest_points(self) -> "ClosestPointQuery":
        """Query of the closest points of the two undeformed bodies."""
        from tkamb.geometry.closest import ClosestPointQuery

        return ClosestPointQuery(self.femoral, self.insert, self.split)

    def of_material(self, material: Material) -> "ContactPair":
        """Return the pair with another material; it shares the geometry computed so far."""
        other = copy.copy(self)
        object.__setattr__(other, "material", material)
        return other

    def touch_at(self, pose: Array) -> Touch | None:
        """Return the first touch of either condyle; its travel starts at y = 0.

        y of the pose has no influence. None if the femoral component does not lie over the insert
        or the pose is not finite. The last eight results are cached.
        """
        level = np.array(pose, float)
        if not np.isfinite(level).all():
            return None
        level[1, 3] = 0.0
        return _first_touch(self, level.tobytes())

    def first_touch_height(self, pose: Array) -> float:
        """Return the y (m) of the femoral origin at which the bodies first touch; NaN if never."""
        touch = self.touch_at(pose)
        return math.nan if touch is None else -touch.travel

    def approach(self, pose: Array) -> float:
        """Return the travel along -y since first touch (m) at a pose; 0 when apart."""
        depth = self.first_touch_height(pose) - float(pose[1, 3])
        return depth if depth > 0 else 0.0

    def passed_through(self, pose: Array) -> str | None:
        """Return words for an unloaded contact far beyond first touch; else None.

        There a model whose columns lie inside or above the femoral component finds no contact.
        """
        approach = self.approach(pose)
        if approach <= MAX_UNLOADED_APPROACH:
            return None
        return (
            f"the femoral component lies {approach / MILLIMETRE:.1f} mm below first touch, but "
            "nothing is loaded: it is pushed through the insert or lies below it"
        )

    def pose_at_approach(self, pose: Array, approach: float) -> Array:
        """Return the pose moved along y to an approach (m)."""
        pose_at = np.array(pose, float)
        pose_at[1, 3] = self.first_touch_height(pose) - approach
        return pose_at


@lru_cache(maxsize=8)
def _first_touch(pair: ContactPair, level: bytes) -> Touch | None:
    return pair.first_touch.either(np.frombuffer(level).reshape(4, 4))


@dataclass(frozen=True, eq=False)
class ContactSurface:
    """The points of a pressure map, on the insert's articular surface.

    Args:
        points: (n, 3) m, insert frame, on the undeformed insert.
        normals: (n, 3) outward unit normals.
        area: (n,) m², tributary area of each point on the true surface, not projected.
        thickness: (n,) m, insert below each point along y.
        triangles: (k, 3) point numbers of triangles between neighbouring points, facing up.
    """

    points: Array
    normals: Array
    area: Array
    thickness: Array
    triangles: Index


@dataclass(frozen=True, eq=False)
class PreparedContact:
    """The read-only state that a model's `prepare` returns; a subclass may add fields."""

    pair: ContactPair
    surface: ContactSurface

    @property
    def points(self) -> Array:
        """Map points (n, 3) m, insert frame."""
        return self.surface.points

    @property
    def triangles(self) -> Index:
        """Map triangles (k, 3)."""
        return self.surface.triangles

    @property
    def node_count(self) -> int:
        """Number of nodes that the model solves for; by default the number of map points."""
        return len(self.points)
