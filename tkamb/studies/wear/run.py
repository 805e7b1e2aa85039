"""A wear simulation, from the user's options to the written files.

Each finished block of cycles is stored in the folder, so that a kill loses one block.
"""

import hashlib
import json
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from tkamb import code_identity
from tkamb.errors import InputError
from tkamb.files import FILE_LIMITS, read_bytes, replaced_file
from tkamb.io.scene import Scene
from tkamb.io.scene.tables import WearTable
from tkamb.run.guard import interrupt_as_such
from tkamb.run.identity import foreign_code
from tkamb.run.recorder import UNREADABLE, Shards, have, read_arrays
from tkamb.run.results import Results
from tkamb.run.workers import PoolOptions
from tkamb.studies.wear.bands import BANDED, WEAR_BAND, Progress, Sampling, check_samples
from tkamb.studies.wear.laws import WearLaw
from tkamb.studies.wear.materials import DEFAULT_MATERIAL, WearMaterial, wear_material
from tkamb.studies.wear.report import SAMPLES_NAME, STATE_NAME, WearReport
from tkamb.studies.wear.setup import WearSetup, setup_of_results, wear_setup
from tkamb.studies.wear.simulation import (
    CycleWear,
    WearCase,
    WearState,
    check_blocks,
    first_cycle,
    simulate_wear,
)


def wear_identity(setup: WearSetup, case: WearCase, cycles: int, updates: int) -> str:
    """Return the hash that identifies a simulation: bodies, motion, laws, numbers, code."""
    digest = hashlib.sha256()
    bodies = (setup.engine.femoral, case.articular.surface)
    arrays = [array for body in bodies for array in (body.vertices, body.faces)]
    drive = case.motion.drive
    if drive is not None:
        arrays += [drive.coordinates, drive.applied, drive.zero]
    motion = case.motion
    arrays += [one for one in (motion.seconds, *(motion.path or ())) if one is not None]
    for array in (*arrays, case.motion.poses, case.motion.load):
        digest.update(np.ascontiguousarray(array, "<f8").tobytes())
    words = (setup.engine.model, setup.engine.material, setup.engine.bearing, case.law, case.creep)
    numbers = (case.density, case.motion.duration, case.motion.passes, cycles, updates)
    machine = () if drive is None else (drive.free, drive.springs)
    others = (foreign_code(setup.engine.model), foreign_code(case.law))
    digest.update(repr((words, numbers, machine, code_identity(), *others)).encode())
    return digest.hexdigest()


def keep_state(folder: Path, state: WearState, identity: str) -> None:
    """Put the state in the folder, whole or not at all.

    Raises:
        InputError: the folder cannot be written.
    """
    arrays = {f.name: np.asarray(getattr(state, f.name)) for f in fields(state) if f.name != "rows"}
    rows = np.asarray(json.dumps(state.rows))
    with replaced_file(folder / STATE_NAME) as temporary, open(temporary, "wb") as file:
        np.savez(file, allow_pickle=False, identity=np.asarray(identity), rows=rows, **arrays)


def kept_state(folder: Path, identity: str, count: int) -> WearState | None:
    """Return the state that a folder keeps; None where there is none.

    Args:
        folder: folder of the simulation.
        identity: hash of the simulation to go on with, from `wear_identity`.
        count: number of articular vertices.

    Raises:
        InputError: it is of another simulation, or cannot be read.
    """
    path = folder / STATE_NAME
    if not path.is_file():
        return None
    try:
        content = read_arrays(read_bytes(path, FILE_LIMITS.mesh_bytes))
    except UNREADABLE as error:
        raise _damaged(path, str(error) or type(error).__name__) from None
    if str(content.pop("identity", "")) != identity:
        what = "is of another simulation: bodies, motion, law, numbers or code differ"
        raise InputError(what, path, "leave out resume=True, or choose another directory")
    try:
        rows = json.loads(str(content.pop("rows")))
        values: dict[str, Any] = {
            name: one.item() if one.ndim == 0 else one for name, one in content.items()
        }
        state = WearState(rows=tuple(rows), **values)
        whole = bool(rows) and all(_is_row(row, rows[0]) for row in rows)
    except (ValueError, KeyError, TypeError) as error:
        raise _damaged(path, str(error)) from None
    arrays = {name: one for name, one in content.items() if one.ndim}
    if not have(arrays, dict.fromkeys(("wear", "creep", "fall"), ("f", (count,)))):
        raise _damaged(path, f"its arrays are not of {count} vertices")
    numbers = (state.cycles, state.step, state.volume, state.creep_volume, state.map_error)
    whole &= all(isinstance(one, float) and math.isfinite(one) for one in numbers)
    whole &= type(state.unsettled) is int and isinstance(state.end, str)
    if not (whole and all(np.isfinite(one).all() for one in arrays.values())):
        raise _damaged(path, "its values are not numbers")
    return state


def _is_row(row: Any, first: Any) -> bool:
    """Return whether a row of the kept table has numbers, and the columns of the first row."""
    return (
        isinstance(row, dict)
        and {"cycles", *BANDED} <= row.keys() == first.keys()
        and all(type(value) in (int, float) for value in row.values())
    )


def _damaged(path: Path, why: str) -> InputError:
    return InputError(f"is damaged ({why})", path, "leave out resume=True to begin again")


@dataclass(frozen=True, eq=False)
class WearRun:
    """A wear simulation that is ready to begin.

    Args:
        setup: bodies, motion, contact.
        case: what is worn, by what law.
        material: with sources.
        cycles: how many.
        updates: number of updates of the geometry.
        sampling: for bands; None: none.
    """

    setup: WearSetup
    case: WearCase
    material: WearMaterial
    cycles: int
    updates: int
    sampling: Sampling | None = None

    def compute(
        self,
        folder: Path | None = None,
        *,
        resume: bool = False,
        progress: Callable[[float], None] = lambda cycles: None,
        crew: PoolOptions | None = None,
        sample_progress: Progress = lambda samples, count: samples,
    ) -> WearReport:
        """Simulate and return the report.

        Args:
            folder: where the state is kept after each block; None: nowhere.
            resume: go on with the state that the folder keeps.
            progress: called with the number of finished cycles.
            crew: who computes the samples; default: this process.
            sample_progress: wraps the samples as they come.

        Raises:
            InputError: what the folder keeps is of another simulation, or no contact is found.
            KeyboardInterrupt: with a folder, saying what is kept there.
        """
        identity = ""
        if folder is not None:
            identity = wear_identity(self.setup, self.case, self.cycles, self.updates)
        state, last = self._simulated(folder, identity, resume, progress)
        bands = None
        if self.sampling is not None:
            shards = None
            if folder is not None:
                shards = Shards(folder, {"wear simulation": identity}, resume, SAMPLES_NAME)
            bands = self.sampling.bands(
                (self.case, self.cycles, self.updates), state.rows, crew, shards, sample_progress
            )
        return WearReport(
            self.setup,
            self.case,
            self.material,
            state,
            last,
            self.cycles,
            self.updates,
            first_cycle(self.case, self.material.all_laws()),
            bands,
        )

    def _simulated(
        self,
        folder: Path | None,
        identity: str,
        resume: bool,
        progress: Callable[[float], None],
    ) -> tuple[WearState, CycleWear]:
        """Return the end of the simulation, kept in the folder block by block."""

        def keep(done: WearState) -> None:
            progress(done.cycles)
            if folder is not None:
                keep_state(folder, done, identity)

        count, state = len(self.case.articular.vertices), None
        if folder is not None and resume:
            state = kept_state(folder, identity, count)
        try:
            with interrupt_as_such():
                return simulate_wear(self.case, self.cycles, self.updates, state=state, keep=keep)
        except KeyboardInterrupt:
            kept = None
            if folder is not None:
                with suppress(InputError):  # the state of another simulation is not reported
                    kept = kept_state(folder, identity, count)
            if kept is None:
                raise
            done = f"{kept.cycles:.6g} cycles are kept"
            raise KeyboardInterrupt(f"{done}; go on with resume=True") from None


@dataclass(eq=False)
class _Asked:
    """Material and law: of the call, otherwise of the scene's [wear].

    Args:
        law: name; None: not asked for.
        material: name or file; None: not asked for.
        wear_factor: mm³/(N m); None: not asked for.
    """

    law: str | None
    material: str | Path | None
    wear_factor: float | None

    def check(self, table: WearTable, scene: Path) -> None:
        """Find the material and the law, with the scene's table where nothing is asked for.

        Raises:
            InputError: there is no such material or law, or the material has no such law.
        """
        name = self.material
        if name is None and table.material is not None:
            name = table.material
            if name.endswith(".toml"):
                name = scene.parent / name
        factor = table.wear_factor_mm3_per_Nm if self.wear_factor is None else self.wear_factor
        made_of = wear_material(name or DEFAULT_MATERIAL)
        chosen = made_of.wear_law(self.law or table.law, factor)
        if factor is not None:
            made_of = made_of.with_own_factor()
        self.material_and_law: tuple[WearMaterial, WearLaw] = (made_of, chosen)


def prepare_wear(
    path: str | Path,
    *,
    cycles: int,
    updates: int = 10,
    law: str | None = None,
    material: str | Path | None = None,
    wear_factor: float | None = None,
    samples: int | None = None,
    period: float = 1.0,
    **setup: Any,
) -> WearRun:
    """Return a wear simulation, everything about it checked.

    Args:
        path: a scene file, or a folder that `tkamb run` wrote.
        cycles: how many.
        updates: how often the insert's geometry follows.
        law: a name of `tkamb.studies.wear.laws`; None: the scene's [wear] law, or the material's
        own.
        material: a name of `tkamb.studies.wear.materials`, or a material file; None: the scene's,
            or "conventional".
        wear_factor: mm³/(N m), in place of the scene's or the material's.
        samples: for bands, at least 20; 0: none; None: 32 where the scene has [uncertainty].
        period: s of a simulator's cycle.
        setup: simulator, springs, contact, …: see `tkamb.studies.wear.setup.wear_setup`.

    Raises:
        InputError: whatever of it cannot be used.
    """
    check_blocks(cycles, updates)
    check_samples(samples or 0)
    if not (math.isfinite(period) and 0.05 <= period <= 3600):
        raise InputError(f"{period} s", "--period", "give 0.05 to 3600 s a cycle")
    asked = _Asked(law, material, wear_factor)
    if material is not None:
        asked.check(WearTable(), Path())  # as early as possible
    ready = wear_setup(path, period=period, check=asked.check, **setup)
    made_of, chosen = asked.material_and_law
    case = _case(ready, made_of, chosen)
    if samples is None:
        samples = WEAR_BAND.samples if ready.uncertainty else 0
    sampling = Sampling.of(ready, case, samples) if samples else None
    return WearRun(ready, case, made_of, cycles, updates, sampling)


def wear_of_results(
    scene: Scene, path: Path, results: Results, *, cycles: int, updates: int, frames: int
) -> WearReport:
    """Return the wear of an insert by the motion of results in memory.

    Material, law and closing of the cycle are those of the scene's [wear].

    Args:
        scene: scene of the results, with the contact that they were computed with.
        path: file of the scene.
        results: with their maps.
        cycles: how many.
        updates: how often the insert's geometry follows.
        frames: most frames of a cycle.

    Raises:
        InputError: whatever of it cannot be used.
    """
    check_blocks(cycles, updates)
    asked = _Asked(None, None, None)
    asked.check(scene.wear or WearTable(), path)
    made_of, chosen = asked.material_and_law
    ready = setup_of_results(scene, path, results, frames)
    return WearRun(ready, _case(ready, made_of, chosen), made_of, cycles, updates).compute()


def _case(ready: WearSetup, made_of: WearMaterial, law: WearLaw) -> WearCase:
    density, creep = made_of.density_kg_per_m3, made_of.creep
    return WearCase(ready.engine, ready.articular, ready.motion, law, density, creep)
