"""The two bodies of a contact, and the state that a model prepares from them."""

import copy
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from tkamb.contact.flags import ArticularEdge
from tkamb.contact.materials import Material
from tkamb.geometry.condyles import condyle_split
from tkamb.geometry.first_touch import FirstTouch, Touch
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.surface import Surface

if TYPE_CHECKING:
    from tkamb.geometry.closest import ClosestPointQuery

Bearing = Literal["fixed", "mobile"]


@dataclass(frozen=True, eq=False)
class ContactPair:
    """The two bodies of a contact and the insert's material.

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
    def split(self) -> float | None:
        """z (m, femoral frame) between the condyles; None: one condyle, called medial."""
        return condyle_split(self.femoral)

    @cached_property
    def first_touch(self) -> FirstTouch:
        """Object that finds the travel of the femoral component until each condyle touches."""
        return FirstTouch(self.femoral, self.insert, self.split)

    @cached_property
    def articular_edge(self) -> ArticularEdge:
        """Edge of the insert's articular surface."""
        return ArticularEdge.of(self.insert)

    @cached_property
    def closest_points(self) -> "ClosestPointQuery":
        """Object that finds the closest points of the two undeformed bodies."""
        from tkamb.geometry.closest import ClosestPointQuery

        return ClosestPointQuery(self.femoral, self.insert, self.split)

    def of_material(self, material: Material) -> "ContactPair":
        """Return the pair with another material; computed geometry is kept."""
        other = copy.copy(self)
        object.__setattr__(other, "material", material)
        return other

    def touch_at(self, pose: Array) -> Touch | None:
        """Return the first touch of either condyle; the travel starts at y = 0.

        The pose's own y does not matter. The result is None if the femoral component does not lie
        over the insert or the pose is not finite. The last eight results are cached.
        """
        level = np.array(pose, float)
        if not np.isfinite(level).all():
            return None
        level[1, 3] = 0.0
        return _first_touch(self, level.tobytes())

    def first_touch_height(self, pose: Array) -> float:
        """Return the y (m) of the femoral origin at which the bodies first touch.

        It depends on the rotation, x and z of pose_femoral_in_insert, not on its y. It is NaN if
        there is no touch.
        """
        touch = self.touch_at(pose)
        return math.nan if touch is None else -touch.travel

    def approach(self, pose: Array) -> float:
        """Return the travel along -y since first touch (m) at a pose; 0 when apart."""
        depth = self.first_touch_height(pose) - float(pose[1, 3])
        return depth if depth > 0 else 0.0

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
        triangles: (k, 3) of neighbouring points, facing up.
    """

    points: Array
    normals: Array
    area: Array
    thickness: Array
    triangles: Index


@dataclass(frozen=True, eq=False)
class PreparedContact:
    """The state that `prepare` returns: read-only; a model may add fields in a subclass.

    Args:
        pair: the two bodies.
        surface: the points of every map of this state.
    """

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
