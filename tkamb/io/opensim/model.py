"""Data of an OpenSim model: bodies, joints, constraints, markers, muscles, ligaments, functions.

Values are in SI units and rad. Points and poses are in the frames of the bodies or "ground", also
if the file gives them in offset frames.

References: Delp et al., IEEE Trans Biomed Eng 54:1940 (2007), doi:10.1109/TBME.2007.901024;
Seth et al., PLoS Comput Biol 14:e1006223 (2018), doi:10.1371/journal.pcbi.1006223.

Every function takes an array of any shape and returns an array of the same shape.

Reference: Forsythe, Malcolm & Moler, Computer Methods for Mathematical Computations (1977),
chapter 4, for the spline's end conditions.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import PPoly, make_interp_spline

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.knee.wrap_object import WrapObject


class Function(Protocol):
    """A function of one variable with its first two derivatives."""

    def __call__(self, x: Array) -> Array:
        """Return the values at x."""
        ...

    def slope(self, x: Array) -> Array:
        """Return the first derivatives at x."""
        ...

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives at x."""
        ...


@dataclass(frozen=True)
class Linear:
    """f(x) = gradient x + offset; a constant has gradient 0."""

    gradient: float
    offset: float

    def __call__(self, x: Array) -> Array:
        """Return the values at x."""
        return self.gradient * x + self.offset

    def slope(self, x: Array) -> Array:
        """Return the first derivatives at x."""
        return np.full_like(x, self.gradient)

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives at x."""
        return np.zeros_like(x)


@dataclass(frozen=True, eq=False)
class Polynomial:
    """f(x) = c_0 xⁿ + … + c_n.

    Args:
        coefficients: (n+1,), beginning with the coefficient of the highest power.
    """

    coefficients: Array

    def __call__(self, x: Array) -> Array:
        """Return the values at x."""
        return np.asarray(np.polyval(self.coefficients, x), float)

    def slope(self, x: Array) -> Array:
        """Return the first derivatives at x."""
        return np.asarray(np.polyval(np.polyder(self.coefficients), x))

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives at x."""
        return np.asarray(np.polyval(np.polyder(self.coefficients, 2), x))


class Piecewise:
    """A piecewise polynomial with linear extrapolation beyond its ends."""

    def __init__(self, pieces: PPoly) -> None:
        self._value, self._slope = pieces, pieces.derivative()
        self._curvature = pieces.derivative(2)
        self.first, self.last = float(pieces.x[0]), float(pieces.x[-1])

    def __call__(self, x: Array) -> Array:
        """Return the values at x."""
        inside = np.clip(x, self.first, self.last)
        return self._value(inside) + self._slope(inside) * (x - inside)

    def slope(self, x: Array) -> Array:
        """Return the first derivatives at x."""
        return self._slope(np.clip(x, self.first, self.last))

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives at x; zero beyond the ends."""
        return np.where((x < self.first) | (x > self.last), 0.0, self._curvature(x))


@dataclass(frozen=True)
class Scaled:
    """f(x) = factor · inner(x): OpenSim's MultiplierFunction."""

    inner: Function
    factor: float

    def __call__(self, x: Array) -> Array:
        """Return the values at x."""
        return self.factor * self.inner(x)

    def slope(self, x: Array) -> Array:
        """Return the first derivatives at x."""
        return self.factor * self.inner.slope(x)

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives at x."""
        return self.factor * self.inner.curvature(x)


def piecewise_linear(x: Array, y: Array) -> Piecewise:
    """Return the polyline through n >= 2 points x, y of shape (n,) with increasing x."""
    return Piecewise(PPoly(np.stack([np.diff(y) / np.diff(x), y[:-1]]), x))


def simm_spline(x: Array, y: Array) -> Piecewise:
    """Return SIMM's cubic spline through n >= 2 points x, y of shape (n,) with increasing x.

    The third derivative in the first interval is that of the cubic through the first four points.
    The last interval uses the last four points. With three points the third derivative is zero;
    with two points the spline is a straight line. The spline is not a natural spline.
    """
    if len(x) == 2:
        return piecewise_linear(x, y)
    ends = (0.0, 0.0)
    if len(x) > 3:
        ends = (6.0 * _third_difference(x[:4], y[:4]), 6.0 * _third_difference(x[-4:], y[-4:]))
    conditions = [(3, ends[0])], [(3, ends[1])]
    return Piecewise(PPoly.from_spline(make_interp_spline(x, y, k=3, bc_type=conditions)))


def _third_difference(x: Array, y: Array) -> float:
    """Return f'''/6 of the cubic through four points."""
    for order in (1, 2, 3):
        y = np.diff(y) / (x[order:] - x[:-order])
    return float(y[0])


@dataclass(frozen=True, eq=False)
class PathPoint:
    """A point of a path, fixed to a body at `location` (3,) m."""

    name: str
    body: str
    location: Array


@dataclass(frozen=True, eq=False)
class ConditionalPathPoint(PathPoint):
    """A path point that is active while a coordinate (rad or m) lies within a range."""

    coordinate: str
    range: tuple[float, float]


@dataclass(frozen=True, eq=False)
class MovingPathPoint:
    """A path point whose three components (m) are functions of coordinates.

    Args:
        coordinates: names of the coordinates on which x, y and z depend; None: the function is
            evaluated at zero.
    """

    name: str
    body: str
    coordinates: tuple[str | None, ...]
    functions: tuple[Function, ...]


AnyPathPoint = PathPoint | ConditionalPathPoint | MovingPathPoint


@dataclass(frozen=True)
class PathWrap:
    """The use of a wrap object by one path.

    Args:
        first: index of the first path point of the part that may wrap.
        method: OpenSim's method for an ellipsoid: "hybrid", "midpoint" or "axial".
    """

    wrap_object: str
    first: int
    last: int
    method: str


@dataclass(frozen=True, eq=False)
class Path:
    """The path of a muscle or ligament: its points in order, and its wrap objects."""

    points: tuple[AnyPathPoint, ...]
    wraps: tuple[PathWrap, ...]


@dataclass(frozen=True, eq=False)
class OpenSimMuscle:
    """A muscle, with the parameters that all of OpenSim's muscle classes share.

    Args:
        kind: the file's class, such as "Thelen2003Muscle".
        max_contraction_velocity: maximum contraction velocity, optimal fibre lengths per second.
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
class OpenSimLigament:
    """A ligament with one of two force laws.

    A Blankevoort1991Ligament has `stiffness_N`, `transition_strain` and `damping_s`. The force of a
    Ligament is `scale_N` times `force_length(length / slack length)`.

    Args:
        kind: "Ligament" or "Blankevoort1991Ligament".
        slack_length_m: greatest length without force.
        stiffness_N: force per unit strain in the linear region, N; None for "Ligament".
        transition_strain: strain at the end of the toe region; None for "Ligament".
        damping_s: damping coefficient; None for "Ligament".
        force_length: normalised force as function of normalised length; None for
            "Blankevoort1991Ligament".
        scale_N: factor of the normalised force, N; None for "Blankevoort1991Ligament".
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


GROUND = "ground"


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body.

    Args:
        centre: centre of mass in the body's frame, m, (3,).
        inertia: inertia tensor about the centre of mass, kg·m², (3, 3).
    """

    name: str
    mass_kg: float
    centre: Array
    inertia: Array


@dataclass(frozen=True)
class Coordinate:
    """A generalised coordinate, m or rad.

    Args:
        rotational: whether the coordinate is an angle. Files "in degrees" state it in degrees.
    """

    name: str
    joint: str
    rotational: bool
    default: float
    range: tuple[float, float]
    clamped: bool
    locked: bool


@dataclass(frozen=True, eq=False)
class JointAxis:
    """One axis of a joint, with the motion along it as a function of one coordinate; None: at zero.

    Args:
        direction: unit vector (3,).
        function: function of the coordinate, which gives the angle (rad) or translation (m).
    """

    direction: Array
    coordinate: str | None
    function: Function


@dataclass(frozen=True, eq=False)
class Joint:
    """Any OpenSim joint: translations in the parent frame, then up to three successive rotations.

    The pose of the child frame in the parent frame has the rotation R = R_1 R_2 R_3, a product of
    rotations about single axes. Its translation is t = Σ u_i a_i along the axes a_i.

    Args:
        kind: the file's class, such as "PinJoint".
        pose_parent_frame: pose of the parent frame in the parent body, (4, 4).
        pose_child_frame: pose of the child frame in the child body, (4, 4).
        backwards: whether the child body is nearer to ground than the parent body.
        unread: reason for which the joint's motion could not be read. Such a joint is welded.
            "": the motion was read.
    """

    name: str
    kind: str
    parent: str
    child: str
    pose_parent_frame: Array
    pose_child_frame: Array
    rotations: tuple[JointAxis, ...]
    translations: tuple[JointAxis, ...]
    backwards: bool = False
    unread: str = ""

    @property
    def inboard(self) -> str:
        """The body nearer to ground."""
        return self.child if self.backwards else self.parent

    @property
    def outboard(self) -> str:
        """The body farther from ground."""
        return self.parent if self.backwards else self.child


@dataclass(frozen=True, eq=False)
class CoordinateCoupler:
    """An enforced constraint dependent = function(independent), rad and m."""

    name: str
    dependent: str
    independent: str
    function: Function


@dataclass(frozen=True, eq=False)
class ConstantDistance:
    """Two points (3,), m, of two bodies have a constant `distance`, m."""

    name: str
    bodies: tuple[str, str]
    points: tuple[Array, Array]
    distance: float
    enforced: bool


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker at `location` (3,), m, of a body. A `fixed` marker does not move with scaling."""

    name: str
    body: str
    location: Array
    fixed: bool


@dataclass(frozen=True)
class Unread:
    """An element of the file that could not be read.

    Args:
        kind: the file's class.
        concerns: names of the bodies and coordinates that occur in the element.
    """

    kind: str
    name: str
    reason: str
    concerns: frozenset[str]

    @property
    def constrains(self) -> bool:
        """Whether the element is a joint or a constraint."""
        return self.kind.endswith(("Joint", "Constraint"))


@dataclass(frozen=True, eq=False)
class OpenSimModel:
    """Units are SI.

    Args:
        gravity: acceleration of gravity in ground, m/s², (3,). It is along -y: the file's ground is
            turned upright when the file is read.
        bodies: name -> body, without ground.
        joints: the joints, ordered from ground outwards.
        coordinates: name -> coordinate, in the file's order. Every vector q has this order.
        couplers: couplers of coordinates, ordered so that each coordinate is set before the
            coordinates that depend on it.
        constant_distances: distances between two points.
        offset_frames: name of an offset frame -> its body, and its pose (4, 4) in that body.
        left_out: "class 'name'" of each element of the file that tkamb does not model.
        unread: elements that a partial reading could not read.
        ground_axes: axes of the file's ground that point along this ground's x, y and z (forward,
            up, right), like "+x,+z,-y"; None: gravity is along none of the file's axes.
    """

    name: str
    gravity: Array
    bodies: dict[str, Body]
    joints: tuple[Joint, ...]
    coordinates: dict[str, Coordinate]
    couplers: tuple[CoordinateCoupler, ...]
    constant_distances: tuple[ConstantDistance, ...]
    markers: dict[str, Marker]
    muscles: dict[str, OpenSimMuscle]
    ligaments: dict[str, OpenSimLigament]
    wrap_objects: dict[str, WrapObject]
    offset_frames: dict[str, tuple[str, Array]]
    left_out: tuple[str, ...]
    unread: tuple[Unread, ...] = ()
    notices: tuple[str, ...] = ()
    ground_axes: str | None = "+x,+y,+z"

    @property
    def mass_kg(self) -> float:
        """Mass of the whole model."""
        return sum(body.mass_kg for body in self.bodies.values())

    def check_gravity(self) -> None:
        """Raise an InputError if the model has no gravity, which says where up is."""
        if not self.gravity.any():
            what = "has no gravity, which says where up is"
            raise InputError(what, self.name, "write <gravity>0 -9.80665 0</gravity> if y is up")
