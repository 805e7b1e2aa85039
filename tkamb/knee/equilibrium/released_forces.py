"""Generalised forces on free knee coordinates at trial places, of a leg or of a simulator."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

import numpy as np

from tkamb.geometry.frames import Array, knee_axes, knee_pose
from tkamb.knee.contact_points import CondylePoint
from tkamb.knee.equilibrium.balance import Balance, Trial, find_balance
from tkamb.knee.joint_equilibrium import JointEquilibrium
from tkamb.knee.load import wrench_of

if TYPE_CHECKING:
    from tkamb.contact.model import Probe, ProbedContact


@dataclass(frozen=True)
class ReleasedForceSettings:
    """The forces on released coordinates."""

    lever_arm: float = 0.025
    """m: arm that makes rotations comparable to translations. Chosen: half the usual distance of
    the condyles."""
    difference_step: float = 1e-7
    """m: step of the finite differences of joint axes and ligaments. Chosen: far above rounding,
    far below a curvature's radius."""


RELEASED_FORCE = ReleasedForceSettings()

SCALE = np.array(
    [1.0, 1.0, 1.0, RELEASED_FORCE.lever_arm, RELEASED_FORCE.lever_arm, RELEASED_FORCE.lever_arm]
)

Sliding = Callable[[Array, Array], Array]


def _no_sliding(place: Array, point: Array) -> Array:
    return np.zeros(3)


class Joint(Protocol):
    """Loads on the free coordinates beside the contact, of a leg or of a simulator."""

    @property
    def released(self) -> tuple[int, ...]:
        """Indices of the n free coordinates."""

    def imbalance(self, coordinates: Array, contact: Array) -> Array:
        """Return the generalised forces (..., n) at coordinates (..., 6) and a contact (6,)."""

    def contact_gain(self, coordinates: Array) -> Array:
        """Return their derivative by the contact's wrench on the insert, (n, 6)."""


J = TypeVar("J", bound=Joint)


class FreeForces(Generic[J]):
    """Generalised forces on the free coordinates of a joint at trial places.

    Args:
        joint: loads beside the contact.
        probe: of the contact model.
        place: (6,) knee coordinates; those not free stay.
        friction: Coulomb coefficient.
        sliding: from coordinates (6,) and point (3,) to the femur's velocity there (3,), m/s.
        touch: the contact at that place, where it is known already.

    Attributes:
        seen: scaled coordinates as bytes -> contact there.
    """

    def __init__(
        self,
        joint: J,
        probe: "Probe",
        place: Array,
        friction: float = 0.0,
        sliding: Sliding = _no_sliding,
        touch: "ProbedContact | None" = None,
    ) -> None:
        self._joint, self._probe, self._place = joint, probe, np.array(place, float)
        self._friction, self._sliding = friction, sliding
        self._rows = list(joint.released)
        self._scale = SCALE[self._rows]
        self._start = self._place[self._rows] * self._scale
        self.seen: dict[bytes, ProbedContact] = {}
        if touch is not None:
            self.seen[self._start.tobytes()] = touch

    def balance(
        self, stiffness: Array | None = None, residual_share: float = 0.0, reach: float = np.inf
    ) -> Balance:
        """Return the equilibrium of the free coordinates, with the given place as initial guess.

        Args:
            stiffness: (n, n) N/m of a search near by.
            residual_share: see `find_balance`.
            reach: m, see `find_balance`.
        """
        return find_balance(self.trial, self._start, stiffness, residual_share, reach)

    def contact(self, balance: Balance) -> "ProbedContact":
        """Return the contact of a balance."""
        return self.seen[balance.coordinates.tobytes()]

    def trial(self, x: Array) -> Trial:
        """Return scaled forces and stiffness at scaled coordinates (n,), m."""
        place, key = self._with(x), x.tobytes()
        contact = self.seen.get(key)
        if contact is None:
            contact = self.seen[key] = self._probe.at(knee_pose(place))
        if not contact.known:
            return Trial(np.full(len(x), np.nan))
        wrench, stiffness = self._with_friction(place, contact)
        force_noise = contact.accuracy * float(np.linalg.norm(wrench[:3]))
        if stiffness is None:
            force = self._joint.imbalance(place, wrench) / self._scale
            return Trial(force, force_noise=force_noise)
        steps = np.zeros((len(x) + 1, 6))
        steps[np.arange(len(x)), self._rows] = RELEASED_FORCE.difference_step / self._scale
        forces = self._joint.imbalance(place + steps, wrench) / self._scale
        change = (forces[:-1] - forces[-1]).T / RELEASED_FORCE.difference_step
        twists = knee_axes(place)[self._rows] / self._scale[:, None]
        gain = self._joint.contact_gain(place) / self._scale[:, None]
        tangent = -(change + gain @ stiffness @ twists.T)
        return Trial(forces[-1], tangent, contact.exact, force_noise)

    def left(self) -> float:
        """Return the largest scaled force, N, at the place where the search would begin."""
        return float(np.abs(self.trial(self._start).force).max())

    def at(self, balance: Balance) -> Array:
        """Return the knee coordinates (6,) of a balance."""
        return self._with(balance.coordinates)

    def _with(self, x: Array) -> Array:
        place = self._place.copy()
        place[self._rows] = x / self._scale
        return place

    def _with_friction(self, place: Array, contact: "ProbedContact") -> tuple[Array, Array | None]:
        """Return wrench (6,) on the insert with friction, and its stiffness (6, 6) if known."""
        wrench, stiffness = np.zeros(6), np.zeros((6, 6))
        for condyle in contact.loads:
            sliding = self._sliding(place, condyle.point)
            touch = CondylePoint(condyle.point, condyle.normal, sliding, 0.0)
            drag = touch.normal - touch.direction(self._friction)
            rubbing = wrench_of(touch.point, drag)
            wrench += condyle.wrench + condyle.force * rubbing
            if condyle.stiffness is not None:
                pressed = -touch.normal @ condyle.stiffness[:3]
                stiffness += condyle.stiffness + np.outer(rubbing, pressed)
        return wrench, stiffness if contact.tangent else None


class ReleasedForces(FreeForces[JointEquilibrium]):
    """Generalised forces on the released coordinates of a leg, its patella fixed to the femur."""

    def tension_per_wrench(self, contact: "ProbedContact") -> Array | None:
        """Return v (6,): a further wrench dw on the insert adds v . dw to the ligament's tension.

        The released coordinates move by dq to the new equilibrium. With K = -df/dq of the
        generalised forces f = -J w of contact, ligaments and muscles,

            -J dw - K dq - J B dy = 0

        gives dq and the change dy of the loads that keep the other coordinates; the tension of the
        patellar ligament is one of them. None where the contact model does not know its tangent.

        Args:
            contact: at the place where the search begins, in equilibrium.
        """
        place = self._place
        wrench, stiffness = self._with_friction(place, contact)
        if stiffness is None:
            return None
        steps = np.zeros((len(self._rows) + 1, 6))
        steps[np.arange(len(self._rows)), self._rows] = RELEASED_FORCE.difference_step / self._scale
        forces = self._joint.whole(place + steps, wrench)
        axes = knee_axes(place)
        twists = axes[self._rows] / self._scale[:, None]
        change = (
            forces[:-1] - forces[-1]
        ).T / RELEASED_FORCE.difference_step - axes @ stiffness @ twists.T
        matrix = np.hstack([-change, axes @ self._joint.columns(place)])
        return np.asarray(-np.linalg.solve(matrix, axes)[-1])

    def tension_at_rest(self, contact: "ProbedContact", per_wrench: Array) -> float:
        """Return the tension (N) of the patellar ligament at the equilibrium near by.

        A residual wrench at the place counts as a further wrench to which the knee yields.

        Args:
            contact: at the place where the search begins.
            per_wrench: (6,), see `tension_per_wrench`.
        """
        wrench, _ = self._with_friction(self._place, contact)
        reactions, remainder = self._joint.kept_and_left(self._place, wrench)
        return float(reactions[-1] + per_wrench @ remainder)

    def pushes(self, balance: Balance) -> bool:
        """Return whether the patellar ligament, where it is taut, would have to push."""
        if self._joint.line is None:
            return False
        place = self.at(balance)
        wrench, _ = self._with_friction(place, self.contact(balance))
        return bool(self._joint.kept(place, wrench)[-1] < 0)
