"""Muscles across the knee whose forces are known: all but those that end on the patella.

A taut line crosses from the shank at p to the thigh, or the pelvis above it, at q. With force F it
pulls the shank at p along u = (q - p)/|q - p|, and the thigh at q along -u. Foot and shank are
one body, so that a line which ends on the foot pulls that body where it leaves the foot. A pull
from the pelvis acts on the femur here, and the loads across the hip balance it with all other
loads on the thigh. Both ends are fixed to their links and follow the knee.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import Array, inverse, transform
from tkamb.knee import unknowns
from tkamb.knee.load import PointForces, wrench_of

if TYPE_CHECKING:
    from tkamb.knee.chain import ChainState


@dataclass(frozen=True, eq=False)
class CrossingLines:
    """Lines from the shank to the thigh at one frame.

    Args:
        shank: (c, 3) m, where they leave the shank or the foot, tibia link.
        thigh: (c, 3) m, where they reach the thigh or the pelvis, femur link.
        knee: (4, 4) pose of the femur link in the tibia link at which both ends were computed from
        the muscles' paths; None: not known.
    """

    shank: Array
    thigh: Array
    knee: Array | None = None

    def turned(self, state: "ChainState") -> float:
        """Return the turn of the knee since the ends were computed, rad; NaN: unknown.

        Ends that wrap a bone or pass a via point would move along it as the knee turns. Here they
        stay on their links, so that a line's direction errs by about this angle at most.
        """
        if self.knee is None:
            return float("nan")
        now = inverse(state.pose("tibia")) @ state.pose("femur")
        change = Rotation.from_matrix(self.knee[:3, :3].T @ now[:3, :3])
        return float(change.magnitude())

    def unit_wrenches(self, tibia: Array, femur: Array) -> Array:
        """Return the wrench (..., c, 6) of one newton of each on the insert, about its origin.

        Args:
            tibia: (4, 4) pose of the tibia link in the insert frame.
            femur: (..., 4, 4) poses of the femur link in it.
        """
        start = transform(tibia, self.shank)
        along = np.einsum("...ij,cj->...ci", femur[..., :3, :3], self.thigh)
        along = along + femur[..., None, :3, 3] - start
        along = along / np.linalg.norm(along, axis=-1, keepdims=True)
        return wrench_of(start, along)

    def unit_loads(self, state: "ChainState") -> list[tuple[PointForces, ...]]:
        """Return what one newton of each does to tibia and femur, insert frame."""
        return [
            (PointForces("tibia", p[None], u[None]), PointForces("femur", q[None], -u[None]))
            for p, q, u in zip(*self._ends(state), strict=True)
        ]

    def loads(self, state: "ChainState", force: Array) -> tuple[PointForces, PointForces]:
        """Return what forces (c,), N, along them do to tibia and femur, insert frame."""
        start, end, along = self._ends(state)
        pulls = force[:, None] * along
        return PointForces("tibia", start, pulls), PointForces("femur", end, -pulls)

    def _ends(self, state: "ChainState") -> tuple[Array, Array, Array]:
        """Return starts, ends and directions (c, 3), insert frame."""
        start = transform(state.pose("tibia"), self.shank)
        end = transform(state.pose("femur"), self.thigh)
        along = end - start
        return start, end, along / np.linalg.norm(along, axis=-1, keepdims=True)


@dataclass(frozen=True, eq=False)
class MuscleShare:
    """What each muscle of a leg carries at one frame.

    Args:
        muscles: m names.
        activation: (m,).
        force: (m,) N.
        coordinates: n names of those that are balanced.
        moment: (n,) N·m, joint moment that muscles and reserves supply together.
        reserve: (n,) N·m, part of it that no muscle supplies.
        flexion: place of the knee's flexion among the coordinates.
        crossing: (c,) places of the muscles that cross the knee, without the extensor group.
        lines: lines of action of the crossing muscles.
        status: "ok" or "failed: …".
    """

    muscles: tuple[str, ...]
    activation: Array
    force: Array
    coordinates: tuple[str, ...]
    moment: Array
    reserve: Array
    flexion: int
    crossing: np.ndarray
    lines: CrossingLines
    status: str = "ok"

    def loads(self, state: "ChainState") -> tuple[PointForces, ...]:
        """Return what the crossing muscles and the knee's reserve do to tibia and femur."""
        both = self.lines.loads(state, self.force[self.crossing])
        return (*both, *unknowns.moment_pair("tibia", "femur", self._knee_reserve))

    def wrench(self, tibia: Array, femur: Array) -> Array:
        """Return the wrench (..., 6) of the same on the insert, about its origin.

        Args:
            tibia: (4, 4) pose of the tibia link in the insert frame.
            femur: (..., 4, 4) poses of the femur link in it.
        """
        units = self.lines.unit_wrenches(tibia, femur)
        total = np.einsum("i,...ij->...j", self.force[self.crossing], units)
        total[..., 3:] += self._knee_reserve
        return np.asarray(total)

    @property
    def _knee_reserve(self) -> Array:
        """(3,) N·m on the tibia, about the insert's z as the residual moment of flexion is."""
        return self.reserve[self.flexion] * unknowns.AXES["ml"]
