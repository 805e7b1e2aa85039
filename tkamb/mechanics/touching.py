"""Where the condyles touch the insert: contact points, which of them are off, what is wrong."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tkamb.body.unknowns import CondylePoint
from tkamb.geometry.frames import Array
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.closest import ClosestPointQuery, CondyleGap, CondyleGaps

LIFT_OFF_ANGLE = 0.5 * DEGREE
LIFT_OFF_GAP = 0.5 * MILLIMETRE
"""A condyle is off the insert where both its gap and the coronal angle of the two gaps exceed
what fluoroscopy errs by (Sharma 2008, 4.3)."""

FARTHEST_GAP = 3e-3
"""m: a femoral component farther from the insert, or deeper in it, is misplaced."""


@dataclass(frozen=True, eq=False)
class Touching:
    """The femorotibial contact of one pose, as the equations take it.

    Args:
        condyles: side -> contact point; empty when contact is not modelled.
        lifted: sides that are clearly off the insert.
        problems: plain words; empty when all is well.
    """

    condyles: dict[str, CondylePoint]
    lifted: frozenset[str]
    problems: tuple[str, ...]


NOWHERE = Touching({}, frozenset(), ())
"""Contact is not modelled."""


def touching(
    query: "ClosestPointQuery", pose: Array, sliding: Callable[[Array], Array]
) -> Touching:
    """Return the contact points of a pose.

    Args:
        query: closest points of the pair.
        pose: (4, 4) pose_femoral_in_insert.
        sliding: point (3,) m, insert frame -> velocity (3,) m/s of the femur's relative to the
            insert's there.
    """
    gaps = query.at(pose)
    found = {"medial": gaps.medial} | ({"lateral": gaps.lateral} if gaps.lateral else {})
    condyles = {side: _condyle(gap, sliding) for side, gap in found.items()}
    nearest = nearest_gap(gaps)
    problems: tuple[str, ...] = ()
    if abs(nearest) > FARTHEST_GAP:
        word = "apart" if nearest > 0 else "overlapping"
        problems = (f"condyles {word} by {abs(nearest) / MILLIMETRE:.1f} mm",)
    return Touching(condyles, _lifted(condyles), problems)


def nearest_gap(gaps: "CondyleGaps") -> float:
    """Return the smallest gap (m) of the condyles."""
    return min(gap.gap for gap in (gaps.medial, gaps.lateral) if gap is not None)


def _condyle(gap: "CondyleGap", sliding: Callable[[Array], Array]) -> CondylePoint:
    return CondylePoint(gap.centre, gap.normal, sliding(gap.centre), gap.gap)


def _lifted(condyles: dict[str, CondylePoint]) -> frozenset[str]:
    if len(condyles) < 2:
        return frozenset()
    medial, lateral = condyles["medial"], condyles["lateral"]
    width = abs(lateral.point[2] - medial.point[2])
    higher = "lateral" if lateral.gap > medial.gap else "medial"
    tilted = abs(lateral.gap - medial.gap) > LIFT_OFF_ANGLE * width
    return frozenset({higher} if tilted and condyles[higher].gap > LIFT_OFF_GAP else ())
