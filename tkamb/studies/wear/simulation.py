"""Many cycles in blocks: contact, wear and creep on the insert after the last block."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.studies.wear.engine import CycleMaps, carried, interpolation
from tkamb.studies.wear.laws import WearLaw
from tkamb.studies.wear.materials import LogarithmicCreep
from tkamb.studies.wear.motion import CycleMotion
from tkamb.studies.wear.sliding import SlidingHistory
from tkamb.studies.wear.worn_surface import ArticularSurface, volume
from tkamb.units import MEGAPASCAL, MILLIMETRE


@dataclass(frozen=True)
class WearSimulationSettings:
    """The simulation of wear over many cycles."""

    max_cycles: float = 10**9
    """Largest number of cycles that is accepted. Chosen: a thousand years of walking."""
    max_updates: int = 10_000
    """Largest number of updates of the surface that is accepted. Chosen: files of results stay
    readable."""
    min_thickness: float = 1e-4
    """m; an insert that is thinner counts as worn through. Chosen: no contact model holds for a
    thinner layer."""
    min_depth: float = 1e-9
    """m: a smaller depth counts as no wear. Chosen: above the rounding of a mesh."""
    max_pattern_change: float = 0.2
    """1: share of the worn volume that may lie elsewhere after a block of cycles; a block with more
    is halved. Chosen: smaller than the error of a wear law."""
    max_block_division: int = 256
    """Ratio of the longest block to the shortest one that is tried. Chosen: eight halvings."""
    min_row_share: float = 0.5
    """Share of the rows of a force-controlled profile that must be computed for a cycle to count.
    Chosen: with less, the cycle is not known."""
    min_improvement: float = 1.1
    """Factor by which halving a block has to lessen the change for another halving. Chosen: with
    less, more halvings do not help."""


WEAR_SIMULATION = WearSimulationSettings()

MILLIGRAM = 1e-6
"""kg."""
MEND = "check load and poses, or another contact model"


class Maps(Protocol):
    """Source of the pressure maps of a cycle: `tkamb.studies.wear.engine.ContactEngine`."""

    def maps(self, insert: Surface, motion: CycleMotion) -> CycleMaps:
        """Return the maps of a motion's frames on an insert."""


@dataclass(frozen=True, eq=False)
class WearCase:
    """Bodies, motion and laws of a wear simulation.

    Args:
        engine: gives pressure maps.
        articular: the insert's surface, unworn.
        motion: one cycle.
        law: of wear.
        density: kg/m³.
        creep: law of creep; None: not modelled.
    """

    engine: Maps
    articular: ArticularSurface
    motion: CycleMotion
    law: WearLaw
    density: float
    creep: LogarithmicCreep | None = None


@dataclass(frozen=True, eq=False)
class WearState:
    """The insert after some cycles. Arrays are per articular vertex.

    Args:
        wear: (n,) m, worn off along the normal.
        creep: (n,) m, crept along y.
        fall: (n,) m, by which the vertices have moved down, wear and creep together.
        cycles: how many cycles are done.
        step: cycles that the next block tries.
        volume: m³, worn off.
        creep_volume: m³, displaced by creep.
        map_error: largest relative correction of a map's force.
        unsettled: blocks whose pressures changed too much even at the shortest length.
        rows: the table so far, one row per block.
        end: why it ended before the last cycle; empty: it did not.
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
    """Wear of one cycle on the present insert. Arrays are per articular vertex.

    Args:
        rate: (n,) m a cycle, along the normal.
        history: pressures and sliding.
        normals: (n, 3) unit normals.
        area: (n,) m².
        map_error: largest relative correction of a map's force.
        poses: (f, 4, 4) of the motion's frames.
        failed: frame -> why it is left out of the cycle.
    """

    rate: Array
    history: SlidingHistory
    normals: Array
    area: Array
    map_error: float
    poses: Array
    failed: Mapping[int, str]

    @property
    def peak_pressure(self) -> Array:
        """Largest pressure of a step, (n,) Pa."""
        return np.asarray(self.history.pressure.max(axis=0))

    def change_to(self, other: "CycleWear") -> float:
        """Return how much of the volume that a cycle wears off lies elsewhere in another cycle."""
        mine, theirs = self.rate * self.area, other.rate * other.area
        total = float(mine.sum())
        return 0.5 * float(np.abs(theirs - mine).sum()) / total if total > 0 else 0.0


def check_blocks(cycles: int, updates: int) -> None:
    """Raise an InputError for numbers of cycles or updates that make no simulation."""
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
    """Return the insert after `cycles`, and what the next cycle would do to it.

    A block takes the maps of the insert as it is at the block's begin and adds their depth per
    cycle times the block's cycles (explicit Euler, first order in the block). No block is longer
    than cycles / updates. A block is rejected and repeated at half its length if there is no
    contact after it, or if more than `most_change` of the worn volume lies elsewhere. (If a block
    removes more than the compression of the contact, the pressure leaves the worn place and returns
    to it in the next block.) The simulation ends early, with the reason in `end`, if the insert is
    worn through or its contact is lost.

    Args:
        case: what is worn.
        cycles: at least 1.
        updates: smallest number of blocks.
        state: where an earlier simulation of the same case stopped.
        keep: called with the state after each block.
        most_change: half the sum of absolute changes over the sum; 1: never reject a block.

    Raises:
        InputError: impossible numbers, or no contact before or after the shortest first block.
    """
    check_blocks(cycles, updates)
    state = state or WearState.unworn(len(case.articular.vertices), cycles / updates)
    now = _cycle(case, state)
    if isinstance(now, str):
        raise InputError(now, "wear", MEND)
    if not state.rows:
        state = replace(state, rows=(_row(case, state, now),))
    before = math.inf
    while state.cycles < cycles and not state.end:
        step = min(state.step, cycles - state.cycles)
        tried = _worn(case, state, now, step)
        after = _cycle(case, tried)
        failed = isinstance(after, str)
        change = math.inf if isinstance(after, str) else now.change_to(after)
        shorter = step / 2 >= cycles / updates / WEAR_SIMULATION.max_block_division
        if shorter and (
            failed
            or (change > most_change and not before <= change * WEAR_SIMULATION.min_improvement)
        ):
            state, before = replace(state, step=step / 2), change
            continue
        if isinstance(after, str):
            if not state.cycles:
                raise InputError(f"after {step:.3g} cycles: {after}", "wear", MEND)
            return replace(state, end=f"after {state.cycles:.6g} cycles: {after}"), now
        # the next block may be longer again where this one changed little
        longer = step * min(2.0, 0.8 * most_change / max(change, 1e-9))
        settled = change <= most_change
        tried = replace(
            tried,
            step=min(cycles / updates, max(longer, step / 2) if settled else step),
            unsettled=tried.unsettled + (not settled),
            map_error=max(tried.map_error, now.map_error),
            rows=(*tried.rows, _row(case, tried, after)),
        )
        state, now, before = tried, after, math.inf
        keep(state)
    return state, now


def _cycle(case: WearCase, state: WearState) -> CycleWear | str:
    """Return the wear of a cycle on the present insert; a text: why it has no contact."""
    insert = case.articular.lowered(state.fall)
    maps = case.engine.maps(insert, case.motion)
    rows = _rows(maps, case.motion)
    return rows if isinstance(rows, str) else _worn_by(case, insert, maps, rows)


def _worn_by(case: WearCase, insert: Surface, maps: CycleMaps, rows: list[int]) -> CycleWear:
    """Return the wear of a cycle through some rows of the maps on an insert."""
    points = insert.vertices[case.articular.vertices]
    normals, area = case.articular.normals_and_areas(insert)
    pressure = maps.pressure[rows] @ interpolation(maps.points, points).T
    pressure, error = carried(pressure, area * normals[:, 1], case.motion.load[rows])
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
    return CycleWear(rate, history, normals, area, error, maps.poses, maps.failed)


@dataclass(frozen=True, eq=False)
class FirstCycle:
    """Checks of the first cycle, on the unworn insert.

    Args:
        frames_change: by how much half as many steps change the cycle's volume, relative to it.
            Of a simulator's profile: the steps of the simulation against steps half as long. NaN:
            a frame of it failed, or nothing wears.
        volumes: law -> m³ a cycle, of the laws that were asked for.
    """

    frames_change: float
    volumes: Mapping[str, float]


def first_cycle(case: WearCase, laws: Mapping[str, WearLaw]) -> FirstCycle:
    """Return how much the number of frames matters, and what other laws say of the first cycle.

    Args:
        case: what is worn.
        laws: name -> law.
    """
    recorded = bool(case.motion.closing)
    fine = case if recorded else replace(case, motion=case.motion.refined())
    insert = case.articular.lowered(np.zeros(len(case.articular.vertices)))
    maps = case.engine.maps(insert, fine.motion)
    every = _rows(maps, fine.motion)
    if isinstance(every, str):
        return FirstCycle(math.nan, {})
    whole = _worn_by(fine, insert, maps, every)
    volumes = {name: float(law.depth(whole.history) @ whole.area) for name, law in laws.items()}
    if maps.failed:
        return FirstCycle(math.nan, volumes)
    half = _worn_by(fine, insert, maps, fine.motion.every_second)
    total, coarse = (float(one.rate @ one.area) for one in (whole, half))
    return FirstCycle(abs(coarse / total - 1.0) if total > 0 else math.nan, volumes)


def _rows(maps: CycleMaps, motion: CycleMotion) -> list[int] | str:
    """Return the frames that the cycle goes through; a text: why there is none.

    Failed rows of a force-controlled profile are left out, and the first remaining row closes the
    cycle. Of a prescribed motion every frame is needed.
    """
    every = range(len(motion))
    good = [k for k in every if k not in maps.failed]
    if not maps.failed:
        return good
    if motion.drive is None or len(good) < WEAR_SIMULATION.min_row_share * len(motion):
        frame, why = next(iter(maps.failed.items()))
        words = f"no contact in {len(maps.failed)} of {len(motion)} frames"
        return f"{words}, the first of them {frame}: {why}"
    ends = good[0] == every[0] and good[-1] == every[-1]
    return good if ends else [*good, good[0]]


def _worn(case: WearCase, state: WearState, now: CycleWear, step: float) -> WearState:
    """Return the state after `step` more cycles, or fewer if the insert is worn through."""
    wear, creep = now.rate * step, np.zeros_like(now.rate)
    thickness = case.articular.thickness - state.fall
    if case.creep is not None:
        begin = state.cycles * case.motion.duration
        end = begin + step * case.motion.duration
        creep = case.creep.depth(now.history.mean_pressure, thickness, begin, end)
    fall = wear / now.normals[:, 1] + creep
    share = _until_worn_through(thickness, fall)
    cycles = state.cycles + share * step
    return replace(
        state,
        cycles=cycles,
        wear=state.wear + share * wear,
        creep=state.creep + share * creep,
        fall=state.fall + share * fall,
        volume=state.volume + share * float(wear @ now.area),
        creep_volume=state.creep_volume + share * float(creep @ (now.area * now.normals[:, 1])),
        end=f"worn through after {cycles:.6g} cycles" if share < 1.0 else "",
    )


def _until_worn_through(thickness: Array, fall: Array) -> float:
    """Return the share of a block after which somewhere only `WEAR_SIMULATION.min_thickness` is
    left; 1: nowhere."""
    falls = fall > 0
    if not falls.any():
        return 1.0
    share = (thickness[falls] - WEAR_SIMULATION.min_thickness) / fall[falls]
    return float(np.clip(share.min(), 0.0, 1.0))


def _row(case: WearCase, state: WearState, now: CycleWear) -> dict[str, float]:
    """Return one row of the table: the insert after the state's cycles."""
    articular, worn_nodes = case.articular, state.wear > WEAR_SIMULATION.min_depth
    area = float(now.area[worn_nodes].sum())
    medial = articular.surface.vertices[articular.vertices, 2] < 0
    each = state.wear * now.area
    crept, drive = case.creep is not None, case.motion.drive
    volume_lost = volume(articular.surface) - volume(articular.lowered(state.fall))
    return {
        "cycles": state.cycles,
        "volume_mm3": state.volume / MILLIMETRE**3,
        "mass_mg": case.density * state.volume / MILLIGRAM,
        "max_depth_mm": float(state.wear.max()) / MILLIMETRE,
        "mean_depth_mm": float(each.sum()) / area / MILLIMETRE if area else 0.0,
        "worn_area_mm2": area / MILLIMETRE**2,
        "medial_share": float(each[medial].sum() / each.sum()) if area else math.nan,
        "creep_depth_mm": float(state.creep.max()) / MILLIMETRE if crept else math.nan,
        "creep_volume_mm3": state.creep_volume / MILLIMETRE**3 if crept else math.nan,
        "mesh_volume_lost_mm3": volume_lost / MILLIMETRE**3,
        "peak_pressure_MPa": float(now.peak_pressure.max()) / MEGAPASCAL,
        **({} if drive is None else drive.ranges(now.poses, now.failed)),
    }
