"""The body side of a case: geometry of each frame in, loads of each frame out."""

import time as clock
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tkamb.errors import ComputationError, InputError, TkambError
from tkamb.geometry.frames import SIDES, Array, cross, knee_pose, knee_twist
from tkamb.io.scene.case import Case
from tkamb.knee.chain import ChainMotion, ChainState
from tkamb.knee.contact_points import (
    CONTACT_POINT,
    NO_CONTACT,
    CondylePoint,
    ContactPoints,
    contact_points,
    nearest_gap,
)
from tkamb.knee.equations import KneeGeometry, KneeLoads, solve_knee, unsolved
from tkamb.knee.load import PointForces
from tkamb.run.known import SharedState, contact_query, extensor_frames
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.probe import CondyleWrench
    from tkamb.geometry.adjustment import Adjustment
    from tkamb.geometry.closest import ClosestPointQuery
    from tkamb.knee.adjustment_effect import AdjustmentEffect
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.patella import PatellaState
    from tkamb.knee.slip import CondyleSlip

STRAIN_FLEXIONS = (0.0, 60.0, 90.0)
"""deg: where the strains of the ligaments are shown."""

NAN = float("nan")


@dataclass(frozen=True, eq=False)
class FrameLoads:
    """The body side of one frame.

    Args:
        geometry: what the equations worked on.
        loads: what they say.
        adjustment: the femoral adjustment, if asked for and possible.
        query_seconds: computing time of the closest points on the meshes.
        seconds: computing time of the equations, contact points given.
        effect: what the adjustment does to the forces; None without one, or where the recorded
            pose has no solution.
    """

    geometry: KneeGeometry
    loads: KneeLoads
    adjustment: "Adjustment | None"
    query_seconds: float
    seconds: float
    effect: "AdjustmentEffect | None" = None


class Mechanics:
    """The rigid-body mechanics of a case, frame by frame.

    Args:
        case: the scene with its files read.
        shared: state of the case that this one is a sample of.
        near: whether the condyles are known to be near the insert.

    Attributes:
        poses: (f, 4, 4) recorded pose_femur_in_insert.
        friction: Coulomb coefficient of the femorotibial contact.
        extensor: patella and lines of action of all frames; None if not modelled.
        ligaments: the bundles, with their slack lengths.
        strains: bundle -> strain at the flexions of `STRAIN_FLEXIONS`; NaN if not recorded.
        muscles: those that share the load; None if the quadriceps alone acts.
    """

    def __init__(self, case: Case, shared: SharedState | None = None, near: bool = False) -> None:
        self.case, self._known = case, shared
        self.poses = knee_pose(case.motion.coordinates)
        self.friction = case.scene.contact.friction if case.scene.contact else 0.0
        if shared is None and not near:
            self._check_near()
        self.extensor = None
        if case.scene.patella:
            self.extensor = extensor_frames(case, self.poses, shared)
        self.ligaments, self.strains = self._build_ligaments()
        self.muscles = shared.muscles if shared else None
        if case.scene.muscles and shared is None:
            from tkamb.run.muscles.shared_muscles import load_muscles

            self.muscles = load_muscles(case)

    @cached_property
    def query(self) -> "ClosestPointQuery | None":
        """Closest points of the two surfaces; None without [contact]."""
        return self._known.query if self._known else contact_query(self.case)

    def _check_near(self) -> None:
        """Raise where the condyles are nowhere near the insert, whatever the frame."""
        contact = self.case.scene.contact
        if contact is None or contact.released or self.query is None:
            return
        middle, last = len(self.poses) // 2, len(self.poses) - 1
        nearest: list[float] = []
        for k in (middle, 0, last):
            nearest.append(nearest_gap(self.query.at(self.poses[k])))
            if abs(nearest[-1]) <= CONTACT_POINT.max_gap:
                break
        else:
            gap = min(nearest, key=abs)
            raise InputError(
                f"neither condyle is near the insert (nearest {abs(gap) / MILLIMETRE:.0f} mm "
                f"{'apart' if gap > 0 else 'inside'})",
                "[motion] with [implant.femoral] and [implant.insert]",
                "check which mesh is which, their units, axes and places, and the motion's",
            )

    def frame(self, k: int, adjustment: "Adjustment | None" = None) -> FrameLoads:
        """Return the loads of frame k; a frame that cannot be solved holds NaN.

        Args:
            k: frame.
            adjustment: the femoral adjustment, if it is decided; None: as the scene asks.
        """
        start = clock.perf_counter()
        if adjustment is None:
            adjustment, problems = self._adjust(k)
        else:
            problems = ()
        pose = adjustment.pose if adjustment else self.poses[k]
        points = NO_CONTACT if problems else self._contact_points(k, pose)
        recorded = self._contact_points(k, self.poses[k]) if adjustment else None
        queried = clock.perf_counter()
        geometry = self.geometry(k)
        problems += points.problems + geometry.problems
        geometry = replace(
            geometry, condyles=points.condyles, lifted=points.lifted, problems=problems
        )
        geometry, loads = self.solved(k, geometry)
        end = clock.perf_counter()
        effect = self._effect(geometry, loads, recorded) if recorded else None
        return FrameLoads(geometry, loads, adjustment, queried - start, end - queried, effect)

    def solved(self, k: int, geometry: KneeGeometry) -> tuple[KneeGeometry, KneeLoads]:
        """Return frame k with the muscles' shares in it, and its loads.

        Args:
            k: frame.
            geometry: the frame, with its contact points.
        """
        if geometry.problems:
            return geometry, unsolved(geometry.problems)
        if self.muscles is None:
            return geometry, solve_knee(geometry, self.friction)
        return self.muscles.solve(k, geometry, self.friction)

    def geometry(
        self, k: int, coordinates: Array | None = None, patella: "PatellaState | None" = None
    ) -> KneeGeometry:
        """Return frame k without its contact, perhaps at other coordinates than recorded.

        Rates and accelerations stay as recorded.

        Args:
            k: frame.
            coordinates: (6,) m and rad; None: as recorded.
            patella: where the patella is with the femur there; None: as recorded.
        """
        recorded = self.case.motion.coordinates[k]
        place = recorded if coordinates is None else coordinates
        state = self.case.chain.at(self.chain_motion(k, place, patella))
        poses = {link: state.pose(link) for link in self._attachment_links()}
        tensions, known = self._pulls(poses)
        geometry = KneeGeometry(
            state, self._ground(k, state), known, coordinates=place, tensions=tensions
        )
        if self.extensor is None:
            return geometry
        try:
            extensor, muscle = self.extensor.at(k, recorded[5], state, patella)
        except ComputationError as error:
            return replace(geometry, problems=(str(error),))
        return replace(geometry, extensor=extensor, muscles=(muscle,))

    def sliding(self, k: int, coordinates: Array, point: Array) -> Array:
        """Return the velocity (3,) m/s of the femur's point relative to the insert's.

        Args:
            k: frame; the rates are the recorded ones.
            coordinates: (6,) where the knee is.
            point: (3,) m, insert frame.
        """
        velocity, spin = knee_twist(coordinates, self.case.motion.velocity[k])
        return np.asarray(velocity + cross(spin, point - coordinates[:3]))

    @property
    def sides(self) -> set[str]:
        """Names of the condyles that may carry load."""
        return {"medial"} if self.case.split is None else set(SIDES)

    def resultants(
        self, k: int, coordinates: Array, condyles: "Mapping[str, CondyleWrench]"
    ) -> dict[str, CondylePoint]:
        """Return the resultants of a contact as the contact points of the equations.

        Args:
            k: frame; the rates are the recorded ones.
            coordinates: (6,) where the knee is.
            condyles: side -> what it does to the insert there.
        """
        return {
            side: CondylePoint(
                condyle.point, condyle.normal, self.sliding(k, coordinates, condyle.point), 0.0
            )
            for side, condyle in condyles.items()
        }

    def post_loads(
        self, k: int, coordinates: Array, post: "CondyleWrench | None"
    ) -> tuple[PointForces, ...]:
        """Return what a cam on the post does to tibia and femur, with friction as a condyle's.

        Args:
            k: frame; the rates are the recorded ones.
            coordinates: (6,) where the knee is.
            post: what the cam does to the insert there; None: nothing.
        """
        if post is None:
            return ()
        sliding = self.sliding(k, coordinates, post.point)
        touch = CondylePoint(post.point, post.normal, sliding, 0.0)
        force = -post.force * touch.direction(self.friction)
        twist = post.wrench[3:] - cross(post.point, post.wrench[:3])
        return (
            PointForces("tibia", post.point[None], force[None], twist),
            PointForces("femur", post.point[None], -force[None], -twist),
        )

    def slips(self, last: int) -> "dict[str, CondyleSlip]":
        """Return side -> rolling and slipping up to a frame; empty without the two surfaces.

        It is the recorded motion's: empty too where released coordinates make another one.

        Args:
            last: the last frame whose slip and its rate are wanted: the rate takes one more.
        """
        case, contact = self.case, self.case.scene.contact
        if self.query is None or case.femoral is None or case.insert is None:
            return {}
        if contact and contact.released:
            return {}
        from tkamb.knee.slip import condyle_slip

        recorded = case.motion.coordinates[: last + 2]
        result = condyle_slip(case.femoral, case.insert, case.split, recorded)
        sides = zip(SIDES, result, strict=True)
        return {side: slip for side, slip in sides if slip is not None}

    def chain_motion(
        self, k: int, coordinates: Array | None = None, patella: "PatellaState | None" = None
    ) -> ChainMotion:
        """Return how the chain moves in frame k, perhaps at other coordinates (6,)."""
        motion, tibia = self.case.motion, self.case.tibia
        coordinates = motion.coordinates[k] if coordinates is None else coordinates
        joints = np.stack([coordinates, motion.velocity[k], motion.acceleration[k]])
        if self.extensor:
            own = self.extensor.joints(k)
            if patella is not None:
                own = np.concatenate([patella.coordinates[None], own[1:]])
            joints = np.hstack([joints, own])
        if tibia is None:
            return ChainMotion(np.eye(4), np.zeros(6), np.zeros(6), joints)
        return ChainMotion(tibia.pose[k], tibia.velocity[k], tibia.acceleration[k], joints)

    def _ground(self, k: int, state: ChainState) -> PointForces | None:
        load = self.ground_in_laboratory(k)
        return None if load is None else state.ground_reaction(*load)

    def ground_in_laboratory(self, k: int) -> tuple[Array, Array, Array] | None:
        """Return force, its point and the moment about it, (3,) each; None if not measured."""
        ground, table = self.case.ground, self.case.scene.ground_reaction
        if ground is None or table is None:
            return None
        if table.applied == "ankle":
            tibia = self.case.tibia
            assert tibia is not None
            return ground.force[k], tibia.pose[k][:3, 3], np.zeros(3)
        return ground.force[k], ground.point[k], ground.moment[k]

    def _adjust(self, k: int) -> "tuple[Adjustment | None, tuple[str, ...]]":
        """Return the femoral adjustment, if asked for, and why it is not possible."""
        contact = self.case.scene.contact
        if self.query is None or contact is None or not contact.adjust:
            return None, ()
        from tkamb.geometry.adjustment import AdjustmentSettings, adjust

        settings = AdjustmentSettings(restore_when=contact.adjust_restore_when)
        try:
            return adjust(self.query, self.poses[k], settings), ()
        except TkambError as error:
            return None, (error.what,)

    def _contact_points(self, k: int, pose: Array) -> ContactPoints:
        """Return where the condyles touch at a pose (4, 4), with the rates of frame k."""
        if self.query is None:
            return NO_CONTACT
        place = self.case.motion.coordinates[k]
        return contact_points(self.query, pose, lambda point: self.sliding(k, place, point))

    def _effect(
        self, geometry: KneeGeometry, loads: KneeLoads, recorded: ContactPoints
    ) -> "AdjustmentEffect | None":
        """Return what the adjustment changed; None where either pose has no solution."""
        if loads.problems or recorded.problems:
            return None
        from tkamb.knee.adjustment_effect import adjustment_effect

        recorded_geometry = replace(geometry, condyles=recorded.condyles, lifted=recorded.lifted)
        before = solve_knee(recorded_geometry, self.friction)
        if before.problems:
            return None
        return adjustment_effect(loads, before, geometry.condyles, recorded.condyles)

    def _pulls(self, poses: dict[str, Array]) -> tuple[dict[str, float], tuple[PointForces, ...]]:
        """Return the ligaments' tensions (N) by name, and what they do to the links."""
        if not self.ligaments:
            return {}, ()
        from tkamb.knee.ligaments import ligament_loads

        tensions, loads = ligament_loads(self.ligaments, poses)
        names = [bundle.name for bundle in self.ligaments]
        return dict(zip(names, tensions.tolist(), strict=True)), loads

    def _build_ligaments(
        self,
    ) -> "tuple[tuple[Ligament, ...], dict[str, tuple[float, ...]]]":
        """Return the bundles, and their strains so that a wrong insertion is seen."""
        if not self.case.ligaments:
            return (), {}
        from tkamb.knee.ligaments import build_ligaments, strain_table

        poses = self.recorded_poses
        flexion = self.case.motion.coordinates[:, 5]
        bundles = build_ligaments(self.case.ligaments, poses, flexion)
        return bundles, strain_table(bundles, poses, flexion, STRAIN_FLEXIONS)

    @cached_property
    def recorded_poses(self) -> dict[str, Array]:
        """Link -> pose_link_in_insert (f, 4, 4) as recorded, of links with attachments."""
        recorded, ligament = self.case.motion.coordinates, self.case.patellar_ligament
        links = self._attachment_links()
        if ligament is not None:
            links |= {ligament.proximal.link, ligament.distal.link}
        poses = {link: np.empty((len(recorded), 4, 4)) for link in links}
        for k, coordinates in enumerate(recorded):  # one at a time: a state is a quarter of a MB
            state = self.case.chain.at(self.chain_motion(k, coordinates))
            for link in links:
                poses[link][k] = state.pose(link)
        return poses

    def _attachment_links(self) -> set[str]:
        bundles = self.case.ligaments
        return {end.link for bundle in bundles for end in (bundle.proximal, bundle.distal)}
