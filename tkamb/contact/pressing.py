"""The generic way to press: find the approach along -y that carries a load."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.pair import ContactPair
from tkamb.contact.result import ContactResult, ContactStatus
from tkamb.contact.validity import HALF, compression
from tkamb.errors import InputError
from tkamb.geometry.first_touch import Touch
from tkamb.geometry.frames import Array

if TYPE_CHECKING:
    from tkamb.contact.model import ContactModel

LOAD_TOLERANCE = 1e-6
"""Largest relative difference between reaction and load that counts as reached."""
COARSE_TOLERANCE = 1e-3
"""The same for a model whose reaction jumps: beyond it the press has not converged."""
FIRST_APPROACH = 5e-5
"""m; where the search begins without a guess."""
DEEPEST = 0.02
"""m; no insert carries a load at a greater approach."""
FINEST_TRAVEL = 1e-16
"""m; a bracket this narrow cannot be narrowed."""
MOST_EVALUATIONS = 80

Reaction = Callable[[float], float]


@dataclass(frozen=True)
class LoadSearch:
    """What the search for a load found.

    Args:
        approach: m; NaN when the load cannot be reached.
        evaluations: how often the reaction was computed.
        residual: |reaction - load| / load there.
        deepest: m, the greatest approach that was tried.
    """

    approach: float
    evaluations: int
    residual: float
    deepest: float


def first_touch_height(pair: ContactPair, pose: Array) -> float:
    """Return the y (m) of the femoral origin at which the bodies first touch.

    It depends on the rotation, x and z of pose_femoral_in_insert, not on its y; NaN if the
    femoral component does not lie over the insert or the pose is not finite. The last few
    answers are kept.
    """
    touch = _touch_at(pair, pose)
    return math.nan if touch is None else -touch.travel


def approach_at(pair: ContactPair, pose: Array) -> float:
    """Return the travel along -y since first touch (m) at a pose; 0 when apart."""
    depth = first_touch_height(pair, pose) - float(pose[1, 3])
    return depth if depth > 0 else 0.0


def pose_at_approach(pair: ContactPair, pose: Array, approach: float) -> Array:
    """Return the pose moved along y to an approach (m)."""
    moved = np.array(pose, float)
    moved[1, 3] = first_touch_height(pair, pose) - approach
    return moved


def check_load(load: float) -> None:
    """Raise an InputError for a load (N) that no contact can carry."""
    if not (math.isfinite(load) and load >= 0):
        raise InputError(f"impossible load {load} N", mend="give a finite load >= 0")


def press_by_search(
    model: "ContactModel",
    state: Any,
    load: float,
    pose: Array,
    guess: ContactResult | None = None,
    reaction: Reaction | None = None,
) -> ContactResult:
    """Find the approach along -y at which `model` carries `load`.

    Rotation, x and z of `pose` are kept, its y is not used. The reaction is minus the y
    component of the force on the insert.

    Args:
        model: any contact model.
        state: what its `prepare` returned.
        load: N, superior-inferior.
        pose: (4, 4) pose_femoral_in_insert.
        guess: an earlier result; its approach starts the search.
        reaction: a faster way to the reaction (N) at an approach (m) than `evaluate`; inf
            where it is out of range.

    Returns:
        The result at the approach found. OUT_OF_RANGE and NaN when the load cannot be
        reached or the femoral component does not lie over the insert; NOT_CONVERGED when
        the reaction jumps over the load. Zero load: first touch, no pressure.

    Raises:
        InputError: the load is negative or not finite.
    """
    check_load(load)
    pose = np.array(pose, float)
    if not math.isfinite(first_touch_height(state.pair, pose)):
        return failed_result(state, pose, "the femoral component does not lie over the insert")
    if load == 0:
        return unloaded_result(model, state, pose)
    seen = _Evaluations(model, state, pose, guess)
    start = guess.approach if guess is not None else FIRST_APPROACH
    found = search_load(reaction or seen.reaction, load, start)
    if not math.isfinite(found.approach):
        why = seen.at(found.deepest).flags
        lost = f"a load of {load:g} N cannot be reached"
        return failed_result(state, pose, lost, *why, found=found)
    return within_insert(state, _carried(seen.at(found.approach), found, load))


def _carried(result: ContactResult, found: LoadSearch, load: float) -> ContactResult:
    """Return the result with what the search says about it."""
    residual = abs(-float(result.wrench_on_insert[1]) - load) / load
    missed = not residual <= COARSE_TOLERANCE
    return replace(
        result,
        approach=found.approach,
        iterations=found.evaluations,
        residual=residual,
        status=ContactStatus.NOT_CONVERGED if missed else result.status,
        flags=(*result.flags, "the reaction jumps over the load") if missed else result.flags,
    )


class _Evaluations:
    """Evaluates a model at approaches and keeps the last result."""

    def __init__(
        self, model: "ContactModel", state: Any, pose: Array, guess: ContactResult | None
    ) -> None:
        self._model, self._state, self._pose, self._guess = model, state, pose, guess
        self._approach = math.nan
        self._last: ContactResult | None = None

    def at(self, approach: float) -> ContactResult:
        """Return the result at an approach (m)."""
        if self._last is None or approach != self._approach:
            placed = pose_at_approach(self._state.pair, self._pose, approach)
            self._last = self._model.evaluate(self._state, placed, self._guess)
            self._approach = approach
        return self._last

    def reaction(self, approach: float) -> float:
        """Return the reaction (N); inf where the model is out of range."""
        result = self.at(approach)
        force = -float(result.wrench_on_insert[1])
        known = result.status is ContactStatus.OK and math.isfinite(force)
        return force if known else math.inf


def search_load(reaction: Reaction, load: float, start: float) -> LoadSearch:
    """Find the approach at which a rising reaction equals the load.

    A bracket is grown from `start`, then narrowed by false position (Illinois) on the
    square root of the reaction, which is nearly straight in the approach: reactions grow
    with its power 1.5 to 2.

    Args:
        reaction: N at an approach in m; 0 at 0; inf where it is out of range.
        load: N, positive.
        start: m, where the search begins.
    """
    target = math.sqrt(load)
    trial = start if 0 < start < DEEPEST else FIRST_APPROACH
    low, low_value, high, high_value = 0.0, -target, math.nan, math.nan
    best, deepest, last_side, count = (math.inf, math.nan), 0.0, 0, 0
    while count < MOST_EVALUATIONS:
        force, deepest, count = reaction(trial), max(deepest, trial), count + 1
        residual = abs(force - load) / load if math.isfinite(force) else math.inf
        best = min(best, (residual, trial))
        if residual <= LOAD_TOLERANCE:
            break
        side = -1 if force < load else 1
        if side < 0:
            high_value *= 0.5 if last_side < 0 else 1.0
            low, low_value = trial, math.sqrt(max(force, 0.0)) - target
        else:
            low_value *= 0.5 if last_side > 0 else 1.0
            high, high_value = trial, math.sqrt(max(force, 0.0)) - target
        last_side = side
        if trial >= DEEPEST or high - low <= FINEST_TRAVEL:
            break
        trial = (
            _ahead(trial, force, load)
            if math.isnan(high)
            else _between(low, low_value, high, high_value)
        )
    reached = best[0] <= LOAD_TOLERANCE or math.isfinite(high_value)
    return LoadSearch(best[1] if reached else math.nan, count, best[0], deepest)


def _ahead(trial: float, force: float, load: float) -> float:
    """Return a deeper trial: the reaction taken as quadratic, a little beyond, at most x4."""
    factor = 2.0 if force <= 0 else min(1.05 * math.sqrt(load / force), 4.0)
    return min(trial * factor + 1e-9, DEEPEST)


def _between(low: float, low_value: float, high: float, high_value: float) -> float:
    """Return false position in the bracket, its middle where an end is out of range."""
    middle = 0.5 * (low + high)
    if not math.isfinite(high_value):
        return middle
    trial = (low * high_value - high * low_value) / (high_value - low_value)
    return trial if low < trial < high else middle


def unloaded_result(model: "ContactModel", state: Any, pose: Array) -> ContactResult:
    """Return first touch: no pressure, no force."""
    touching = pose_at_approach(state.pair, pose, 0.0)
    result = model.evaluate(state, touching)
    nothing = np.zeros(len(result.points))
    return replace(
        result,
        pressure=nothing,
        nodal_force=np.zeros((len(nothing), 3)),
        wrench_on_insert=np.zeros(6),
        medial=None,
        lateral=None,
        approach=0.0,
        status=ContactStatus.OK,
        iterations=0,
        residual=0.0,
        flags=(),
    )


def failed_result(
    state: Any, pose: Array, *reasons: str, found: LoadSearch | None = None
) -> ContactResult:
    """Return a result that holds nothing but the reason: OUT_OF_RANGE and NaN.

    Args:
        state: has the map's points.
        pose: (4, 4) at which it failed.
        reasons: plain words, become the flags.
        found: the search that failed, if there was one.
    """
    points = np.asarray(state.points)
    unknown = np.full(len(points), np.nan)
    return ContactResult(
        pose=np.array(pose, float),
        points=points,
        normals=np.full_like(points, np.nan),
        pressure=unknown,
        area=unknown,
        gap=unknown,
        nodal_force=np.full_like(points, np.nan),
        wrench_on_insert=np.full(6, np.nan),
        medial=None,
        lateral=None,
        approach=math.nan,
        status=ContactStatus.OUT_OF_RANGE,
        iterations=0 if found is None else found.evaluations,
        residual=math.nan if found is None else found.residual,
        flags=tuple(dict.fromkeys(reasons)),
    )


def within_insert(state: Any, result: ContactResult, *more: str) -> ContactResult:
    """Return the result if the bodies are not pressed through each other.

    OUT_OF_RANGE where the approach is as large as the insert is thick; a flag from half of
    that on. See `tkamb.contact.validity.compression`.

    Args:
        state: prepared contact.
        result: a contact.
        more: flags to add.
    """
    touch = _touch_at(state.pair, result.pose)
    if touch is not None and result.approach > 0:
        ratio, words = compression(state.pair, touch, result)
        if ratio >= 1.0:
            return failed_result(state, result.pose, f"{words}: {_THROUGH}", *result.flags)
        if ratio >= HALF:
            more = (*more, f"{words}: {_THROUGH}")
    return replace(result, flags=(*result.flags, *more)) if more else result


_THROUGH = "is there a spike or a thin place in a mesh?"


def _touch_at(pair: ContactPair, pose: Array) -> Touch | None:
    """Return the first touch of either condyle, whatever the pose's y; travel from y = 0."""
    level = np.array(pose, float)
    if not np.isfinite(level).all():
        return None
    level[1, 3] = 0.0
    return _first_touch(pair, level.tobytes())


@lru_cache(maxsize=8)
def _first_touch(pair: ContactPair, level: bytes) -> Touch | None:
    return pair.first_touch.either(np.frombuffer(level).reshape(4, 4))
