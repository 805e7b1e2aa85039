"""Inputs of a wear simulation from a scene, a folder of results or a simulator's profile."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from tkamb.contact.model import ContactModel
from tkamb.contact.registry import contact_model_in_mm, contact_options
from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array, knee_pose
from tkamb.io.given_material import given_material
from tkamb.io.scene import Scene, load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.io.scene.tables import ContactTable, PatellofemoralTable, WearTable
from tkamb.io.scene.uncertainty import UncertaintyTable
from tkamb.run.identity import files_hash, overrides_of_run, preset_of_run, scene_hash
from tkamb.run.maps import ContactMaps
from tkamb.run.results import Results
from tkamb.run.results_folder import read_results
from tkamb.run.simulation import simulate
from tkamb.studies.uncertainty.inputs import uncertainty_of
from tkamb.studies.wear.engine import ArticularSurface, ContactEngine
from tkamb.studies.wear.motion import CycleMotion, check_closing, chosen_frames
from tkamb.studies.wear.simulator import Profile, Springs, read_profile, read_springs
from tkamb.units import MILLIMETRE

Progress = Callable[[Sequence[int]], Iterable[int]]
AFTER_A_RUN = ("wear",)
"""Tables of a scene that do not affect a run. They may be changed for a folder of results."""


@dataclass(frozen=True, eq=False)
class WearSetup:
    """Bodies, motion and contact of a wear simulation.

    Args:
        articular: articular surface of the insert.
        side: side of the knee. The bodies of a left knee are mirrored.
        resolution_mm: spacing of the model's map points, mm.
        scene_sha256: SHA-256 of the scene, without and with the requested contact model. The
            summary of a run of the scene contains one of them.
        files_sha256: SHA-256 of the files that the scene names.
        run_frames: start, stop and step of the frames of the run with the maps; None: the motion
            does not come from a folder of results.
        uncertainty: table [uncertainty] of the scene, or its defaults; None: of the button, or of a
            profile without the table.
        has_uncertainty: whether the scene has this table.
        simulated: whether the motion is a simulator's profile.
        part: "insert", or "button": then "insert" in other names means the patellar button, in the
            button frame (`tkamb.knee.button`).
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
    has_uncertainty: bool = False
    simulated: bool = False
    part: str = "insert"


PARTS = ("insert", "button")
"""Parts of polyethylene whose wear can be computed."""


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
    part: str = "insert",
) -> WearSetup:
    """Return bodies, motion and contact of a wear simulation.

    Args:
        simulator: file of a profile (`tkamb.studies.wear.simulator`) that replaces the motion of
            the scene.
        springs: file of the springs of the simulator for force control.
        contact: name of the contact model that replaces that of the scene.
        resolution_mm: resolution that replaces that of the scene, mm.
        frames: largest number of frames of a recorded cycle, or smallest number of a profile.
        period: duration of a simulator's cycle, s.
        close: closing of recorded frames to a cycle (`tkamb.studies.wear.motion`) that replaces
            `close` of [wear] in the scene.
        overrides: dotted key of the scene -> value. A folder of results accepts only keys of
            [wear], because other keys need another run.
        check: function of [wear] and the path of the scene that is called before frames are run.
        progress: wrapper of the iterator of the frames to run.
        part: "insert", or "button" for the patellar button of a folder of results.
    """
    if part not in PARTS:
        raise InputError(f"no part '{part}'", "--part", names_near(part, PARTS))
    if frames < 2:
        raise InputError(f"{frames} frames", "--frames-per-cycle", "give at least 2")
    path = Path(path)
    if springs is not None and simulator is None:
        raise InputError("springs without a simulator", "--springs", "also give --simulator")
    keys = dict(overrides or {})
    if close is not None:
        if simulator is not None:
            raise InputError("a simulator's profile is already closed", "--close", "leave it out")
        check_closing(close)
        keys["wear.close"] = close
    if part == "button":
        if simulator is not None:
            raise InputError("a simulator has no patella", "--simulator", "leave out --part")
        return _button_setup(path, contact, resolution_mm, frames, keys, check)
    motion: CycleMotion | None = None
    run_frames: tuple[int, ...] | None = None
    if os.path.isdir(path) and simulator is None:
        results = read_results(path)
        case, run_frames, scene_path = _of_results(path, results, keys)
        assert results.maps is not None
        motion = _cycle_of_maps(results.maps, case.scene, frames)
        hashes = _hashes(case, case.scene)
    else:
        run_keys: dict[str, Any] = {}
        preset: str | None = None
        if os.path.isdir(path):
            summary = read_results(path).summary
            preset = preset_of_run(summary)
            path, run_keys = _scene_of(summary, path), overrides_of_run(summary)
        scene_path = path
        scene = load_scene(path, run_keys | keys, preset)
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
        motion = _of_scene(case, path, frames, progress)
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
        has_uncertainty=case.scene.uncertainty is not None,
        simulated=simulator is not None,
    )


def _button_setup(
    path: Path,
    model: str | None,
    resolution_mm: float | None,
    frames: int,
    keys: Mapping[str, Any],
    check: Callable[[WearTable, Path], None],
) -> WearSetup:
    """Return the result of `wear_setup` for the patellar button of a folder of results.

    Raises:
        InputError: there is no folder with maps of the button.
    """
    results = read_results(path) if os.path.isdir(path) else None
    if results is None or results.button_maps is None:
        hint = "run a scene with [contact.patellofemoral], and give its folder"
        raise InputError("has no maps of the patellar button", path, hint)
    from tkamb.run.read_scene import recording_of

    case, run_frames, scene_path = _of_results(path, results, keys)
    check(_wear_table(case.scene), scene_path)
    table, button = case.scene.contact, recording_of(case, near=True).knee.button_contact
    assert table is not None and table.patellofemoral is not None and button is not None
    of_button, pair = table.patellofemoral, button.contact.pair
    options = dict(of_button.options) if model in (None, of_button.model) else {}
    used = ContactTable(
        model=model or of_button.model,
        resolution_mm=resolution_mm or of_button.resolution_mm,
        options=options,
    )
    return WearSetup(
        engine=ContactEngine(_model(used), pair.femoral, pair.material, pair.bearing),
        articular=ArticularSurface.of_insert(pair.insert, used.resolution_mm * MILLIMETRE),
        motion=_cycle_of_maps(results.button_maps, case.scene, frames),
        side=case.scene.patient.side,
        contact=used.model,
        resolution_mm=used.resolution_mm,
        source=str(path),
        scene_sha256=_hashes(case, case.scene),
        files_sha256=files_hash(case),
        run_frames=run_frames,
        part="button",
    )


def setup_of_results(scene: Scene, path: Path, results: Results, frames: int) -> WearSetup:
    """Return bodies, motion and contact of a wear simulation from results in memory.

    Args:
        frames: largest number of frames of a cycle.
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
        hint = "leave the key out to compute the wear of the dishes alone"
        raise InputError("the wear of a post is not modelled", "[contact] post", hint)


def _cycle_of_maps(maps: ContactMaps, scene: Scene, most: int) -> CycleMotion:
    track = _Track.of_maps(maps)
    frames = [*chain(*chosen_frames(len(track.time), most))]
    return _cycle_of(track, frames, scene, track.time, (track.time, track.poses))


def _wear_table(scene: Scene) -> WearTable:
    return scene.wear or WearTable()


def _hashes(case: Case, scene: Scene) -> tuple[str, ...]:
    hashes = (scene_hash(variant) for variant in (scene, case.scene))
    return tuple(dict.fromkeys(hashes))


def _of_profile(
    profile: Profile, springs: Springs | None, engine: ContactEngine, case: Case, period: float
) -> CycleMotion:
    assert case.insert is not None and case.scene.contact is not None
    profile.drive((0.0, 0.0), springs)  # raises for unsuitable springs before the search
    dwell = engine.dwell(case.insert, profile.rotation)
    drive = profile.drive(dwell, springs)
    notes = ["a simulator's cycle in displacement control; AP and ML from the dwell position"]
    if drive is not None:
        names = ", ".join(drive.names)
        notes = [f"a simulator's cycle in force control: {names} in equilibrium, without friction"]
        if friction := case.scene.contact.friction:
            notes.append(f"force control neglects the friction of {friction:g} of the scene")
    seconds = np.diff(profile.percent) / 100.0 * period
    poses = profile.poses(dwell)
    return CycleMotion(poses, profile.load, period, 1, tuple(notes), drive, seconds)


def _of_scene(case: Case, path: Path, most: int, progress: Progress) -> CycleMotion:
    """Run at most `most` frames of a scene, including the first and the last; return the cycle."""
    recorded, contact = case.motion.time, case.scene.contact
    assert contact is not None
    count = len(recorded)
    chosen = [slice(part.start, part.stop, part.step) for part in chosen_frames(count, most)]
    runs = [simulate(case, frames=part, scene_path=path, progress=progress) for part in chosen]
    tracks = [_Track.of_maps(run.maps) for run in runs if run.maps is not None]
    track = _Track(*(np.concatenate(parts) for parts in zip(*tracks, strict=True)))
    changed = contact.released or contact.adjust  # the computed poses differ from the recording
    whole = None if changed else (recorded, knee_pose(case.motion.coordinates))
    return _cycle_of(track, range(len(track.time)), case.scene, recorded, whole)


class _Track(NamedTuple):
    """Computed frames: times, s, (f,); pose_femoral_in_insert (f, 4, 4); load along -y, N, (f,)."""

    time: Array
    poses: Array
    load: Array

    @classmethod
    def of_maps(cls, maps: ContactMaps) -> "_Track":
        return cls(np.asarray(maps.time_s), np.asarray(maps.femoral_pose), -maps.forces_N[:, 1])


def _cycle_of(
    track: _Track,
    chosen: Sequence[int],
    scene: Scene,
    recorded: Array,
    whole: tuple[Array, Array] | None,
) -> CycleMotion:
    """Return the cycle of some computed frames.

    Args:
        recorded: times of the recording, s, shape (g,).
        whole: times and poses (g, 4, 4) of the recording; None: the poses are unknown.
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
    note = f"{len(frames)} of its {count} frames are used, including the first and the last"
    return replace(motion, notes=(*motion.notes, note))


def _of_results(
    folder: Path, results: Results, overrides: Mapping[str, Any]
) -> tuple[Case, tuple[int, ...], Path]:
    for key in overrides:
        if key.partition(".")[0] not in AFTER_A_RUN:
            what = f"'{key}' cannot be changed after the run in this folder"
            raise InputError(what, f"--set {key}", "give the scene instead of the folder")
    if results.maps is None:
        raise InputError("has no contact maps", folder, "run the scene with [contact]")
    keys = overrides_of_run(results.summary) | dict(overrides)
    scene_path = _scene_of(results.summary, folder)
    scene = load_scene(scene_path, keys, preset_of_run(results.summary))
    table = results.summary.get("contact")
    if isinstance(table, dict):
        button = results.summary.get("patellofemoral_contact")
        if isinstance(button, dict):  # the summary has results beside its keys
            keys_of = PatellofemoralTable.model_fields
            own = {key: value for key, value in button.items() if key in keys_of}
            table = table | {"patellofemoral": own}
        try:
            contact = ContactTable.model_validate(table)
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in ("contact", *first["loc"]))
            what = f"'{key}' of its summary.json: {first['msg']}"
            raise InputError(what, folder, "run the scene again") from None
        scene = scene.model_copy(update={"contact": contact})
    case = load_case(scene)
    if scene_hash(case.scene) != results.summary.get("scene_sha256"):
        what = "was computed with an earlier version of the scene file"
        raise InputError(what, folder, "run the scene again, or give the scene file")
    chosen = (results.summary.get("identity") or {}).get("choice of frames") or ()
    return case, tuple(chosen), scene_path


def _scene_of(summary: dict[str, Any], folder: Path) -> Path:
    scene = summary.get("scene")
    if not isinstance(scene, str):
        raise InputError("does not name its scene", folder, "give the scene file")
    return Path(scene)


def _with_contact(
    scene: Scene, model: str | None, resolution_mm: float | None, path: Path
) -> Scene:
    """Return the scene with another contact model and resolution.

    Another model has its default options.
    """
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
    material = given_material(case.scene.insert_material)
    return ContactEngine(_model(table), case.femoral, material, insert.bearing)


def _model(table: ContactTable) -> ContactModel:
    options = dict(table.options)
    if "cache" in contact_options(table.model):
        options["cache"] = False  # each update of the geometry needs another operator
    return contact_model_in_mm(table.model, table.resolution_mm, options)
