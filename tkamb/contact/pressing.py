"""The press of any contact model: the search for the approach along -y that carries a load."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.pair import ContactPair
from tkamb.contact.result import ContactResult, ContactStatus, Guess
from tkamb.errors import InputError
from tkamb.geometry.first_touch import Touch
from tkamb.geometry.frames import Array, transform
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.model import ContactModel


@dataclass(frozen=True)
class PressSettings:
    """The search for the approach that carries a load."""

    load_tolerance: float = 1e-6
    """1: relative difference of reaction and load below which the search has converged."""
    coarse_tolerance: float = 1e-3
    """1: relative difference above which the press has not converged. It exceeds `load_tolerance`,
    because a reaction may jump where map points come into contact."""
    first_approach: float = 5e-5
    """m: initial guess of the approach if the caller gives none."""
    max_approach: float = 0.02
    """m: largest approach of a search. No insert carries a load beyond it."""
    least_bracket: float = 1e-16
    """m: width of the bracket at which the search ends. It is above the rounding of
    an approach of 20 mm (3e-18 m)."""
    max_evaluations: int = 80
    """Largest number of evaluations of the reaction in one press. Bisection of `max_approach` to
    `least_bracket` needs 48."""
    flagged_thickness_share: float = 0.5
    """1: ratio of approach to thickness from which a result is flagged. Half of the ratio
    at which the contact has failed."""
    rim_distance: float = 0.5 * MILLIMETRE
    """m: near the rim the thickness, zero at the rim itself, is the largest one within this
    distance.
    """
    ray_start_depth: float = 1e-7
    """m: depth below the surface at which rays into the insert begin; it is also the smallest
    thickness. It is above the rounding of a mesh."""


PRESS = PressSettings()


THROUGH = "check the meshes for a spike or a thin place"
COLUMNS = np.array([(x, 0.0, z) for x in (0, -1, 1) for z in (0, -1, 1)]) * PRESS.rim_distance
DOWN = np.array([0.0, -1.0, 0.0])

Reaction = Callable[[float], float]


@dataclass(frozen=True)
class LoadSearch:
    """Result of the search for a load.

    Args:
        approach: m, that carries the load; NaN if the load cannot be reached.
        residual: smallest |reaction - load| / load.
        deepest: m, largest evaluated approach.
    """

    approach: float
    evaluations: int
    residual: float
    deepest: float


def check_load(load: float) -> None:
    """Raise an InputError for a load (N) that no contact can carry."""
    if not (math.isfinite(load) and load >= 0):
        raise InputError(f"cannot be {load:g} N", "load", "give a finite force of at least 0 N")


def press_by_search(
    model: "ContactModel",
    state: Any,
    load: float,
    pose: Array,
    guess: Guess | None = None,
    reaction: Reaction | None = None,
    unloaded: float = 0.0,
) -> ContactResult:
    """Find the approach along -y at which `model` carries `load`.

    Only y of `pose` changes; it is not used.

    Args:
        load: superior-inferior force, N.
        guess: earlier result or warm start; its approach is the initial guess of the search.
        reaction: the force (N) on the insert along -y at an approach (m), faster than `evaluate`;
            inf if out of range.
        unloaded: m, see `search_load`.

    Returns:
        The contact at the approach that carries the load. It is OUT_OF_RANGE, with NaN, if the load
        cannot be reached or the femoral component does not lie over the insert. It is NOT_CONVERGED
        if the reaction jumps over the load. With a load of zero it is the first touch.
    """
    check_load(load)
    pose = np.array(pose, float)
    if not math.isfinite(state.pair.first_touch_height(pose)):
        return ContactResult.out_of_range(state, pose, beside_words(state.pair, pose))
    if load == 0:
        return unloaded_result(model, state, pose)
    evaluations = _Evaluations(model, state, pose, guess)
    start = guess.approach if guess is not None else PRESS.first_approach
    search = search_load(reaction or evaluations.reaction, load, start, unloaded)
    if not math.isfinite(search.approach):
        why = evaluations.at(search.deepest).flags
        problem = f"a load of {load:g} N cannot be reached"
        return ContactResult.out_of_range(
            state, pose, problem, *why, iterations=search.evaluations, residual=search.residual
        )
    return within_insert(state, _carried(evaluations.at(search.approach), search, load))


def beside_words(pair: ContactPair, pose: Array) -> str:
    """Return words for a component beside the insert, with the distance of the bounding boxes."""
    femur = transform(pose, pair.femoral.vertices)[:, [0, 2]]
    insert = pair.insert.vertices[:, [0, 2]]
    apart = np.maximum(insert.min(0) - femur.max(0), femur.min(0) - insert.max(0))
    distance = float(np.linalg.norm(np.maximum(apart, 0.0)))
    words = "the femoral component does not lie over the insert"
    return words if distance == 0.0 else f"{words}, but {distance / MILLIMETRE:.1f} mm beside it"


def _carried(result: ContactResult, search: LoadSearch, load: float) -> ContactResult:
    residual = abs(-float(result.wrench_on_insert[1]) - load) / load
    # With `not <=` a residual of NaN counts as not converged.
    diverged = not residual <= PRESS.coarse_tolerance
    return replace(
        result,
        iterations=search.evaluations,
        residual=residual,
        status=ContactStatus.NOT_CONVERGED if diverged else result.status,
        flags=(*result.flags, "the reaction jumps over the load") if diverged else result.flags,
    )


class _Evaluations:
    def __init__(self, model: "ContactModel", state: Any, pose: Array, guess: Guess | None) -> None:
        self._model, self._state, self._pose, self._guess = model, state, pose, guess
        self._approach = math.nan
        self._last: ContactResult | None = None

    def at(self, approach: float) -> ContactResult:
        if self._last is None or approach != self._approach:
            pose = self._state.pair.pose_at_approach(self._pose, approach)
            self._last = self._model.evaluate(self._state, pose, self._guess)
            self._approach = approach
        return self._last

    def reaction(self, approach: float) -> float:
        result = self.at(approach)
        force = -float(result.wrench_on_insert[1])
        in_range = result.status is ContactStatus.OK and math.isfinite(force)
        return force if in_range else math.inf


def search_load(reaction: Reaction, load: float, start: float, unloaded: float = 0.0) -> LoadSearch:
    """Find the approach at which a rising reaction equals the load.

    The trial approach grows from `start` (m) until the load (N, positive) is bracketed. False
    position (Illinois) then narrows the bracket.

    Args:
        reaction: the reaction (N) at an approach (m): 0 at `unloaded`, inf if out of range.
        unloaded: m, an approach without reaction. It is negative for a model of smooth surfaces,
            which may overlap where the triangles first touch.
    """
    # The square root of the reaction is nearly linear in the approach (F ~ d^2 for a sphere on a
    # layer, d^1.5 on a half-space), so that false position converges fast.
    target = math.sqrt(load)
    trial = start if 0 < start < PRESS.max_approach else PRESS.first_approach
    low, low_value, high, high_value = unloaded, -target, math.nan, math.nan
    best, deepest, last_side, count = (math.inf, math.nan), 0.0, 0, 0
    while count < PRESS.max_evaluations:
        force, deepest, count = reaction(trial), max(deepest, trial), count + 1
        residual = abs(force - load) / load if math.isfinite(force) else math.inf
        best = min(best, (residual, trial))
        if residual <= PRESS.load_tolerance:
            break
        side = -1 if force < load else 1
        if side < 0:
            # Illinois rule: if one end of the bracket stays twice, the value there is halved, so
            # that this end moves, too.
            high_value *= 0.5 if last_side < 0 else 1.0
            low, low_value = trial, math.sqrt(max(force, 0.0)) - target
        else:
            low_value *= 0.5 if last_side > 0 else 1.0
            high, high_value = trial, math.sqrt(max(force, 0.0)) - target
        last_side = side
        if trial >= PRESS.max_approach or high - low <= PRESS.least_bracket:
            break
        trial = (
            _ahead(trial, force, load)
            if math.isnan(high)
            else _between(low, low_value, high, high_value)
        )
    # If the reaction at the bracket's upper end is not finite, the model goes out of range before
    # the load is reached.
    reached = best[0] <= PRESS.load_tolerance or math.isfinite(high_value)
    return LoadSearch(best[1] if reached else math.nan, count, best[0], deepest)


def _ahead(trial: float, force: float, load: float) -> float:
    # Extrapolation with F ~ d^2, 5 % farther, so that the next trial brackets the load.
    factor = 2.0 if force <= 0 else min(1.05 * math.sqrt(load / force), 4.0)
    return min(trial * factor + 1e-9, PRESS.max_approach)


def _between(low: float, low_value: float, high: float, high_value: float) -> float:
    """Return the next trial (m): false position, or the middle if `high` is out of range."""
    middle = 0.5 * (low + high)
    # A secant needs a finite value at the upper end; otherwise bisect.
    if not math.isfinite(high_value):
        return middle
    trial = (low * high_value - high * low_value) / (high_value - low_value)
    # Rounding may place the root of the secant outside the bracket.
    return trial if low < trial < high else middle


def unloaded_result(model: "ContactModel", state: Any, pose: Array) -> ContactResult:
    """Return the contact at first touch, without pressure and force."""
    touching = state.pair.pose_at_approach(pose, 0.0)
    gap = model.evaluate(state, touching).gap
    return ContactResult.of(state, touching, np.zeros(len(gap)), gap)


def within_insert(state: Any, result: ContactResult, *more: str) -> ContactResult:
    """Return the result, after a check that the bodies are not pressed through each other.

    It is OUT_OF_RANGE if the approach is at least the insert's thickness (`compression`), and
    flagged from `PRESS.flagged_thickness_share` of it. `more` are other flags.
    """
    touch = state.pair.touch_at(result.pose)
    if touch is not None and result.approach > 0:
        ratio, words = compression(state.pair, touch, result)
        if ratio >= 1.0:
            return ContactResult.out_of_range(
                state, result.pose, f"{words}: {THROUGH}", *result.flags
            )
        if ratio >= PRESS.flagged_thickness_share:
            more = (*more, f"{words}: {THROUGH}")
    return replace(result, flags=(*result.flags, *more)) if more else result


def compression(pair: ContactPair, touch: Touch, result: ContactResult) -> tuple[float, str]:
    """Return the largest ratio of approach to insert thickness, and a description of its place.

    At first touch, where the undeformed bodies overlap by the whole approach, it detects a spike of
    the femoral component. Under each condyle's centre of pressure it detects a spike of the insert.
    """
    condyles = {"medial": result.medial, "lateral": result.lateral}
    positions = {"where the meshes first touch": touch.point} | {
        f"under the {side} condyle": condyle.centre_of_pressure
        for side, condyle in condyles.items()
        if condyle is not None
    }
    thickness = thickness_near(pair, np.array(list(positions.values())))
    worst = int(thickness.argmin())
    where, (x, _, z) = list(positions.items())[worst]
    return result.approach / float(thickness[worst]), (
        f"an approach of {result.approach / MILLIMETRE:.3g} mm {where} (x = {x / MILLIMETRE:.1f}, "
        f"z = {z / MILLIMETRE:.1f} mm), where the insert is {thickness[worst] / MILLIMETRE:.3g} mm "
        "thick"
    )


def thickness_near(pair: ContactPair, positions: Array) -> Array:
    """Return the insert's thickness (n,), m, along y at positions (n, 3).

    A ray from the top measures it to the point where it first leaves the insert. Near a rim it is
    the largest within `PRESS.rim_distance`; without a ray that meets the insert, the height above
    the bottom.
    """
    low, high = pair.insert.bounds[:, 1]
    columns = (positions[:, None] + COLUMNS).reshape(-1, 3)
    columns[:, 1] = high + PRESS.rim_distance
    enter, _ = pair.insert.rays.first(columns, DOWN)
    hits = np.isfinite(enter)
    columns[hits, 1] -= enter[hits] + PRESS.ray_start_depth
    leave, _ = pair.insert.rays.first(columns, DOWN)
    hits &= np.isfinite(leave)
    thick = np.where(hits, leave + PRESS.ray_start_depth, 0.0).reshape(len(positions), -1)
    # Away from the rim all rays meet the insert, and the middle ray gives the thickness.
    interior = hits.reshape(thick.shape).all(axis=1)
    thickness = np.where(interior, thick[:, 0], thick.max(axis=1))
    return np.maximum(
        np.where(thickness > 0, thickness, positions[:, 1] - low), PRESS.ray_start_depth
    )
