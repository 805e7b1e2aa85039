"""Simulation of a scene (`simulate`)."""

import logging
import math
import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any

from tkamb.errors import InputError, must_be, real_number
from tkamb.geometry.frames import Array
from tkamb.io.claim import claimed_directory
from tkamb.io.scene import Scene, load_scene, with_overrides, with_preset
from tkamb.io.scene.case import Case, load_case
from tkamb.run.guard import interrupt_as_such
from tkamb.run.identity import input_hashes, run_identity, scene_hash
from tkamb.run.metrics import peak_pressure
from tkamb.run.plausibility.plausibility import Plausibility
from tkamb.run.read_scene import recording_of
from tkamb.run.recorder import FolderRecorder, Recorder, Row, finished_results
from tkamb.run.recording import frame_arrays
from tkamb.run.results import Results
from tkamb.run.results_folder import BUTTON_NAME, MAPS_NAME
from tkamb.run.status import frame_status
from tkamb.run.summary import summary_of
from tkamb.run.tabulate import frame_row
from tkamb.run.workers import PoolOptions, Task, WorkerPool

if TYPE_CHECKING:
    from tkamb.knee.contact import KneeContact
    from tkamb.knee.frame import Frame, FrameStart
    from tkamb.knee.slip import CondyleSlip


# 1: number of earlier contacts that are stored as initial guesses. Older ones are
# no better than a new search.
KEPT_CONTACTS = 20
# 1: successive frames that a worker computes. The first has no initial guess from an earlier
# frame. Chosen independent of the number of workers, so that it does not affect results.
FRAMES_PER_CHUNK = 10


Finished = tuple[int, Row, dict[str, Array] | None]
"""Frame, its row of results.csv, and the arrays of its contact (`frame_arrays`) or None."""


class FrameSolver:
    """Computes the frames of a case.

    Args:
        frames: frames to compute; None: all.
        slips: slips from another solver of this case; None: they are computed.

    Attributes:
        slips: side -> rolling and slip of a condyle in the recorded motion.
        before: starts of earlier frames, the initial guesses for the next frame.

    Raises:
        InputError: the input cannot be used.
    """

    def __init__(
        self, case: Case, frames: range | None = None, slips: "dict[str, CondyleSlip] | None" = None
    ) -> None:
        self._case = case
        self.recording = recording_of(case)
        self.plausibility = Plausibility(case, self.recording)
        last = max(frames or range(len(case.motion.time)))
        if slips is None:  # slips belong to the recorded motion: none if coordinates are released
            released = case.scene.contact and case.scene.contact.released
            slips = {} if released else self.recording.slips(last)
        self.slips = slips
        self.before: list[FrameStart] = []

    def solve(self, k: int) -> Finished:
        """Compute frame k."""
        frame = self.recording.frame(k, self.before)
        self._keep(frame)
        flags = self.plausibility.flags(k, frame)
        status = frame_status(self._case, k, frame, flags)
        return k, frame_row(self._case, k, frame, self.slips, status), frame_arrays(frame)

    def _keep(self, frame: "Frame") -> None:
        """Store the start. Only the last one of a contact has a warm start, which is large."""
        if frame.contact is not None:
            self.before = [replace(each, contact=None) for each in self.before]
        self.before.append(frame.next)
        del self.before[:-KEPT_CONTACTS]


Chunk = tuple[list[int], "dict[str, CondyleSlip]"]
"""Successive frames, and the slips of the recorded motion (`FrameSolver`)."""


@contextmanager
def _without_warnings() -> Iterator[None]:
    log = logging.getLogger("tkamb")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)


class ChunkSolver:
    """Solver of a worker process, which reads the scene once. The contact is prepared with the
    first chunk, when the parent process has prepared its own and filled a cache.
    """

    @_without_warnings()
    def __init__(self, scene: Scene) -> None:
        self._solver = FrameSolver(load_case(scene), slips={})

    @_without_warnings()
    def __call__(self, number: int, chunk: Chunk) -> list[Finished]:
        """Return the frames of a chunk."""
        frames, self._solver.slips = chunk
        self._solver.before.clear()
        return [self._solver.solve(k) for k in frames]


def finished_in_order(
    team: WorkerPool, slips: "dict[str, CondyleSlip]", indices: range, remaining: Sequence[int]
) -> Iterator[Finished]:
    """Yield frames from worker processes in their order.

    Args:
        indices: all frames of the run. They determine the chunks.

    Raises:
        ComputationError: a worker was killed.
    """
    chunks: dict[int, Chunk] = {}
    for k in remaining:
        chunks.setdefault(indices.index(k) // FRAMES_PER_CHUNK, ([], slips))[0].append(k)
    early: dict[int, list[Finished]] = {}
    order = iter(chunks)
    expected: Any = next(order, None)
    for number, frames in team.answers(list(chunks.items())):
        early[number] = frames
        while expected in early:
            yield from early.pop(expected)
            expected = next(order, None)


Progress = Callable[[Sequence[int]], Iterable[int]]


def simulate(
    scene: Scene | Case | str | Path,
    *,
    contact: str | Mapping[str, Any] | None = None,
    resolution_mm: float | None = None,
    preset: str | None = None,
    frames: slice | range | None = None,
    directory: str | Path | None = None,
    scene_path: str | Path | None = None,
    progress: Progress = lambda frames: frames,
    stage: Callable[[str], None] = lambda name: None,
    resume: bool = False,
    force: bool = False,
    workers: int = 1,
    overrides: Mapping[str, Any] | None = None,
    **tables: Mapping[str, Any],
) -> Results:
    """Run a scene and return its results.

    Values of the scene can be changed, as with `tkamb run --set`, by dotted keys,
    `overrides={"patient.mass_kg": 80.0}`, or by tables, `patient={"mass_kg": 80.0}`.

    Args:
        scene: scene, path of a scene file, or case.
        contact: name of a contact model, or key -> value of the table [contact]; None: the scene's
            model.
        resolution_mm: spacing of the map points, mm; None: the scene's spacing.
        preset: name of a published study. Its choices replace those of the scene, as with
            `tkamb run --as` (`tkamb.io.presets`), except for `contact` and `resolution_mm`.
        frames: frames to compute, a slice or a range; None: all.
        directory: folder for the finished frames, see `tkamb.run.recorder`; None: in memory.
        scene_path: path of the scene file, for the summary.
        progress: function that wraps the frame indices, for a progress bar.
        stage: function that is called with the name of each stage before the frames.
        resume: whether to continue an interrupted run of the same scene and frames in `directory`.
        force: whether to write into a folder with files that are not tkamb's.
        workers: number of processes. With more than one, every tenth frame has no initial guess
            from the frame before, which changes results within the tolerance of the solver.
        overrides: dotted key of the scene -> value.
        tables: table of the scene -> key -> value.

    Raises:
        InputError: the scene, a file, a key or the number of workers cannot be used; a case is
            given with `contact`, `resolution_mm`, `preset` or changed values; the run to resume is
            another one; or the folder cannot be claimed (`tkamb.io.claim`).
        ComputationError: a worker was killed.
        KeyboardInterrupt: the run was interrupted. The finished frames are in `directory`.
    """
    options = PoolOptions(workers)
    hint = "give the name of a contact model, or key -> value of [contact]"
    must_be(contact, (str, Mapping, NoneType), "contact", hint)
    must_be(overrides, (Mapping, NoneType), "overrides", "give dotted key -> value")
    must_be(preset, (str, NoneType), "preset", "give its name")
    if isinstance(contact, Mapping):
        tables, contact = {**tables, "contact": contact}, None
    changes = _dotted(overrides or {}, tables)
    if isinstance(scene, str | Path):
        scene_path, scene = scene, load_scene(scene, changes)
    elif changes:
        scene = _scene_with(scene, changes)
    start = clock.perf_counter()
    stage("reading scene and recordings")
    if preset is not None:
        scene = _scene_as(scene, preset, contact, resolution_mm)
    case = _case_with_contact(scene, contact, resolution_mm)
    indices = chosen_frames(frames, len(case.motion.time))
    identity = run_identity(case, indices)
    if directory is None and resume:
        raise InputError("needs the folder of the earlier run", "resume", "give a directory")
    if directory is not None and resume:
        finished = finished_results(Path(directory), identity)
        if finished is not None:
            return finished
    path = None if scene_path is None else Path(scene_path)
    run = _Run(case, indices, identity, input_hashes(case, path), path, start)
    with ExitStack() as stack:
        team, chunks = None, math.ceil(len(indices) / FRAMES_PER_CHUNK)
        if min(workers, chunks) > 1:
            task = Task(ChunkSolver, (case.scene,))
            team = stack.enter_context(options.team(task, chunks))  # workers prepare meanwhile
        stage("preparing body and contact")
        run.prepare()  # before the folder is changed, so that bad input does not change it
        recorder = Recorder()
        if directory is not None:
            folder = stack.enter_context(claimed_directory(directory, force, "run"))
            recorder = FolderRecorder(folder, identity, resume)
        stack.callback(recorder.close)
        return run.compute(recorder, progress, team)


@dataclass(eq=False)
class _Run:
    case: Case
    indices: range
    identity: dict[str, Any]
    inputs: dict[str, str]
    path: Path | None
    start: float

    def prepare(self) -> None:
        if self.case.scene.muscles:
            from tkamb.run.muscles.sharing import solver_is_installed, solver_missing

            if not solver_is_installed():  # before the preparation, which may take minutes
                raise solver_missing()
        self.solver = FrameSolver(self.case, self.indices)
        self.seconds = {"read": clock.perf_counter() - self.start}
        if self.case.scene.contact is not None:
            start = clock.perf_counter()
            self.solver.recording.method.prepare()
            self.seconds["prepare contact"] = clock.perf_counter() - start

    def compute(self, recorder: Recorder, progress: Progress, team: WorkerPool | None) -> Results:
        self.recorder = recorder
        knee = self.solver.recording.knee
        if knee.contact is not None:
            self._begin_maps(MAPS_NAME, knee.contact, "insert: x anterior, y superior, z lateral")
        if knee.button_contact is not None:
            axes = "button: x superior, y from its back to its articular surface, z lateral"
            self._begin_maps(BUTTON_NAME, knee.button_contact.contact, axes)
        self._take_earlier()
        self.resumed = len(self.recorder.rows)
        remaining = [k for k in self.indices if k not in self.recorder.rows]
        try:
            with interrupt_as_such():
                for frame in self._finished(remaining, progress, team):
                    self.recorder.record(*frame)
                    if self.recorder.due() and len(self.recorder.rows) < len(self.indices):
                        self.recorder.publish(self.results)
        except KeyboardInterrupt:
            if not self.recorder.keeps_files or not self.recorder.rows:
                raise
            self.recorder.publish(self.results)
            progress_words = f"{len(self.recorder.rows)} of {len(self.indices)} frames"
            raise KeyboardInterrupt(f"{progress_words} are kept; go on with resume=True") from None
        self.recorder.finish()
        return self.recorder.publish(self.results)

    def results(self) -> Results:
        """Frames that are not computed yet are failed frames."""
        columns = self.recorder.rows.columns(self.case, self.indices)
        self.seconds["all"] = clock.perf_counter() - self.start
        strains = self.solver.recording.strains
        summary = summary_of(self.case, columns, self.seconds, self.path, strains)
        muscles = self.solver.recording.muscles
        if muscles is not None:
            summary["muscle_groups"] = muscles.groups
        plausibility = self.solver.plausibility
        summary["remarks"] = list(self.case.remarks)
        summary["questions"] = [question.text for question in plausibility.questions]
        summary["notes"] += plausibility.answered
        summary["identity"] = self.identity
        summary["inputs"] = self.inputs
        summary["resumed_frames"] = self.resumed
        summary["unfinished_frames"] = len(self.indices) - len(self.recorder.rows)
        results = Results(
            columns,
            summary,
            self.recorder.maps(MAPS_NAME),
            button_maps=self.recorder.maps(BUTTON_NAME),
        )
        if (largest := peak_pressure(results)) is not None:
            summary["peak_pressure"] = largest
        return results

    def _finished(
        self, remaining: Sequence[int], progress: Progress, team: WorkerPool | None
    ) -> Iterator[Finished]:
        if team is None:
            yield from (self.solver.solve(k) for k in progress(remaining))
            return
        frames = finished_in_order(team, self.solver.slips, self.indices, remaining)
        yield from (frame for _, frame in zip(progress(remaining), frames, strict=True))

    def _begin_maps(self, name: str, contact: "KneeContact", frame: str) -> None:
        labels = {
            "frame": frame,
            "model": contact.model.name,
            "version": str(self.identity["version of tkamb"]),
            "scene_sha256": scene_hash(self.case.scene),
            "licence": self.case.scene.output.licence or "not stated",
            "creator": f"tkamb {self.identity['version of tkamb']}",
        }
        self.recorder.begin_maps(name, contact.state.points, contact.state.triangles, labels)

    def _take_earlier(self) -> None:
        """The last contacts of the run to resume become initial guesses."""
        earlier, recording = self.recorder.take_earlier(self.indices), self.solver.recording
        last = list(earlier.items())[-KEPT_CONTACTS:]
        self.solver.before = [recording.recalled(k, arrays) for k, arrays in last]


def _dotted(overrides: Mapping[str, Any], tables: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(overrides)
    for name, table in tables.items():
        if not isinstance(table, Mapping):
            hint = f'{name}={{"key": value}}, or overrides={{"{name}.key": value}}'
            raise InputError("is neither an option nor a table of values", name, hint)
        for key, value in table.items():
            dotted = f"{name}.{key}"
            if dotted in merged:
                raise InputError("is given twice", dotted, "remove one of them")
            merged[dotted] = value
    return merged


def _scene_with(scene: Scene | Case, overrides: dict[str, Any]) -> Scene:
    if isinstance(scene, Case):
        raise InputError("a case has been read already", "overrides", "give its scene instead")
    return with_overrides(scene, overrides)


def _scene_as(
    scene: Scene | Case, preset: str, model: str | None, resolution_mm: float | None
) -> Scene:
    if isinstance(scene, Case):
        raise InputError("a case has been read already", "preset", "give its scene instead")
    choices = {"contact.model": model, "contact.resolution_mm": resolution_mm}
    return with_preset(scene, preset, {key: v for key, v in choices.items() if v is not None})


def _case_with_contact(scene: Scene | Case, model: str | None, resolution_mm: float | None) -> Case:
    if resolution_mm is not None:
        resolution_mm = real_number(resolution_mm, "resolution_mm", "give it in mm")
    changes = {"model": model, "resolution_mm": resolution_mm}
    changes = {key: value for key, value in changes.items() if value is not None}
    if isinstance(scene, Case):
        if changes:
            raise InputError("a case has been read already", "contact", "give its scene instead")
        return scene
    if not changes:
        return load_case(scene)
    if scene.contact is None:
        raise InputError("the scene has no [contact]", "contact", "add the table to the scene")
    table = scene.contact.model_copy(update=changes)
    return load_case(scene.model_copy(update={"contact": table}))


def chosen_frames(frames: slice | range | None, count: int) -> range:
    """Return the frames of a slice or range."""
    must_be(frames, (slice, range, NoneType), "frames", "give a slice or a range")
    if frames is None:
        return range(count)
    if isinstance(frames, range):
        return _frames_of_range(frames, count)
    ends = [end for end in (frames.start, frames.stop) if end is not None]
    chosen = range(count)[frames] if frames.step != 0 else range(0)
    if any(not -count <= end <= count for end in ends) or len(chosen) == 0:
        start, stop, step = (
            "" if part is None else part for part in (frames.start, frames.stop, frames.step)
        )
        raise InputError(
            f"frames {start}:{stop}{'' if step == '' else f':{step}'} are not in the motion",
            "frames",
            f"it has frames 0 to {count - 1}; all are 0:{count}",
        )
    return chosen


def _frames_of_range(frames: range, count: int) -> range:
    """Return an increasing range; negative numbers do not count from the end, unlike a slice's."""
    if frames.step < 0 or len(frames) == 0 or frames[0] < 0 or frames[-1] >= count:
        hint = f"it has frames 0 to {count - 1}; a range must increase"
        raise InputError(f"frames {frames} are not in the motion", "frames", hint)
    return frames


def frames_slice(text: str) -> slice:
    """Return the slice of a text A:B or A:B:STEP.

    Raises:
        ValueError: the text has another form.
    """
    parts = text.split(":")
    if not 2 <= len(parts) <= 3:
        raise ValueError(f"'{text}' is not A:B or A:B:STEP")
    try:
        return slice(*(int(part) if part else None for part in parts))
    except ValueError:
        raise ValueError(f"'{text}' does not hold integers only") from None
