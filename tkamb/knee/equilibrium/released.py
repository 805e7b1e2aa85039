"""Released knee coordinates: their equilibrium under contact, ligaments and muscles.

Flexion is as recorded. The superior-inferior position always follows from the contact.
Adduction, axial rotation, anterior-posterior and medial-lateral position follow from equilibrium
if the scene releases them. If not, they are kept as recorded, and the force or moment that keeps
them is a residual of the equations of motion.

Within one search the patella is fixed to the femur, its ligament turns with it, and the other
muscles' forces are constant. Then the patella and the lines are solved again at the new pose, and
the load is shared again among the muscles with the new contact, until the knee no longer moves. In
equilibrium the sharing's tension of the extensor group is therefore that of the knee's equations.
Inertia and sliding speed are those of the recorded rates: the released coordinates are
quasi-static. Friction is Coulomb's: mu times each condyle's resultant, against the recorded
sliding, on the line of action of the resultant. Without friction, the forces have a potential
except for follower loads.

The contact comes as a probe; this file does not know the models.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_axes, knee_pose
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.equilibrium.balance import Balance, BalanceStatus
from tkamb.knee.equilibrium.relaxation import Relaxation
from tkamb.knee.equilibrium.released_forces import SCALE, ReleasedForces
from tkamb.knee.joint_equilibrium import JointEquilibrium, external_wrench, joint_equilibrium

if TYPE_CHECKING:
    from tkamb.contact.probe import CondyleWrench, Probe, ProbedContact
    from tkamb.knee.contact_points import CondylePoint
    from tkamb.knee.crossing import MuscleShare
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.load import PointForces
    from tkamb.knee.patella import PatellaState
    from tkamb.run.muscles.shared_muscles import SharedMuscles


@dataclass(frozen=True)
class ReleasedKneeSettings:
    """The knee with released coordinates and its patella."""

    knee_tolerance: float = 2e-6
    """m: the iteration between knee and patella has converged when the knee moves by less. Chosen:
    the same as the tolerance of the knee's own step."""
    contact_force_tolerance: float = 0.1
    """N: it must also change the contact force by less than this, or by less than
    `contact_force_share` of it. Chosen: a ten-thousandth of a usual contact force."""
    contact_force_share: float = 2e-4
    """1: see `contact_force_tolerance`. Chosen: the patella's changes from facet to facet alter the
    force by about as much."""
    max_passes: int = 24
    """Passes between knee and patella at most. Chosen: each halves the remaining change where the
    knee is soft."""
    inner_tolerance_share: float = 0.1
    """1: residual of a pass as a share of its own change. Chosen: with muscles a few passes are
    needed in any case, so that a pass need not converge further."""
    muscle_force_range: float = 3e-3
    """m: distance from a contact like the last frame's within which extrapolated muscle forces
    hold. Chosen: contacts move by less from frame to frame."""
    slack_force: float = 1e-3
    """N: an extensor group with a smaller tension is slack. Chosen: far below any force that
    matters."""
    initial_load_error: float = 0.5
    """1: largest relative difference between the load at an initial guess and the load of the last
    frame. Chosen: from there the search converges."""
    max_height_steps: int = 4
    """Largest number of heights that are tried to bring the load within `initial_load_error`.
    Chosen: each costs one contact."""


RELEASED_KNEE = ReleasedKneeSettings()

SUPERIOR = KNEE_COORDINATES.index("si")


@dataclass(frozen=True, eq=False)
class KneeEquilibrium:
    """One frame with its released coordinates in equilibrium.

    Args:
        coordinates: (6,) m and rad.
        geometry: the leg there, without its contact.
        patella: where it is; None if not modelled.
        contact: the contact there.
        balance: the last search.
        passes: number of solutions of patella and lines.
        trials: number of evaluations of the contact.
        change: N, what the last pass changed in the contact force.
        problem: why this is no result, or empty.
        doubt: see `Relaxation`.
    """

    coordinates: Array
    geometry: KneeGeometry
    patella: "PatellaState | None"
    contact: "ProbedContact"
    balance: Balance
    passes: int
    trials: int
    change: float
    problem: str
    doubt: float = 0.0


def released_indices(names: Sequence[str]) -> tuple[int, ...]:
    """Return the indices of the released coordinates, the superior-inferior one among them."""
    return tuple(i for i, name in enumerate(KNEE_COORDINATES) if name == "si" or name in names)


class Body(Protocol):
    """What the search needs from the body, frame by frame: of a whole motion, or of one instant."""

    friction: float
    extensor: Any

    @property
    def ligaments(self) -> "Sequence[Ligament]":
        """The bundles, with slack lengths."""

    @property
    def muscles(self) -> "SharedMuscles | None":
        """Muscles that share the load; None if the quadriceps alone acts."""

    @property
    def sides(self) -> set[str]:
        """Names of the condyles that may carry load."""

    def geometry(
        self, k: int, coordinates: Array | None = None, patella: "PatellaState | None" = None
    ) -> KneeGeometry:
        """Return frame k without its contact, perhaps at other coordinates (6,)."""

    def sliding(self, k: int, coordinates: Array, point: Array) -> Array:
        """Return the velocity (3,) m/s of the femur's point relative to the insert's."""

    def resultants(
        self, k: int, coordinates: Array, condyles: "Mapping[str, CondyleWrench]"
    ) -> "dict[str, CondylePoint]":
        """Return the resultants of a contact as the contact points of the equations."""

    def post_loads(
        self, k: int, coordinates: Array, post: "CondyleWrench | None"
    ) -> "tuple[PointForces, ...]":
        """Return what a cam on the post does to tibia and femur."""


class ReleasedKnee:
    """Finds the released coordinates of a body, frame by frame.

    Args:
        mechanics: the body side.
        probe: of the contact model.
        names: the released coordinates, "si" understood.

    Attributes:
        released: their indices.
        muscles: the load is shared among muscles.
    """

    def __init__(self, mechanics: Body, probe: "Probe", names: Sequence[str]) -> None:
        self._mechanics, self._probe = mechanics, probe
        self.muscles = mechanics.muscles is not None
        self.released = released_indices(names)
        self._external: tuple[int, Array] | None = None
        """Index and external wrench of the last frame."""

    def find(
        self,
        k: int,
        start: Array,
        points: dict[str, Array] | None = None,
        before: KneeEquilibrium | None = None,
    ) -> KneeEquilibrium:
        """Return frame k in equilibrium.

        Args:
            k: frame.
            start: (6,) coordinates; the released ones are where the search begins.
            points: side -> (3,) m, where a condyle that carries nothing is nearest to the
                insert: residual forces act in the middle of both condyles' points.
            before: the frame before, whose patella and stiffness are guesses.

        Raises:
            ComputationError: no muscle forces carry the frame.
        """
        place, middle, force = np.array(start, float), np.array(start[:3]), np.full(3, np.nan)
        knee, slack, trials, passes = before, False, 0, 0
        touch, mixing, ways = None, Relaxation(), [np.inf, np.inf]
        if self._mechanics.muscles and before:
            place, touch = self._carrying(place, before.contact)
        reach = RELEASED_KNEE.muscle_force_range if touch else np.inf
        while passes < RELEASED_KNEE.max_passes:
            knee, pushes = self._pass(k, place, middle, slack, knee, touch, mixing, reach)
            touch = knee.contact
            passes, trials = passes + 1, trials + knee.balance.trials
            change = float(np.linalg.norm(knee.contact.wrench[:3] - force))
            knee = replace(knee, passes=passes, trials=trials, change=change)
            travel = np.abs((knee.coordinates - place) * SCALE).max()
            place, force, last = knee.coordinates, knee.contact.wrench[:3], middle
            middle = _middle(knee.contact, points, place)
            ways.append(max(travel, np.abs(middle - last).max() if self._keeps else 0.0))
            if pushes:
                # A line that would push drives the knee away: slack, it begins from the same
                # initial guess.
                slack, knee, touch = True, before, None
                place, middle, force = np.array(start, float), np.array(start[:3]), force * np.nan
                ways = [np.inf, np.inf]
            elif knee.problem or (
                mixing.settled
                and knee.balance.at_rest
                and ahead(ways[-3:]) * ways[-1] < RELEASED_KNEE.knee_tolerance
                and ahead(ways[-3:]) * change
                < max(
                    RELEASED_KNEE.contact_force_tolerance,
                    RELEASED_KNEE.contact_force_share * float(np.linalg.norm(force)),
                )
            ):
                return replace(knee, doubt=mixing.doubt)
        assert knee is not None
        return replace(knee, problem="the iteration between knee and patella does not converge")

    def _carrying(
        self, place: Array, like: "ProbedContact"
    ) -> "tuple[Array, ProbedContact | None]":
        """Return the place, raised or lowered to about the contact force of another contact.

        Returns:
            Coordinates (6,) and the contact there; None if the same condyles do not carry, or the
            model does not know its tangent.
        """
        load = float(like.wrench[1])
        for _ in range(RELEASED_KNEE.max_height_steps):
            contact = self._probe.at(knee_pose(place))
            if (
                not contact.tangent
                or not contact.condyles
                or set(contact.condyles) != set(like.condyles)
            ):
                break
            more = float(contact.wrench[1]) - load
            if abs(more) < RELEASED_KNEE.initial_load_error * abs(load):
                return place, contact
            twist = knee_axes(place)[SUPERIOR]
            slope = sum(
                float(c.stiffness[1] @ twist) for c in contact.loads if c.stiffness is not None
            )
            if not slope > 0.0:
                break
            place = place.copy()
            place[SUPERIOR] -= more / slope
        return place, None

    def _pass(
        self,
        k: int,
        place: Array,
        middle: Array,
        slack: bool,
        before: KneeEquilibrium | None,
        touch: "ProbedContact | None",
        mixing: Relaxation,
        reach: float,
    ) -> tuple[KneeEquilibrium, bool]:
        """Return the equilibrium with the patella at `place`; say if its ligament would push."""
        patella = self._patella(k, place, before.patella if before else None)
        geometry = self._mechanics.geometry(k, place, patella)
        joint = self._joint(k, geometry, middle, slack)
        muscles = self._mechanics.muscles
        if muscles is not None and not geometry.problems:
            applied = None if touch is None or before is None else before.geometry.share
            applied = None if applied is None else muscles.at(k, applied)
            share = mixing.mixed(self._share(k, geometry, joint, touch, applied, mixing))
            geometry, joint = replace(geometry, share=share), replace(joint, share=share)
            if slack := muscles.tension(share) < RELEASED_KNEE.slack_force:
                joint = self._joint(k, geometry, middle, slack)
        forces = self._forces(k, joint, place, touch)
        stiffness = before.balance.stiffness if before else None
        balance = forces.balance(
            stiffness, *((RELEASED_KNEE.inner_tolerance_share, reach) if muscles else ())
        )
        contact, problem = forces.contact(balance), "; ".join(geometry.problems)
        if balance.status is not BalanceStatus.OK:
            problem = problem or f"released: {balance.status.value}" + (
                " (quadriceps slack, flexors not modelled)" if slack and not muscles else ""
            )
        knee = KneeEquilibrium(
            forces.at(balance),
            geometry,
            patella,
            contact,
            balance,
            1,
            balance.trials,
            np.nan,
            problem,
        )
        # with other muscles their sharing says whether the quadriceps is slack
        ended = balance.at_rest or balance.status is not BalanceStatus.OK
        return knee, ended and not muscles and contact.known and forces.pushes(balance)

    def _share(
        self,
        k: int,
        geometry: KneeGeometry,
        joint: JointEquilibrium,
        touch: "ProbedContact | None",
        applied: "MuscleShare | None",
        mixing: Relaxation,
    ) -> "MuscleShare":
        """Return the force of each muscle; the released coordinates yield to the muscles.

        Contact points are kept if no contact is known yet, or if the contact model has no tangent.
        If they make the equations singular, the knee's forces pass through the femoral origin.

        Args:
            k: frame.
            geometry: the frame without its contact.
            joint: its equations, the extensor mechanism taut.
            touch: the contact there; None where the search begins without a contact like that of
            the last frame.
            applied: sharing of the last pass, in this frame or the one before.
            mixing: relaxation of forces and compliance.

        Raises:
            ComputationError: no muscle forces carry the frame.
        """
        mechanics, place = self._mechanics, geometry.coordinates
        muscles, friction = mechanics.muscles, mechanics.friction
        assert muscles is not None
        contact = self._probe.at(knee_pose(place)) if touch is None else touch
        gain = None
        if applied is not None:
            forces = self._forces(k, replace(joint, share=applied), place)
            smooth = self._probe.smoothed(knee_pose(place), contact)
            gain = mixing.yielding(forces.tension_per_wrench(smooth))
        if applied is not None and gain is not None:
            pull = applied.wrench(geometry.state.pose("tibia"), geometry.state.pose("femur"))
            base = forces.tension_at_rest(contact, gain) - float(gain @ pull)
            share = muscles.share_of_yielding_knee(k, geometry, base, gain)
        else:
            points = mechanics.resultants(k, place, contact.condyles)
            geometry = replace(geometry, post=mechanics.post_loads(k, place, contact.post))
            off = frozenset(mechanics.sides - set(points)) if points else frozenset[str]()
            share = muscles.share(k, replace(geometry, condyles=points), friction, off)
            if touch is None and share.status != "ok":
                share = muscles.share(k, geometry, friction, frozenset())
        if share.status != "ok":
            raise ComputationError(f"muscles: {share.status.removeprefix('failed: ')}")
        return share

    @property
    def _keeps(self) -> bool:
        """Whether residual forces act: a translation or rotation is kept as recorded."""
        return len(self.released) < 5

    def _patella(self, k: int, place: Array, guess: "PatellaState | None") -> "PatellaState | None":
        extensor = self._mechanics.extensor
        if extensor is None:
            return None
        return extensor.patella(k, knee_pose(place), guess)

    def _joint(
        self, k: int, geometry: KneeGeometry, middle: Array, slack: bool
    ) -> JointEquilibrium:
        ligaments, place = self._mechanics.ligaments, geometry.coordinates
        if self._external is None or self._external[0] != k:
            self._external = k, external_wrench(geometry, place)
        external = self._external[1]
        if not np.isfinite(external).all():  # of a patella that was lost: the next may not be
            self._external = None
        return joint_equilibrium(geometry, ligaments, place, self.released, middle, slack, external)

    def _forces(
        self,
        k: int,
        joint: JointEquilibrium,
        place: Array,
        touch: "ProbedContact | None" = None,
    ) -> "ReleasedForces":
        sliding = partial(self._mechanics.sliding, k)
        friction = self._mechanics.friction
        return ReleasedForces(joint, self._probe, place, friction, sliding, touch)


def ahead(ways: Sequence[float]) -> float:
    """Return the distance that converging passes still have to go, per distance of the last pass.

    With q the larger of the last two ratios of successive distances, the geometric series that
    remains is q / (1 - q). It is 1 where a pass did not at least halve the distance of the one
    before, or where there were fewer than three passes: the last pass itself must then be short.

    Args:
        ways: m, distances of the last three passes; inf where there was none.
    """
    first, second, last = ways
    if not 0.0 < second <= 0.5 * first < np.inf or last > 0.5 * second:
        return 1.0
    ratio = max(last / second, second / first)
    return ratio / (1.0 - ratio)


def _middle(contact: "ProbedContact", points: dict[str, Array] | None, place: Array) -> Array:
    contact_points = (points or {}) | {side: c.point for side, c in contact.condyles.items()}
    return (
        np.asarray(np.mean(list(contact_points.values()), axis=0)) if contact_points else place[:3]
    )
