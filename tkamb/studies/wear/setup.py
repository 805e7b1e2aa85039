"""From a scene, a folder of results or a simulator's profile to the inputs of a wear simulation."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from tkamb.contact.registry import contact_model, contact_options
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, knee_pose
from tkamb.io.given_material import given_material
from tkamb.io.scene import Scene, load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.io.scene.tables import ContactTable, WearTable
from tkamb.io.scene.uncertainty import UncertaintyTable
from tkamb.run.identity import files_hash, overrides_of_run, preset_of_run, scene_hash
from tkamb.run.maps import ContactMaps
from tkamb.run.results import Results
from tkamb.run.results_folder import read_results
from tkamb.run.simulation import simulate
from tkamb.studies.uncertainty.inputs import uncertainty_of
from tkamb.studies.wear.engine import ContactEngine
from tkamb.studies.wear.motion import CycleMotion, check_closing, chosen_frames
from tkamb.studies.wear.simulator import Profile, Springs, read_profile, read_springs
from tkamb.studies.wear.worn_surface import ArticularSurface
from tkamb.units import MILLIMETRE

Progress = Callable[[Sequence[int]], Iterable[int]]
AFTER_A_RUN = ("wear",)
"""Tables of a scene that a run does not read; they may be changed for a folder of results."""


@dataclass(frozen=True, eq=False)
class WearSetup:
    """The bodies, the motion and the contact of a wear simulation.

    Args:
        engine: contact model, femoral component, material.
        articular: the insert's surface.
        motion: one cycle.
        side: side of the knee; the bodies of a left knee are mirrored.
        contact: name of the contact model.
        resolution_mm: spacing of the points of its map.
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
    close: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    check: Callable[[WearTable, Path], None] = lambda table, path: None,
    progress: Progress = lambda indices: indices,
) -> WearSetup:
    """Return the bodies, the motion and the contact of a wear simulation.

    Args:
        path: a scene file, or a folder that `tkamb run` wrote.
        simulator: a profile (`tkamb.studies.wear.simulator`) in place of the scene's motion.
        springs: a file of its springs (`tkamb.studies.wear.simulator`), for force control.
        contact: contact model, in place of the scene's.
        resolution_mm: in place of the scene's.
        frames: largest number of frames of a recorded cycle, smallest of a simulator's; the cycle
        itself does not depend on it.
        period: s of a simulator's cycle.
        close: how recorded frames become a cycle (`tkamb.studies.wear.motion`), in place of the
            scene's [wear] close.
        overrides: dotted key -> value of the scene. A folder of results takes only keys of
            [wear]: the others would be of another run.
        check: is given the scene's [wear] and path before any frame is run.
        progress: wraps the frames of a scene that has to be run.

    Raises:
        InputError: the scene, folder or profile cannot be used, has no contact, or one of a post.
    """
    if frames < 2:
        raise InputError(f"{frames} frames", "--frames-per-cycle", "give at least 2")
    path = Path(path)
    if springs is not None and simulator is None:
        raise InputError("springs without a simulator", "--springs", "also give --simulator")
    given_keys = dict(overrides or {})
    if close is not None:
        if simulator is not None:
            raise InputError("a simulator's profile is a cycle already", "--close", "leave it out")
        check_closing(close)
        given_keys["wear.close"] = close
    motion: CycleMotion | None = None
    run_frames: tuple[int, ...] | None = None
    if os.path.isdir(path) and simulator is None:
        case, motion, run_frames, scene_path = _of_results(path, frames, given_keys)
        hashes = _hashes(case, case.scene)
    else:
        of_run: dict[str, Any] = {}
        preset: str | None = None
        if os.path.isdir(path):
            summary = read_results(path).summary
            preset = preset_of_run(summary)
            path, of_run = _scene_of(summary, path), overrides_of_run(summary)
        scene_path = path
        scene = load_scene(path, of_run | given_keys, preset)
        case = load_case(_with_contact(scene, contact, resolution_mm, path))
        hashes = _hashes(case, scene)
    check(_wear_table(case.scene), scene_path)
    table = _with_contact(case.scene, contact, resolution_mm, path).contact
    assert table is not None and case.femoral is not None and case.insert is not None
    _refuse_post(case)
    engine = _engine(case, table)
    if simulator is not None:
        spring_table = None if springs is None else read_springs(springs)
        motion = _of_profile(read_profile(simulator, frames), spring_table, engine, case, period)
    elif motion is None:
        motion = _of_scene(case.scene, path, frames, progress)
    return WearSetup(
        engine=engine,
        articular=ArticularSurface.of_insert(case.insert, table.resolution_mm * MILLIMETRE),
        motion=motion,
        side=case.scene.patient.side,
        contact=table.model,
        resolution_mm=table.resolution_mm,
        source=str(simulator or path),
        scene_sha256=hashes,
        files_sha256=files_hash(case),
        run_frames=run_frames,
        uncertainty=uncertainty_of(case) if simulator is None else case.scene.uncertainty,
        simulated=simulator is not None,
    )


def setup_of_results(scene: Scene, path: Path, results: Results, frames: int) -> WearSetup:
    """Return what is worn by the motion of results that are at hand, all of whose frames count.

    Args:
        scene: scene of the results, with the contact that they were computed with.
        path: file of the scene.
        results: with their maps.
        frames: most frames of a cycle.

    Raises:
        InputError: there is no contact, or one of a post.
    """
    case, table = load_case(scene), scene.contact
    if table is None or results.maps is None or case.insert is None:
        raise InputError("the scene has no [contact]", path, "add the table: wear needs pressure")
    _refuse_post(case)
    motion = _cycle_of_maps(results.maps, scene, frames)
    return WearSetup(
        engine=_engine(case, table),
        articular=ArticularSurface.of_insert(case.insert, table.resolution_mm * MILLIMETRE),
        motion=motion,
        side=scene.patient.side,
        contact=table.model,
        resolution_mm=table.resolution_mm,
        source=str(path),
        scene_sha256=_hashes(case, scene),
        files_sha256=files_hash(case),
        uncertainty=uncertainty_of(case),
    )


def _refuse_post(case: Case) -> None:
    if case.post is not None:
        hint = "leave the key out: the dishes' wear alone is modelled"
        raise InputError("the post does not wear", "[contact] post", hint)


def _cycle_of_maps(maps: ContactMaps, scene: Scene, most: int) -> CycleMotion:
    """Return the cycle of at most so many frames of a run's."""
    track = _Track.of_maps(maps)
    frames = [*chain(*chosen_frames(len(track.time), most))]
    return _cycle_of(track, frames, scene, track.time, (track.time, track.poses))


def _wear_table(scene: Scene) -> WearTable:
    return scene.wear or WearTable()


def _hashes(case: Case, scene: Scene) -> tuple[str, ...]:
    """Return the hashes that a run of the scene has: as given, and with the contact asked for."""
    scenes = (scene, case.scene)
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
        result = ", ".join(drive.names)
        notes = [f"a simulator's cycle in force control: {result} in equilibrium, without friction"]
        if friction := case.scene.contact.friction:
            notes.append(f"the scene's friction of {friction:g} is left out of force control")
    seconds = np.diff(profile.percent) / 100.0 * period
    poses = profile.poses(dwell)
    return CycleMotion(poses, profile.load, period, 1, tuple(notes), drive, seconds)


def _of_scene(scene: Scene, path: Path, most: int, progress: Progress) -> CycleMotion:
    """Run a scene, or some of its frames, the first and the last among them; return its cycle."""
    case = load_case(scene)
    recorded = case.motion.time
    count = len(recorded)
    chosen = [slice(one.start, one.stop, one.step) for one in chosen_frames(count, most)]
    runs = [simulate(scene, frames=one, scene_path=path, progress=progress) for one in chosen]
    tracks = [_Track.of_maps(run.maps) for run in runs if run.maps is not None]
    track = _Track(*(np.concatenate(parts) for parts in zip(*tracks, strict=True)))
    contact = scene.contact
    assert contact is not None
    changed = contact.released or contact.adjust  # other poses than the recorded ones
    whole = None if changed else (recorded, knee_pose(case.motion.coordinates))
    return _cycle_of(track, range(len(track.time)), scene, recorded, whole)


class _Track(NamedTuple):
    """Recorded frames.

    Args:
        time: (f,) s.
        poses: (f, 4, 4) pose_femoral_in_insert.
        load: (f,) N along -y.
    """

    time: Array
    poses: Array
    load: Array

    @classmethod
    def of_maps(cls, maps: ContactMaps) -> "_Track":
        load = -np.asarray(maps.nodal_force_N)[:, :, 1].sum(axis=1)
        return cls(np.asarray(maps.time_s), np.asarray(maps.femoral_pose), load)


def _cycle_of(
    track: _Track,
    chosen: Sequence[int],
    scene: Scene,
    recorded: Array,
    whole: tuple[Array, Array] | None,
) -> CycleMotion:
    """Return the cycle that some frames of a track stand for.

    Args:
        track: what was computed.
        chosen: frames of it.
        scene: says how they become a cycle.
        recorded: (g,) s, times of the whole recording.
        whole: those times and the poses (g, 4, 4) at them; None: the poses are not known.
    """
    frames, count = list(chosen), len(recorded)
    time, poses, load = (values[frames] for values in track)
    interval = float(recorded[-1] - recorded[0]) / max(1, count - 1)
    if len(frames) == count:
        whole = None
    closing = _wear_table(scene).close
    motion = CycleMotion.of_frames(time, poses, load, closing, interval, whole)
    if len(frames) == count:
        return motion
    note = f"{len(frames)} of its {count} frames are computed, the first and the last among them"
    return replace(motion, notes=(*motion.notes, note))


def _of_results(
    folder: Path, most: int, overrides: Mapping[str, Any]
) -> tuple[Case, CycleMotion, tuple[int, ...], Path]:
    """Return the case, the cycle, the choice of frames and the scene of a folder of results."""
    for key in overrides:
        if key.partition(".")[0] not in AFTER_A_RUN:
            what = f"'{key}' is not of the run in this folder"
            raise InputError(what, f"--set {key}", "give the scene in place of the folder")
    results = read_results(folder)
    if results.maps is None:
        raise InputError("has no contact maps", folder, "run the scene with [contact]")
    keys = overrides_of_run(results.summary) | dict(overrides)
    scene_path = _scene_of(results.summary, folder)
    scene = load_scene(scene_path, keys, preset_of_run(results.summary))
    table = results.summary.get("contact")
    if isinstance(table, dict):
        try:
            contact = ContactTable.model_validate(table)
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in ("contact", *first["loc"]))
            what = f"'{key}' of its summary.json: {first['msg']}"
            raise InputError(what, folder, "run the scene again") from None
        scene = scene.model_copy(update={"contact": contact})
    case = load_case(scene)
    if scene_hash(case) != results.summary.get("scene_sha256"):
        what = "was run with another scene than its file says now"
        raise InputError(what, folder, "run it again, or give the scene")
    chosen = (results.summary.get("identity") or {}).get("choice of frames") or ()
    motion = _cycle_of_maps(results.maps, scene, most)
    return case, motion, tuple(chosen), scene_path


def _scene_of(summary: dict[str, Any], folder: Path) -> Path:
    scene = summary.get("scene")
    if not isinstance(scene, str):
        raise InputError("does not say which scene it is of", folder, "give the scene")
    return Path(scene)


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
    return ContactEngine(
        model, case.femoral, given_material(case.scene.insert_material), insert.bearing
    )
