"""Points on links, point forces, and their wrenches about the insert's origin."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, cross


@dataclass(frozen=True, eq=False)
class LinkPoint:
    """A point fixed to a link: its name, and the position (3,), m, in its frame."""

    link: str
    position: Array


# m: a point farther from its frame is refused, because it is probably in millimetres.
# A leg is 0.9 m long, and 1 mm is the smallest useful coordinate in millimetres.
MAX_DISTANCE = 1.0


Point = LinkPoint | tuple[str, Sequence[float]]
"""A point on a frame of the model: a `LinkPoint`, or the frame's name and three coordinates, m."""


@dataclass(frozen=True, eq=False)
class PointForces:
    """Forces on one link, at one frame of the motion, insert frame.

    Args:
        points: points of application, (m, 3), m.
        forces: forces, or forces per unit of an unknown magnitude, (m, 3), N.
        moment: free moment on the same link, (3,), N·m.
    """

    link: str
    points: Array
    forces: Array
    moment: Array = field(default_factory=lambda: np.zeros(3))


def scaled(loads: Iterable[PointForces], factor: float) -> list[PointForces]:
    """Return loads times a factor."""
    return [
        PointForces(load.link, load.points, factor * load.forces, factor * load.moment)
        for load in loads
    ]


def wrench_of(points: Array, forces: Array) -> Array:
    """Return force and moment (..., 6) about the origin of forces (..., 3) at points (..., 3)."""
    return np.concatenate([forces, cross(points, forces)], axis=-1)


def wrenches(loads: Sequence[PointForces]) -> Array:
    """Return force and moment (n, 6) of each load about the insert frame's origin."""
    points = np.concatenate([load.points for load in loads])
    forces = np.concatenate([load.forces for load in loads])
    owner = np.repeat(np.arange(len(loads)), [len(load.points) for load in loads])
    x, y, z = points.T
    fx, fy, fz = forces.T
    terms = (fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx)
    result = np.zeros((len(loads), 6))
    for k, term in enumerate(terms):
        result[:, k] = np.bincount(owner, term, len(loads))
    result[:, 3:] += np.array([load.moment for load in loads])
    return result


def total_wrench(loads: Sequence[PointForces], point: Array) -> Array:
    """Return the summed force and moment (6,) of several loads about `point` (3,)."""
    total = wrenches(loads).sum(axis=0)
    total[3:] -= cross(point, total[:3])
    return total


def link_point(point: Point) -> LinkPoint:
    """Return a point on a frame as a `LinkPoint`."""
    link: object = None
    position: object = ()
    if isinstance(point, LinkPoint):
        link, position = point.link, point.position
    elif isinstance(point, tuple | list) and len(point) == 2:
        link, position = point
    try:
        coordinates = np.asarray(position, float)
    except (TypeError, ValueError):
        coordinates = np.empty(0)
    if not isinstance(link, str) or coordinates.shape != (3,) or not np.isfinite(coordinates).all():
        raise InputError(
            f"{point!r} is not a point on a frame",
            "Knee",
            "give (frame name, (x, y, z)) in metres",
        )
    distance = float(np.linalg.norm(coordinates))
    if distance > MAX_DISTANCE:
        raise InputError(
            f"a point lies {distance:.4g} m from the frame '{link}'",
            "Knee",
            "is it in millimetres? give it in metres",
        )
    return LinkPoint(link, coordinates)
