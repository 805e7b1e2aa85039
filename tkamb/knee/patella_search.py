"""The search for the equilibrium of a patella whose motion was not recorded.

A frame has three unknowns, the coordinates patella_ap, patella_si and patella_rotation, and three
equations of a massless patella without friction:

    gap to the femoral component = 0
    length of the patellar ligament = its given length
    muscle, ligament and contact force meet in one point (moment balance in the plane)

By virtual work, the third equation states that the length of the muscle is stationary among all
poses that satisfy the first two equations. A stable patella is at a minimum of this length. Near a
known solution, Newton's method solves the three equations together. Broyden's updates improve the
Jacobian, whose entries are called slopes. Without a known solution, the search rotates the patella
in the direction of the residual moment until the moment changes sign.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, transform
from tkamb.knee.patella import (
    PATELLA,
    ExtensorMechanism,
    PatellaBalance,
    PatellaFrame,
    PatellaState,
    PatellaStatus,
)


@dataclass(frozen=True)
class PatellaSearchSettings:
    """Tolerances and limits of the search for the patella."""

    length_tolerance: float = 1e-8
    """m: error of gap and ligament length below which the search has converged. Not studied."""
    rotation_tolerance: float = 1e-7
    """rad: step of the rotation below which the search has converged. Not studied."""
    max_chord_lengths: float = 8.0
    """1: largest extrapolation along the chord between the states at two rotations, in lengths of
    this chord. Chosen because a longer extrapolation fails."""
    max_evaluations: int = 14
    """Maximum number of Newton steps from a guess near the solution. Not studied."""
    lever_arm: float = 0.02
    """m: arm that makes a rotation comparable to a length in Broyden's update. Chosen as half the
    width of a patella."""
    max_distance: float = 5e-3
    """m: largest distance of a solution from the position where the button first touches the femur
    at the same rotation. Chosen because a more distant solution lies behind the femur."""


PATELLA_SEARCH = PatellaSearchSettings()


LONGEST_STEP = np.array([5e-3, 5e-3, np.deg2rad(4.0)])
"""m, m and rad: largest step of the coordinates."""


FIRST_STEP = np.deg2rad(0.5)
"""rad: first step when the search rotates the patella."""
NEAR_TURN = np.deg2rad(12.0)
"""rad: largest rotation from the initial guess in Newton's method with known slopes."""
WIDEST_TURN = np.deg2rad(40.0)
"""rad: largest rotation from the initial guess when the search rotates the patella."""


class _Lost(ComputationError):
    """The search found no equilibrium. `status` names the condition that failed."""

    def __init__(self, status: PatellaStatus) -> None:
        super().__init__(status.value)
        self.status = status


def solve_patella(
    mechanism: ExtensorMechanism,
    pose_femur_in_insert: Array,
    guess: Array | None = None,
    slopes: Array | None = None,
    anywhere: bool = True,
) -> PatellaState:
    """Return the patella in equilibrium at one frame.

    Args:
        mechanism: the extensor mechanism.
        pose_femur_in_insert: pose of the femur link, shape (4, 4).
        guess: coordinates as initial guess, shape (3,), m and rad; None: the search covers all
            rotations.
        slopes: `PatellaState.slopes` at the guess, shape (3, 3); None: unknown.
        anywhere: whether the search covers all rotations if the search from the guess fails.

    Returns:
        The state. Coordinates and forces are NaN unless its status is OK, SEVERAL or EDGE.
    """
    search = _Search(mechanism, pose_femur_in_insert)
    balance, several = None, False
    if guess is not None and np.isfinite(guess).all():
        try:
            balance = search.follow(guess, slopes)
        except ComputationError:
            balance = None
    if balance is None:
        if not anywhere:
            return _failed_patella(PatellaStatus.MOMENT)
        try:
            balance, several = search.scan()
        except _Lost as lost:
            return _failed_patella(lost.status)
    if balance.normal_force <= 0.0 or balance.ligament_force <= 0.0:
        return _failed_patella(PatellaStatus.PULL)
    status = PatellaStatus.SEVERAL if several else PatellaStatus.OK
    if balance.contact.on_edge > 0.5:
        status = PatellaStatus.EDGE
    return search.state(balance, status)


class _Closing:
    """Newton steps for gap and ligament length at a constant rotation, with Broyden's slopes.

    The first slopes are the contact's unit normal and the ligament's direction. On the flanks of
    the groove the slope of the gap is up to a fifth smaller.
    """

    def __init__(self, ligament_length: float) -> None:
        self._length = ligament_length
        self._slopes: Array = np.eye(2)
        self._step: Array = np.zeros(2)
        self.errors: Array = np.full(2, np.inf)

    @property
    def converged(self) -> bool:
        return bool(np.abs(self.errors).max() < PATELLA_SEARCH.length_tolerance)

    def step(self, balance: PatellaBalance) -> Array:
        """Return the next step (2,) in ap and si, m, limited to 5 mm."""
        last_errors, stretch = self.errors, balance.ligament.length - self._length
        self.errors = np.array([balance.contact.gap, stretch])
        error, last_error = float(np.abs(self.errors).max()), float(np.abs(last_errors).max())
        improves = error < 0.5 * last_error < np.inf
        if improves:
            update_error = self.errors - last_errors - self._slopes @ self._step
            self._slopes += np.outer(update_error, self._step) / (self._step @ self._step)
        if not improves or abs(np.linalg.det(self._slopes)) < PATELLA.least_determinant:
            self._slopes = _slopes_in_plane(balance)
        step = np.linalg.solve(self._slopes, -self.errors)
        self._step = np.asarray(
            step * min(1.0, LONGEST_STEP[0] / max(float(np.linalg.norm(step)), 1e-12))
        )
        return self._step


class _Search(PatellaFrame):
    """The search at one frame."""

    def at_rotation(self, start: Array, rotation: float) -> PatellaBalance:
        """Return the balance with zero gap and the given ligament length at a rotation (rad).

        Raises:
            ComputationError: there is no such balance, or a line ends inside the outline that it
                wraps.
        """
        closing = _Closing(self.mechanism.ligament_length)
        coordinates = np.array([start[0], start[1], rotation])
        for _ in range(40):
            balance = self.balance(coordinates)
            step = closing.step(balance)
            if closing.converged:
                return balance
            coordinates = coordinates + np.append(step, 0.0)
        worst = np.argmax(np.abs(closing.errors))
        raise _Lost((PatellaStatus.GAP, PatellaStatus.LIGAMENT)[worst])

    def follow(self, guess: Array, slopes: Array | None = None) -> PatellaBalance:
        """Return the stable equilibrium near a guess, where the moment vanishes.

        Args:
            guess: patella coordinates, shape (3,), m and rad.
            slopes: slopes at a similar pose, for Newton's method, shape (3, 3); None: unknown.

        Raises:
            ComputationError: there is no equilibrium within `WIDEST_TURN`.
        """
        if slopes is not None:
            balance = self._closed_in(guess, slopes, (-NEAR_TURN, NEAR_TURN))
            if balance is not None:
                return balance
        current = self.at_rotation(guess, float(guess[2]))
        step = FIRST_STEP
        while abs(current.coordinates[2] - guess[2]) < WIDEST_TURN:
            rotation = current.coordinates[2] + np.sign(current.moment) * step
            next_balance = self.at_rotation(current.coordinates, float(rotation))
            if next_balance.moment * current.moment <= 0.0:
                return self.between(current, next_balance)
            extrapolated = self._chord(current, next_balance, PATELLA_SEARCH.max_chord_lengths)
            if extrapolated is not None:
                return extrapolated
            current, step = next_balance, 1.6 * step
        raise _Lost(PatellaStatus.MOMENT)

    def between(self, first: PatellaBalance, second: PatellaBalance) -> PatellaBalance:
        """Return the balance at the zero of the moment between two rotations."""
        balance = self._chord(first, second)
        if balance is not None:
            return balance
        last = first

        def moment(rotation: float) -> float:
            nonlocal last
            last = self.at_rotation(last.coordinates, rotation)
            return last.moment

        ends = (first.coordinates[2], second.coordinates[2])
        try:
            brentq(moment, *ends, xtol=PATELLA_SEARCH.rotation_tolerance, rtol=1e-12)
        except ValueError:
            # At the rotation of `second`, a search from `first` may find another balance. If the
            # moments of both ends then have the same sign, they do not bracket a zero.
            raise _Lost(PatellaStatus.MOMENT) from None
        return last

    def _chord(
        self, first: PatellaBalance, second: PatellaBalance, max_lengths: float = 1.0
    ) -> PatellaBalance | None:
        """Return the stable equilibrium near the chord between two balances; None: not found.

        Args:
            first: balance at the start of the chord.
            second: balance at the end of the chord.
            max_lengths: largest distance from the start, in lengths of the chord, 1.
        """
        turn = float(second.coordinates[2] - first.coordinates[2])
        slope_in_plane = (second.coordinates - first.coordinates)[:2] / turn
        slope = (second.moment - first.moment) / turn
        if slope >= 0.0:
            return None
        slopes = np.zeros((3, 3))
        slopes[:2, :2] = _slopes_in_plane(first)
        slopes[:2, 2], slopes[2, 2] = -slopes[:2, :2] @ slope_in_plane, slope
        start = first.coordinates + np.append(slope_in_plane, 1.0) * -first.moment / slope
        span = np.array([min(0.0, max_lengths * turn), max(0.0, max_lengths * turn)])
        return self._closed_in(start, slopes, span + first.coordinates[2] - start[2])

    def _closed_in(
        self, start: Array, slopes: Array, span: Sequence[float]
    ) -> PatellaBalance | None:
        """Return the stable equilibrium near a pose by Newton's method with Broyden's slopes.

        The result is None if a step leaves the span, if the slopes are those of an unstable state,
        or if the iteration does not converge.

        Args:
            start: patella coordinates, shape (3,), m and rad.
            slopes: approximate slopes of gap, ligament length and moment, shape (3, 3).
            span: smallest and largest rotation from the start, rad.
        """
        scale = np.array([1.0, 1.0, PATELLA_SEARCH.lever_arm])
        coordinates, step, last_errors = start, None, np.zeros(3)
        for _ in range(PATELLA_SEARCH.max_evaluations):
            if not span[0] <= coordinates[2] - start[2] <= span[1]:
                return None
            balance = self.balance(coordinates)
            stretch = balance.ligament.length - self.mechanism.ligament_length
            errors = np.array([balance.contact.gap, stretch, balance.moment])
            if step is not None:
                update_error, scaled = errors - last_errors - slopes @ step, step * scale
                slopes = slopes + np.outer(update_error, scaled * scale) / (scaled @ scaled)
            if not _stable(slopes):
                return None
            step, last_errors = -np.linalg.solve(slopes, errors), errors
            if (
                np.abs(errors[:2]).max() < PATELLA_SEARCH.length_tolerance
                and abs(step[2]) < PATELLA_SEARCH.rotation_tolerance
            ):
                return replace(balance, slopes=slopes)
            step = step / max(1.0, float(np.abs(step / LONGEST_STEP).max()))
            coordinates = coordinates + step
        return None

    def scan(self) -> tuple[PatellaBalance, bool]:
        """Return the stable equilibrium with the shortest muscle, and whether there are several.

        Raises:
            _Lost: there is no stable equilibrium. `status` is the condition that failed last in the
                order of `_CONDITIONS`.
        """
        flexion = np.arctan2(self.in_insert[1, 0], self.in_insert[0, 0])
        # The patella rotates with the tibia by about two thirds of the flexion. This rotation is
        # the middle of the scan.
        rotations = -0.65 * flexion + np.deg2rad(np.arange(-50.0, 50.1, 10.0))
        candidates: list[PatellaBalance | None] = []
        failures = []
        for rotation in rotations:
            try:
                candidates.append(self.first_touch(float(rotation)))
            except ComputationError as error:
                candidates.append(None)
                failures.append(_condition(error))
        balances = []
        for first, second in pairwise(candidates):
            # The equilibrium is stable where the moment falls through zero.
            if first and second and first.moment > 0.0 >= second.moment:
                try:
                    balances.append(self.between(first, second))
                except ComputationError as error:
                    failures.append(_condition(error))
        if not balances:
            failures += [PatellaStatus.MOMENT] * any(candidates)
            raise _Lost(max(failures, key=_CONDITIONS.index))
        return min(balances, key=lambda b: b.muscle.length), len(balances) > 1

    def first_touch(self, rotation: float) -> PatellaBalance:
        """Return the balance at a rotation (rad) near first touch.

        The patella swings on its ligament about the tuberosity, from anterior to posterior, until
        the button touches the femur.

        Raises:
            ComputationError: the button does not touch the femur, or there is no balance near the
                first contact.
        """
        mechanism = self.mechanism
        rotated = mechanism.contact.pose(np.array([0.0, 0.0, rotation]))
        proximal = transform(rotated, mechanism.ligament_proximal)
        # The proximal end of the ligament moves on a circle about the tuberosity.
        radius = np.sqrt(
            max(mechanism.ligament_length**2 - (proximal[2] - self.tuberosity[2]) ** 2, 1e-8)
        )

        def coordinates_at(lean: float) -> Array:
            swing = self.insert[:2, :2] @ (radius * np.array([np.sin(lean), np.cos(lean)]))
            return np.append(self.tuberosity[:2] + swing - proximal[:2], rotation)

        leans = np.deg2rad(np.arange(75.0, -75.1, -5.0))
        touching = next(
            (k for k, lean in enumerate(leans) if mechanism.contact.touches(coordinates_at(lean))),
            0,
        )
        # Index 0: no position touches the femur, or the first position touches it.
        if touching == 0:
            raise _Lost(PatellaStatus.NO_CONTACT)
        separate, touching_lean = leans[touching - 1], leans[touching]
        for _ in range(6):
            middle = 0.5 * (separate + touching_lean)
            separate, touching_lean = (
                (separate, middle)
                if mechanism.contact.touches(coordinates_at(middle))
                else (middle, touching_lean)
            )
        balance = self.at_rotation(coordinates_at(separate), rotation)
        if (
            np.linalg.norm((balance.coordinates - coordinates_at(separate))[:2])
            > PATELLA_SEARCH.max_distance
        ):
            raise _Lost(PatellaStatus.GAP)
        return balance


_CONDITIONS = (
    PatellaStatus.NO_CONTACT,
    PatellaStatus.LINE,
    PatellaStatus.LIGAMENT,
    PatellaStatus.GAP,
    PatellaStatus.MOMENT,
)
"""Conditions in the order of the checks. A failed search reports the last of its conditions."""


def _condition(error: ComputationError) -> PatellaStatus:
    """Return the condition that an error names; LINE if it names none."""
    return error.status if isinstance(error, _Lost) else PatellaStatus.LINE


def _slopes_in_plane(balance: PatellaBalance) -> Array:
    """Return the derivatives (2, 2) of gap and ligament length with respect to ap and si."""
    return np.stack([balance.contact.normal[:2], -balance.ligament.start_direction[:2]])


def _stable(slopes: Array) -> bool:
    """Return whether the moment opposes a rotation at constant gap and ligament length."""
    plane = slopes[:2, :2]
    if abs(np.linalg.det(plane)) < PATELLA.least_determinant:
        return False
    return bool(slopes[2, 2] < slopes[2, :2] @ np.linalg.solve(plane, slopes[:2, 2]))


def _failed_patella(status: PatellaStatus) -> PatellaState:
    nan, unknown = float("nan"), np.full(3, np.nan)
    return PatellaState(unknown, unknown, unknown, unknown, nan, nan, nan, nan, nan, status)
