"""The whole pipeline on one page: scene, body, contact, results."""

import time as clock
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from tkamb.case import Case, load_case
from tkamb.errors import InputError
from tkamb.mechanics import FrameLoads, Mechanics
from tkamb.results import Results
from tkamb.scene import Scene, load_scene
from tkamb.status import frame_status
from tkamb.summary import scene_hash, summary_of
from tkamb.tabulate import tabulate

if TYPE_CHECKING:
    from tkamb.equilibrium import FrameContact
    from tkamb.output.maps_file import ContactMaps

Progress = Callable[[Iterable[int]], Iterable[int]]


def simulate(
    scene: Scene | str | Path,
    *,
    contact: str | None = None,
    resolution_mm: float | None = None,
    frames: slice | None = None,
    directory: str | Path | None = None,
    scene_path: str | Path | None = None,
    progress: Progress = lambda frames: frames,
) -> Results:
    """Run a scene and return its results.

    Args:
        scene: a scene, or the path of its file.
        contact: contact model, instead of the scene's.
        resolution_mm: spacing of the map points, instead of the scene's.
        frames: which frames; default all.
        directory: an existing folder where contact.h5 grows frame by frame; None keeps the
            maps in memory.
        scene_path: where the scene came from, for the summary.
        progress: wraps the frame indices, a progress bar for example.

    Raises:
        InputError: the scene or a file that it names cannot be used.
    """
    if isinstance(scene, str | Path):
        scene_path, scene = scene, load_scene(scene)
    start = clock.perf_counter()
    case = load_case(_with_contact(scene, contact, resolution_mm))
    indices = _chosen(frames, len(case.motion.time))
    mechanics = Mechanics(case)
    seconds = {"read": clock.perf_counter() - start}
    body: list[FrameLoads] = []
    touched: list[FrameContact] = []
    maps = None
    if case.scene.contact:
        maps = _press_all(case, mechanics, progress(indices), body, touched, directory, seconds)
    else:
        body += [mechanics.frame(k) for k in progress(indices)]
    statuses = [
        frame_status(case, k, frame, touched[i] if touched else None)
        for i, (k, frame) in enumerate(zip(indices, body, strict=True))
    ]
    columns = tabulate(case, indices, body, touched, mechanics.slips(), statuses)
    seconds["all"] = clock.perf_counter() - start
    summary = summary_of(case, columns, seconds, None if scene_path is None else Path(scene_path))
    return Results(columns, summary, maps)


def _press_all(
    case: Case,
    mechanics: Mechanics,
    indices: Iterable[int],
    body: "list[FrameLoads]",
    touched: "list[FrameContact]",
    directory: str | Path | None,
    seconds: dict[str, float],
) -> "ContactMaps":
    """Solve body and contact frame by frame; the maps go to contact.h5 or to memory."""
    from tkamb.equilibrium import ContactSide
    from tkamb.output.maps_memory import map_sink

    side = ContactSide(case, mechanics)
    seconds["prepare contact"] = side.prepare_seconds
    labels = {
        "frame": "insert: x anterior, y superior, z lateral",
        "model": side.table.model,
        "scene_sha256": scene_hash(case),
    }
    with map_sink(directory, side.state.points, side.state.triangles, labels) as sink:
        for k in indices:
            loads, contact = side.frame(k, touched)
            body.append(loads)
            touched.append(contact)
            result, time = touched[-1].result, float(case.motion.time[k])
            if result is None:
                sink.append_failed(time)
            else:
                sink.append(time, result.pressure, result.gap, result.nodal_force, result.pose)
    return sink.maps


def _with_contact(scene: Scene, model: str | None, resolution_mm: float | None) -> Scene:
    changes = {"model": model, "resolution_mm": resolution_mm}
    changes = {key: value for key, value in changes.items() if value is not None}
    if not changes:
        return scene
    if scene.contact is None:
        raise InputError("the scene has no [contact]", "contact", "add the table to the scene")
    return scene.model_copy(update={"contact": scene.contact.model_copy(update=changes)})


def _chosen(frames: slice | None, count: int) -> range:
    """Return the frames of a slice; its ends must lie inside the motion."""
    if frames is None:
        return range(count)
    ends = [end for end in (frames.start, frames.stop) if end is not None]
    chosen = range(count)[frames] if frames.step != 0 else range(0)
    if any(not -count <= end <= count for end in ends) or len(chosen) == 0:
        raise InputError(
            f"frames {frames.start}:{frames.stop}:{frames.step} are not in the motion",
            "--frames",
            f"it has frames 0 to {count - 1}",
        )
    return chosen
