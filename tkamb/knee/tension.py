"""Muscles of given tension: lines between any frames of a model, and what tensions are allowed."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array, cross
from tkamb.knee.anatomy import Anatomy, Place
from tkamb.knee.muscles import Muscle
from tkamb.knee.parts import link_point


@dataclass(frozen=True, eq=False)
class TensionLine:
    """A line of given tension, straight from point to point.

    Args:
        places: the frames that its points are fixed to.
        positions: (3,) m each, of the points in these frames.
    """

    places: tuple[Place, ...]
    positions: tuple[Array, ...]

    def forces(self, data: Any, tension: float) -> list[tuple[int, pin.Force]]:
        """Return joints, and the forces on them in their own frames.

        Args:
            data: Pinocchio's, with joint placements up to date.
            tension: N.
        """
        placements = [data.oMi[place.joint] for place in self.places]
        points = [
            placement.act(place.placement.act(position))
            for placement, place, position in zip(
                placements, self.places, self.positions, strict=True
            )
        ]
        steps = np.diff(np.array(points), axis=0)
        along = steps / np.linalg.norm(steps, axis=1, keepdims=True)
        pulls = tension * np.concatenate([along[:1], np.diff(along, axis=0), -along[-1:]])
        return [
            (place.joint, placement.actInv(pin.Force(pull, cross(point, pull))))
            for placement, place, point, pull in zip(
                placements, self.places, points, pulls, strict=True
            )
        ]


def tension_lines(muscles: Iterable[Muscle], anatomy: Anatomy) -> dict[str, TensionLine]:
    """Return muscle -> its line.

    Raises:
        InputError: fewer than two points, a wrap, or no such frame.
    """
    lines = {}
    for muscle in muscles:
        points = [link_point(point) for point in muscle.points]
        if len(points) < 2 or muscle.wrap is not None:
            raise InputError(
                "is no straight line over two points or more",
                f"muscle {muscle.name}",
                "give its points; a quadriceps that wraps belongs to extensor=",
            )
        places = tuple(anatomy.frame(point.link) for point in points)
        lines[muscle.name] = TensionLine(places, tuple(point.position for point in points))
    return lines


def checked_tensions(
    tensions: Mapping[str, float] | float | None, extensor: tuple[str, ...], lines: Iterable[str]
) -> dict[str, float]:
    """Return muscle -> N.

    Args:
        tensions: as given; a number alone is the quadriceps'.
        extensor: names of the extensor mechanism's lines, the quadriceps first.
        lines: names of the other muscles.

    Raises:
        InputError: an unknown muscle, or a tension that is negative or not finite.
    """
    if tensions is None:
        return {}
    if not isinstance(tensions, Mapping):
        if not extensor:
            raise InputError("has no quadriceps", "tensions", "give extensor=, or names")
        tensions = {extensor[0]: tensions}
    names = (*extensor, *lines)
    for name, tension in tensions.items():
        if name not in names:
            raise InputError(f"no muscle '{name}'", "tensions", names_near(name, list(names)))
        if not (np.isfinite(tension) and tension >= 0.0):
            raise InputError(f"tension {tension} N", f"muscle {name}", "a muscle only pulls")
    return {name: float(tension) for name, tension in tensions.items()}
