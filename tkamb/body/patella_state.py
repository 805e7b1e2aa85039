"""The extensor mechanism over all frames, and where the patella is at one of them."""

from dataclasses import dataclass
from enum import Enum

from tkamb.body.patellofemoral import PatellofemoralContact
from tkamb.geometry.frames import Array


class PatellaStatus(Enum):
    """How the search ended: found, or which condition of the place was not met."""

    OK = "ok"
    SEVERAL = "several_solutions"
    EDGE = "contact_on_edge_of_femoral_mesh"
    NO_CONTACT = "no contact: the button meets the femoral component at no rotation"
    LINE = "a line's end lies inside what it wraps, or runs along the contact normal"
    GAP = "the gap to the femoral component does not close"
    LIGAMENT = "the patellar ligament's length is not met"
    MOMENT = "moments balance at no rotation that was tried"
    PULL = "the contact would have to pull, or the patellar ligament to push"

    @property
    def found(self) -> bool:
        """Whether there is a place; else the value says which condition failed."""
        return self in (PatellaStatus.OK, PatellaStatus.SEVERAL, PatellaStatus.EDGE)


@dataclass(frozen=True, eq=False)
class PatellaState:
    """The patella at one frame.

    Args:
        coordinates: (3,) patella_ap, patella_si (m), patella_rotation (rad); NaN if not found.
        contact_point: (3,) m, on the line of action, insert frame.
        contact_normal: (3,) unit, out of the femur into the patella, in the femur's sagittal
            plane, insert frame.
        contact_on_patella: (3,) m, the same point in the patella's frame.
        gap: m, positive when apart.
        ligament_ratio: patellar ligament tension per tension of the muscle, massless patella.
        patellofemoral_ratio: patellofemoral force per tension of the muscle, massless patella.
        shift: m along z, the mediolateral shift that is left out of the motion; first order.
        tilt: rad about y, likewise.
        status: how the search ended.
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


@dataclass(frozen=True, eq=False)
class ExtensorMechanism:
    """What stays the same over all frames.

    Args:
        contact: button against femoral component, in the patellar joint's frame.
        pose_joint_in_femur: (4, 4), the patellar joint's frame on the femur link.
        muscle_origin: (3,) m, femur link; of the stretch that leaves the femur.
        muscle_insertion: (3,) m, patella link.
        ligament_proximal: (3,) m, patella link.
        ligament_distal: (3,) m, insert frame.
        ligament_length: m.
        femoral_outline: (n, 2) m, in the femur link's x-y plane; None: no wrapping.
        insert_outline: (n, 2) m, in the insert's x-y plane; None: no wrapping.
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
