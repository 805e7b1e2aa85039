"""Rigid-body mechanics of a knee in the frames of a motion: loads from poses."""

import copy
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import TkambError
from tkamb.geometry.frames import SIDES, Array, cross, inverse, knee_pose, transform
from tkamb.knee.contact_points import NO_CONTACT, ContactPoints
from tkamb.knee.equations import KneeGeometry, SolvedLoads, solve_knee
from tkamb.knee.instant import Instant
from tkamb.knee.knee import Knee
from tkamb.knee.load import PointForces

if TYPE_CHECKING:
    from tkamb.contact.model import ContactModel
    from tkamb.geometry.adjustment import Adjustment, AdjustmentSettings
    from tkamb.geometry.closest import ClosestPointQuery
    from tkamb.knee.adjustment import AdjustmentEffect
    from tkamb.knee.extensor import ExtensorFrames
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.patella import PatellaState
    from tkamb.knee.slip import CondyleSlip
    from tkamb.run.muscles.shared_muscles import SharedMuscles


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of a Pinocchio model in f frames.

    Args:
        time: times, s, (f,).
        q: configurations, (f, nq).
        v: velocities, (f, nv).
        a: accelerations, (f, nv).
        coordinates: knee coordinates, m and rad, (f, 6).
    """

    time: Array
    q: Array
    v: Array
    a: Array
    coordinates: Array

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, eq=False)
class Ground(Sequence[Any]):
    """The ground reaction in each frame as external forces on the joints of a model.

    Args:
        forces: one `pin.StdVec_Force` per frame, with a force per joint in the joint's frame.
        points: points of application in the laboratory, m, (f, 3).
    """

    forces: tuple[Any, ...]
    points: Array

    def __len__(self) -> int:
        return len(self.forces)

    def __getitem__(self, k: Any) -> Any:
        return self.forces[k]


@dataclass(frozen=True, eq=False)
class FrameLoads:
    """The loads of one frame by the rigid-body equations.

    Args:
        geometry: geometry in the equations.
        loads: solution of the equations.
        adjustment: femoral adjustment; None: not requested, or impossible.
        query_seconds: computing time of the closest points on the meshes, s.
        seconds: computing time of kinematics and equations, s.
        effect: change of the forces by the adjustment; None without an adjustment, or without a
            solution at the recorded pose.
    """

    geometry: KneeGeometry
    loads: SolvedLoads
    adjustment: "Adjustment | None"
    query_seconds: float
    seconds: float
    effect: "AdjustmentEffect | None" = None


class Mechanics:
    """The rigid-body mechanics of a knee in the frames of a motion.

    Args:
        knee: knee of a right leg.
        motion: motion of the knee's model.
        ground: ground reaction; None: not measured.
        extensor: patella in all frames; None: not modelled.
        muscles: muscles of [muscles]; None: the quadriceps is the only muscle.
        adjust: settings of the femoral adjustment; None: no adjustment.
        strains: name of a ligament bundle -> strains at some flexions, for the summary.

    Attributes:
        poses: recorded pose_femur_in_insert, (f, 4, 4).
    """

    def __init__(
        self,
        knee: Knee,
        motion: Motion,
        ground: Ground | None = None,
        extensor: "ExtensorFrames | None" = None,
        muscles: "SharedMuscles | None" = None,
        adjust: "AdjustmentSettings | None" = None,
        strains: dict[str, tuple[float, ...]] | None = None,
    ) -> None:
        self.knee, self.motion, self.ground = knee, motion, ground
        self.extensor, self.muscles, self._adjustment = extensor, muscles, adjust
        self.strains = strains or {}
        self.poses = knee_pose(motion.coordinates)
        self._data = knee._kinematic_data()

    def with_contact(self, model: "ContactModel") -> "Mechanics":
        """Return the same mechanics with another contact model."""
        other = copy.copy(self)
        other.knee = self.knee.with_contact(model)
        return other

    @property
    def friction(self) -> float:
        """Coulomb coefficient of the femorotibial contact."""
        return self.knee.friction

    @property
    def ligaments(self) -> "tuple[Ligament, ...]":
        """The ligament bundles with their slack lengths."""
        return self.knee.ligaments

    @property
    def query(self) -> "ClosestPointQuery | None":
        """Query of the closest points of femoral component and insert; None without contact."""
        return None if self.knee.contact is None else self.knee._query

    def instant(self, k: int) -> Instant:
        """Return the knee at frame k."""
        motion = self.motion
        instant = self.knee._instant(
            motion.q[k],
            motion.v[k],
            motion.a[k],
            None if self.ground is None else self.ground[k],
            data=self._data,
            patella=None if self.extensor is None else self.extensor.at(k),
            muscles=None if self.muscles is None else self.muscles.frame(k),
        )
        # Joint placements cause rounding errors: restore the recorded coordinates exactly.
        joints = instant.motion.joints.copy()
        joints[0, :6] = motion.coordinates[k]
        if self.extensor is not None:
            joints[0, 6:] = self.extensor.joints(k)[0]
        instant = replace(instant, motion=replace(instant.motion, joints=joints))
        if self.ground is None or instant.ground is None:
            return instant
        insert = instant.motion.tibia @ self.knee.chain.insert_in_tibia
        point = transform(inverse(insert), self.ground.points[k])
        return replace(instant, ground=_acting_at(point, instant.ground))

    def geometry(
        self, k: int, coordinates: Array | None = None, patella: "PatellaState | None" = None
    ) -> KneeGeometry:
        """Return the geometry of frame k without contact, see `Instant.geometry`."""
        return self.instant(k).geometry(coordinates, patella)

    def frame(self, k: int, adjustment: "Adjustment | None" = None) -> FrameLoads:
        """Return the loads of frame k; NaN in a frame without a solution.

        Args:
            k: index of the frame.
            adjustment: femoral adjustment; None: computed if the scene has one.
        """
        start, instant = clock.perf_counter(), self.instant(k)
        kinematics_end, problems = clock.perf_counter(), tuple[str, ...]()
        if adjustment is None:
            adjustment, problems = self._adjust(k)
        pose = adjustment.pose if adjustment else self.poses[k]
        points = NO_CONTACT if problems else self._contact_points(instant, pose)
        recorded = self._contact_points(instant, self.poses[k]) if adjustment else None
        query_end = clock.perf_counter()
        geometry = instant.geometry()
        problems += points.problems + geometry.problems
        geometry = replace(
            geometry, condyles=points.condyles, lifted=points.lifted, problems=problems
        )
        geometry, loads = instant.solved(geometry)
        end = clock.perf_counter()
        effect = self._effect(geometry, loads, recorded) if recorded else None
        seconds = kinematics_end - start + end - query_end
        query_seconds = query_end - kinematics_end
        return FrameLoads(geometry, loads, adjustment, query_seconds, seconds, effect)

    def slips(self, last: int) -> "dict[str, CondyleSlip]":
        """Return side -> rolling and slip of a condyle up to a frame; empty without contact.

        Args:
            last: last frame of the slip. The slip rate uses one more frame.
        """
        if self.knee.contact is None:
            return {}
        from tkamb.knee.slip import condyle_slip

        pair = self.knee.contact.pair
        recorded = self.motion.coordinates[: last + 2]
        result = condyle_slip(pair.femoral, pair.insert, pair.split, recorded)
        sides = zip(SIDES, result, strict=True)
        return {side: slip for side, slip in sides if slip is not None}

    def _adjust(self, k: int) -> "tuple[Adjustment | None, tuple[str, ...]]":
        """Return the femoral adjustment, if the scene has one, and reasons for its failure."""
        if self.query is None or self._adjustment is None:
            return None, ()
        from tkamb.geometry.adjustment import adjust

        try:
            return adjust(self.query, self.poses[k], self._adjustment), ()
        except TkambError as error:
            return None, (error.what,)

    def _contact_points(self, instant: Instant, pose: Array) -> ContactPoints:
        """Return the contact points of the condyles at a pose (4, 4) and their velocities."""
        return NO_CONTACT if self.query is None else instant.contact_points(self.query, pose)

    def _effect(
        self, geometry: KneeGeometry, loads: SolvedLoads, recorded: ContactPoints
    ) -> "AdjustmentEffect | None":
        """Return the change by the adjustment; None: one of the two poses has no solution."""
        if loads.problems or recorded.problems:
            return None
        from tkamb.knee.adjustment import adjustment_effect

        recorded_geometry = replace(geometry, condyles=recorded.condyles, lifted=recorded.lifted)
        before = solve_knee(recorded_geometry, self.friction)
        if before.problems:
            return None
        return adjustment_effect(loads, before, geometry.condyles, recorded.condyles)


def _acting_at(point: Array, load: PointForces) -> PointForces:
    """Return the equivalent load at a point (3,) of a load at the origin."""
    moment = load.moment - np.asarray(cross(point, load.forces[0]))
    return PointForces(load.link, point[None], load.forces, moment)
