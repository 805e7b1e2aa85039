"""The generic way to press: find the approach along -y that carries a load."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from tkamb.contact.model import ContactModel, ContactPair, ContactResult, ContactStatus
from tkamb.errors import InputError
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import Array

LOAD_TOLERANCE = 1e-6
"""Largest relative difference between reaction and load that counts as reached."""
COARSE_TOLERANCE = 1e-3
"""The same for a model whose reaction jumps: beyond it the press has not converged."""
FIRST_APPROACH = 5e-5
"""m; where the search begins without a guess."""
DEEPEST = 0.02
"""m; no insert carries a load at a greater approach."""
FINEST_TRAVEL = 1e-13
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
    """

    approach: float
    evaluations: int
    residual: float


def first_touch_height(pair: ContactPair, pose: Array) -> float:
    """Return the y (m) of the femoral origin at which the bodies first touch.

    It depends on the rotation, x and z of pose_femoral_in_insert, not on its y; NaN if the
    femoral component does not lie over the insert. The last few answers are kept.
    """
    level = np.array(pose, float)
    level[1, 3] = 0.0
    return _touch_height(pair, level.tobytes())


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
    model: ContactModel,
    state: Any,
    load: float,
    pose: Array,
    guess: ContactResult | None = None,
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

    Returns:
        The result at the approach found. OUT_OF_RANGE and NaN when the load cannot be
        reached or the femoral component does not lie over the insert; NOT_CONVERGED when
        the reaction jumps over the load. Zero load: first touch, no pressure.

    Raises:
        InputError: the load is negative or not finite.
    """
    check_load(load)
    pair: ContactPair = state.pair
    pose = np.array(pose, float)
    if not math.isfinite(first_touch_height(pair, pose)):
        return failed_result(state, pose, "the femoral component does not lie over the insert")
    if load == 0:
        return unloaded_result(model, state, pose)
    last: dict[float, ContactResult] = {}

    def reaction(approach: float) -> float:
        result = model.evaluate(state, pose_at_approach(pair, pose, approach), guess)
        last.clear()
        last[approach] = result
        force = -float(result.wrench_on_insert[1])
        return force if result.status is ContactStatus.OK else math.inf

    start = guess.approach if guess is not None else FIRST_APPROACH
    found = search_load(reaction, load, start)
    if not math.isfinite(found.approach):
        reasons = next(iter(last.values())).flags if last else ()
        return failed_result(
            state, pose, f"a load of {load:g} N cannot be reached", *reasons, found=found
        )
    result = last.get(found.approach)
    if result is None:
        result = model.evaluate(state, pose_at_approach(pair, pose, found.approach), guess)
    missed = found.residual > COARSE_TOLERANCE
    return replace(
        result,
        approach=found.approach,
        iterations=found.evaluations,
        residual=found.residual,
        status=ContactStatus.NOT_CONVERGED if missed else result.status,
        flags=(*result.flags, "the reaction jumps over the load") if missed else result.flags,
    )


def search_load(reaction: Reaction, load: float, start: float) -> LoadSearch:
    """Find the approach at which a rising reaction equals the load.

    A bracket is grown from `start` by doubling, then narrowed by false position (Illinois)
    on the square root of the reaction, which is nearly straight in the approach: reactions
    grow with its power 1.5 to 2.

    Args:
        reaction: N at an approach in m; 0 at 0; inf where it is out of range.
        load: N, positive.
        start: m, where the search begins.
    """
    target = math.sqrt(load)
    trial = start if 0 < start < DEEPEST else FIRST_APPROACH
    low, low_value, high, high_value = 0.0, -target, math.nan, math.nan
    best, kept_side = LoadSearch(math.nan, 0, math.inf), 0
    for count in range(1, MOST_EVALUATIONS + 1):
        force = reaction(trial)
        residual = abs(force - load) / load
        if residual < best.residual:
            best = LoadSearch(trial, count, residual)
        if residual <= LOAD_TOLERANCE:
            return LoadSearch(trial, count, residual)
        value = math.sqrt(max(force, 0.0)) - target
        if value < 0:
            high_value *= 0.5 if kept_side == -1 else 1.0
            low, low_value, kept_side = trial, value, -1
        else:
            low_value *= 0.5 if kept_side == 1 else 1.0
            high, high_value, kept_side = trial, value, 1
        if math.isnan(high):
            if trial >= DEEPEST:
                return LoadSearch(math.nan, count, best.residual)
            trial = min(2 * trial, DEEPEST) if force == 0 else _ahead(trial, force, load)
            continue
        if high - low <= FINEST_TRAVEL:
            break
        trial = _between(low, low_value, high, high_value)
    if math.isinf(high_value) or not math.isfinite(best.approach):
        return LoadSearch(math.nan, count, best.residual)
    return replace(best, evaluations=count)


def _ahead(trial: float, force: float, load: float) -> float:
    """Return a deeper trial: the reaction taken as quadratic, a little beyond, at most x4."""
    return min(trial * min(1.05 * math.sqrt(load / force), 4.0) + 1e-9, DEEPEST)


def _between(low: float, low_value: float, high: float, high_value: float) -> float:
    """Return false position in the bracket, its middle where an end is out of range."""
    middle = 0.5 * (low + high)
    if not math.isfinite(high_value):
        return middle
    trial = (low * high_value - high * low_value) / (high_value - low_value)
    return trial if low < trial < high else middle


def unloaded_result(model: ContactModel, state: Any, pose: Array) -> ContactResult:
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


@lru_cache(maxsize=4)
def _touch_of(pair: ContactPair) -> FirstTouch:
    return FirstTouch(pair.femoral, pair.insert)


@lru_cache(maxsize=64)
def _touch_height(pair: ContactPair, level: bytes) -> float:
    return -_touch_of(pair).travel(np.frombuffer(level).reshape(4, 4))
