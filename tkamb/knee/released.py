"""Released knee coordinates: their equilibrium under contact, ligaments and muscles.

Flexion keeps its recorded value. Equilibrium with the contact always determines the
superior-inferior position. It also determines adduction, axial rotation, anterior-posterior and
medial-lateral position if the scene releases them. A coordinate that is not released keeps its
recorded value. The force or moment that holds it is a residual of the equations of motion.

The search is repeated in passes. Within one pass the patella is fixed to the femur, and the forces
of all muscles except the extensor group are constant. Then patella, lines and muscle forces are
computed again at the new pose and contact. The passes end when the knee no longer moves between
them. The tension of the extensor group then satisfies the knee's equations.

Inertia and sliding speed use the recorded rates: the released coordinates are quasi-static. Coulomb
friction is mu times the resultant of each condyle. It is opposite to the recorded sliding and acts
where the resultant acts.

`tkamb.knee.relaxation` has the changes of muscle forces and compliance from pass to pass.
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
    """m: movement of the knee between passes below which the passes have converged. Equal to
    the step tolerance of the search."""
    contact_force_tolerance: float = 0.1
    """N: change of the contact force below which passes have converged, or `contact_force_share` of
    the force if that is larger. A ten-thousandth of a usual contact force."""
    residual_tolerance: float = 0.5
    """N (moments are divided by the lever arm): largest residual force on a released coordinate,
    with patella, lines and contact of the returned pose. A frame has no result if the residual
    exceeds the largest of this tolerance, `residual_share` of the contact force, and the error of
    the contact force. Measured residuals are below 0.1 N."""
    residual_share: float = 1e-3
    """1: see `residual_tolerance`. The facets of the patella change the force by a
    share of 2e-4."""
    contact_force_share: float = 2e-4
    """1: see `contact_force_tolerance`. The facets of the patella change the force
    by about this share."""
    tension_tolerance: float = 1e-7
    """1: change of the quadriceps' tension between passes, relative to it, below which passes with
    a released patella have converged."""
    tension_jump: float = 1e-4
    """1: change of this tension that may remain where it no longer falls from pass to pass: the
    force of the button's contact jumps there from facet to facet. Equal to the largest difference
    of two tensions at a recorded pose."""
    joint_residual: float = 1e-6
    """1: residual force on a released coordinate over the quadriceps' tension below which knee and
    released patella are in equilibrium together, if the quadriceps is the only muscle."""
    joint_passes: int = 4
    """1: passes that are added to reach `joint_residual`. A facet of the patella may prevent it:
    then the other tolerances decide."""
    max_passes: int = 24
    """Maximum number of passes. A pass halves the change of a compliant knee."""
    inner_tolerance_share: float = 0.1
    """1: a pass with muscles ends when its remaining Newton step is less than this share of the
    knee's movement in the pass. More passes follow in any case."""
    muscle_force_range: float = 3e-3
    """m: distance from the initial guess at which a pass ends if the last frame gave the muscle
    forces. The knee moves by less from frame to frame."""
    slack_force: float = 1e-3
    """N: an extensor group with a smaller tension is slack. It is far below the
    resolution of the reports."""
    initial_load_error: float = 0.5
    """1: largest relative difference between the load at a guess and the load of the last frame.
    Not studied."""
    max_height_steps: int = 4
    """Maximum number of heights that are tried to bring the load within `initial_load_error`.
    Each height costs one evaluation of the contact."""


RELEASED_KNEE = ReleasedKneeSettings()

SUPERIOR = KNEE_COORDINATES.index("si")


@dataclass(frozen=True, eq=False)
class KneeEquilibrium:
    """Result of the search for the released coordinates of one frame.

    Args:
        coordinates: knee coordinates, shape (6,), m and rad.
        geometry: input of the equations at these coordinates, without the contact.
        patella: the patella at these coordinates; None: not modelled.
        contact: the contact at these coordinates.
        balance: result of the last pass.
        trials: number of evaluations of the contact in all passes.
        change: change of the contact force in the last pass, N.
        problem: reason why the search failed; empty: it succeeded.
        compliance_error: `Relaxation.compliance_error` at the end.
        residual: largest residual force on a released coordinate with patella, lines and contact of
            the returned pose, N (moments divided by the lever arm); inf: not measured.
        pull: tension of the patellar ligament that balances flexion in the last pass, N.
        second: description of a second equilibrium from another initial guess (`InitialPoses`);
            empty: not found.
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
    compliance_error: float = 0.0
    residual: float = np.inf
    pull: float = np.nan
    second: str = ""


def stored_equilibrium(
    geometry: KneeGeometry, patella: "PatellaState | None", force: Array, stiffness: Array
) -> KneeEquilibrium:
    """Return an equilibrium of stored arrays, as initial guess of the next frame.

    Args:
        geometry: input of the equations at the stored coordinates.
        patella: the patella at these coordinates; None: not modelled.
        force: `Balance.force` of the last pass.
        stiffness: `Balance.stiffness` of the last pass.
    """
    from tkamb.contact.model import ProbedContact

    place, nan = geometry.coordinates, float("nan")
    balance = Balance(place, force, stiffness, BalanceStatus.OK, 0, 0, nan, ())
    return KneeEquilibrium(
        place, geometry, patella, ProbedContact({}), balance, 0, 0, change=nan, problem=""
    )


def released_indices(names: Sequence[str]) -> tuple[int, ...]:
    """Return the indices of the released coordinates, including "si"."""
    return tuple(i for i, name in enumerate(KNEE_COORDINATES) if name == "si" or name in names)


class ReleasedKnee:
    """Finds the released coordinates of a knee, instant by instant.

    Args:
        names: names of released coordinates; "si" is always released.

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
            start: knee coordinates with an initial guess of the released coordinates, shape (6,).
            points: side -> point (3,), m, where an unloaded condyle is nearest to the insert. The
                residual forces act in the middle of the two condyles' points.
            before: result of the previous frame, used as initial guess.

        Raises:
            ComputationError: no muscle forces balance the frame.
        """
        coordinates, middle, force = np.array(start, float), np.array(start[:3]), np.full(3, np.nan)
        added = 0
        # Every frame begins with a taut patellar ligament, even if it was slack in the last frame.
        knee, slack, trials, passes = before, False, 0, 0
        last_contact, relaxation, distances = None, Relaxation(), [np.inf, np.inf]
        pull = None if before is None else _pull(before.geometry)
        change_of_pull = np.inf
        if instant.muscles and before:
            coordinates, last_contact = self._at_load(coordinates, before.contact)
        # The muscle forces of the last frame are a good guess only near the pose of their contact.
        stop_distance = RELEASED_KNEE.muscle_force_range if last_contact else np.inf
        while passes < RELEASED_KNEE.max_passes:
            knee, pushes = self._pass(
                instant,
                coordinates,
                middle,
                slack,
                knee,
                last_contact,
                relaxation,
                stop_distance,
                pull,
            )
            last_change = change_of_pull
            pull, change_of_pull = self._next_pull(instant, knee, slack)
            last_contact = knee.contact
            passes, trials = passes + 1, trials + knee.balance.trials
            change = float(np.linalg.norm(knee.contact.wrench[:3] - force))
            knee = replace(knee, passes=passes, trials=trials, change=change)
            travel = np.abs((knee.coordinates - coordinates) * SCALE).max()
            coordinates, force, last_middle = knee.coordinates, knee.contact.wrench[:3], middle
            middle = _middle(knee.contact, points, coordinates)
            distances.append(
                max(
                    travel, np.abs(middle - last_middle).max() if self._has_residual_forces else 0.0
                )
            )
            if pushes:
                # The patellar ligament cannot push: the search begins again with a slack ligament.
                slack, knee, last_contact = True, before, None
                pull = None
                coordinates, middle, force = (
                    np.array(start, float),
                    np.array(start[:3]),
                    force * np.nan,
                )
                distances = [np.inf, np.inf]
            elif knee.problem or (
                relaxation.converged
                and knee.balance.converged
                and _tension_has_converged(change_of_pull, last_change)
                and remaining_distance(distances[-3:]) * distances[-1]
                < RELEASED_KNEE.knee_tolerance
                and remaining_distance(distances[-3:]) * change
                < max(
                    RELEASED_KNEE.contact_force_tolerance,
                    RELEASED_KNEE.contact_force_share * float(np.linalg.norm(force)),
                )
            ):
                knee = self._measured(
                    instant,
                    replace(knee, compliance_error=relaxation.compliance_error),
                    middle,
                    slack,
                    pull,
                )
                joint = np.inf
                if pull is not None and instant.muscles is None:
                    joint = RELEASED_KNEE.joint_residual * pull[0]
                together = knee.residual <= joint or added == RELEASED_KNEE.joint_passes
                if knee.problem or (
                    together and knee.residual <= self._residual_limit(knee.contact)
                ):
                    return knee
                added += not together
        assert knee is not None
        return replace(knee, problem="the iteration between knee and patella does not converge")

    def joint_at(
        self,
        instant: Instant,
        geometry: KneeGeometry,
        contact: "ProbedContact",
        points: dict[str, Array],
        slack: bool,
    ) -> JointEquilibrium:
        """Return the equations of the released coordinates at a geometry and its contact.

        Args:
            geometry: result of `Instant.geometry`.
            contact: the contact at the geometry's coordinates.
            points: side -> point where an unloaded condyle is nearest to the insert.
            slack: whether the extensor mechanism carries no load.
        """
        middle = _middle(contact, points, geometry.coordinates)
        return self._joint(instant, geometry, middle, slack)

    def forces(
        self,
        instant: Instant,
        joint: JointEquilibrium,
        coordinates: Array,
        contact: "ProbedContact",
    ) -> "ReleasedForces":
        """Return the forces on the released coordinates at coordinates (6,) with their contact."""
        return self._forces(instant, joint, coordinates, contact)

    def _residual_limit(self, contact: "ProbedContact") -> float:
        """Return the residual (N) below which a frame has converged."""
        share = max(RELEASED_KNEE.residual_share, contact.accuracy)
        force = float(np.linalg.norm(contact.wrench[:3]))
        return max(RELEASED_KNEE.residual_tolerance, share * force)

    def _measured(
        self,
        instant: Instant,
        knee: KneeEquilibrium,
        middle: Array,
        slack: bool,
        pull: "tuple[float, Array | None] | None",
    ) -> KneeEquilibrium:
        if knee.problem:
            return knee
        patella = None
        if instant.extensor is not None:
            patella = instant.extensor.patella(knee_pose(knee.coordinates), knee.patella)
        geometry = instant.geometry(knee.coordinates, patella)
        if not slack:
            geometry = _pulled(instant, geometry, patella, pull, complete=True)
        joint = self._joint(instant, geometry, middle, slack)
        if knee.geometry.share is not None:
            geometry = replace(geometry, share=knee.geometry.share)
            joint = replace(joint, share=knee.geometry.share)
        residual = self._forces(instant, joint, knee.coordinates, knee.contact).residual()
        problem = "; ".join(geometry.problems)
        return replace(knee, geometry=geometry, patella=patella, residual=residual, problem=problem)

    def _at_load(
        self, coordinates: Array, target: "ProbedContact"
    ) -> "tuple[Array, ProbedContact | None]":
        """Return coordinates with the height changed until the load is about that of `target`.

        Returns:
            Coordinates (6,), and the contact at these coordinates. The contact is None if other
            condyles carry the load, if the model gives no tangent, or if the load is not reached.
        """
        load = float(target.wrench[1])
        for _ in range(RELEASED_KNEE.max_height_steps):
            contact = self._probe.at(knee_pose(coordinates))
            if (
                not contact.tangent
                or not contact.condyles
                or set(contact.condyles) != set(target.condyles)
            ):
                break
            excess = float(contact.wrench[1]) - load
            if abs(excess) < RELEASED_KNEE.initial_load_error * abs(load):
                return coordinates, contact
            twist = knee_axes(coordinates)[SUPERIOR]
            slope = sum(
                float(c.stiffness[1] @ twist) for c in contact.loads if c.stiffness is not None
            )
            if not slope > 0.0:
                break
            coordinates = coordinates.copy()
            coordinates[SUPERIOR] -= excess / slope
        return coordinates, None

    def _pass(
        self,
        instant: Instant,
        coordinates: Array,
        middle: Array,
        slack: bool,
        before: KneeEquilibrium | None,
        last_contact: "ProbedContact | None",
        relaxation: Relaxation,
        stop_distance: float,
        pull: "tuple[float, Array | None] | None",
    ) -> tuple[KneeEquilibrium, bool]:
        """Return the equilibrium of one pass, and whether the patellar ligament would push."""
        patella, guess = None, before.patella if before else None
        if instant.extensor is not None:
            patella = instant.extensor.patella(knee_pose(coordinates), guess)
        geometry = instant.geometry(coordinates, patella)
        if not slack:
            geometry = _pulled(instant, geometry, patella, pull)
        joint = self._joint(instant, geometry, middle, slack)
        muscles = instant.muscles
        if muscles is not None and not geometry.problems:
            applied = None if last_contact is None or before is None else before.geometry.share
            applied = None if applied is None else muscles.at(applied)
            share = relaxation.relaxed_forces(
                self._share(instant, geometry, joint, last_contact, applied, relaxation)
            )
            geometry, joint = replace(geometry, share=share), replace(joint, share=share)
            if slack := muscles.tension(share) < RELEASED_KNEE.slack_force:
                joint = self._joint(instant, geometry, middle, slack)
        forces = self._forces(instant, joint, coordinates, last_contact)
        stiffness = before.balance.stiffness if before else None
        balance = forces.balance(
            stiffness, *((RELEASED_KNEE.inner_tolerance_share, stop_distance) if muscles else ())
        )
        if pull is not None and not muscles:
            balance = forces.polished(balance, pull[0])
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
            pull=forces.line_tension(balance) if contact.known else np.nan,
        )
        # With other muscles, static optimisation decides whether the quadriceps is slack.
        ended = balance.converged or balance.status is not BalanceStatus.OK
        return knee, ended and not muscles and contact.known and forces.pushes(balance)

    def _share(
        self,
        instant: Instant,
        geometry: KneeGeometry,
        joint: JointEquilibrium,
        last_contact: "ProbedContact | None",
        applied: "MuscleShare | None",
        relaxation: Relaxation,
    ) -> "MuscleShare":
        """Return the force of each muscle, for a knee that moves when these forces change.

        If no equilibrium is known yet, or if the contact has no tangent, the contact points are
        constant instead. If there is also no `last_contact` and these points give no muscle forces,
        the contact force acts at the femoral origin.

        Args:
            geometry: input of the equations, without the contact.
            joint: equations of the released coordinates with a taut extensor mechanism.
            last_contact: the contact at this pose, from the last pass or from `_at_load`; None:
                neither gave one, and the contact is computed here.
            applied: muscle forces of the last pass, in this frame or the previous frame.
            relaxation: relaxation of forces and compliance.

        Raises:
            ComputationError: no muscle forces balance the frame.
        """
        coordinates, muscles, friction = geometry.coordinates, instant.muscles, instant.friction
        assert muscles is not None
        contact = self._probe.at(knee_pose(coordinates)) if last_contact is None else last_contact
        compliance = None
        if applied is not None:
            forces = self._forces(instant, replace(joint, share=applied), coordinates)
            smooth = self._probe.smoothed(knee_pose(coordinates), contact)
            compliance = relaxation.compliance(forces.tension_per_wrench(smooth))
        if applied is not None and compliance is not None:
            muscle_wrench = applied.wrench(
                geometry.state.pose("tibia"), geometry.state.pose("femur")
            )
            base = forces.tension_in_equilibrium(contact, compliance) - float(
                compliance @ muscle_wrench
            )
            touched = {side: condyle.point for side, condyle in contact.condyles.items()}
            touched = touched if instant.two_condyles else {}
            share = muscles.share_of_yielding_knee(geometry, base, compliance, touched)
        else:
            points = instant.resultants(coordinates, contact.condyles)
            geometry = replace(geometry, post=instant.post_loads(coordinates, contact.post))
            lifted = frozenset(instant.sides - set(points)) if points else frozenset[str]()
            share = muscles.share(replace(geometry, condyles=points), friction, lifted)
            if last_contact is None and share.status != "ok":
                share = muscles.share(geometry, friction, frozenset())
        if share.status != "ok":
            raise ComputationError(f"muscles: {share.status.removeprefix('failed: ')}")
        return share

    @staticmethod
    def _next_pull(
        instant: Instant, knee: KneeEquilibrium, slack: bool
    ) -> "tuple[tuple[float, Array | None] | None, float]":
        """Return tension and first guess of a released patella in the next pass.

        Returns:
            Tension of the quadriceps (N) with the patella's coordinates (6,), None: unknown; and
            the relative change of the tension. The change is 0 with a plane or a slack patella.
        """
        extensor, patella = knee.geometry.extensor, knee.patella
        lost = slack or extensor is None or bool(knee.problem)
        # A muscle share without quadriceps has a slack ligament.
        if instant.patella is None or lost or extensor is None or not knee.pull > 0.0:
            return None, 0.0
        released = extensor.released
        if released is None:
            assert patella is not None
            return (knee.pull / patella.ligament_ratio, instant.patella_start), np.inf
        change = knee.pull / released.forces["patellar_ligament"]
        return (change * released.tension, released.coordinates), abs(change - 1.0)

    @property
    def _has_residual_forces(self) -> bool:
        return len(self.released) < 5

    def _joint(
        self, instant: Instant, geometry: KneeGeometry, middle: Array, slack: bool
    ) -> JointEquilibrium:
        ligaments, coordinates = instant.ligaments, geometry.coordinates
        if self._external is None or self._external[0] is not instant:
            self._external = instant, external_wrench(geometry, coordinates)
        external = self._external[1]
        # Not finite: the patella was not found at this pose. The next call computes it again.
        if not np.isfinite(external).all():
            self._external = None
        return joint_equilibrium(
            geometry, ligaments, coordinates, self.released, middle, slack, external
        )

    def _forces(
        self,
        instant: Instant,
        joint: JointEquilibrium,
        coordinates: Array,
        contact: "ProbedContact | None" = None,
    ) -> "ReleasedForces":
        friction = instant.friction
        return ReleasedForces(joint, self._probe, coordinates, friction, instant.sliding, contact)


def _pull(geometry: KneeGeometry) -> "tuple[float, Array | None] | None":
    """Return tension and coordinates of the released patella of a frame; None: it has none."""
    released = None if geometry.extensor is None else geometry.extensor.released
    return None if released is None else (released.tension, released.coordinates)


def _pulled(
    instant: Instant,
    geometry: KneeGeometry,
    patella: "PatellaState | None",
    pull: "tuple[float, Array | None] | None",
    complete: bool = False,
) -> KneeGeometry:
    """Return a geometry with the released patella under a tension, if that is known.

    Args:
        geometry: the frame with the plane patella.
        patella: the plane patella.
        pull: tension of the quadriceps, N, and first guess of the coordinates (6,).
        complete: see `PatellaMethod.pulled`.
    """
    if instant.patella is None or pull is None or geometry.extensor is None or geometry.problems:
        return geometry
    tension, start = pull
    assert patella is not None
    return instant.patella.pulled(
        geometry, tension, patella.patellofemoral_ratio, start, complete=complete
    )


def _tension_has_converged(change: float, last: float) -> bool:
    """Return whether the tension has converged, by its relative change in the last two passes."""
    stalls = 0.9 * last < change < RELEASED_KNEE.tension_jump
    return stalls or change < RELEASED_KNEE.tension_tolerance


def remaining_distance(distances: Sequence[float]) -> float:
    """Return the remaining distance of converging passes, per distance of the last pass.

    Let q be the larger of the last two ratios of successive distances. The result is the sum
    q / (1 - q) of the remaining geometric series. It is 1 if there were fewer than three passes, or
    if a pass did not halve the distance of the previous pass.

    Args:
        distances: distances of the last three passes, m; inf: no such pass.
    """
    first, second, last = distances
    if not 0.0 < second <= 0.5 * first < np.inf or last > 0.5 * second:
        return 1.0
    ratio = max(last / second, second / first)
    return ratio / (1.0 - ratio)


def _middle(contact: "ProbedContact", points: dict[str, Array] | None, coordinates: Array) -> Array:
    contact_points = (points or {}) | {side: c.point for side, c in contact.condyles.items()}
    return (
        np.asarray(np.mean(list(contact_points.values()), axis=0))
        if contact_points
        else coordinates[:3]
    )
