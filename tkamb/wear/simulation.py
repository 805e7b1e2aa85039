"""Many cycles in blocks: contact, wear and creep on the insert as the block before has left it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.units import MEGAPASCAL, MILLIMETRE
from tkamb.wear.creep import LogarithmicCreep
from tkamb.wear.engine import CycleMaps
from tkamb.wear.laws import WearLaw
from tkamb.wear.motion import CycleMotion
from tkamb.wear.sliding import SlidingHistory
from tkamb.wear.transfer import carried, interpolation
from tkamb.wear.worn_surface import ArticularSurface, volume

MOST_CYCLES = 10**9
MOST_UPDATES = 10_000
THINNEST = 1e-4
"""m; where less of the insert is left it counts as worn through."""
WORN = 1e-9
"""m; less depth than this is no wear."""
MILLIGRAM = 1e-6


class Maps(Protocol):
    """What gives the pressure maps of a cycle: `tkamb.wear.engine.ContactEngine`."""

    def maps(self, insert: Surface, motion: CycleMotion) -> CycleMaps:
        """Return the maps of a motion's frames on an insert."""


@dataclass(frozen=True, eq=False)
class WearCase:
    """What is worn, by what.

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


@dataclass(eq=False)
class WearState:
    """The insert after some cycles. Arrays are per articular vertex.

    Args:
        blocks: how many blocks are done.
        cycles: how many cycles are done.
        wear: (n,) m, worn off along the normal.
        creep: (n,) m, crept along y.
        fall: (n,) m, by which the vertices have moved down, wear and creep together.
        volume: m³, worn off.
        creep_volume: m³, displaced by creep.
        sliding: (n,) m a cycle, in the last block.
        cross_shear: (n,) in the last block.
        pressure: (n,) Pa, the largest of the cycle in the last block.
        map_error: largest relative correction of a map's force.
        rows: the table so far.
        end: why it ended before the last cycle; empty: it did not.
    """

    blocks: int
    cycles: float
    wear: Array
    creep: Array
    fall: Array
    volume: float
    creep_volume: float
    sliding: Array
    cross_shear: Array
    pressure: Array
    map_error: float = 0.0
    rows: list[dict[str, float]] = field(default_factory=list)
    end: str = ""

    @classmethod
    def unworn(cls, count: int) -> "WearState":
        """Return the state before the first cycle."""
        zeros = [np.zeros(count) for _ in range(6)]
        return cls(0, 0.0, *zeros[:3], 0.0, 0.0, *zeros[3:])


def check_blocks(cycles: int, updates: int) -> None:
    """Raise an InputError for numbers of cycles or updates that make no simulation."""
    if not 1 <= cycles <= MOST_CYCLES:
        raise InputError(f"{cycles} cycles", "--cycles", f"give 1 to {MOST_CYCLES:.0e}")
    if not 1 <= updates <= min(MOST_UPDATES, cycles):
        most = min(MOST_UPDATES, cycles)
        raise InputError(f"{updates} updates", "--updates", f"give 1 to {most}")


def simulate_wear(
    case: WearCase,
    cycles: int,
    updates: int,
    *,
    state: WearState | None = None,
    keep: Callable[[WearState], None] = lambda state: None,
    progress: Callable[[range], Iterable[int]] = lambda blocks: blocks,
) -> WearState:
    """Return the insert after `cycles`, its geometry updated `updates` times.

    Each block of cycles / updates takes the maps of the insert as it is at the block's begin and
    adds their depth per cycle times the block's cycles (explicit Euler, first order in the
    block). The simulation ends early, with the reason in `end`, where the insert is worn through
    or its contact is lost.

    Args:
        case: what is worn.
        cycles: at least 1.
        updates: number of blocks.
        state: where an earlier simulation of the same case stopped.
        keep: is given the state after each block.
        progress: wraps the blocks, a progress bar for example.

    Raises:
        InputError: impossible numbers, or no contact in the first block.
    """
    check_blocks(cycles, updates)
    state = state or WearState.unworn(len(case.articular.vertices))
    for block in progress(range(state.blocks, updates)):
        if state.end:
            break
        until = cycles * (block + 1) / updates
        _advance(case, state, until)
        state.blocks = block + 1
        keep(state)
    return state


def _advance(case: WearCase, state: WearState, until: float) -> None:
    """Wear and creep from the state's cycles to `until`."""
    insert = case.articular.lowered(state.fall)
    maps = case.engine.maps(insert, case.motion)
    if maps.failed:
        frame, why = next(iter(maps.failed.items()))
        what = (
            f"no contact in {len(maps.failed)} of {len(case.motion)} frames, first {frame}: {why}"
        )
        if not state.blocks:
            raise InputError(what, "wear", "check load and poses, or another contact model")
        state.end = f"after {state.cycles:.6g} cycles: {what}"
        return
    history, normals, area = _history(case, state, insert, maps)
    wear = case.law.depth(history) * (until - state.cycles)
    creep = np.zeros_like(wear)
    left = case.articular.thickness - state.fall
    if case.creep is not None:
        times = (cycle * case.motion.duration for cycle in (state.cycles, until))
        creep = case.creep.depth(history.mean_pressure, left, *times)
    fall = wear / normals[:, 1] + creep
    share = _until_worn_through(left, fall)
    if share < 1.0:
        until = state.cycles + share * (until - state.cycles)
        state.end = f"worn through after {until:.6g} cycles"
    if not state.rows:
        state.rows.append(_row(case, state, insert))
    state.cycles = until
    state.wear, state.creep = state.wear + share * wear, state.creep + share * creep
    state.fall = state.fall + share * fall
    state.volume += share * float(wear @ area)
    state.creep_volume += share * float(creep @ (area * normals[:, 1]))
    state.sliding, state.cross_shear = history.distance, history.cross_shear
    state.rows.append(_row(case, state, insert))


def _history(
    case: WearCase, state: WearState, insert: Surface, maps: CycleMaps
) -> tuple[SlidingHistory, Array, Array]:
    """Return what the vertices see in a cycle, their normals (n, 3) and areas (n,) m²."""
    points = insert.vertices[case.articular.vertices]
    normals, area = case.articular.normals_and_areas(insert)
    pressure = maps.pressure @ interpolation(maps.points, points).T
    pressure, error = carried(pressure, area * normals[:, 1], case.motion.load)
    state.map_error = max(state.map_error, error)
    state.pressure = pressure.max(axis=0)
    history = SlidingHistory.of_cycle(maps.poses, pressure, points, normals, case.motion.passes)
    return history, normals, area


def _until_worn_through(left: Array, fall: Array) -> float:
    """Return the share of a block after which somewhere only `THINNEST` is left; 1: nowhere."""
    falls = fall > 0
    if not falls.any():
        return 1.0
    share = (left[falls] - THINNEST) / fall[falls]
    return float(np.clip(share.min(), 0.0, 1.0))


def _row(case: WearCase, state: WearState, insert: Surface) -> dict[str, Any]:
    """Return one row of the table: the insert after the state's cycles."""
    area = case.articular.normals_and_areas(insert)[1]
    worn = state.wear > WORN
    worn_area = float(area[worn].sum())
    medial = insert.vertices[case.articular.vertices, 2] < 0
    projected = state.wear * area
    whole = float(projected.sum())
    share = float(projected[medial].sum()) / whole if whole > 0 else float("nan")
    return {
        "cycles": state.cycles,
        "volume_mm3": state.volume / MILLIMETRE**3,
        "mass_mg": case.density * state.volume / MILLIGRAM,
        "max_depth_mm": float(state.wear.max()) / MILLIMETRE,
        "mean_depth_mm": state.volume / worn_area / MILLIMETRE if worn_area else 0.0,
        "worn_area_mm2": worn_area / MILLIMETRE**2,
        "medial_share": share,
        "creep_depth_mm": _creep_depth(case, state),
        "creep_volume_mm3": _creep_volume(case, state),
        "peak_pressure_MPa": float(state.pressure.max()) / MEGAPASCAL,
        "mesh_volume_mm3": _lost_by_mesh(case, state) / MILLIMETRE**3,
    }


def _lost_by_mesh(case: WearCase, state: WearState) -> float:
    """Return the volume (m³) that the mesh has lost, to wear and creep together."""
    articular = case.articular
    return volume(articular.surface) - volume(articular.lowered(state.fall))


def _creep_depth(case: WearCase, state: WearState) -> float:
    return float("nan") if case.creep is None else float(state.creep.max()) / MILLIMETRE


def _creep_volume(case: WearCase, state: WearState) -> float:
    return float("nan") if case.creep is None else state.creep_volume / MILLIMETRE**3
