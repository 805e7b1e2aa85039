"""Equilibrium of the knee joint at one frame, whatever its contact may be.

Across the knee, femur and shank exchange one wrench. It balances ground reaction, weight and
inertia of the shank. It does not depend on the knee coordinates, because the shank moves as
recorded. Contact, ligaments, muscles and the patellar ligament must add up to it:

    R(q, y) = w_external + w_ligaments(q) + w_muscles(q) + w_contact(q) + B y = 0   (on the insert)

The columns B are the loads that may keep the prescribed coordinates in place: the patellar
ligament's line (flexion), and the residuals of the equations of motion for the others. The
extensor muscle and the patellofemoral force are internal to the femur's side. A released
coordinate i is driven by the generalised force

    r_i = -J_i(q) . R(q, y),   y such that the prescribed coordinates have none,

J of `knee_axes`: zero at equilibrium, and along +q_i where the femur wants to go.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import KNEE_COORDINATES, Array, inverse, knee_axes, knee_pose, transform
from tkamb.knee import unknowns
from tkamb.knee.crossing import MuscleShare
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.load import wrench_of

if TYPE_CHECKING:
    from tkamb.knee.ligaments import BundleArrays, Ligament


@dataclass(frozen=True, eq=False)
class PatellarLine:
    """The patellar ligament where it leaves the patella: a straight line to an anchor.

    Args:
        end: (3,) m, on the patella, carried by the femur, femur frame.
        anchor: (3,) m, the next point on the shank, tuberosity or front lip, insert frame.
    """

    end: Array
    anchor: Array

    def wrench(self, poses: Array) -> Array:
        """Return the wrench (..., 6) of a unit tension on the insert at poses (..., 4, 4)."""
        line = transform(poses, self.end) - self.anchor
        return wrench_of(self.anchor, line / np.linalg.norm(line, axis=-1, keepdims=True))


@dataclass(frozen=True, eq=False)
class JointEquilibrium:
    """The equations of equilibrium of the released knee coordinates at one frame.

    Args:
        external: (6,) w_external on the insert, force and moment about its origin.
        ligaments: the bundles.
        line: the patellar ligament, which balances flexion; None: a moment balances it.
        keeping: (6, m) the other columns of B, of unit magnitude.
        released: indices of the n released coordinates.
        share: the muscles across the knee beside the quadriceps, if modelled.
        tibia: (4, 4) pose of the tibia link in the insert frame.
    """

    external: Array
    ligaments: "BundleArrays"
    line: PatellarLine | None
    keeping: Array
    released: tuple[int, ...]
    share: MuscleShare | None = None
    tibia: Array = field(default_factory=lambda: np.eye(4))

    def imbalance(self, coordinates: Array, contact: Array) -> Array:
        """Return r (..., n): generalised forces on the released coordinates.

        Args:
            coordinates: (..., 6) knee coordinates.
            contact: (6,) w_contact on the insert.
        """
        axes, columns, wrench = self._sum_loads(coordinates, contact)
        reactions = _magnitudes(axes[..., self._prescribed, :], columns, wrench)
        remainder = wrench + np.einsum("...ij,...j->...i", columns, reactions)
        return -np.einsum("...ij,...j->...i", axes[..., list(self.released), :], remainder)

    def kept(self, coordinates: Array, contact: Array) -> Array:
        """Return y (6 - n,): the loads that keep the prescribed coordinates, flexion last."""
        axes, columns, wrench = self._sum_loads(coordinates, contact)
        return _magnitudes(axes[..., self._prescribed, :], columns, wrench)

    def contact_gain(self, coordinates: Array) -> Array:
        """Return d r / d w_contact (n, 6) at coordinates (6,)."""
        axes, columns = knee_axes(coordinates), self.columns(coordinates)
        rows = axes[self._prescribed]
        # Projection that takes the reactions of the prescribed coordinates out of a contact wrench.
        through = np.eye(6) - columns @ np.linalg.solve(rows @ columns, rows)
        return np.asarray(-axes[list(self.released)] @ through)

    def kept_and_left(self, coordinates: Array, contact: Array) -> tuple[Array, Array]:
        """Return what `kept` does, and the residual wrench R (6,) on the insert."""
        axes, columns, wrench = self._sum_loads(coordinates, contact)
        reactions = _magnitudes(axes[self._prescribed], columns, wrench)
        return reactions, wrench + columns @ reactions

    def whole(self, coordinates: Array, contact: Array) -> Array:
        """Return generalised forces (m, 6) on all coordinates, with y of the last of m places.

        Args:
            coordinates: (m, 6) knee coordinates.
            contact: (6,) w_contact on the insert.
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
        if line is not None and not self.keeping.size:
            return line
        columns = np.broadcast_to(self.keeping, (*poses.shape[:-2], *self.keeping.shape))
        return columns if line is None else np.concatenate([columns, line], axis=-1)


def _magnitudes(rows: Array, columns: Array, wrench: Array) -> Array:
    """Return y with rows (columns y + wrench) = 0."""
    # Prescribed coordinates are held: their reactions make the generalised forces on them vanish.
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
        ligaments: the bundles.
        coordinates: (6,) knee coordinates of the geometry.
        released: indices of the released coordinates; flexion is never among them.
        middle: (3,) m, where the residual forces act, insert frame.
        slack: the extensor mechanism carries nothing.
        external: (6,) see `external_wrench`.
    """
    line = None if slack or geometry.extensor is None else patellar_line(geometry, coordinates)
    columns = [
        unit_keeper(name, middle)
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


def unit_keeper(name: str, middle: Array) -> Array:
    """Return the wrench (6,) on the insert of the residual that keeps one knee coordinate.

    As in the equations of motion: forces along the insert's axes at `middle`, moments about
    its x (adduction), y (axial rotation) and z (flexion).
    """
    axis = unknowns.AXES[
        {"adduction": "ap", "axial_rotation": "si", "flexion": "ml"}.get(name, name)
    ]
    if name in unknowns.AXES:
        return wrench_of(middle, axis)
    return np.concatenate([np.zeros(3), axis])


def patellar_line(geometry: KneeGeometry, coordinates: Array) -> PatellarLine:
    """Return the patellar ligament's first straight stretch at coordinates (6,)."""
    extensor, chain = geometry.extensor, geometry.state.chain
    assert extensor is not None
    shank = [load for load in extensor.patellar_ligament if chain.on_shank(load.link)]
    free = [load for load in extensor.patellar_ligament if not chain.on_shank(load.link)]
    end, along = free[0].points[0], free[0].forces[0]
    # The ligament may wrap the insert, so that its anchor is the first point on the shank along it.
    away = min(float((load.points[0] - end) @ along) for load in shank)
    return PatellarLine(transform(inverse(knee_pose(coordinates)), end), end + away * along)


def external_wrench(geometry: KneeGeometry, coordinates: Array) -> Array:
    """Return the wrench (6,) on the insert that ground, weight and inertia exert on the shank.

    The same wherever the knee is in that frame.
    """
    state = geometry.state
    hip = unknowns.hip(state.point("hip", np.zeros(3)))
    ground = [geometry.ground] if geometry.ground else []
    columns = state.generalised([*(unknown.loads for unknown in hip), ground])
    # As in `KneeSystem`: what hip and knee supply together, less the ground reaction.
    without = state.inertial - columns[:, -1]
    # The first six equations hold no internal loads of the knee, so that they give the hip's alone.
    at_hip = np.linalg.solve(columns[:6, :6], without[:6])
    knee = (without - columns[:, :6] @ at_hip)[state.chain.knee_columns()]
    # Generalised forces are axes times wrench; solved for the wrench on the tibia.
    return np.asarray(np.linalg.solve(knee_axes(coordinates), knee))


def crossing_bundles(
    geometry: KneeGeometry, ligaments: "Sequence[Ligament]", coordinates: Array
) -> "BundleArrays":
    """Return the bundles that cross the knee, their ends in the femur and insert frames.

    An end on the patella is taken as fixed to the femur.
    """
    from tkamb.knee.ligaments import BundleArrays

    state, chain = geometry.state, geometry.state.chain
    to_femur = inverse(knee_pose(coordinates))
    crossing, femur, shank = [], [], []
    for bundle in ligaments:
        ends = {
            chain.on_shank(end.link): transform(state.pose(end.link), end.position)
            for end in (bundle.proximal, bundle.distal)
        }
        if len(ends) == 2:
            crossing.append(bundle)
            femur.append(transform(to_femur, ends[False]))
            shank.append(ends[True])
    return BundleArrays.of(crossing, np.array(femur), np.array(shank))
