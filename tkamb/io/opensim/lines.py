"""Muscles and ligaments as data: paths, wrap objects and parameters.

SI and radians; points and poses in the bodies themselves.
"""

from dataclasses import dataclass
from typing import Literal

from tkamb.geometry.frames import Array
from tkamb.io.opensim.functions import Function


@dataclass(frozen=True, eq=False)
class PathPoint:
    """A point (3,) m of a body that a path passes through."""

    name: str
    body: str
    location: Array


@dataclass(frozen=True, eq=False)
class ConditionalPathPoint(PathPoint):
    """A path point that counts while a coordinate lies within a range."""

    coordinate: str
    range: tuple[float, float]


@dataclass(frozen=True, eq=False)
class MovingPathPoint:
    """A path point whose three components (m) are functions of coordinates.

    Args:
        name: the point's name.
        body: body in whose frame it moves.
        coordinates: of x, y and z; None: the function's value at zero holds throughout.
        functions: of x, y and z.
    """

    name: str
    body: str
    coordinates: tuple[str | None, ...]
    functions: tuple[Function, ...]


AnyPathPoint = PathPoint | ConditionalPathPoint | MovingPathPoint
Shape = Literal["cylinder", "sphere", "ellipsoid", "torus"]


@dataclass(frozen=True, eq=False)
class WrapObject:
    """A surface that paths pass around, fixed to a body.

    Args:
        name: the object's name.
        body: body that carries it.
        shape: "cylinder" (along its z), "sphere", "ellipsoid" or "torus" (about its z).
        pose: (4, 4) its frame in the body.
        dimensions: m. Cylinder: radius, length; sphere: radius; ellipsoid: semi-axes x, y, z;
            torus: radius of the centre line, radius of the tube.
        quadrant: axis 0, 1 or 2 and sign ±1 of the half on which paths must lie; None: either.
        active: whether paths wrap it.
    """

    name: str
    body: str
    shape: Shape
    pose: Array
    dimensions: tuple[float, ...]
    quadrant: tuple[int, int] | None
    active: bool


@dataclass(frozen=True)
class PathWrap:
    """A wrap object as one path uses it.

    Args:
        wrap_object: the wrap object's name.
        first: index of the first path point of the range within which it may be wrapped.
        last: index of the last one.
        method: "hybrid", "midpoint" or "axial": how OpenSim places an ellipsoid's path.
    """

    wrap_object: str
    first: int
    last: int
    method: str


@dataclass(frozen=True, eq=False)
class Path:
    """Path of a muscle or ligament: points in order, and wrap objects."""

    points: tuple[AnyPathPoint, ...]
    wraps: tuple[PathWrap, ...]


@dataclass(frozen=True, eq=False)
class Muscle:
    """A muscle with the four numbers all of OpenSim's classes share.

    Args:
        name: the muscle's name.
        kind: the file's class, such as "Thelen2003Muscle".
        path: its path.
        max_isometric_force_N: maximal isometric force.
        optimal_fibre_length_m: fibre length at that force.
        tendon_slack_length_m: tendon's length without load.
        pennation_rad: pennation at the optimal fibre length.
        max_contraction_velocity: optimal fibre lengths per second.
        enabled: whether the file lets it act.
    """

    name: str
    kind: str
    path: Path
    max_isometric_force_N: float
    optimal_fibre_length_m: float
    tendon_slack_length_m: float
    pennation_rad: float
    max_contraction_velocity: float
    enabled: bool


@dataclass(frozen=True, eq=False)
class Ligament:
    """A ligament, by one of two laws.

    Blankevoort1991Ligament has `stiffness_N` (N per strain) and `transition_strain`;
    Ligament has `force_length`, N per `scale_N` against length over slack length.

    Args:
        name: the ligament's name.
        kind: "Ligament" or "Blankevoort1991Ligament".
        path: its path.
        slack_length_m: length at which it begins to pull.
        stiffness_N: N per unit strain in the linear part; None for "Ligament".
        transition_strain: where the toe ends and the linear part begins; None for "Ligament".
        damping_s: damping coefficient; None for "Ligament".
        force_length: normalised force over normalised length; None for "Blankevoort…".
        scale_N: what the normalised force is multiplied by; None for "Blankevoort…".
        enabled: whether the file lets it act.
    """

    name: str
    kind: str
    path: Path
    slack_length_m: float
    stiffness_N: float | None
    transition_strain: float | None
    damping_s: float | None
    force_length: Function | None
    scale_N: float | None
    enabled: bool
