"""Wear over many cycles, in blocks that begin with the contact on the worn insert."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.studies.wear.engine import (
    ArticularSurface,
    CycleMaps,
    SlidingHistory,
    interpolation,
    scaled_to_load,
    volume,
)
from tkamb.studies.wear.laws import LogarithmicCreep, WearLaw
from tkamb.studies.wear.motion import CycleMotion
from tkamb.units import MEGAPASCAL, MILLIMETRE


@dataclass(frozen=True)
class WearSimulationSettings:
    """Simulation of wear over many cycles."""

    max_cycles: float = 10**9
    """Largest number of cycles that is accepted. A thousand years of walking."""
    max_updates: int = 10_000
    """Largest number of updates of the geometry that is accepted. Chosen to limit the size of the
    results."""
    min_thickness: float = 1e-4
    """m: thickness at which the insert counts as worn through. No contact model is
    valid for a thinner layer."""
    min_depth: float = 1e-9
    """m: depth below which a point counts as unworn. Above the round-off of a mesh."""
    max_pattern_change: float = 0.2
    """Share of the wear rate that moves to other points, above which a block is halved. Larger:
    fewer blocks, less accurate. Below the error of a wear law."""
    max_block_division: int = 256
    """Largest ratio of the longest block to a halved block. Chosen to allow eight halvings."""
    min_row_share: float = 0.5
    """Share of the rows of a force-controlled profile that must converge. Fewer rows
    do not describe the cycle."""
    min_improvement: float = 1.1
    """Factor by which a halving must reduce the share that moves to other points. Otherwise the
    block is not halved again. Not studied."""


WEAR_SIMULATION = WearSimulationSettings()

MILLIGRAM = 1e-6
"""kg."""
CONTACT_HINT = "check load and poses, or use another contact model"


class Maps(Protocol):
    """Interface of `tkamb.studies.wear.engine.ContactEngine`."""

    def maps(self, insert: Surface, motion: CycleMotion) -> CycleMaps:
        """Return the pressure maps of the frames of a motion on an insert."""


@dataclass(frozen=True, eq=False)
class WearCase:
    """Bodies, motion and laws of a wear simulation.

    Args:
        engine: contact of the femoral component with an insert.
        articular: articular surface of the unworn insert.
        density: density of the insert, kg/m³.
        creep: creep law; None: creep is not modelled.
    """

    engine: Maps
    articular: ArticularSurface
    motion: CycleMotion
    law: WearLaw
    density: float
    creep: LogarithmicCreep | None = None


@dataclass(frozen=True, eq=False)
class WearState:
    """The insert after some cycles. Arrays have one entry per articular vertex.

    Args:
        wear: worn depth along the normal, m, shape (n,).
        creep: creep depth along y, m, shape (n,).
        fall: downward displacement of the vertices by wear and creep, m, shape (n,).
        volume: worn volume, m³.
        creep_volume: volume displaced by creep, m³.
        map_error: largest relative correction of the force of a map.
        unsettled: number of blocks that exceed `max_pattern_change` after all halvings.
        rows: rows of the table, one before the first cycle and one per block.
        end: reason why the simulation ended before the last cycle; "" if it did not.
    """

    wear: Array
    creep: Array
    fall: Array
    cycles: float = 0.0
    step: float = 0.0
    volume: float = 0.0
    creep_volume: float = 0.0
    map_error: float = 0.0
    unsettled: int = 0
    rows: tuple[dict[str, float], ...] = ()
    end: str = ""

    @classmethod
    def unworn(cls, count: int, step: float) -> "WearState":
        """Return the state before the first cycle."""
        return cls(np.zeros(count), np.zeros(count), np.zeros(count), step=step)


@dataclass(frozen=True, eq=False)
class CycleWear:
    """Wear of one cycle on the current insert. Arrays have one entry per articular vertex.

    Args:
        rate: worn depth per cycle along the normal, m, shape (n,).
        normals: unit normals, shape (n, 3).
        area: tributary areas, m², shape (n,).
        map_error: largest relative correction of the force of a map.
        poses: femoral poses of the frames of the motion, shape (f, 4, 4).
        failed: frame -> reason why it failed.
        flagged: frame -> flag of a contact for which no model's error is known.
    """

    rate: Array
    history: SlidingHistory
    normals: Array
    area: Array
    map_error: float
    poses: Array
    failed: Mapping[int, str]
    flagged: Mapping[int, str] = field(default_factory=dict)

    @property
    def peak_pressure(self) -> Array:
        """Largest pressure of a step, Pa, shape (n,)."""
        return np.asarray(self.history.pressure.max(axis=0))

    def change_to(self, other: "CycleWear") -> float:
        """Return the share of the worn volume per cycle that is at other points in `other`."""
        volumes, other_volumes = self.rate * self.area, other.rate * other.area
        total = float(volumes.sum())
        return 0.5 * float(np.abs(other_volumes - volumes).sum()) / total if total > 0 else 0.0


def check_blocks(cycles: int, updates: int) -> None:
    """Raise an InputError if the number of cycles or updates is out of range."""
    if not 1 <= cycles <= WEAR_SIMULATION.max_cycles:
        raise InputError(
            f"{cycles} cycles", "--cycles", f"give 1 to {WEAR_SIMULATION.max_cycles:.0e}"
        )
    if not 1 <= updates <= min(WEAR_SIMULATION.max_updates, cycles):
        most = min(WEAR_SIMULATION.max_updates, cycles)
        raise InputError(f"{updates} updates", "--updates", f"give 1 to {most}")


def simulate_wear(
    case: WearCase,
    cycles: int,
    updates: int,
    *,
    state: WearState | None = None,
    keep: Callable[[WearState], None] = lambda state: None,
    most_change: float = WEAR_SIMULATION.max_pattern_change,
) -> tuple[WearState, CycleWear]:
    """Return the insert after a number of cycles, and the wear of a further cycle.

    A block adds the worn depth per cycle at its beginning times its number of cycles (explicit
    Euler, first order). It has at most cycles / updates cycles. It is repeated with half its length
    if there is no contact after it, or if more than `most_change` of the worn volume per cycle
    moves to other points. (A block that removes more than the compression of the contact moves the
    pressure away from the worn area.) The simulation ends early if the insert is worn through or
    contact is lost. `end` then contains the reason.

    Args:
        cycles: number of cycles, at least 1.
        updates: smallest number of blocks.
        state: state of an earlier simulation of the case, to resume it; None: unworn.
        keep: function that is called with the state after each block.
        most_change: share of the worn volume per cycle, from 0 to 1. 1: never repeat a block.
    """
    check_blocks(cycles, updates)
    state = state or WearState.unworn(len(case.articular.vertices), cycles / updates)
    current = _cycle(case, state)
    if isinstance(current, str):
        raise InputError(current, "wear", CONTACT_HINT)
    if not state.rows:
        state = replace(state, rows=(_row(case, state, current),))
    previous_change = math.inf
    while state.cycles < cycles and not state.end:
        step = min(state.step, cycles - state.cycles)
        trial = _after_block(case, state, current, step)
        following = _cycle(case, trial)
        failed = isinstance(following, str)
        change = math.inf if isinstance(following, str) else current.change_to(following)
        may_halve = step / 2 >= cycles / updates / WEAR_SIMULATION.max_block_division
        stagnates = previous_change <= change * WEAR_SIMULATION.min_improvement
        if may_halve and (failed or (change > most_change and not stagnates)):
            state, previous_change = replace(state, step=step / 2), change
            continue
        if isinstance(following, str):
            if not state.cycles:
                raise InputError(f"after {step:.3g} cycles: {following}", "wear", CONTACT_HINT)
            return replace(state, end=f"after {state.cycles:.6g} cycles: {following}"), current
        # the next block becomes longer if this one changed the pattern little
        longer = step * min(2.0, 0.8 * most_change / max(change, 1e-9))
        accepted = change <= most_change
        trial = replace(
            trial,
            step=min(cycles / updates, max(longer, step / 2) if accepted else step),
            unsettled=trial.unsettled + (not accepted),
            map_error=max(trial.map_error, current.map_error),
            rows=(*trial.rows, _row(case, trial, following)),
        )
        state, current, previous_change = trial, following, math.inf
        keep(state)
    return state, current


def _cycle(case: WearCase, state: WearState) -> CycleWear | str:
    insert = case.articular.lowered(state.fall)
    maps = case.engine.maps(insert, case.motion)
    rows = _rows(maps, case.motion)
    return rows if isinstance(rows, str) else _cycle_wear(case, insert, maps, rows)


def _cycle_wear(case: WearCase, insert: Surface, maps: CycleMaps, rows: list[int]) -> CycleWear:
    points = insert.vertices[case.articular.vertices]
    normals, area = case.articular.normals_and_areas(insert)
    pressure = maps.pressure[rows] @ interpolation(maps.points, points).T
    pressure, error = scaled_to_load(pressure, area * normals[:, 1], case.motion.load[rows])
    poses, path, seconds = maps.poses[rows], case.motion.path, case.motion.seconds_between(rows)
    if path is not None:
        weights = path.weights(rows)
        times = weights @ np.concatenate([[0.0], np.cumsum(seconds)])
        height = weights @ poses[:, 1, 3]
        poses, pressure, seconds = path.poses.copy(), weights @ pressure, np.diff(times)
        poses[:, 1, 3] = height
    passes = case.motion.passes
    history = SlidingHistory.of_cycle(poses, pressure, points, normals, passes, seconds)
    rate = case.law.depth(history)
    return CycleWear(rate, history, normals, area, error, maps.poses, maps.failed, maps.flagged)


@dataclass(frozen=True, eq=False)
class FirstCycle:
    """Checks of the first cycle, on the unworn insert.

    Args:
        frames_change: relative change of the worn volume if a recorded cycle has half as many
            steps, or if a simulator's profile has the steps of the simulation instead of twice as
            many. NaN: a frame failed, or nothing wears.
        volumes: law -> worn volume per cycle, m³.
    """

    frames_change: float
    volumes: Mapping[str, float]


def first_cycle(case: WearCase, laws: Mapping[str, WearLaw]) -> FirstCycle:
    """Return the effect of the number of frames, and the worn volumes of several laws.

    Args:
        laws: name -> wear law.
    """
    recorded = bool(case.motion.closing)
    fine = case if recorded else replace(case, motion=case.motion.refined())
    insert = case.articular.lowered(np.zeros(len(case.articular.vertices)))
    maps = case.engine.maps(insert, fine.motion)
    rows = _rows(maps, fine.motion)
    if isinstance(rows, str):
        return FirstCycle(math.nan, {})
    full = _cycle_wear(fine, insert, maps, rows)
    volumes = {name: float(law.depth(full.history) @ full.area) for name, law in laws.items()}
    if maps.failed:
        return FirstCycle(math.nan, volumes)
    half = _cycle_wear(fine, insert, maps, fine.motion.every_second)
    total, coarse = (float(wear.rate @ wear.area) for wear in (full, half))
    return FirstCycle(abs(coarse / total - 1.0) if total > 0 else math.nan, volumes)


def _rows(maps: CycleMaps, motion: CycleMotion) -> list[int] | str:
    """Return the frames of the cycle, or the reason why there is no cycle.

    Failed rows of a force-controlled profile are omitted. If an end failed, the first remaining row
    closes the cycle. A prescribed motion needs every frame.
    """
    frames = range(len(motion))
    successful = [k for k in frames if k not in maps.failed]
    if not maps.failed:
        return successful
    if motion.drive is None or len(successful) < WEAR_SIMULATION.min_row_share * len(motion):
        frame, reason = next(iter(maps.failed.items()))
        words = f"no contact in {len(maps.failed)} of {len(motion)} frames"
        return f"{words}, the first of them {frame}: {reason}"
    has_ends = successful[0] == frames[0] and successful[-1] == frames[-1]
    return successful if has_ends else [*successful, successful[0]]


def _after_block(case: WearCase, state: WearState, current: CycleWear, step: float) -> WearState:
    """Return the state after `step` more cycles, or fewer if the insert is worn through."""
    wear, creep = current.rate * step, np.zeros_like(current.rate)
    thickness = case.articular.thickness - state.fall
    if case.creep is not None:
        begin = state.cycles * case.motion.duration
        end = begin + step * case.motion.duration
        creep = case.creep.depth(current.history.mean_pressure, thickness, begin, end)
    fall = wear / current.normals[:, 1] + creep
    share = _until_worn_through(thickness, fall)
    cycles = state.cycles + share * step
    return replace(
        state,
        cycles=cycles,
        wear=state.wear + share * wear,
        creep=state.creep + share * creep,
        fall=state.fall + share * fall,
        volume=state.volume + share * float(wear @ current.area),
        creep_volume=state.creep_volume
        + share * float(creep @ (current.area * current.normals[:, 1])),
        end=f"worn through after {cycles:.6g} cycles" if share < 1.0 else "",
    )


def _until_worn_through(thickness: Array, fall: Array) -> float:
    """Return the share of a block after which the insert is worn through, at most 1."""
    falls = fall > 0
    if not falls.any():
        return 1.0
    share = (thickness[falls] - WEAR_SIMULATION.min_thickness) / fall[falls]
    return float(np.clip(share.min(), 0.0, 1.0))


def _row(case: WearCase, state: WearState, current: CycleWear) -> dict[str, float]:
    articular, worn_nodes = case.articular, state.wear > WEAR_SIMULATION.min_depth
    area = float(current.area[worn_nodes].sum())
    medial = articular.surface.vertices[articular.vertices, 2] < 0
    volumes = state.wear * current.area
    has_creep, drive = case.creep is not None, case.motion.drive
    volume_lost = volume(articular.surface) - volume(articular.lowered(state.fall))
    return {
        "cycles": state.cycles,
        "volume_mm3": state.volume / MILLIMETRE**3,
        "mass_mg": case.density * state.volume / MILLIGRAM,
        "max_depth_mm": float(state.wear.max()) / MILLIMETRE,
        "mean_depth_mm": float(volumes.sum()) / area / MILLIMETRE if area else 0.0,
        "worn_area_mm2": area / MILLIMETRE**2,
        "medial_share": float(volumes[medial].sum() / volumes.sum()) if area else math.nan,
        "creep_depth_mm": float(state.creep.max()) / MILLIMETRE if has_creep else math.nan,
        "creep_volume_mm3": state.creep_volume / MILLIMETRE**3 if has_creep else math.nan,
        "mesh_volume_lost_mm3": volume_lost / MILLIMETRE**3,
        "peak_pressure_MPa": float(current.peak_pressure.max()) / MEGAPASCAL,
        **({} if drive is None else drive.ranges(current.poses, current.failed)),
    }
