"""What the body asks of the knee joint at one frame, whatever its contact may be.

Across the knee, femur and shank exchange one wrench: what ground, weight and inertia leave
unbalanced on the shank. It does not depend on the knee coordinates, for the shank moves as
recorded. Contact, ligaments and the patellar ligament must add up to it:

    R(q, y) = w_external + w_ligaments(q) + w_contact(q) + B y = 0        (on the insert)

The columns B are the loads that may keep the prescribed coordinates in place: the patellar
ligament's line (flexion), and the residuals of the equations of motion for the others. The
quadriceps and the patellofemoral force are internal to the femur's side. What a released
coordinate i is driven by is the generalised force

    r_i = -J_i(q) . R(q, y),   y such that the prescribed coordinates have none,

J of `knee_axes`: zero at equilibrium, and along +q_i where the femur wants to go.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.body import unknowns
from tkamb.body.knee import KneeGeometry
from tkamb.body.ligaments import Ligament, quadratic_toe_force, two_line_force
from tkamb.body.load import PointForces, total_wrench
from tkamb.geometry.frames import KNEE_COORDINATES, Array, inverse, knee_pose, transform
from tkamb.geometry.knee_axes import knee_axes

ORIGIN = np.zeros(3)


@dataclass(frozen=True, eq=False)
class LigamentSet:
    """All bundles across the knee at once; those that do not cross it are left out.

    Args:
        on_femur: (m, 3) m, their ends on the femur's side, femur frame.
        on_shank: (m, 3) m, their other ends, insert frame.
        two_line: (m,) which law.
        stiffness: (m,) N/m or N per unit strain, as the law takes it.
        slack_length: (m,) m.
    """

    on_femur: Array
    on_shank: Array
    two_line: Array
    stiffness: Array
    slack_length: Array

    def wrench(self, poses: Array) -> Array:
        """Return the wrench (..., 6) on the insert at poses (..., 4, 4) of the femur."""
        femur = np.einsum("...ij,mj->...mi", poses[..., :3, :3], self.on_femur)
        femur = femur + poses[..., None, :3, 3]
        line = femur - self.on_shank
        length = np.linalg.norm(line, axis=-1)
        law = (self.slack_length, self.stiffness)
        tension = np.where(
            self.two_line, two_line_force(length, *law), quadratic_toe_force(length, *law)
        )
        pull = (tension / length)[..., None] * line
        moment = np.cross(np.broadcast_to(self.on_shank, pull.shape), pull)
        return np.concatenate([pull.sum(axis=-2), moment.sum(axis=-2)], axis=-1)


@dataclass(frozen=True, eq=False)
class KneeDemand:
    """The equations of equilibrium of the released knee coordinates at one frame.

    Args:
        external: (6,) w_external on the insert, force and moment about its origin.
        ligaments: the bundles.
        keeping: (6, 6 - n) B, one column per prescribed coordinate.
        released: indices of the n released coordinates.
    """

    external: Array
    ligaments: LigamentSet
    keeping: Array
    released: tuple[int, ...]

    def imbalance(self, coordinates: Array, contact: Array) -> Array:
        """Return r (..., n): generalised forces on the released coordinates.

        Args:
            coordinates: (..., 6) knee coordinates.
            contact: (6,) w_contact on the insert.
        """
        axes, wrench = self._loaded(coordinates, contact)
        kept = self._kept(axes, wrench)
        left = wrench + np.einsum("ij,...j->...i", self.keeping, kept)
        return -np.einsum("...ij,...j->...i", axes[..., list(self.released), :], left)

    def kept(self, coordinates: Array, contact: Array) -> Array:
        """Return y (6 - n,): magnitudes of the loads that keep the prescribed coordinates."""
        return self._kept(*self._loaded(coordinates, contact))

    def contact_gain(self, coordinates: Array) -> Array:
        """Return d r / d w_contact (n, 6) at coordinates (6,)."""
        axes = knee_axes(coordinates)
        rows = self._prescribed
        through = np.linalg.solve(axes[rows] @ self.keeping, axes[rows])
        return -axes[list(self.released)] @ (np.eye(6) - self.keeping @ through)

    @property
    def _prescribed(self) -> list[int]:
        return [i for i in range(6) if i not in self.released]

    def _loaded(self, coordinates: Array, contact: Array) -> tuple[Array, Array]:
        pulls = self.ligaments.wrench(knee_pose(coordinates))
        return knee_axes(coordinates), self.external + contact + pulls

    def _kept(self, axes: Array, wrench: Array) -> Array:
        rows = axes[..., self._prescribed, :]
        right = np.einsum("...ij,...j->...i", rows, wrench)
        return np.asarray(-np.linalg.solve(rows @ self.keeping, right[..., None])[..., 0])


def knee_demand(
    geometry: KneeGeometry,
    ligaments: Sequence[Ligament],
    coordinates: Array,
    released: tuple[int, ...],
    middle: Array,
    slack: bool,
) -> KneeDemand:
    """Return what the body asks of the knee at one frame.

    Args:
        geometry: the frame; its condyles and ligament loads are not looked at.
        ligaments: the bundles.
        coordinates: (6,) knee coordinates at which the geometry stands.
        released: indices of the released coordinates; flexion is never among them.
        middle: (3,) m, where the residual forces act, insert frame.
        slack: the extensor mechanism carries nothing.
    """
    keeping = [
        total_wrench([load for load in loads if load.link == "tibia"], ORIGIN)
        for i, loads in enumerate(_keepers(geometry, middle, slack))
        if i not in released
    ]
    return KneeDemand(
        external_wrench(geometry, coordinates),
        ligament_set(geometry, ligaments, coordinates),
        np.array(keeping).T,
        released,
    )


def external_wrench(geometry: KneeGeometry, coordinates: Array) -> Array:
    """Return the wrench (6,) that ground, weight and inertia exert on the shank."""
    state = geometry.state
    hip = unknowns.hip(state.point("hip", np.zeros(3)))
    ground = [geometry.ground] if geometry.ground else []
    columns = state.generalised([*(unknown.loads for unknown in hip), ground])
    without = state.inertial - columns[:, -1]
    at_hip = np.linalg.solve(columns[:6, :6], without[:6])
    knee = (without - columns[:, :6] @ at_hip)[state.chain.knee_columns()]
    return np.linalg.solve(knee_axes(coordinates), knee)


def ligament_set(
    geometry: KneeGeometry, ligaments: Sequence[Ligament], coordinates: Array
) -> LigamentSet:
    """Return the bundles that cross the knee, their ends in the femur and insert frames.

    An end on the patella moves with the femur from where it stands.
    """
    state, chain = geometry.state, geometry.state.chain
    to_femur = inverse(knee_pose(coordinates))
    femur, shank, rows = [], [], []
    for bundle in ligaments:
        ends = {
            chain.on_shank(link): transform(state.pose(link), point)
            for link, point in (
                (bundle.proximal_link, bundle.proximal_point),
                (bundle.distal_link, bundle.distal_point),
            )
        }
        if len(ends) == 2:
            femur.append(transform(to_femur, ends[False]))
            shank.append(ends[True])
            rows.append((bundle.law == "two-line", bundle.stiffness, bundle.slack_length))
    table = np.array(rows, float).reshape(-1, 3)
    return LigamentSet(
        np.array(femur).reshape(-1, 3),
        np.array(shank).reshape(-1, 3),
        table[:, 0] > 0,
        table[:, 1],
        table[:, 2],
    )


def _keepers(geometry: KneeGeometry, middle: Array, slack: bool) -> list[Sequence[PointForces]]:
    """Return per knee coordinate the load of unit magnitude that may keep it in place."""
    extensor = geometry.extensor
    flexion = unknowns.moment_pair("tibia", "femur", unknowns.AXES["ml"])
    moments = {"axial_rotation": "si", "adduction": "ap"}
    keepers: list[Sequence[PointForces]] = []
    for name in KNEE_COORDINATES:
        if name == "flexion":
            taut = extensor is not None and not slack
            keepers.append(extensor.patellar_ligament if taut and extensor else flexion)
        elif name in moments:
            axis = unknowns.AXES[moments[name]]
            keepers.append(unknowns.moment_pair("tibia", "femur", axis))
        else:
            keepers.append(unknowns.pair("tibia", "femur", middle, unknowns.AXES[name]))
    return keepers
