"""Contact points of the condyles on the insert, lift-off, and misplaced poses."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.closest import ClosestPointQuery, CondyleGap, CondyleGaps


@dataclass(frozen=True)
class ContactPointSettings:
    """Limits of lift-off, gap and sliding speed of the condyles."""

    lift_off_angle: float = 0.5 * DEGREE
    """rad: a condyle is lifted off if the coronal angle from both gaps exceeds this angle, and the
    condyle's gap exceeds `lift_off_gap`. Source: error of fluoroscopy (Sharma 2008, 4.3)."""
    lift_off_gap: float = 0.5 * MILLIMETRE
    """m: gap above which a condyle may be lifted off, see `lift_off_angle`. Source: error of
    fluoroscopy (Sharma 2008, 4.3)."""
    max_gap: float = 3e-3
    """m: a femoral component with a larger gap or penetration is misplaced. Chosen because it is
    larger than the errors of fluoroscopy."""
    standstill_speed: float = 1e-3
    """m/s: v0 of the regularised friction. Friction fades below this sliding speed. Chosen because
    it is far below the sliding speed of a moving knee."""


CONTACT_POINT = ContactPointSettings()


@dataclass(frozen=True, eq=False)
class CondylePoint:
    """The contact point of one condyle on the insert, insert frame.

    Args:
        point: position, shape (3,), m.
        normal: unit normal from the insert to the femur, shape (3,).
        sliding: velocity of the femur relative to the insert at the point, shape (3,), m/s.
        gap: gap, positive when apart, m.
    """

    point: Array
    normal: Array
    sliding: Array
    gap: float

    def direction(self, friction: float) -> Array:
        """Return the contact force on the femur (3,) per unit normal force.

        The result is n - mu t with t = v / sqrt(|v|² + v0²) for the tangential velocity v: Coulomb
        friction that fades below v0 = 1 mm/s.
        """
        tangential = self.sliding - (self.sliding @ self.normal) * self.normal
        # Without v0 the direction of the force would jump when the sliding reverses.
        speed = np.sqrt(tangential @ tangential + CONTACT_POINT.standstill_speed**2)
        return np.asarray(self.normal - friction * tangential / speed)


@dataclass(frozen=True, eq=False)
class ContactPoints:
    """The femorotibial contact of one pose, as input of the equations.

    Args:
        condyles: side -> contact point; empty: contact is not modelled.
        lifted: sides that are lifted off the insert.
        problems: reasons why the pose cannot be used; empty: it can be used.
    """

    condyles: dict[str, CondylePoint]
    lifted: frozenset[str]
    problems: tuple[str, ...]


NO_CONTACT = ContactPoints({}, frozenset(), ())
"""Contact points of a frame in which contact is not modelled."""


def contact_points(
    query: "ClosestPointQuery", pose: Array, sliding: Callable[[Array], Array]
) -> ContactPoints:
    """Return the contact points of a pose.

    Args:
        query: closest points of the pair.
        pose: pose_femoral_in_insert, shape (4, 4).
        sliding: function of a point (3,), m, insert frame. It returns the velocity (3,), m/s, of
            the femur relative to the insert at that point.
    """
    gaps = query.at(pose)
    condyle_gaps = {"medial": gaps.medial} | ({"lateral": gaps.lateral} if gaps.lateral else {})
    condyles = {side: _condyle(gap, sliding) for side, gap in condyle_gaps.items()}
    nearest = nearest_gap(gaps)
    problems: tuple[str, ...] = ()
    if abs(nearest) > CONTACT_POINT.max_gap:
        state = "apart" if nearest > 0 else "overlapping"
        problems = (f"condyles {state} by {abs(nearest) / MILLIMETRE:.1f} mm",)
    return ContactPoints(condyles, _find_lifted(condyles), problems)


def nearest_gap(gaps: "CondyleGaps") -> float:
    """Return the smallest gap (m) of the condyles."""
    return min(gap.gap for gap in (gaps.medial, gaps.lateral) if gap is not None)


def _condyle(gap: "CondyleGap", sliding: Callable[[Array], Array]) -> CondylePoint:
    return CondylePoint(gap.centre, gap.normal, sliding(gap.centre), gap.gap)


def _find_lifted(condyles: dict[str, CondylePoint]) -> frozenset[str]:
    if len(condyles) < 2:
        return frozenset()
    medial, lateral = condyles["medial"], condyles["lateral"]
    # z is medial-lateral: the width is the distance of the contact points in the coronal plane.
    width = abs(lateral.point[2] - medial.point[2])
    higher = "lateral" if lateral.gap > medial.gap else "medial"
    # The coronal angle is small: it is the difference of the gaps over the width.
    tilted = abs(lateral.gap - medial.gap) > CONTACT_POINT.lift_off_angle * width
    return frozenset(
        {higher} if tilted and condyles[higher].gap > CONTACT_POINT.lift_off_gap else ()
    )
