"""Released knee coordinates: where contact, ligaments and muscle line leave them at rest.

Flexion is as recorded. The superior-inferior position always follows from the contact;
adduction, axial rotation, anterior-posterior and medial-lateral position do so if the scene
releases them, else they are kept as recorded, and what keeps them is a residual of the
equations of motion.

Within one search the patella rides on the femur, and its ligament turns with it; patella and
lines are then found anew at the solved pose, until that moves the knee no more. Inertia and
sliding speed are those of the recorded rates: for the released coordinates all is
quasi-static. Friction is Coulomb's, mu times each condyle's resultant against the recorded
sliding, on the line of action of the resultant; without it nothing but follower loads keeps
the forces from having a potential.

The contact comes as a probe; this file does not know the models.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from tkamb.body.contact_points import CondylePoint
from tkamb.body.joint_equilibrium import JointEquilibrium, joint_equilibrium
from tkamb.body.knee import KneeGeometry
from tkamb.body.load import wrench_of
from tkamb.equilibrium.balance import Balance, BalanceStatus, Trial, find_balance
from tkamb.equilibrium.mechanics import Mechanics
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_axes, knee_pose

if TYPE_CHECKING:
    from tkamb.body.crossing import MuscleShare
    from tkamb.body.patella import PatellaState
    from tkamb.contact.probe import Probe, ProbedContact

LEVER = 0.025
"""m: half the usual distance of the condyles; makes rotations comparable to translations."""
SCALE = np.array([1.0, 1.0, 1.0, LEVER, LEVER, LEVER])
KNEE_CHANGE = 2e-6
"""m: the knee moves less than this when the patella is found anew."""
FORCE_CHANGE = 0.1
"""N: neither does the contact force."""
MOST_PASSES = 20
"""Passes by which knee and patella settle; each halves what is left where the knee is soft."""
TINY = 1e-7
"""m: step of the finite differences of axes and ligaments."""


Sliding = Callable[[Array, Array], Array]


def _no_sliding(place: Array, point: Array) -> Array:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class KneeEquilibrium:
    """One frame with its released coordinates at rest.

    Args:
        coordinates: (6,) m and rad.
        geometry: the leg there, without its contact.
        patella: where it is; None if not modelled.
        contact: the contact there.
        balance: the last search.
        passes: how often patella and lines were found anew.
        trials: how often the contact was computed.
        change: N, what the last pass changed in the contact force.
        problem: why this is no result, or empty.
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


def released_indices(names: Sequence[str]) -> tuple[int, ...]:
    """Return the indices of the released coordinates, the superior-inferior one among them."""
    return tuple(i for i, name in enumerate(KNEE_COORDINATES) if name == "si" or name in names)


class ReleasedKnee:
    """Finds the released coordinates of a case, frame by frame.

    Args:
        mechanics: the body side.
        probe: of the contact model.
        names: the released coordinates, "si" understood.
    """

    def __init__(self, mechanics: Mechanics, probe: "Probe", names: Sequence[str]) -> None:
        self._mechanics, self._probe = mechanics, probe
        self.released = released_indices(names)
        self._rows = list(self.released)

    def find(
        self,
        k: int,
        start: Array,
        points: dict[str, Array] | None = None,
        before: KneeEquilibrium | None = None,
        share: "MuscleShare | None" = None,
    ) -> KneeEquilibrium:
        """Return frame k at rest.

        Args:
            k: frame.
            start: (6,) coordinates; the released ones are where the search begins.
            points: side -> (3,) m, where a condyle that carries nothing is nearest to the
                insert: residual forces act in the middle of both condyles' points.
            before: the frame before, whose patella and stiffness are guesses.
            share: the forces of the other muscles, which follow the knee.
        """
        place, middle, force = np.array(start, float), np.array(start[:3]), np.full(3, np.nan)
        knee, slack, trials, passes = before, False, 0, 0
        while passes < MOST_PASSES:
            knee, pushes = self._pass(k, place, middle, slack, knee, share)
            passes, trials = passes + 1, trials + knee.balance.trials
            change = float(np.linalg.norm(knee.contact.wrench[:3] - force))
            knee = replace(knee, passes=passes, trials=trials, change=change)
            moved = np.abs((knee.coordinates - place) * SCALE).max()
            place, force, last = knee.coordinates, knee.contact.wrench[:3], middle
            middle = _middle(knee.contact, points, place)
            shift = np.abs(middle - last).max() if self._keeps else 0.0
            if pushes:
                # a line that pushes drives the knee away: slack, it begins where this began
                slack, knee = True, before
                place, middle, force = np.array(start, float), np.array(start[:3]), force * np.nan
            elif knee.problem or (max(moved, shift) < KNEE_CHANGE and change < FORCE_CHANGE):
                return knee
        assert knee is not None
        return replace(knee, problem="knee and patella do not settle together")

    def _pass(
        self,
        k: int,
        place: Array,
        middle: Array,
        slack: bool,
        before: KneeEquilibrium | None,
        share: "MuscleShare | None",
    ) -> tuple[KneeEquilibrium, bool]:
        """Return the knee at rest with the patella as at `place`, and whether it would push."""
        patella = self._patella(k, place, before.patella if before else None)
        geometry = replace(self._mechanics.geometry(k, place, patella), share=share)
        forces = self._forces(k, geometry, middle, slack)
        balance = forces.balance(before.balance.stiffness if before else None)
        contact, problem = forces.contact(balance), "; ".join(geometry.problems)
        if balance.status is not BalanceStatus.OK:
            problem = problem or f"released: {balance.status.value}" + (
                " (quadriceps slack, flexors not modelled)" if slack and not share else ""
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
        return knee, contact.known and forces.pushes(balance)

    @property
    def _keeps(self) -> bool:
        """Whether residual forces act: a translation or rotation is kept as recorded."""
        return len(self.released) < 5

    def _patella(self, k: int, place: Array, guess: "PatellaState | None") -> "PatellaState | None":
        extensor = self._mechanics.extensor
        if extensor is None:
            return None
        return extensor.patella(k, knee_pose(place), guess.coordinates if guess else None)

    def _forces(
        self, k: int, geometry: KneeGeometry, middle: Array, slack: bool
    ) -> "ReleasedForces":
        mechanics = self._mechanics
        joint = joint_equilibrium(
            geometry,
            mechanics.ligaments,
            geometry.coordinates,
            self.released,
            middle,
            slack,
        )
        sliding = partial(mechanics.sliding, k)
        return ReleasedForces(joint, self._probe, geometry.coordinates, mechanics.friction, sliding)


class ReleasedForces:
    """What drives the released coordinates at trial places, the patella held on the femur.

    Args:
        joint: of the body.
        probe: of the contact model.
        place: (6,) knee coordinates; those not released stay.
        friction: Coulomb coefficient.
        sliding: from coordinates (6,) and point (3,) to the femur's velocity there (3,), m/s.

    Attributes:
        seen: scaled coordinates as bytes -> contact there.
    """

    def __init__(
        self,
        joint: JointEquilibrium,
        probe: "Probe",
        place: Array,
        friction: float = 0.0,
        sliding: Sliding = _no_sliding,
    ) -> None:
        self._joint, self._probe, self._place = joint, probe, np.array(place, float)
        self._friction, self._sliding = friction, sliding
        self._rows = list(joint.released)
        self._scale = SCALE[self._rows]
        self.seen: dict[bytes, ProbedContact] = {}

    def balance(self, stiffness: Array | None = None) -> Balance:
        """Return where the released coordinates come to rest, from the given place."""
        return find_balance(self.trial, self._place[self._rows] * self._scale, stiffness)

    def contact(self, balance: Balance) -> "ProbedContact":
        """Return the contact of a balance."""
        return self.seen[balance.coordinates.tobytes()]

    def trial(self, x: Array) -> Trial:
        """Return scaled forces and stiffness at scaled coordinates (n,), m."""
        place = self._with(x)
        contact = self.seen[x.tobytes()] = self._probe.at(knee_pose(place))
        if not contact.known:
            return Trial(np.full(len(x), np.nan))
        wrench, stiffness = self._with_friction(place, contact)
        if stiffness is None:
            return Trial(self._joint.imbalance(place, wrench) / self._scale)
        steps = np.zeros((len(x) + 1, 6))
        steps[np.arange(len(x)), self._rows] = TINY / self._scale
        forces = self._joint.imbalance(place + steps, wrench) / self._scale
        change = (forces[:-1] - forces[-1]).T / TINY
        twists = knee_axes(place)[self._rows] / self._scale[:, None]
        gain = self._joint.contact_gain(place) / self._scale[:, None]
        return Trial(forces[-1], -(change + gain @ stiffness @ twists.T))

    def at(self, balance: Balance) -> Array:
        """Return the knee coordinates (6,) of a balance."""
        return self._with(balance.coordinates)

    def pushes(self, balance: Balance) -> bool:
        """Return whether the patellar ligament, where it is taut, would have to push."""
        if self._joint.line is None:
            return False
        place = self.at(balance)
        wrench, _ = self._with_friction(place, self.contact(balance))
        return bool(self._joint.kept(place, wrench)[-1] < 0)

    def _with(self, x: Array) -> Array:
        place = self._place.copy()
        place[self._rows] = x / self._scale
        return place

    def _with_friction(self, place: Array, contact: "ProbedContact") -> tuple[Array, Array | None]:
        """Return wrench (6,) on the insert with friction, and its stiffness (6, 6) if known."""
        wrench, stiffness = np.zeros(6), np.zeros((6, 6))
        for condyle in contact.condyles.values():
            sliding = self._sliding(place, condyle.point)
            touch = CondylePoint(condyle.point, condyle.normal, sliding, 0.0)
            drag = touch.normal - touch.direction(self._friction)
            rubbing = wrench_of(touch.point, drag)
            wrench += condyle.wrench + condyle.force * rubbing
            if condyle.stiffness is not None:
                pressed = -touch.normal @ condyle.stiffness[:3]
                stiffness += condyle.stiffness + np.outer(rubbing, pressed)
        return wrench, stiffness if contact.tangent else None


def _middle(contact: "ProbedContact", points: dict[str, Array] | None, place: Array) -> Array:
    known = (points or {}) | {side: c.point for side, c in contact.condyles.items()}
    return np.asarray(np.mean(list(known.values()), axis=0)) if known else place[:3]
