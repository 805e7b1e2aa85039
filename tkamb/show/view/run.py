"""Runs for the viewer: a results folder and its scene, or a scene that is run first."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import SIDES
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.frame import FrameStart
from tkamb.knee.patella import touching_patella
from tkamb.knee.unknowns import CondylePoint
from tkamb.run.identity import RUN_AGAIN, case_of_results, same_files, scene_hash
from tkamb.run.metrics import map_rows
from tkamb.run.read_scene import recording_of
from tkamb.run.recording import Recording
from tkamb.run.results import Results
from tkamb.run.results_folder import SUMMARY_NAME, read_results
from tkamb.run.simulation import simulate

Progress = Callable[[Iterable[int]], Iterable[int]]


@dataclass(frozen=True, eq=False)
class CaseResults:
    """A case and the results that belong to it.

    Args:
        recording: knee and motion of the case, which give the geometry of the drawing.
        frames: index of the motion's frame for each row of the results.
    """

    case: Case
    recording: Recording
    results: Results
    frames: tuple[int, ...]

    def geometries(self, progress: Progress = lambda frames: frames) -> list[KneeGeometry]:
        """Return the geometry of the knee's equations for every frame.

        The contact points of condyles and patella come from the maps of the run, or are computed
        again. If knee and contact are coupled, both are solved again, because the contact
        determines the points of action.
        """
        contact = self.case.scene.contact
        if contact is None or (contact.coupling == "none" and not contact.released):
            rows = map_rows(self.results)
            return [self._geometry(k, rows.get(row)) for row, k in enumerate(progress(self.frames))]
        result, before = list[KneeGeometry](), list[FrameStart]()
        for k in progress(self.frames):
            frame = self.recording.frame(k, before)
            result.append(frame.geometry)
            before.append(frame.next)
        return result

    def _geometry(self, k: int, row: int | None) -> KneeGeometry:
        maps, recording = self.results.maps, self.recording
        lasting = recording.muscles is None and recording.knee.patella is None
        if maps is None or row is None or not lasting:
            return recording.loads(k).geometry
        instant = recording.instant(k)
        points, normals = maps.contact_points_m[row], maps.contact_normals[row]
        condyles = {
            side: CondylePoint(point, normal, instant.sliding(instant.coordinates, point), np.nan)
            for side, point, normal in zip(SIDES, points[:2], normals[:2], strict=True)
            if np.isfinite(point).all()
        }
        if not condyles:
            return recording.loads(k).geometry
        patella = None
        if recording.extensor is not None and np.isfinite(points[2]).all():
            patella = touching_patella(recording.extensor.joints(k)[0], points[2], normals[2])
        return replace(instant.geometry(patella=patella), condyles=condyles)


@dataclass(frozen=True, eq=False)
class Source:
    """Content of a path: results and their case, or a case that has not been run.

    Args:
        results: results of the case; None: it has not been run.
        kept: folder with the results of a scene file; None: no such folder, or `path` is a folder.
    """

    path: Path
    case: Case
    results: Results | None
    kept: Path | None = None

    def __len__(self) -> int:
        """Return the number of frames that can be shown."""
        return len(self.case.motion.time if self.results is None else self.results)

    def open(
        self,
        progress: Progress = lambda frames: frames,
        announce: Callable[[str], None] = lambda line: None,
    ) -> CaseResults:
        """Return the run. It is computed first if there are no results.

        Args:
            progress: function that wraps the frame indices, for example a progress bar.
            announce: function that prints a line for the user.
        """
        if self.kept is not None:
            announce(f"results of this scene found in {self.kept}")
        results = self.results
        if results is None:
            announce("running the scene (keep its results with `tkamb run`)")
            results = simulate(self.case, scene_path=self.path, progress=progress)
        return match_frames(self.case, results)


def read_source(path: str | Path, contact: str | None = None) -> Source:
    """Return the content of a results folder or a scene file, without a run.

    If a scene's output folder has results of this scene, the source has these results.

    Args:
        path: a folder that `tkamb run` wrote, or a scene file.
        contact: contact model that replaces the scene's; only for a scene file.
    """
    path = Path(path)
    if os.path.isdir(path):
        if contact:
            raise InputError("has its own contact model", path, "give the scene to choose another")
        results = read_results(path)
        if not len(results):
            raise InputError("holds no frame", path, RUN_AGAIN)
        return Source(path, case_of_results(results), results)
    scene = load_scene(path, {"contact.model": contact} if contact else {})
    case = load_case(scene)
    folder = scene.output.directory or Path("out") / path.resolve().parent.name
    if os.path.exists(folder / SUMMARY_NAME):
        results = read_results(folder)
        same = results.summary.get("scene_sha256") == scene_hash(case.scene)
        same = same and same_files(case, results.summary)
        if same and len(results) and not results.summary.get("unfinished_frames"):
            return Source(path, case, results, folder)
    return Source(path, case, None)


def open_run(
    path: str | Path,
    *,
    contact: str | None = None,
    announce: Callable[[str], None] = lambda line: None,
) -> CaseResults:
    """Return the run of a results folder or a scene file; see `read_source` and `Source`."""
    return read_source(path, contact).open(announce=announce)


def check_frame(sources: Sequence[Source], frame: int) -> None:
    """Raise an InputError if no run has the frame. Call it before any run or drawing.

    Args:
        frame: row of the results; negative ones count from the end.
    """
    most = max(map(len, sources))
    if not -most <= frame < most:
        raise no_frame(frame, most)


def no_frame(frame: int, most: int) -> InputError:
    """Return the error for a frame that no run has. The longest run has `most` frames."""
    return InputError(f"there is no frame {frame}", "frame", f"give one of 0 to {most - 1}")


def match_frames(case: Case, results: Results) -> CaseResults:
    """Return the run of a case and its results, with the frames matched by time."""
    frame_at = {float(time): k for k, time in enumerate(case.motion.time)}
    try:
        frames = tuple(frame_at[float(time)] for time in results["time_s"])
    except KeyError as error:
        raise InputError(
            f"no frame at {error.args[0]} s in the scene's motion", "results", RUN_AGAIN
        ) from None
    return CaseResults(case, recording_of(case, near=True), results, frames)


def run_of_results(results: Results) -> CaseResults:
    """Return the run of results. The scene is read from the path in their summary."""
    return match_frames(case_of_results(results), results)
