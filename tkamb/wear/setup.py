"""From a scene, a folder of results or a simulator's profile to what is worn by what."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model, contact_options
from tkamb.errors import InputError
from tkamb.output.maps import ContactMaps
from tkamb.results_folder import read_results
from tkamb.run.rerun import overrides_of_run, preset_of_run
from tkamb.run.summary import files_hash, scene_hash
from tkamb.scene import Scene, load_scene
from tkamb.scene.case import Case, load_case
from tkamb.scene.tables import ContactTable
from tkamb.scene.uncertainty import UncertaintyTable
from tkamb.simulation import simulate
from tkamb.units import MILLIMETRE
from tkamb.wear.engine import ContactEngine
from tkamb.wear.motion import CycleMotion
from tkamb.wear.profile import Profile, read_profile
from tkamb.wear.springs import Springs, read_springs
from tkamb.wear.worn_surface import ArticularSurface

Progress = Callable[[Sequence[int]], Iterable[int]]


@dataclass(frozen=True, eq=False)
class WearSetup:
    """The bodies, the motion and the contact of a wear simulation.

    Args:
        engine: contact model, femoral component, material.
        articular: the insert's surface.
        motion: one cycle.
        side: of the knee; the bodies of a left one are mirrored.
        contact: name of the contact model.
        resolution_mm: of its map.
        source: the file or folder that the motion comes from.
        scene_sha256: of the scene as it was given and with the contact that was asked for; a
            run's summary has one of them.
        files_sha256: of the files that the scene names, likewise.
        run_frames: first, last and step of the frames of the run whose maps are worn; None: the
            motion is the scene's or a simulator's.
        uncertainty: the scene's table; None: it has none.
        simulated: the motion is a simulator's.
    """

    engine: ContactEngine
    articular: ArticularSurface
    motion: CycleMotion
    side: str
    contact: str
    resolution_mm: float
    source: str
    scene_sha256: tuple[str, ...]
    files_sha256: str
    run_frames: tuple[int, ...] | None = None
    uncertainty: UncertaintyTable | None = None
    simulated: bool = False


def wear_setup(
    path: str | Path,
    *,
    simulator: str | Path | None = None,
    springs: str | Path | None = None,
    contact: str | None = None,
    resolution_mm: float | None = None,
    frames: int = 40,
    period: float = 1.0,
    progress: Progress = lambda indices: indices,
) -> WearSetup:
    """Return what is worn.

    Args:
        path: a scene file, or a folder that `tkamb run` wrote.
        simulator: a profile (`tkamb.wear.profile`) in place of the scene's motion.
        springs: a file of its springs (`tkamb.wear.springs`), for force control.
        contact: contact model, in place of the scene's.
        resolution_mm: in place of the scene's.
        frames: most frames of a cycle.
        period: s of a simulator's cycle.
        progress: wraps the frames of a scene that has to be run.

    Raises:
        InputError: the scene, folder or profile cannot be used, has no contact, or one of a post.
    """
    if frames < 2:
        raise InputError(f"{frames} frames", "--frames-per-cycle", "give at least 2")
    path = Path(path)
    if springs is not None and simulator is None:
        raise InputError("springs without a simulator", "--springs", "give --simulator too")
    motion: CycleMotion | None = None
    run_frames: tuple[int, ...] | None = None
    if os.path.isdir(path) and simulator is None:
        case, motion, run_frames = _of_results(path)
        hashes = _hashes(case, case.scene)
    else:
        overrides: dict[str, Any] = {}
        preset: str | None = None
        if os.path.isdir(path):
            summary = read_results(path).summary
            preset = preset_of_run(summary)
            path, overrides = _scene_of(summary, path), overrides_of_run(summary)
        given = load_scene(path, overrides, preset)
        case = load_case(_with_contact(given, contact, resolution_mm, path))
        hashes = _hashes(case, given)
    table = _with_contact(case.scene, contact, resolution_mm, path).contact
    assert table is not None and case.femoral is not None and case.insert is not None
    if case.post is not None:
        mend = "leave the key out: the dishes' wear alone is modelled"
        raise InputError("the post does not wear", "[contact] post", mend)
    engine = _engine(case, table)
    if simulator is not None:
        held = None if springs is None else read_springs(springs)
        motion = _of_profile(read_profile(simulator, frames), held, engine, case, period)
    elif motion is None:
        motion = _of_scene(case.scene, path, frames, progress)
    return WearSetup(
        engine=engine,
        articular=ArticularSurface.of_insert(case.insert, table.resolution_mm * MILLIMETRE),
        motion=motion if simulator else motion.thinned(frames),
        side=case.scene.patient.side,
        contact=table.model,
        resolution_mm=table.resolution_mm,
        source=str(simulator or path),
        scene_sha256=hashes,
        files_sha256=files_hash(case),
        run_frames=run_frames,
        uncertainty=case.scene.uncertainty,
        simulated=simulator is not None,
    )


def _hashes(case: Case, given: Scene) -> tuple[str, ...]:
    """Return the hashes that a run of the scene has: as given, and with the contact asked for."""
    scenes = (given, case.scene)
    return tuple(dict.fromkeys(scene_hash(replace(case, scene=one)) for one in scenes))


def _of_profile(
    profile: Profile, springs: Springs | None, engine: ContactEngine, case: Case, period: float
) -> CycleMotion:
    """Return a simulator's cycle, in displacement or in force control."""
    assert case.insert is not None and case.scene.contact is not None
    profile.drive((0.0, 0.0), springs)  # springs that do not suit are refused before any search
    dwell = engine.dwell(case.insert, profile.rotation)
    drive = profile.drive(dwell, springs)
    notes = ["a simulator's cycle in displacement control; AP and ML from the dwell position"]
    if drive is not None:
        found = ", ".join(drive.names)
        notes = [f"a simulator's cycle in force control: {found} in equilibrium, without friction"]
        if friction := case.scene.contact.friction:
            notes.append(f"the scene's friction of {friction:g} is left out of force control")
    return CycleMotion(profile.poses(dwell), profile.load, period, 1, tuple(notes), drive)


def _of_scene(scene: Scene, path: Path, most: int, progress: Progress) -> CycleMotion:
    """Run a scene, or every so many of its frames, and return its cycle."""
    count = len(load_case(scene).motion.time)
    step = max(1, -(-count // most))
    results = simulate(scene, frames=slice(0, count, step), scene_path=path, progress=progress)
    assert results.maps is not None
    motion = _of_maps(results.maps)
    if step == 1:
        return motion
    note = f"every {step}th frame of the scene's {count} is computed"
    return replace(motion, notes=(*motion.notes, note))


def _of_results(folder: Path) -> tuple[Case, CycleMotion, tuple[int, ...]]:
    """Return the case, the cycle and the choice of frames of a folder of results."""
    results = read_results(folder)
    if results.maps is None:
        raise InputError("has no contact maps", folder, "run the scene with [contact]")
    summary = results.summary
    scene = load_scene(
        _scene_of(summary, folder), overrides_of_run(summary), preset_of_run(summary)
    )
    table = results.summary.get("contact")
    if isinstance(table, dict):
        scene = scene.model_copy(update={"contact": ContactTable.model_validate(table)})
    case = load_case(scene)
    if scene_hash(case) != results.summary.get("scene_sha256"):
        what = "was run with another scene than its file says now"
        raise InputError(what, folder, "run it again, or give the scene")
    chosen = (results.summary.get("identity") or {}).get("choice of frames") or ()
    return case, _of_maps(results.maps), tuple(chosen)


def _scene_of(summary: dict[str, Any], folder: Path) -> Path:
    scene = summary.get("scene")
    if not isinstance(scene, str):
        raise InputError("does not say which scene it is of", folder, "give the scene")
    return Path(scene)


def _of_maps(maps: ContactMaps) -> CycleMotion:
    load = -np.asarray(maps.nodal_force_N)[:, :, 1].sum(axis=1)
    return CycleMotion.of_frames(maps.time_s, np.asarray(maps.femoral_pose), load)


def _with_contact(
    scene: Scene, model: str | None, resolution_mm: float | None, path: Path
) -> Scene:
    """Return the scene with another contact model; the former one's options do not go along."""
    if scene.contact is None:
        raise InputError("the scene has no [contact]", path, "add the table: wear needs pressure")
    changes: dict[str, Any] = {}
    if model is not None and model != scene.contact.model:
        changes = {"model": model, "options": {}}
    if resolution_mm is not None:
        changes["resolution_mm"] = resolution_mm
    return scene.model_copy(update={"contact": scene.contact.model_copy(update=changes)})


def _engine(case: Case, table: ContactTable) -> ContactEngine:
    insert = case.scene.implant.insert
    assert insert is not None and case.femoral is not None
    options = dict(table.options)
    if "cache" in contact_options(table.model):
        options["cache"] = False  # every update has an operator of its own, used once
    model = contact_model(table.model, table.resolution_mm, **options)
    return ContactEngine(model, case.femoral, material(table.material), insert.bearing)
