"""Forces on a massless patella without friction, at a pose in the femur's sagittal plane.

The three coordinates are patella_ap, patella_si and patella_rotation. The forces of muscle,
patellar ligament and contact balance at every pose; their moment vanishes only at equilibrium
(`tkamb.knee.patella_search`).
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, inverse, rotate, transform
from tkamb.knee.patellofemoral import PatellarContact, PatellofemoralContact
from tkamb.knee.wrapping import TautPath, path_in_link


@dataclass(frozen=True)
class PatellaSettings:
    """Limit below which the forces on the patella are not determined."""

    least_determinant: float = 1e-6
    """1: determinant of the unit vectors of contact normal and ligament below which the two are
    parallel. Chosen because it is above rounding errors."""


PATELLA = PatellaSettings()


class PatellaStatus(Enum):
    """How the search for the patella ended: with a pose, or with the condition that failed."""

    OK = "ok"
    SEVERAL = "several_solutions"
    EDGE = "contact_on_edge_of_femoral_mesh"
    NO_CONTACT = "no contact: the button does not meet the femoral component at any rotation"
    LINE = "an end of a line lies inside what it wraps, or the ligament is along the contact normal"
    GAP = "the gap to the femoral component does not close"
    LIGAMENT = "the given length of the patellar ligament cannot be reached"
    MOMENT = "the moments do not balance at any rotation that was tried"
    PULL = "the contact would have to pull, or the patellar ligament to push"

    @property
    def found(self) -> bool:
        """Whether the patella was found. If not, the value states the condition that failed."""
        return self in (PatellaStatus.OK, PatellaStatus.SEVERAL, PatellaStatus.EDGE)


@dataclass(frozen=True, eq=False)
class PatellaState:
    """The patella at one frame.

    Args:
        coordinates: patella_ap, patella_si (m) and patella_rotation (rad), (3,); NaN: not
            found.
        contact_point: on the line of action of the contact force, insert frame, (3,), m.
        contact_normal: unit normal from femur to patella in the femur's sagittal plane, insert
            frame, (3,).
        contact_on_patella: contact point in the patella's frame, (3,), m.
        gap: distance of button and femoral component, negative in penetration, m.
        ligament_ratio: patellar ligament tension per muscle tension, for a massless patella.
        patellofemoral_ratio: patellofemoral force per muscle tension, for a massless patella.
        shift: first-order estimate of the mediolateral shift along z, m.
        tilt: first-order estimate of the tilt about y, rad. The computed patella does not shift or
            tilt.
        slopes: approximate derivatives of gap, ligament length and moment per unit tension (m) by
            the coordinates, (3, 3), as input of a later search; None: unknown.
    """

    coordinates: Array
    contact_point: Array
    contact_normal: Array
    contact_on_patella: Array
    gap: float
    ligament_ratio: float
    patellofemoral_ratio: float
    shift: float
    tilt: float
    status: PatellaStatus
    slopes: Array | None = None


@dataclass(frozen=True, eq=False)
class ExtensorMechanism:
    """The extensor mechanism as input of the search for the patella, constant over frames.

    Args:
        pose_joint_in_femur: pose of the patellar joint's frame in the femur link, (4, 4).
        muscle_origin: start of the segment that leaves the femur, femur frame, (3,), m.
        muscle_insertion: patella frame, (3,), m; `ligament_proximal` too.
        ligament_distal: insert frame, (3,), m.
        ligament_length: constant, m.
        femoral_outline: outline that the muscle wraps, in the femur's x-y plane, (n, 2), m;
            None: no wrapping.
        insert_outline: outline that the ligament wraps, in the insert's x-y plane, (n, 2), m;
            None: no wrapping.
    """

    contact: PatellofemoralContact
    pose_joint_in_femur: Array
    muscle_origin: Array
    muscle_insertion: Array
    ligament_proximal: Array
    ligament_distal: Array
    ligament_length: float
    femoral_outline: Array | None = None
    insert_outline: Array | None = None


@dataclass(frozen=True, eq=False)
class PatellaBalance:
    """Forces on the patella per unit muscle tension, in the patellar joint's frame.

    `moment` is the residual moment per unit tension, m. `slopes` are those of `PatellaState`.
    """

    coordinates: Array
    contact: PatellarContact
    muscle: TautPath
    ligament: TautPath
    ligament_force: float
    normal_force: float
    moment: float
    slopes: Array | None = None


def patella_at(
    mechanism: ExtensorMechanism,
    pose_femur_in_insert: Array,
    coordinates: Array,
    contact: PatellarContact,
) -> PatellaState:
    """Return the state of a patella at given coordinates, for any gap and residual moment.

    `contact` is that of the button at these coordinates (3,), m and rad.
    """
    frame = PatellaFrame(mechanism, pose_femur_in_insert)
    balance = frame.balance_at(np.asarray(coordinates, float), contact)
    edge = balance.contact.on_edge > 0.5
    return frame.state(balance, PatellaStatus.EDGE if edge else PatellaStatus.OK)


def touching_patella(coordinates: Array, point: Array, normal: Array) -> PatellaState:
    """Return the state of a patella from coordinates (3,), contact point and unit normal (3,).

    Both are in the insert frame; all other values are NaN.
    """
    nan = float("nan")
    on_patella = np.full(3, nan)
    place = (coordinates, point, normal, on_patella)
    return PatellaState(*place, nan, nan, nan, nan, nan, PatellaStatus.OK)


class PatellaFrame:
    """The mechanism at one frame, in the patellar joint's frame."""

    def __init__(self, mechanism: ExtensorMechanism, pose_femur_in_insert: Array) -> None:
        self.mechanism = mechanism
        self.in_insert = np.asarray(pose_femur_in_insert, float) @ mechanism.pose_joint_in_femur
        self.insert = inverse(self.in_insert)
        self.femur = inverse(mechanism.pose_joint_in_femur)
        self.origin = transform(self.femur, mechanism.muscle_origin)
        self.tuberosity = transform(self.insert, mechanism.ligament_distal)

    def balance(self, coordinates: Array) -> PatellaBalance:
        """Return the forces at coordinates (3,), and the residual moment per unit tension (m)."""
        return self.balance_at(coordinates, self.mechanism.contact.at(coordinates))

    def balance_at(self, coordinates: Array, contact: PatellarContact) -> PatellaBalance:
        """Return the result of `balance` for a known contact."""
        mechanism = self.mechanism
        patella_pose = mechanism.contact.pose(coordinates)
        muscle = path_in_link(
            self.origin,
            transform(patella_pose, mechanism.muscle_insertion),
            mechanism.femoral_outline,
            self.femur,
        )
        ligament = path_in_link(
            transform(patella_pose, mechanism.ligament_proximal),
            self.tuberosity,
            mechanism.insert_outline,
            self.insert,
        )
        # Unit forces on the patella: the muscle pulls it towards the origin, the ligament towards
        # the tibia.
        muscle_direction, ligament_direction = (
            -muscle.end_direction[:2],
            ligament.start_direction[:2],
        )
        directions = np.column_stack([ligament_direction, contact.normal[:2]])
        if abs(np.linalg.det(directions)) < PATELLA.least_determinant:
            raise ComputationError("the patellar ligament runs along the contact normal")
        # Force equilibrium in the sagittal plane, per newton of muscle tension: two equations for
        # the ligament tension and the contact force.
        ligament_force, normal_force = np.linalg.solve(directions, -muscle_direction)
        # The residual moment about the origin vanishes in equilibrium.
        moment = (
            _cross(muscle.points[-1], muscle_direction)
            + ligament_force * _cross(ligament.points[0], ligament_direction)
            + normal_force * _cross(contact.point, contact.normal)
        )
        return PatellaBalance(
            coordinates,
            contact,
            muscle,
            ligament,
            float(ligament_force),
            float(normal_force),
            float(moment),
        )

    def state(self, balance: PatellaBalance, status: PatellaStatus) -> PatellaState:
        """Return the state from the forces, in the insert frame."""
        contact = balance.contact
        in_patella = inverse(self.mechanism.contact.pose(balance.coordinates))
        return PatellaState(
            balance.coordinates,
            transform(self.in_insert, contact.point),
            rotate(self.in_insert, contact.normal),
            transform(in_patella, contact.point),
            contact.gap,
            balance.ligament_force,
            balance.normal_force,
            contact.shift,
            contact.tilt,
            status,
            balance.slopes,
        )


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])
