"""Generalised forces on the released knee coordinates, of a leg or of a simulator.

The shank moves as recorded. Its weight and inertia and the ground reaction therefore give a wrench
w_external that does not depend on the knee coordinates. Contact, ligaments, muscles and the
patellar ligament must balance this wrench:

    R(q, y) = w_external + w_ligaments(q) + w_muscles(q) + w_contact(q) + B y = 0   (on the insert)

The columns B are the reactions of the prescribed coordinates: the patellar ligament for flexion,
and the residuals of the equations of motion for all other prescribed coordinates. The extensor
muscle and the patellofemoral force are internal to the femur's side. The generalised force on a
released coordinate i is

    r_i = -J_i(q) . R(q, y),

where J is `knee_axes`, and y makes the generalised forces on the prescribed coordinates zero. r_i
is zero at equilibrium, and positive if it drives the femur towards +q_i.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

import numpy as np

from tkamb.geometry.frames import KNEE_COORDINATES, Array, inverse, knee_axes, knee_pose, transform
from tkamb.knee import unknowns
from tkamb.knee.balance import Balance, BalanceStatus, Trial, find_balance, polished
from tkamb.knee.crossing import MuscleShare
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.load import wrench_of
from tkamb.knee.unknowns import CondylePoint

if TYPE_CHECKING:
    from tkamb.contact.model import Probe, ProbedContact
    from tkamb.knee.ligaments import BundleArrays, Ligament


@dataclass(frozen=True, eq=False)
class PatellarLine:
    """The first straight segment of the patellar ligament below the patella.

    Args:
        end: end on the patella, femur frame, shape (3,), m; the patella is fixed to the femur here.
        anchor: next point on the shank (tuberosity or front lip), insert frame, shape (3,), m.
    """

    end: Array
    anchor: Array

    def wrench(self, poses: Array) -> Array:
        """Return the wrench (..., 6) of a unit tension on the insert at poses (..., 4, 4)."""
        line = transform(poses, self.end) - self.anchor
        return wrench_of(self.anchor, line / np.linalg.norm(line, axis=-1, keepdims=True))


@dataclass(frozen=True, eq=False)
class StrandLines:
    """The ligaments from a released patella to the tibia, with constant shares of their resultant.

    Args:
        ends: ends on the patella, femur frame, shape (k, 3), m; the patella is fixed to the femur
            here.
        anchors: ends on the shank, insert frame, shape (k, 3), m.
        shares: tension of each over the resultant of all, shape (k,), 1.
        wrapping: wrench (6,) of the others, which wrap, on the insert, per unit of the resultant.
    """

    ends: Array
    anchors: Array
    shares: Array
    wrapping: Array

    def wrench(self, poses: Array) -> Array:
        """Return the wrench (..., 6) of a unit resultant on the insert at poses (..., 4, 4)."""
        ends = np.einsum("...ij,kj->...ki", poses[..., :3, :3], self.ends)
        lines = ends + poses[..., None, :3, 3] - self.anchors
        pulls = self.shares[:, None] * lines / np.linalg.norm(lines, axis=-1, keepdims=True)
        return wrench_of(self.anchors, pulls).sum(axis=-2) + self.wrapping


@dataclass(frozen=True, eq=False)
class JointEquilibrium:
    """The equations of equilibrium of the released knee coordinates at one frame.

    Args:
        external: w_external on the insert, force and moment about the insert's origin, shape (6,).
        ligaments: the ligament bundles.
        line: the patellar ligament, which balances flexion; None: a moment balances flexion.
        residual_loads: unit residual loads, the remaining columns of B, shape (6, m).
        released: indices of the n released coordinates.
        share: the muscles across the knee except the quadriceps; None: not modelled.
        tibia: pose of the tibia link in the insert frame, shape (4, 4).
    """

    external: Array
    ligaments: "BundleArrays"
    line: PatellarLine | StrandLines | None
    residual_loads: Array
    released: tuple[int, ...]
    share: MuscleShare | None = None
    tibia: Array = field(default_factory=lambda: np.eye(4))

    def residual(self, coordinates: Array, contact: Array) -> Array:
        """Return r (..., n), the generalised forces on the released coordinates.

        Args:
            coordinates: knee coordinates, shape (..., 6).
            contact: w_contact on the insert, shape (6,).
        """
        axes, columns, wrench = self._sum_loads(coordinates, contact)
        reactions = _magnitudes(axes[..., self._prescribed, :], columns, wrench)
        remainder = wrench + np.einsum("...ij,...j->...i", columns, reactions)
        return -np.einsum("...ij,...j->...i", axes[..., list(self.released), :], remainder)

    def reactions(self, coordinates: Array, contact: Array) -> Array:
        """Return y (6 - n,), the reactions of the prescribed coordinates, flexion last."""
        axes, columns, wrench = self._sum_loads(coordinates, contact)
        return _magnitudes(axes[..., self._prescribed, :], columns, wrench)

    def contact_gain(self, coordinates: Array) -> Array:
        """Return d r / d w_contact (n, 6) at coordinates (6,)."""
        axes, columns = knee_axes(coordinates), self.columns(coordinates)
        # The projection subtracts the reactions that balance a contact wrench.
        projection = np.eye(6) + columns @ self.reaction_gain(coordinates)
        return np.asarray(-axes[list(self.released)] @ projection)

    def reaction_gain(self, coordinates: Array) -> Array:
        """Return d y / d w_contact (6 - n, 6) at coordinates (6,), flexion last."""
        rows = knee_axes(coordinates)[self._prescribed]
        return np.asarray(-np.linalg.solve(rows @ self.columns(coordinates), rows))

    def reactions_and_residual(self, coordinates: Array, contact: Array) -> tuple[Array, Array]:
        """Return y of `reactions`, and the residual wrench R (6,) on the insert."""
        axes, columns, wrench = self._sum_loads(coordinates, contact)
        reactions = _magnitudes(axes[self._prescribed], columns, wrench)
        return reactions, wrench + columns @ reactions

    def forces_on_all_coordinates(self, coordinates: Array, contact: Array) -> Array:
        """Return the generalised forces (m, 6) on all coordinates, with y at the last of m poses.

        Args:
            coordinates: knee coordinates, shape (m, 6).
            contact: w_contact on the insert, shape (6,).
        """
        axes, columns, wrench = self._sum_loads(coordinates, contact)
        reactions = _magnitudes(axes[-1, self._prescribed], columns[-1], wrench[-1])
        return -np.einsum("mij,mj->mi", axes, wrench + columns @ reactions)

    def columns(self, coordinates: Array) -> Array:
        """Return B (6, 6 - n) at coordinates (6,)."""
        return self._columns(knee_pose(coordinates))

    @property
    def _prescribed(self) -> list[int]:
        return [i for i in range(6) if i not in self.released]

    def _sum_loads(self, coordinates: Array, contact: Array) -> tuple[Array, Array, Array]:
        """Return axes (..., 6, 6), columns B (..., 6, 6 - n) and wrench (..., 6)."""
        poses = knee_pose(coordinates)
        wrench = self.external + contact + self.ligaments.wrench(poses)
        if self.share is not None:
            wrench = wrench + self.share.wrench(self.tibia, poses)
        return knee_axes(coordinates), self._columns(poses), wrench

    def _columns(self, poses: Array) -> Array:
        """Return B (..., 6, 6 - n) at poses (..., 4, 4)."""
        line = None if self.line is None else self.line.wrench(poses)[..., None]
        if line is not None and not self.residual_loads.size:
            return line
        columns = np.broadcast_to(
            self.residual_loads, (*poses.shape[:-2], *self.residual_loads.shape)
        )
        return columns if line is None else np.concatenate([columns, line], axis=-1)


def _magnitudes(rows: Array, columns: Array, wrench: Array) -> Array:
    """Return y with rows (columns y + wrench) = 0."""
    # The reactions make the generalised forces on the prescribed coordinates zero.
    right = np.einsum("...ij,...j->...i", rows, wrench)
    return np.asarray(-np.linalg.solve(rows @ columns, right[..., None])[..., 0])


def joint_equilibrium(
    geometry: KneeGeometry,
    ligaments: "Sequence[Ligament]",
    coordinates: Array,
    released: tuple[int, ...],
    middle: Array,
    slack: bool,
    external: Array,
) -> JointEquilibrium:
    """Return the equations of equilibrium of the knee at one frame.

    Args:
        geometry: the frame; its condyles and ligament loads are not used.
        ligaments: the ligament bundles.
        coordinates: knee coordinates of the geometry, shape (6,), m and rad.
        released: indices of the released coordinates, never including flexion.
        middle: point where the residual forces act, insert frame, shape (3,), m.
        slack: whether the extensor mechanism carries no load.
        external: result of `external_wrench`, shape (6,).
    """
    line = None if slack or geometry.extensor is None else patellar_line(geometry, coordinates)
    columns = [
        unit_residual(name, middle)
        for i, name in enumerate(KNEE_COORDINATES)
        if i not in released and not (name == "flexion" and line)
    ]
    return JointEquilibrium(
        external,
        crossing_bundles(geometry, ligaments, coordinates),
        line,
        np.array(columns).reshape(-1, 6).T,
        released,
        geometry.share,
        geometry.state.pose("tibia"),
    )


def unit_residual(name: str, middle: Array) -> Array:
    """Return the wrench (6,) on the insert of the unit residual for one prescribed coordinate.

    As in the equations of motion, the residuals are forces along the insert's axes at `middle`, and
    moments about its x (adduction), y (axial rotation) and z (flexion).
    """
    axis = unknowns.AXES[
        {"adduction": "ap", "axial_rotation": "si", "flexion": "ml"}.get(name, name)
    ]
    if name in unknowns.AXES:
        return wrench_of(middle, axis)
    return np.concatenate([np.zeros(3), axis])


def patellar_line(geometry: KneeGeometry, coordinates: Array) -> PatellarLine | StrandLines:
    """Return the first straight segment of the patellar ligament at coordinates (6,)."""
    extensor, chain = geometry.extensor, geometry.state.chain
    assert extensor is not None
    if extensor.released is not None:
        return extensor.released.strands(inverse(knee_pose(coordinates)))
    shank_loads = [load for load in extensor.patellar_ligament if chain.on_shank(load.link)]
    other_loads = [load for load in extensor.patellar_ligament if not chain.on_shank(load.link)]
    end, direction = other_loads[0].points[0], other_loads[0].forces[0]
    # The ligament may wrap the insert. The anchor is its first point on the shank.
    distance = min(float((load.points[0] - end) @ direction) for load in shank_loads)
    return PatellarLine(transform(inverse(knee_pose(coordinates)), end), end + distance * direction)


def external_wrench(geometry: KneeGeometry, coordinates: Array) -> Array:
    """Return the wrench (6,) of ground reaction, weight and inertia on the shank, insert frame.

    The wrench does not depend on the knee coordinates of the geometry.
    """
    state = geometry.state
    hip = unknowns.hip(state.point("hip", np.zeros(3)))
    ground = [geometry.ground] if geometry.ground else []
    columns = state.generalised([*(unknown.loads for unknown in hip), ground])
    # Generalised forces of hip and knee together, as in `KneeSystem`.
    required = state.inertial - columns[:, -1]
    # The internal loads of the knee cancel in the six equations of the free root, so these
    # equations give the loads of the hip.
    at_hip = np.linalg.solve(columns[:6, :6], required[:6])
    knee = (required - columns[:, :6] @ at_hip)[state.chain.knee_columns()]
    # Generalised forces are axes times wrench: solve for the wrench on the tibia.
    return np.asarray(np.linalg.solve(knee_axes(coordinates), knee))


def crossing_bundles(
    geometry: KneeGeometry, ligaments: "Sequence[Ligament]", coordinates: Array
) -> "BundleArrays":
    """Return the bundles that cross the knee, with ends in the femur and insert frames.

    An end on the patella is fixed to the femur here.
    """
    from tkamb.knee.ligaments import DISTAL, PROXIMAL, BundleArrays

    state, chain = geometry.state, geometry.state.chain
    bodies = {
        PROXIMAL: (PROXIMAL, inverse(knee_pose(coordinates))),
        DISTAL: (DISTAL, np.eye(4)),
    }
    crossing = []
    for bundle in ligaments:
        placed = bundle.on_links(
            {
                link: (DISTAL if chain.on_shank(link) else PROXIMAL, state.pose(link))
                for link in bundle.links
            }
        )
        if len(placed.links) == 2:
            crossing.append(placed.on_links(bodies))
    return BundleArrays.between(crossing)


# m: arm that makes rotations comparable to translations. Half the usual distance of the
# condyles.
LEVER_ARM = 0.025
# m: step of the finite differences of joint axes and ligaments. It is far above
# rounding errors and far below any radius of curvature.
DIFFERENCE_STEP = 1e-7


SCALE = np.array([1.0, 1.0, 1.0, LEVER_ARM, LEVER_ARM, LEVER_ARM])

Sliding = Callable[[Array, Array], Array]


def _no_sliding(coordinates: Array, point: Array) -> Array:
    return np.zeros(3)


class Joint(Protocol):
    """Loads other than contact on the free coordinates, of a leg or of a simulator."""

    @property
    def released(self) -> tuple[int, ...]:
        """Indices of the n free coordinates."""

    def residual(self, coordinates: Array, contact: Array) -> Array:
        """Return the generalised forces (..., n) at coordinates (..., 6) and a contact (6,)."""

    def contact_gain(self, coordinates: Array) -> Array:
        """Return the derivative (n, 6) of these forces by the contact's wrench on the insert."""


J = TypeVar("J", bound=Joint)


class FreeForces(Generic[J]):
    """Generalised forces on the free coordinates of a joint at trial coordinates.

    Coordinates and forces are scaled: rotations are multiplied by a lever arm, and moments are
    divided by this arm.

    Args:
        joint: loads other than contact.
        coordinates: knee coordinates, shape (6,), m and rad; coordinates that are not free keep
            their values.
        friction: Coulomb coefficient.
        sliding: function of coordinates (6,) and a point (3,). It returns the velocity (3,), m/s,
            of the femur relative to the insert at that point.
        contact: the contact at `coordinates`; None: unknown.

    Attributes:
        contacts: scaled coordinates as bytes -> contact at these coordinates.
    """

    def __init__(
        self,
        joint: J,
        probe: "Probe",
        coordinates: Array,
        friction: float = 0.0,
        sliding: Sliding = _no_sliding,
        contact: "ProbedContact | None" = None,
    ) -> None:
        self._joint, self._probe, self._coordinates = joint, probe, np.array(coordinates, float)
        self._friction, self._sliding = friction, sliding
        self._rows = list(joint.released)
        self._scale = SCALE[self._rows]
        self._start = self._coordinates[self._rows] * self._scale
        self.contacts: dict[bytes, ProbedContact] = {}
        if contact is not None:
            self.contacts[self._start.tobytes()] = contact

    def balance(
        self,
        stiffness: Array | None = None,
        residual_share: float = 0.0,
        stop_distance: float = np.inf,
    ) -> Balance:
        """Return the equilibrium of the free coordinates, with `coordinates` as initial guess.

        Args:
            stiffness: stiffness of an earlier, similar search, shape (n, n), N/m; None: unknown.
            residual_share: see `find_balance`.
            stop_distance: see `find_balance`, m.
        """
        return find_balance(self.trial, self._start, stiffness, residual_share, stop_distance)

    def polished(self, balance: Balance, size: float) -> Balance:
        """Return a balance after more steps, until the residual is small against a load, N."""
        if balance.status is not BalanceStatus.OK:
            return balance
        x, last = polished(self.trial, balance.coordinates, size)
        stiffness = balance.stiffness if last.stiffness is None else last.stiffness
        return replace(balance, coordinates=x, force=last.force, stiffness=stiffness)

    def contact(self, balance: Balance) -> "ProbedContact":
        """Return the contact of a balance."""
        return self.contacts[balance.coordinates.tobytes()]

    def trial(self, x: Array) -> Trial:
        """Return scaled forces and stiffness at scaled coordinates (n,), m."""
        coordinates, key = self._coordinates_at(x), x.tobytes()
        contact = self.contacts.get(key)
        if contact is None:
            contact = self.contacts[key] = self._probe.at(knee_pose(coordinates))
        if not contact.known:
            return Trial(np.full(len(x), np.nan))
        wrench, stiffness = self._with_friction(coordinates, contact)
        force_noise = contact.accuracy * float(np.linalg.norm(wrench[:3]))
        if stiffness is None:
            force = self._joint.residual(coordinates, wrench) / self._scale
            return Trial(force, force_noise=force_noise)
        # Forces at displaced coordinates; the last row is at the coordinates themselves.
        steps = np.zeros((len(x) + 1, 6))
        steps[np.arange(len(x)), self._rows] = DIFFERENCE_STEP / self._scale
        forces = self._joint.residual(coordinates + steps, wrench) / self._scale
        change = (forces[:-1] - forces[-1]).T / DIFFERENCE_STEP
        twists = knee_axes(coordinates)[self._rows] / self._scale[:, None]
        gain = self._joint.contact_gain(coordinates) / self._scale[:, None]
        tangent = -(change + gain @ stiffness @ twists.T)
        return Trial(forces[-1], tangent, contact.exact, force_noise)

    def residual(self) -> float:
        """Return the largest scaled force, N, at the initial coordinates."""
        return float(np.abs(self.trial(self._start).force).max())

    def at(self, balance: Balance) -> Array:
        """Return the knee coordinates (6,) of a balance."""
        return self._coordinates_at(balance.coordinates)

    def wrench_at(self, coordinates: Array, contact: "ProbedContact") -> Array:
        """Return the wrench (6,) of a contact on the insert at coordinates (6,), with friction."""
        return self._with_friction(coordinates, contact)[0]

    def _coordinates_at(self, x: Array) -> Array:
        coordinates = self._coordinates.copy()
        coordinates[self._rows] = x / self._scale
        return coordinates

    def _with_friction(
        self, coordinates: Array, contact: "ProbedContact"
    ) -> tuple[Array, Array | None]:
        """Return the wrench (6,) on the insert with friction, and its stiffness (6, 6) if known."""
        wrench, stiffness = np.zeros(6), np.zeros((6, 6))
        for condyle in contact.loads:
            sliding = self._sliding(coordinates, condyle.point)
            contact_point = CondylePoint(condyle.point, condyle.normal, sliding, 0.0)
            friction_force = contact_point.normal - contact_point.direction(self._friction)
            friction_wrench = wrench_of(contact_point.point, friction_force)
            wrench += condyle.wrench + condyle.force * friction_wrench
            if condyle.stiffness is not None:
                normal_stiffness = -contact_point.normal @ condyle.stiffness[:3]
                stiffness += condyle.stiffness + np.outer(friction_wrench, normal_stiffness)
        return wrench, stiffness if contact.tangent else None


class ReleasedForces(FreeForces[JointEquilibrium]):
    """Forces on the released coordinates of a leg whose patella is fixed to the femur."""

    def tension_per_wrench(self, contact: "ProbedContact") -> Array | None:
        """Return v (6,): a wrench dw on the insert changes the ligament's tension by v . dw.

        The released coordinates move by dq to the new equilibrium. Let f = -J w be the generalised
        forces of contact, ligaments and muscles, and K = -df/dq. The equations

            -J dw - K dq - J B dy = 0

        give dq and the change dy of the reactions of the prescribed coordinates. The tension of the
        patellar ligament is one of the reactions. The result is None if the contact has no tangent.

        Args:
            contact: the contact in equilibrium at `coordinates`.
        """
        coordinates = self._coordinates
        wrench, stiffness = self._with_friction(coordinates, contact)
        if stiffness is None:
            return None
        steps = np.zeros((len(self._rows) + 1, 6))
        steps[np.arange(len(self._rows)), self._rows] = DIFFERENCE_STEP / self._scale
        forces = self._joint.forces_on_all_coordinates(coordinates + steps, wrench)
        axes = knee_axes(coordinates)
        twists = axes[self._rows] / self._scale[:, None]
        change = (forces[:-1] - forces[-1]).T / DIFFERENCE_STEP - axes @ stiffness @ twists.T
        # The unknowns are dq and dy. The ligament's tension is the last entry of y.
        matrix = np.hstack([-change, axes @ self._joint.columns(coordinates)])
        return np.asarray(-np.linalg.solve(matrix, axes)[-1])

    def tension_in_equilibrium(self, contact: "ProbedContact", per_wrench: Array) -> float:
        """Return the predicted tension (N) of the patellar ligament at the near equilibrium.

        The prediction is linear in the residual wrench at `coordinates`.

        Args:
            contact: the contact at `coordinates`.
            per_wrench: result of `tension_per_wrench`, shape (6,).
        """
        wrench, _ = self._with_friction(self._coordinates, contact)
        reactions, remainder = self._joint.reactions_and_residual(self._coordinates, wrench)
        return float(reactions[-1] + per_wrench @ remainder)

    def pushes(self, balance: Balance) -> bool:
        """Return whether a taut patellar ligament would have to push."""
        return self.line_tension(balance) < 0

    def line_tension(self, balance: Balance) -> float:
        """Return the tension of the patellar ligament, N; 0: slack, or not modelled."""
        if self._joint.line is None:
            return 0.0
        coordinates = self.at(balance)
        wrench, _ = self._with_friction(coordinates, self.contact(balance))
        return float(self._joint.reactions(coordinates, wrench)[-1])
