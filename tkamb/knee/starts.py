"""Initial guesses of the released coordinates, and the search from each of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from tkamb.contact.pair import ContactPair
from tkamb.errors import ComputationError
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_pose
from tkamb.knee.instant import Instant
from tkamb.knee.released import KneeEquilibrium, ReleasedKnee
from tkamb.knee.released_forces import SCALE
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.cam_post import CamPost


@dataclass(frozen=True)
class InitialPoseSettings:
    """Limits of the initial guesses of the released coordinates."""

    max_extrapolation: float = 2e-3
    """m: largest extrapolation from the last frame. A guess far from the solution
    costs more time than it saves."""
    first_penetration: float = 5e-5
    """m: penetration of an initial guess at first touch. A loaded contact of
    polyethylene has more penetration, and the search also finds a lightly loaded contact from this
    guess."""
    max_continuation: float = 1e-3
    """m (rotations times the lever arm): distance of an equilibrium from its initial guess above
    which other guesses are tried for a second equilibrium. The shipped knee moves by 0.5 mm at most
    between frames.
    """
    other_shift: float = 5e-3
    """m: shift of the recorded pose in anterior and posterior direction, for two more initial
    guesses of a first frame. About a third of a dish."""
    same_place: float = 0.5e-3
    """m (rotations times the lever arm): distance above which two equilibria are different.
    It is well above the tolerances of the search."""


INITIAL_POSE = InitialPoseSettings()

AP = KNEE_COORDINATES.index("ap")


class InitialPoses:
    """The initial guesses of a search by `knee`, the most likely guess first."""

    def __init__(self, knee: ReleasedKnee, pair: ContactPair, post: "CamPost | None") -> None:
        self._knee, self._pair, self._post = knee, pair, post

    def equilibrium(
        self, instant: Instant, previous: Sequence[KneeEquilibrium], points: dict[str, Array]
    ) -> KneeEquilibrium:
        """Return the equilibrium from the first initial guess from which the search succeeds.

        If it is farther than `INITIAL_POSE.max_continuation` from that guess, the search is
        repeated from others; `second` of the result describes another equilibrium at which such a
        search ends. `previous` are up to three previous frames in order; `points` (3,), m, are
        those where an unloaded condyle is nearest to the insert.

        Raises:
            ComputationError: no initial guess lies over the insert, or no muscle forces balance the
                frame.
        """
        knee, failure = None, "the femoral component does not lie over the insert"
        recorded = instant.coordinates
        starts = self._guesses(recorded, [knee.coordinates for knee in previous])
        for guess in starts:
            if not np.isfinite(guess).all():
                continue
            try:
                knee = self._knee.find(instant, guess, points, previous[-1] if previous else None)
            except ComputationError as error:
                failure = error.what
                continue
            if not knee.problem:
                break
        if knee is None:
            raise ComputationError(failure)
        if knee.problem or _distance(guess, knee.coordinates) <= INITIAL_POSE.max_continuation:
            return knee
        others = list(starts) or self._shifted_guesses(instant)
        return replace(knee, second=self._second(instant, knee, others, points))

    def _shifted_guesses(self, instant: Instant) -> list[Array]:
        """Return the recorded pose shifted anteriorly and posteriorly, at first touch."""
        guesses = [instant.coordinates.copy(), instant.coordinates.copy()]
        for guess, sign in zip(guesses, (1.0, -1.0), strict=True):
            guess[AP] += sign * INITIAL_POSE.other_shift * (AP in self._knee.released)
        return [self.at_first_touch(guess) for guess in guesses]

    def _second(
        self,
        instant: Instant,
        knee: KneeEquilibrium,
        starts: list[Array],
        points: dict[str, Array],
    ) -> str:
        for guess in starts:
            if not np.isfinite(guess).all():
                continue
            try:
                other = self._knee.find(instant, guess, points)
            except ComputationError:
                continue
            distance = _distance(other.coordinates, knee.coordinates)
            if other.problem or distance <= INITIAL_POSE.same_place:
                continue
            displacement = np.abs(other.coordinates - knee.coordinates)
            forces = [np.linalg.norm(one.contact.wrench[:3]) for one in (knee, other)]
            return (
                f"a second equilibrium: from another initial guess the search ends "
                f"{displacement[:3].max() / MILLIMETRE:.1f} mm and "
                f"{displacement[3:].max() / DEGREE:.1f} deg away, "
                f"with {forces[1]:.0f} N instead of {forces[0]:.0f} N of contact force"
            )
        return ""

    def _guesses(self, recorded: Array, previous: list[Array]) -> Iterator[Array]:
        """Yield up to three initial guesses: extrapolated, of the last frame, and recorded.

        The extrapolated guess keeps its height; the others are at first touch.
        """
        rows = list(self._knee.released)
        for number, released_guess in enumerate(
            [extrapolated(previous), previous[-1]] if previous else []
        ):
            guess = recorded.copy()
            guess[rows] = released_guess[rows]
            yield guess if number == 0 else self.at_first_touch(guess)
        yield self.at_first_touch(recorded)

    def at_first_touch(self, coordinates: Array) -> Array:
        """Return coordinates (6,), m and rad, with the height changed to first touch.

        If AP is released and cam and post overlap, AP is changed to their first touch.
        """
        touching = self._on_the_dishes(coordinates)
        if self._post is None or AP not in self._knee.released:
            return touching
        gap = self._post.clearance(knee_pose(touching))
        if not gap < 0:
            return touching
        return self._on_the_dishes(
            np.array([coordinates[0] + gap + INITIAL_POSE.first_penetration, *coordinates[1:]])
        )

    def _on_the_dishes(self, coordinates: Array) -> Array:
        height = self._pair.first_touch_height(knee_pose(coordinates))
        return np.array([coordinates[0], height - INITIAL_POSE.first_penetration, *coordinates[2:]])


def _distance(first: Array, second: Array) -> float:
    """Return the largest distance (m) between coordinates (6,), rotations times the lever arm."""
    return float(np.abs((second - first) * SCALE).max())


def extrapolated(previous: list[Array]) -> Array:
    """Return coordinates (6,) extrapolated from up to three frames.

    The last step is repeated with a factor from 0 to 1, its projection on the previous step. A
    lightly loaded knee moves irregularly, hence the limit `INITIAL_POSE.max_extrapolation`.
    """
    if len(previous) < 3:
        return previous[-1]
    last_but_one, step = ((b - a) * SCALE for a, b in pairwise(previous))
    # The factor of a steady motion is 1. If the motion reverses, the factor is negative, and the
    # guess is the last frame.
    factor = float(last_but_one @ step) / max(float(last_but_one @ last_but_one), 1e-18)
    limit = INITIAL_POSE.max_extrapolation / max(float(np.linalg.norm(step)), 1e-9)
    return previous[-1] + min(max(factor, 0.0), 1.0, limit) * (previous[-1] - previous[-2])
