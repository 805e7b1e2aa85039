"""A wear simulation, from the user's options to the report.

Each finished block of cycles is stored in the folder. An interruption loses at most one block.
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
from tkamb.files import MESH_BYTES, read_bytes, replaced_file, undamaged
from tkamb.io.scene import Scene
from tkamb.io.scene.tables import WearTable
from tkamb.run.guard import interrupt_as_such
from tkamb.run.identity import foreign_code
from tkamb.run.recorder import Shards, read_arrays
from tkamb.run.results import Results
from tkamb.run.workers import PoolOptions
from tkamb.studies.wear.bands import WEAR_BAND, Progress, Sampling, check_samples
from tkamb.studies.wear.laws import DEFAULT_MATERIAL, WearLaw, WearMaterial, wear_material
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
    """Return the SHA-256 of bodies, motion, laws, numbers and code of a simulation."""
    digest = hashlib.sha256()
    bodies = (setup.engine.femoral, case.articular.surface)
    arrays = [array for body in bodies for array in (body.vertices, body.faces)]
    drive = case.motion.drive
    if drive is not None:
        arrays += [drive.coordinates, drive.applied, drive.zero]
    motion = case.motion
    arrays += [array for array in (motion.seconds, *(motion.path or ())) if array is not None]
    for array in (*arrays, case.motion.poses, case.motion.load):
        digest.update(np.ascontiguousarray(array, "<f8").tobytes())
    words = (setup.engine.model, setup.engine.material, setup.engine.bearing, case.law, case.creep)
    numbers = (case.density, case.motion.duration, case.motion.passes, cycles, updates)
    machine = () if drive is None else (drive.free, drive.springs)
    others = (foreign_code(setup.engine.model), foreign_code(case.law))
    digest.update(repr((words, numbers, machine, code_identity(), *others)).encode())
    return digest.hexdigest()


def keep_state(folder: Path, state: WearState, identity: str) -> None:
    """Store the state in the folder. An interruption leaves the earlier state in place."""
    arrays = {f.name: np.asarray(getattr(state, f.name)) for f in fields(state) if f.name != "rows"}
    rows = np.asarray(json.dumps(state.rows))
    with replaced_file(folder / STATE_NAME) as temporary, open(temporary, "wb") as file:
        np.savez(file, allow_pickle=False, identity=np.asarray(identity), rows=rows, **arrays)


def kept_state(folder: Path, identity: str) -> WearState | None:
    """Return the state that is stored in a folder; None if there is none."""
    path = folder / STATE_NAME
    if not path.is_file():
        return None
    with undamaged(path, "leave out resume=True to begin again"):
        content = read_arrays(read_bytes(path, MESH_BYTES))
        if str(content.pop("identity")) != identity:
            what = "is of another simulation: bodies, motion, law, numbers or code differ"
            raise InputError(what, path, "leave out resume=True, or choose another directory")
        rows = tuple(json.loads(str(content.pop("rows"))))
        values: dict[str, Any] = {
            name: array if array.ndim else array.item() for name, array in content.items()
        }
        return WearState(rows=rows, **values)


@dataclass(frozen=True, eq=False)
class WearRun:
    """A wear simulation with checked inputs.

    Args:
        sampling: samples for bands; None: no bands.
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
            folder: folder in which the state is stored after each block; None: it stays in memory.
            resume: whether to use the state that is stored in the folder.
            progress: function that is called with the number of finished cycles.
            crew: worker pool settings for the samples; default: this process.
            sample_progress: wrapper of the iterator of the finished samples.

        Raises:
            InputError: the folder holds another simulation, or there is no contact.
            KeyboardInterrupt: interrupted. Finished blocks and samples stay in the folder.
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
        """Return the state at the end and the wear of a further cycle; store each block."""

        def keep(state: WearState) -> None:
            progress(state.cycles)
            if folder is not None:
                keep_state(folder, state, identity)

        state = None
        if folder is not None and resume:
            state = kept_state(folder, identity)
        try:
            with interrupt_as_such():
                return simulate_wear(self.case, self.cycles, self.updates, state=state, keep=keep)
        except KeyboardInterrupt:
            stored = None
            if folder is not None:
                with suppress(InputError):  # the state of another simulation is not reported
                    stored = kept_state(folder, identity)
            if stored is None:
                raise
            words = f"{stored.cycles:.6g} cycles are kept"
            raise KeyboardInterrupt(f"{words}; go on with resume=True") from None


@dataclass(eq=False)
class _MaterialChoice:
    """Names of law and material, and wear factor, mm³/(N m); None: that of [wear] in the scene."""

    law: str | None
    material: str | Path | None
    wear_factor: float | None

    def check(self, table: WearTable, scene: Path) -> None:
        """Set `material_and_law` from the call and the table [wear] of a scene file.

        Raises:
            InputError: the material or law is unknown, or the material has no such law.
        """
        name = self.material
        if name is None and table.material is not None:
            name = table.material
            if name.endswith(".toml"):
                name = scene.parent / name
        factor = table.wear_factor_mm3_per_Nm if self.wear_factor is None else self.wear_factor
        material = wear_material(name or DEFAULT_MATERIAL)
        law = material.wear_law(self.law or table.law, factor)
        if factor is not None:
            material = material.with_own_factor()
        self.material_and_law: tuple[WearMaterial, WearLaw] = (material, law)


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
    """Return a wear simulation with checked inputs.

    Args:
        updates: number of updates of the insert's geometry.
        law: name of a wear law (`tkamb.studies.wear.laws`); None: that of [wear] in the scene, or
            the default law of the material.
        material: name (`tkamb.studies.wear.laws`) or file of a wear material; None: that of
            [wear] in the scene, or "conventional".
        wear_factor: wear factor that replaces that of scene or material, mm³/(N m).
        samples: number of samples for bands, at least 20; 0: no bands; None: 32 if the scene has
            [uncertainty].
        period: duration of a simulator's cycle, s.
    """
    check_blocks(cycles, updates)
    check_samples(samples or 0)
    if not (math.isfinite(period) and 0.05 <= period <= 3600):
        raise InputError(f"{period} s", "--period", "give 0.05 to 3600 s per cycle")
    choice = _MaterialChoice(law, material, wear_factor)
    if material is not None:
        choice.check(WearTable(), Path())  # before the scene is read
    inputs = wear_setup(path, period=period, check=choice.check, **setup)
    chosen_material, chosen_law = choice.material_and_law
    case = _case(inputs, chosen_material, chosen_law)
    if samples and inputs.part == "button":
        raise InputError("the button's wear has no bands", "--samples", "leave it out")
    if samples is None:
        samples = WEAR_BAND.samples if inputs.has_uncertainty else 0
    sampling = Sampling.of(inputs, case, samples) if samples else None
    return WearRun(inputs, case, chosen_material, cycles, updates, sampling)


def wear_of_results(
    scene: Scene, path: Path, results: Results, *, cycles: int, updates: int, frames: int
) -> WearReport:
    """Return the wear of an insert by the motion of results in memory.

    Material, law and closing of the cycle are those of [wear] in the scene.

    Args:
        updates: number of updates of the insert's geometry.
        frames: largest number of frames of a cycle.
    """
    check_blocks(cycles, updates)
    choice = _MaterialChoice(None, None, None)
    choice.check(scene.wear or WearTable(), path)
    material, law = choice.material_and_law
    setup = setup_of_results(scene, path, results, frames)
    return WearRun(setup, _case(setup, material, law), material, cycles, updates).compute()


def _case(setup: WearSetup, material: WearMaterial, law: WearLaw) -> WearCase:
    density, creep = material.density_kg_per_m3, material.creep
    return WearCase(setup.engine, setup.articular, setup.motion, law, density, creep)
