"""Released knee coordinates: their equilibrium under contact, ligaments and muscles.

Flexion is as recorded. The superior-inferior position always follows from the contact.
Adduction, axial rotation, anterior-posterior and medial-lateral position follow from equilibrium
if the scene releases them. If not, they are kept as recorded, and the force or moment that keeps
them is a residual of the equations of motion.

The search is repeated in passes. Within one pass the patella is fixed to the femur, and the forces
of the other muscles are constant. Then patella and lines are solved again at the new pose, and the
load is shared again among the muscles with the new contact, until the knee does not move between
passes. So the shared tension of the extensor group agrees with the knee's equations.

Inertia and sliding speed follow from the recorded rates: the released coordinates are quasi-static.
Coulomb friction is mu times the resultant of each condyle, against the recorded sliding, on the
line of action of the resultant.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_axes, knee_pose
from tkamb.knee.balance import Balance, BalanceStatus
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.instant import Instant
from tkamb.knee.relaxation import Relaxation
from tkamb.knee.released_forces import (
    SCALE,
    JointEquilibrium,
    ReleasedForces,
    external_wrench,
    joint_equilibrium,
)

if TYPE_CHECKING:
    from tkamb.contact.model import Probe, ProbedContact
    from tkamb.knee.crossing import MuscleShare
    from tkamb.knee.patella import PatellaState


@dataclass(frozen=True)
class ReleasedKneeSettings:
    """Tolerances and limits of the passes between knee, patella and muscles."""

    knee_tolerance: float = 2e-6
    """m: movement of the knee between passes below which they have converged. Chosen: the same as
    the tolerance of a step of the search."""
    contact_force_tolerance: float = 0.1
    """N: change of the contact force below which passes have converged, or `contact_force_share` of
    the force if that is larger. Chosen: a ten-thousandth of a usual contact force."""
    residual_tolerance: float = 0.5
    """N (moments are divided by the lever arm): largest residual force on a released coordinate at
    the returned pose, with patella, lines and contact computed there. A frame has no result if the
    residual exceeds the largest of this, `residual_share` of the contact force, and the error of
    the contact force. Chosen: measured residuals are below 0.1 N."""
    residual_share: float = 1e-3
    """1: see `residual_tolerance`. Chosen: the patella's changes from facet to facet alter the
    force by 2e-4 of it."""
    contact_force_share: float = 2e-4
    """1: see `contact_force_tolerance`. Chosen: the patella's changes from facet to facet alter the
    force by about as much."""
    max_passes: int = 24
    """Maximum number of passes. Chosen: for a compliant knee a pass halves the change."""
    inner_tolerance_share: float = 0.1
    """1: remaining step of a pass with muscles, as a share of its movement, at which the pass ends.
    Chosen: more passes follow in any case."""
    muscle_force_range: float = 3e-3
    """m: distance from the initial guess within which the muscle forces of the last frame are a
    good guess. Chosen: the knee moves by less from frame to frame."""
    slack_force: float = 1e-3
    """N: an extensor group with a smaller tension is slack. Chosen: far below what is reported."""
    initial_load_error: float = 0.5
    """1: largest relative difference between the load at an initial guess and the load of the last
    frame. Chosen: from there the search converges."""
    max_height_steps: int = 4
    """Maximum number of heights that are tried to bring the load within `initial_load_error`.
    Chosen: each costs one evaluation of the contact."""


RELEASED_KNEE = ReleasedKneeSettings()

SUPERIOR = KNEE_COORDINATES.index("si")


@dataclass(frozen=True, eq=False)
class KneeEquilibrium:
    """Result of the search for the released coordinates of one frame.

    Args:
        coordinates: (6,) knee coordinates, m and rad.
        geometry: input of the equations there, without the contact.
        patella: the patella there; None: not modelled.
        contact: the contact there.
        balance: the last pass.
        passes: number of passes.
        trials: number of evaluations of the contact.
        change: N, change of the contact force in the last pass.
        problem: why this is no result, in words; empty: it is one.
        doubt: `Relaxation.doubt` at the end.
        residual: N (moments are divided by the lever arm), largest residual force on a released
            coordinate at the returned pose, with patella, lines and contact computed there; inf:
            not measured.
        second: a second equilibrium that another initial guess leads to, in words; empty: none was
            found (`InitialPoses`).
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
    residual: float = np.inf
    second: str = ""


def released_indices(names: Sequence[str]) -> tuple[int, ...]:
    """Return the indices of the released coordinates, the superior-inferior one among them."""
    return tuple(i for i, name in enumerate(KNEE_COORDINATES) if name == "si" or name in names)


class ReleasedKnee:
    """Finds the released coordinates of a knee, instant by instant.

    Args:
        probe: probe of the contact model.
        names: the released coordinates; "si" is always one of them.

    Attributes:
        released: indices of the released coordinates.
    """

    def __init__(self, probe: "Probe", names: Sequence[str]) -> None:
        self._probe = probe
        self.released = released_indices(names)
        self._external: tuple[Instant, Array] | None = None
        """The last instant and its external wrench."""

    def find(
        self,
        instant: Instant,
        start: Array,
        points: dict[str, Array] | None = None,
        before: KneeEquilibrium | None = None,
    ) -> KneeEquilibrium:
        """Return the knee in equilibrium.

        Args:
            instant: the knee.
            start: (6,) knee coordinates, initial guess of the released ones.
            points: side -> (3,) m, point where an unloaded condyle is nearest to the insert. The
                residual forces act in the middle of both condyles' points.
            before: result of the frame before, used as initial guess.

        Raises:
            ComputationError: no muscle forces balance the frame.
        """
        place, middle, force = np.array(start, float), np.array(start[:3]), np.full(3, np.nan)
        # `slack` starts again in every frame: a ligament that pushed in the last one may pull now.
        knee, slack, trials, passes = before, False, 0, 0
        touch, mixing, ways = None, Relaxation(), [np.inf, np.inf]
        if instant.muscles and before:
            place, touch = self._carrying(place, before.contact)
        # Only near a known contact do the muscle forces of the last frame hold in the first pass.
        reach = RELEASED_KNEE.muscle_force_range if touch else np.inf
        while passes < RELEASED_KNEE.max_passes:
            knee, pushes = self._pass(instant, place, middle, slack, knee, touch, mixing, reach)
            touch = knee.contact
            passes, trials = passes + 1, trials + knee.balance.trials
            change = float(np.linalg.norm(knee.contact.wrench[:3] - force))
            knee = replace(knee, passes=passes, trials=trials, change=change)
            travel = np.abs((knee.coordinates - place) * SCALE).max()
            place, force, last = knee.coordinates, knee.contact.wrench[:3], middle
            middle = _middle(knee.contact, points, place)
            ways.append(max(travel, np.abs(middle - last).max() if self._keeps else 0.0))
            if pushes:
                # A ligament that would push cannot act: the search begins again without it.
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
                knee = self._measured(instant, replace(knee, doubt=mixing.doubt), middle, slack)
                if knee.problem or knee.residual <= self._allowed(knee.contact):
                    return knee
        assert knee is not None
        return replace(knee, problem="the iteration between knee and patella does not converge")

    def _allowed(self, contact: "ProbedContact") -> float:
        """Return the residual (N) below which a frame has converged."""
        share = max(RELEASED_KNEE.residual_share, contact.accuracy)
        force = float(np.linalg.norm(contact.wrench[:3]))
        return max(RELEASED_KNEE.residual_tolerance, share * force)

    def _measured(
        self, instant: Instant, knee: KneeEquilibrium, middle: Array, slack: bool
    ) -> KneeEquilibrium:
        """Return the knee with patella, lines and residual computed at its pose."""
        if knee.problem:
            return knee
        patella = None
        if instant.extensor is not None:
            patella = instant.extensor.patella(knee_pose(knee.coordinates), knee.patella)
        geometry = instant.geometry(knee.coordinates, patella)
        joint = self._joint(instant, geometry, middle, slack)
        if knee.geometry.share is not None:
            geometry = replace(geometry, share=knee.geometry.share)
            joint = replace(joint, share=knee.geometry.share)
        residual = self._forces(instant, joint, knee.coordinates, knee.contact).residual()
        problem = "; ".join(geometry.problems)
        return replace(knee, geometry=geometry, patella=patella, residual=residual, problem=problem)

    def _carrying(
        self, place: Array, like: "ProbedContact"
    ) -> "tuple[Array, ProbedContact | None]":
        """Return a place raised or lowered to about the contact force of another contact.

        Returns:
            Coordinates (6,), and the contact there. The contact is None if other condyles carry
            load there, or if the contact has no tangent.
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
        instant: Instant,
        place: Array,
        middle: Array,
        slack: bool,
        before: KneeEquilibrium | None,
        touch: "ProbedContact | None",
        mixing: Relaxation,
        reach: float,
    ) -> tuple[KneeEquilibrium, bool]:
        """Return the equilibrium of a pass, and whether the patellar ligament would push."""
        patella, guess = None, before.patella if before else None
        if instant.extensor is not None:
            patella = instant.extensor.patella(knee_pose(place), guess)
        geometry = instant.geometry(place, patella)
        joint = self._joint(instant, geometry, middle, slack)
        muscles = instant.muscles
        if muscles is not None and not geometry.problems:
            applied = None if touch is None or before is None else before.geometry.share
            applied = None if applied is None else muscles.at(applied)
            share = mixing.mixed(self._share(instant, geometry, joint, touch, applied, mixing))
            geometry, joint = replace(geometry, share=share), replace(joint, share=share)
            if slack := muscles.tension(share) < RELEASED_KNEE.slack_force:
                joint = self._joint(instant, geometry, middle, slack)
        forces = self._forces(instant, joint, place, touch)
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
        # With other muscles, the sharing decides whether the quadriceps is slack.
        ended = balance.at_rest or balance.status is not BalanceStatus.OK
        return knee, ended and not muscles and contact.known and forces.pushes(balance)

    def _share(
        self,
        instant: Instant,
        geometry: KneeGeometry,
        joint: JointEquilibrium,
        touch: "ProbedContact | None",
        applied: "MuscleShare | None",
        mixing: Relaxation,
    ) -> "MuscleShare":
        """Return the force of each muscle, while the released coordinates yield to these forces.

        If no equilibrium is known yet, or if the contact has no tangent, the contact points are
        constant. If the equations are then singular, the contact force acts at the femoral origin.

        Args:
            instant: the knee.
            geometry: input of the equations, without the contact.
            joint: equations of the released coordinates with a taut extensor mechanism.
            touch: the contact there; None: no contact like that of the last frame is known.
            applied: sharing of the last pass, in this frame or the frame before.
            mixing: relaxation of forces and compliance.

        Raises:
            ComputationError: no muscle forces balance the frame.
        """
        place, muscles, friction = geometry.coordinates, instant.muscles, instant.friction
        assert muscles is not None
        contact = self._probe.at(knee_pose(place)) if touch is None else touch
        gain = None
        if applied is not None:
            forces = self._forces(instant, replace(joint, share=applied), place)
            smooth = self._probe.smoothed(knee_pose(place), contact)
            gain = mixing.yielding(forces.tension_per_wrench(smooth))
        if applied is not None and gain is not None:
            pull = applied.wrench(geometry.state.pose("tibia"), geometry.state.pose("femur"))
            base = forces.tension_at_rest(contact, gain) - float(gain @ pull)
            share = muscles.share_of_yielding_knee(geometry, base, gain)
        else:
            points = instant.resultants(place, contact.condyles)
            geometry = replace(geometry, post=instant.post_loads(place, contact.post))
            off = frozenset(instant.sides - set(points)) if points else frozenset[str]()
            share = muscles.share(replace(geometry, condyles=points), friction, off)
            if touch is None and share.status != "ok":
                share = muscles.share(geometry, friction, frozenset())
        if share.status != "ok":
            raise ComputationError(f"muscles: {share.status.removeprefix('failed: ')}")
        return share

    @property
    def _keeps(self) -> bool:
        """Whether residual forces act, because a coordinate is kept as recorded."""
        return len(self.released) < 5

    def _joint(
        self, instant: Instant, geometry: KneeGeometry, middle: Array, slack: bool
    ) -> JointEquilibrium:
        ligaments, place = instant.ligaments, geometry.coordinates
        if self._external is None or self._external[0] is not instant:
            self._external = instant, external_wrench(geometry, place)
        external = self._external[1]
        if not np.isfinite(external).all():  # of a patella that was lost: the next may not be
            self._external = None
        return joint_equilibrium(geometry, ligaments, place, self.released, middle, slack, external)

    def _forces(
        self,
        instant: Instant,
        joint: JointEquilibrium,
        place: Array,
        touch: "ProbedContact | None" = None,
    ) -> "ReleasedForces":
        friction = instant.friction
        return ReleasedForces(joint, self._probe, place, friction, instant.sliding, touch)


def ahead(ways: Sequence[float]) -> float:
    """Return the remaining distance of converging passes, per distance of the last pass.

    Let q be the larger of the last two ratios of successive distances. The remaining geometric
    series has the sum q / (1 - q). The result is 1 if there were fewer than three passes, or if a
    pass did not halve the distance of the pass before.

    Args:
        ways: m, distances of the last three passes; inf: no such pass.
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
