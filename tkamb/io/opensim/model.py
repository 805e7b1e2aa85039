"""An OpenSim model as data: bodies, joints, constraints, markers, muscles, ligaments, wrap objects.

Frames are those of the file: each body's own, and "ground". SI and radians. There are no offset
frames: points and poses are given in the bodies themselves.

References: Delp et al., IEEE Trans Biomed Eng 54:1940 (2007), doi:10.1109/TBME.2007.901024;
Seth et al., PLoS Comput Biol 14:e1006223 (2018), doi:10.1371/journal.pcbi.1006223.
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
class OpenSimMuscle:
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
class OpenSimLigament:
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


GROUND = "ground"


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body.

    Args:
        name: the body's name.
        mass_kg: mass.
        centre: (3,) m, centre of mass.
        inertia: (3, 3) kg·m² about the centre of mass.
    """

    name: str
    mass_kg: float
    centre: Array
    inertia: Array


@dataclass(frozen=True)
class Coordinate:
    """A generalised coordinate, m or rad.

    Args:
        name: the coordinate's name.
        joint: the joint it belongs to.
        rotational: whether it is an angle (files "in degrees" hold it in degrees).
        default: its default value.
        range: smallest and largest value.
        clamped: whether OpenSim keeps it within the range.
        locked: whether OpenSim keeps it at its default.
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
    """One axis of a joint, moved by a function of one coordinate.

    Args:
        direction: (3,) unit vector.
        coordinate: the coordinate's name; None: the function's value at zero holds throughout.
        function: coordinate -> angle (rad) or translation (m) along the axis.
    """

    direction: Array
    coordinate: str | None
    function: Function


@dataclass(frozen=True, eq=False)
class Joint:
    """Any OpenSim joint: three successive rotations, then translations in the parent frame.

    The child frame stands in the parent frame with R = R_1 R_2 R_3 (each about its own axis,
    carried by those before) and t = Σ u_i a_i.

    Args:
        name: the joint's name.
        kind: the file's class, such as "PinJoint".
        parent: body that carries the parent frame.
        child: body that carries the child frame.
        pose_parent_frame: (4, 4) parent frame in the parent body.
        pose_child_frame: (4, 4) child frame in the child body.
        rotations: up to three axes.
        translations: up to three axes.
        backwards: whether the way out from ground leads from child to parent.
        unread: why its motion could not be read, so that it holds its bodies still; "" if it was.
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
        """Body on the side of ground."""
        return self.child if self.backwards else self.parent

    @property
    def outboard(self) -> str:
        """Body that the joint carries, seen from ground."""
        return self.parent if self.backwards else self.child


@dataclass(frozen=True, eq=False)
class CoordinateCoupler:
    """dependent = function(independent), m and rad; those not enforced are not kept."""

    name: str
    dependent: str
    independent: str
    function: Function


@dataclass(frozen=True, eq=False)
class ConstantDistance:
    """Two points (3,) of two bodies that stay `distance` (m) apart."""

    name: str
    bodies: tuple[str, str]
    points: tuple[Array, Array]
    distance: float
    enforced: bool


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker at a point (3,) m of a body; `fixed` where scaling must not move it."""

    name: str
    body: str
    location: Array
    fixed: bool


@dataclass(frozen=True)
class Unread:
    """Something in the file that could not be read.

    Args:
        kind: the file's class.
        name: its name.
        reason: the refusal, one line.
        concerns: bodies and coordinates that it names.
    """

    kind: str
    name: str
    reason: str
    concerns: frozenset[str]

    @property
    def constrains(self) -> bool:
        """Whether it holds bodies or coordinates together: a joint or a constraint."""
        return self.kind.endswith(("Joint", "Constraint"))


@dataclass(frozen=True, eq=False)
class OpenSimModel:
    """An OpenSim model as read.

    Args:
        name: the model's name.
        gravity: (3,) m/s² in ground.
        bodies: by name, ground not among them.
        joints: from ground outwards.
        coordinates: in the file's order, which is that of every vector q.
        couplers: coordinates that follow others, each after those that it follows.
        constant_distances: points kept apart.
        markers: by name.
        muscles: by name.
        ligaments: by name.
        wrap_objects: by name.
        offset_frames: offset frames of bodies: name -> body and pose (4, 4) in it.
        left_out: "class 'name'" of everything in the file that was not taken over.
        unread: elements that a partial reading could not read; they are an error if needed.
        notices: lines on how the file was read.
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

    @property
    def mass_kg(self) -> float:
        """Sum of the bodies' masses."""
        return sum(body.mass_kg for body in self.bodies.values())
