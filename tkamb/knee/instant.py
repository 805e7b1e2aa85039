"""A knee at one instant: geometry, contact points and loads, at q or at other knee coordinates.

The motion of the shank depends on q, v and a alone. The wrench that the knee must exert on it is
therefore computed once in a search over knee coordinates.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import SIDES, Array, cross, knee_pose, knee_twist
from tkamb.knee.canonical import canonical_state
from tkamb.knee.chain import Chain, ChainMotion
from tkamb.knee.equations import KneeGeometry, SolvedLoads, solve_knee, unsolved
from tkamb.knee.load import PointForces
from tkamb.knee.unknowns import CONTACT_POINT, CondylePoint
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.model import CondyleWrench
    from tkamb.geometry.closest import ClosestPointQuery, CondyleGap, CondyleGaps
    from tkamb.knee.chain import ChainState
    from tkamb.knee.crossing import MuscleShare
    from tkamb.knee.extensor import ExtensorLines
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.patella import PatellaState
    from tkamb.knee.patella_frame import PatellaMethod


@dataclass(frozen=True, eq=False)
class ContactPoints:
    """The femorotibial contact of one pose.

    Args:
        condyles: side -> contact point; empty: contact is not modelled.
        lifted: sides that are lifted off the insert.
        problems: reasons why the pose cannot be used.
    """

    condyles: dict[str, CondylePoint]
    lifted: frozenset[str]
    problems: tuple[str, ...]


NO_CONTACT = ContactPoints({}, frozenset(), ())
"""Contact is not modelled."""


class PatellaFinder(Protocol):
    """Finds the patella at one instant."""

    @property
    def lines(self) -> "ExtensorLines":
        """The extensor mechanism."""

    def patella(
        self, pose: Array | None = None, guess: "PatellaState | None" = None
    ) -> "PatellaState":
        """Return the patella with the femur at a pose (4, 4); None: that of q."""


class SharingMuscles(Protocol):
    """Muscles of a leg that share the load with the knee."""

    def share(
        self, geometry: KneeGeometry, friction: float, lifted: frozenset[str]
    ) -> "MuscleShare":
        """Return the muscle forces at a fixed pose of the knee."""

    def share_of_yielding_knee(
        self,
        geometry: KneeGeometry,
        base: float,
        per_wrench: Array,
        points: Mapping[str, Array] | None = None,
    ) -> "MuscleShare":
        """Return the muscle forces, on which the released coordinates depend."""

    def at(self, share: "MuscleShare") -> "MuscleShare":
        """Return the forces of a share with the lines of action of this instant."""

    def tension(self, share: "MuscleShare") -> float:
        """Return the tension of the extensor group, N."""

    def solve(self, geometry: KneeGeometry, friction: float) -> tuple[KneeGeometry, SolvedLoads]:
        """Return the geometry with the muscles' forces added, and all loads."""


@dataclass(frozen=True, eq=False)
class PatellaAt:
    """Finds the patella of one instant, from its coordinates in q or by equilibrium.

    Args:
        pose: femur in the insert frame at q, (4, 4).
        coordinates: patella coordinates of q, (3,), m and rad; None: q has none.
        solved: whether it is solved again at other poses, or fixed to the femur.
    """

    lines: "ExtensorLines"
    pose: Array
    coordinates: Array | None
    solved: bool

    def patella(
        self, pose: Array | None = None, guess: "PatellaState | None" = None
    ) -> "PatellaState":
        """Return the patella with the femur at a pose (4, 4); None: that of q."""
        pose = self.pose if pose is None else pose
        if self.coordinates is None:
            return self.lines.solved(pose, guess)
        if not self.solved or np.array_equal(pose, self.pose):
            return self.lines.given(pose, self.coordinates)
        return self.lines.solved(pose, guess, self.coordinates)


@dataclass(frozen=True, eq=False)
class Instant:
    """A knee at one instant; wrenches (6,) are in the insert frame.

    Args:
        shank: wrench that inertia and weight of the shank require, (6,), insert frame.
        thigh: external wrench on the thigh, (6,), insert frame.
        ligaments: ligament bundles, with ends on links of the chain.
        extensor: object that finds the patella; None: not modelled.
        friction: Coulomb coefficient.
        ground: external load on the shank; None: no load.
        muscles: muscles of the leg that share the load; None: the quadriceps alone acts.
        patella: how the released patella is found; None: the patella moves in its plane.
        patella_start: coordinates (6,) of the released patella at a neighbouring instant; None:
            unknown.
    """

    chain: Chain
    motion: ChainMotion
    shank: Array
    thigh: Array
    on_patella: Array
    ligaments: "tuple[Ligament, ...]"
    extensor: PatellaFinder | None
    friction: float
    two_condyles: bool
    ground: PointForces | None = None
    muscles: SharingMuscles | None = None
    patella: "PatellaMethod | None" = None
    patella_start: Array | None = None

    @property
    def sides(self) -> set[str]:
        """Names of the condyles that may carry load."""
        return set(SIDES) if self.two_condyles else {"medial"}

    @property
    def coordinates(self) -> Array:
        """Knee coordinates (6,) of q, m and rad."""
        return self.motion.joints[0, :6]

    def geometry(
        self, coordinates: Array | None = None, patella: "PatellaState | None" = None
    ) -> KneeGeometry:
        """Return the knee without its contact.

        Args:
            coordinates: knee coordinates, (6,), m and rad; None: those of q.
            patella: the patella; None: `extensor` finds it.
        """
        knee_coordinates = self.coordinates if coordinates is None else coordinates
        motion = self.motion
        problems: tuple[str, ...] = ()
        if self.extensor is not None and patella is None:
            try:
                patella = self.extensor.patella(
                    None if coordinates is None else knee_pose(knee_coordinates)
                )
            except ComputationError as error:
                problems = (str(error),)
        joints = motion.joints.copy()
        joints[0, :6] = knee_coordinates
        if patella is not None and patella.status.found:
            joints[0, 6:] = patella.coordinates
        state = canonical_state(
            self.chain, replace(motion, joints=joints), self.shank, self.thigh, self.on_patella
        )
        tensions: dict[str, float] = {}
        pulls: tuple[PointForces, ...] = ()
        try:
            tensions, pulls = self._pulls(state)
        except ComputationError as error:
            problems += (str(error),)
        geometry = KneeGeometry(
            state,
            self.ground,
            pulls,
            coordinates=knee_coordinates,
            tensions=tensions,
            problems=problems,
        )
        if self.extensor is None or patella is None:
            return geometry
        try:
            extensor, muscle = self.extensor.lines.loads(knee_coordinates[5], state, patella)
        except ComputationError as error:
            return replace(geometry, problems=(str(error),))
        return replace(geometry, extensor=extensor, muscles=(muscle,))

    def _pulls(self, state: "ChainState") -> tuple[dict[str, float], tuple[PointForces, ...]]:
        """Return ligament -> tension (N), and the ligaments' loads on the links."""
        if not self.ligaments:
            return {}, ()
        from tkamb.knee.ligaments import ligament_loads

        links = {link for bundle in self.ligaments for link in bundle.links}
        tensions, loads = ligament_loads(self.ligaments, {link: state.pose(link) for link in links})
        names = [bundle.name for bundle in self.ligaments]
        return dict(zip(names, tensions.tolist(), strict=True)), loads

    def contact_points(self, query: "ClosestPointQuery", pose: Array) -> ContactPoints:
        """Return the undeformed bodies' contact points at a pose (4, 4)."""
        return contact_points(query, pose, lambda point: self.sliding(self.coordinates, point))

    def solved(self, geometry: KneeGeometry) -> tuple[KneeGeometry, SolvedLoads]:
        """Return a geometry with muscle forces and released patella added, and its loads.

        Args:
            geometry: result of `geometry`, with contact points.
        """
        if geometry.problems:
            return geometry, unsolved(geometry.problems)
        if self.patella is None or geometry.extensor is None:
            return self._solved(geometry)
        return self.patella.solved(geometry, self._solved, self.patella_start)

    def solved_with_muscles(self, geometry: KneeGeometry) -> tuple[KneeGeometry, SolvedLoads]:
        """Return a geometry with its released patella, and its loads.

        Args:
            geometry: result of `geometry`, with contact points and muscle forces.
        """

        def solve(one: KneeGeometry) -> tuple[KneeGeometry, SolvedLoads]:
            return one, solve_knee(one, self.friction)

        if self.patella is None or geometry.extensor is None:
            return solve(geometry)
        return self.patella.solved(geometry, solve, self.patella_start)

    def _solved(self, geometry: KneeGeometry) -> tuple[KneeGeometry, SolvedLoads]:
        if self.muscles is None:
            return geometry, solve_knee(geometry, self.friction)
        return self.muscles.solve(geometry, self.friction)

    def sliding(self, coordinates: Array, point: Array) -> Array:
        """Return the velocity (3,), m/s, of a point of the femur relative to the insert.

        The rates are those of q and v.

        Args:
            coordinates: knee coordinates, (6,), m and rad.
            point: position, insert frame, (3,), m.
        """
        velocity, spin = knee_twist(coordinates, self.motion.joints[1, :6])
        return np.asarray(velocity + cross(spin, point - coordinates[:3]))

    def resultants(
        self, coordinates: Array, condyles: "Mapping[str, CondyleWrench]"
    ) -> dict[str, CondylePoint]:
        """Return the resultants of a contact as the contact points of the equations.

        Args:
            coordinates: knee coordinates, (6,), m and rad.
            condyles: side -> load on the insert at these coordinates.
        """
        return {
            side: CondylePoint(
                condyle.point, condyle.normal, self.sliding(coordinates, condyle.point), 0.0
            )
            for side, condyle in condyles.items()
        }

    def touching(
        self,
        geometry: KneeGeometry,
        coordinates: Array,
        condyles: "Mapping[str, CondyleWrench]",
        points: Mapping[str, Array],
    ) -> KneeGeometry:
        """Return a geometry with the resultants of a contact as its contact points.

        Args:
            geometry: result of `geometry`.
            coordinates: knee coordinates, (6,), m and rad.
            condyles: loaded side -> its load on the insert at these coordinates.
            points: side -> point (3,), m, where an unloaded condyle is nearest to the insert.
        """
        vertical, zero = np.array([0.0, 1.0, 0.0]), np.zeros(3)
        unloaded = {
            side: CondylePoint(point, vertical, zero, float("nan"))
            for side, point in points.items()
        }
        resultants = self.resultants(coordinates, condyles)
        lifted = frozenset(self.sides - set(resultants))
        return replace(geometry, condyles=unloaded | resultants, lifted=lifted)

    def post_loads(
        self, coordinates: Array, post: "CondyleWrench | None"
    ) -> tuple[PointForces, ...]:
        """Return the loads of cam and post on tibia and femur, including friction.

        Args:
            coordinates: knee coordinates, (6,), m and rad.
            post: load of the cam on the insert at these coordinates; None: no contact.
        """
        if post is None:
            return ()
        sliding = self.sliding(coordinates, post.point)
        contact_point = CondylePoint(post.point, post.normal, sliding, 0.0)
        force = -post.force * contact_point.direction(self.friction)
        # Couple of the cam's pressure about `post.point`.
        couple = post.wrench[3:] - cross(post.point, post.wrench[:3])
        return (
            PointForces("tibia", post.point[None], force[None], couple),
            PointForces("femur", post.point[None], -force[None], -couple),
        )


def contact_points(
    query: "ClosestPointQuery", pose: Array, sliding: Callable[[Array], Array]
) -> ContactPoints:
    """Return the contact points of a pose.

    Args:
        pose: pose_femoral_in_insert, (4, 4).
        sliding: function of a point (3,), m, insert frame. It returns the velocity (3,), m/s, of
            the femur relative to the insert at that point.
    """
    gaps = query.at(pose)
    condyle_gaps = {"medial": gaps.medial} | ({"lateral": gaps.lateral} if gaps.lateral else {})
    condyles = {side: _condyle(gap, sliding) for side, gap in condyle_gaps.items()}
    nearest = nearest_gap(gaps)
    problems: tuple[str, ...] = ()
    if abs(nearest) > CONTACT_POINT.max_gap:
        state = "apart" if nearest > 0 else "overlapping"
        problems = (f"condyles {state} by {abs(nearest) / MILLIMETRE:.1f} mm",)
    return ContactPoints(condyles, _find_lifted(condyles), problems)


def nearest_gap(gaps: "CondyleGaps") -> float:
    """Return the smallest gap (m) of the condyles."""
    return min(gap.gap for gap in (gaps.medial, gaps.lateral) if gap is not None)


def _condyle(gap: "CondyleGap", sliding: Callable[[Array], Array]) -> CondylePoint:
    return CondylePoint(gap.centre, gap.normal, sliding(gap.centre), gap.gap)


def _find_lifted(condyles: dict[str, CondylePoint]) -> frozenset[str]:
    if len(condyles) < 2:
        return frozenset()
    medial, lateral = condyles["medial"], condyles["lateral"]
    # z is medial-lateral: the width is the distance of the contact points in the coronal plane.
    width = abs(lateral.point[2] - medial.point[2])
    higher = "lateral" if lateral.gap > medial.gap else "medial"
    # The coronal angle is small: it is the difference of the gaps over the width.
    tilted = abs(lateral.gap - medial.gap) > CONTACT_POINT.lift_off_angle * width
    return frozenset(
        {higher} if tilted and condyles[higher].gap > CONTACT_POINT.lift_off_gap else ()
    )
