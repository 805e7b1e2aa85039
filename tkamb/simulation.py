"""The whole pipeline on one page: scene, body, contact, results."""

import time as clock
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb.claim import claimed_directory
from tkamb.equilibrium.mechanics import Mechanics
from tkamb.errors import InputError
from tkamb.plausibility.plausibility import Plausibility
from tkamb.results import Results
from tkamb.run.recorder import FolderRecorder, Recorder, finished_results
from tkamb.run.status import frame_status
from tkamb.run.summary import input_hashes, run_identity, scene_hash, summary_of
from tkamb.run.tabulate import frame_row, join_rows
from tkamb.scene import Scene, load_scene
from tkamb.scene.case import Case, load_case

if TYPE_CHECKING:
    from tkamb.equilibrium.contact_side import ContactSide
    from tkamb.equilibrium.frame_contact import FrameContact

Progress = Callable[[Sequence[int]], Iterable[int]]

LAST_FRAMES = 20
"""How many contacts are kept as guesses for the next."""


def simulate(
    scene: Scene | str | Path,
    *,
    contact: str | None = None,
    resolution_mm: float | None = None,
    frames: slice | None = None,
    directory: str | Path | None = None,
    scene_path: str | Path | None = None,
    progress: Progress = lambda frames: frames,
    resume: bool = False,
    force: bool = False,
) -> Results:
    """Run a scene and return its results.

    Args:
        scene: a scene, or the path of its file.
        contact: contact model, instead of the scene's.
        resolution_mm: spacing of the map points, instead of the scene's.
        frames: which frames; default all.
        directory: folder where the finished frames are kept, see `tkamb.run.recorder`; None
            keeps them in memory.
        scene_path: where the scene came from, for the summary.
        progress: wraps the frame indices, a progress bar for example.
        resume: go on with what an earlier, interrupted run of the same scene and frames left
            in the folder; needs one.
        force: write into the folder even if it holds things that are not tkamb's.

    Raises:
        InputError: the scene or a file that it names cannot be used, the run to resume is
            another one, or the folder cannot be claimed (`tkamb.claim`).
        KeyboardInterrupt: with a folder, what was finished is written there first.
    """
    if isinstance(scene, str | Path):
        scene_path, scene = scene, load_scene(scene)
    start = clock.perf_counter()
    case = load_case(_with_contact(scene, contact, resolution_mm))
    indices = chosen_frames(frames, len(case.motion.time))
    identity = run_identity(case, indices)
    if directory is None and resume:
        raise InputError("there is no folder to go on in", "resume", "give a directory")
    if directory is not None and resume:
        done = finished_results(Path(directory), identity)
        if done is not None:
            return done
    path = None if scene_path is None else Path(scene_path)
    run = _Run(case, indices, identity, input_hashes(case, path), path, start)
    run.prepare()  # before the folder is touched: bad input leaves it as it was
    with ExitStack() as stack:
        recorder = Recorder()
        if directory is not None:
            folder = stack.enter_context(claimed_directory(directory, force))
            recorder = FolderRecorder(folder, identity, resume)
        stack.callback(recorder.close)
        return run.compute(recorder, progress)


@dataclass(eq=False)
class _Run:
    """One run: computes its frames, hands them to the recorder, and makes the results."""

    case: Case
    indices: range
    identity: dict[str, Any]
    inputs: dict[str, str]
    path: Path | None
    start: float

    def prepare(self) -> None:
        """Build both sides of the equilibrium; whatever is wrong with the input shows here."""
        self.mechanics = Mechanics(self.case)
        self.plausibility = Plausibility(self.mechanics)
        self.slips = self.mechanics.slips()
        self.seconds = {"read": clock.perf_counter() - self.start}
        self.side = self._contact_side() if self.case.scene.contact else None

    def compute(self, recorder: Recorder, progress: Progress) -> Results:
        """Compute every frame that is not there yet and return the results."""
        self.recorder, side = recorder, self.side
        if side is not None:
            self._begin_maps(side)
        before = self._earlier(side)
        self.resumed = len(self.recorder.rows)
        left = [k for k in self.indices if k not in self.recorder.rows]
        try:
            for k in progress(left):
                self._frame(k, side, before)
                if self.recorder.due() and len(self.recorder.rows) < len(self.indices):
                    self.recorder.publish(self.results())
        except KeyboardInterrupt:
            if not self.recorder.keeps_files or not self.recorder.rows:
                raise
            self.recorder.publish(self.results())
            done = f"{len(self.recorder.rows)} of {len(self.indices)} frames"
            raise KeyboardInterrupt(f"{done} are kept; go on with --resume") from None
        self.recorder.finish()
        results = self.results()
        self.recorder.publish(results)
        return results

    def results(self) -> Results:
        """Return the results so far; frames that are still to do are failed ones."""
        columns = join_rows(self.case, self.indices, self.recorder.rows)
        self.seconds["all"] = clock.perf_counter() - self.start
        summary = summary_of(self.case, columns, self.seconds, self.path, self.mechanics.strains)
        summary["questions"] = [question.text for question in self.plausibility.questions]
        if self.mechanics.muscles is not None:
            summary["muscle_groups"] = self.mechanics.muscles.groups
        summary["identity"] = self.identity
        summary["inputs"] = self.inputs
        summary["resumed_frames"] = self.resumed
        summary["unfinished_frames"] = len(self.indices) - len(self.recorder.rows)
        return Results(columns, summary, self.recorder.maps)

    def _frame(self, k: int, side: "ContactSide | None", before: "list[FrameContact]") -> None:
        contact = arrays = None
        if side is None:
            body = self.mechanics.frame(k)
        else:
            from tkamb.run.recall import contact_arrays

            body, contact = side.frame(k, before)
            before.append(contact)
            del before[:-LAST_FRAMES]
            arrays = contact_arrays(contact)
        doubts = self.plausibility.flags(k, body)
        status = frame_status(self.case, k, body, contact, doubts)
        self.recorder.record(k, frame_row(self.case, k, body, contact, self.slips, status), arrays)

    def _contact_side(self) -> "ContactSide":
        from tkamb.equilibrium.contact_side import ContactSide

        side = ContactSide(self.case, self.mechanics)
        self.seconds["prepare contact"] = side.prepare_seconds
        return side

    def _begin_maps(self, side: "ContactSide") -> None:
        labels = {
            "frame": "insert: x anterior, y superior, z lateral",
            "model": side.table.model,
            "scene_sha256": scene_hash(self.case),
        }
        self.recorder.begin_maps(side.state.points, side.state.triangles, labels)

    def _earlier(self, side: "ContactSide | None") -> "list[FrameContact]":
        """Return the last contacts of the run that is resumed."""
        earlier = self.recorder.take_earlier(self.indices)
        if side is None or not earlier:
            return []
        from tkamb.run.recall import recalled

        last = list(earlier.items())[-LAST_FRAMES:]
        return [recalled(side, self.mechanics, k, arrays) for k, arrays in last]


def _with_contact(scene: Scene, model: str | None, resolution_mm: float | None) -> Scene:
    changes = {"model": model, "resolution_mm": resolution_mm}
    changes = {key: value for key, value in changes.items() if value is not None}
    if not changes:
        return scene
    if scene.contact is None:
        raise InputError("the scene has no [contact]", "contact", "add the table to the scene")
    return scene.model_copy(update={"contact": scene.contact.model_copy(update=changes)})


def chosen_frames(frames: slice | None, count: int) -> range:
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
