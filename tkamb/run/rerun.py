"""The case that results came from: their scene read anew, if it is still what was run."""

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb.errors import InputError
from tkamb.io.scene import Scene, load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.run.summary import files_hash, scene_hash

if TYPE_CHECKING:
    from tkamb.run.results import Results

RUN_AGAIN = "run it again: tkamb run"


def case_of_results(results: "Results") -> Case:
    """Return the case of results, whose summary names the scene.

    Raises:
        InputError: the scene is not there, or no longer what was run.
    """
    summary = results.summary
    case, scene = load_case(_scene_of(summary)), summary.get("scene")
    if scene_hash(case) != summary.get("scene_sha256"):
        has_overrides = "overrides" in summary
        what = "has changed since these results were computed"
        what += "" if has_overrides else ", or was run with --set"
        raise InputError(what, scene, run_again(summary))
    if not same_files(case, summary):
        what = "a mesh or table that it names has changed since these results were computed"
        raise InputError(what, scene, run_again(summary))
    return case


def overrides_of_run(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted key -> value that the run's scene had in the place of its file's."""
    return dict(summary.get("overrides") or {})


def preset_of_run(summary: Mapping[str, Any]) -> str | None:
    """Return the name of the preset that was laid over the run's scene, if any."""
    preset = summary.get("preset") or {}
    return preset.get("name")


def run_again(summary: Mapping[str, Any]) -> str:
    """Return the command that computes results like these, for a shell."""
    options = (f"{key}={json.dumps(value)}" for key, value in overrides_of_run(summary).items())
    preset = preset_of_run(summary)
    study = [] if preset is None else [f"--as {shlex.quote(preset)}"]
    changed = (f"--set {shlex.quote(one)}" for one in options)
    return " ".join([RUN_AGAIN, str(summary["scene"]), *study, *changed])


def same_files(case: Case, summary: Mapping[str, Any]) -> bool:
    """Say whether meshes and tables hold what the run read; a run without a record counts."""
    result = (summary.get("identity") or {}).get("content of a file")
    return result is None or result == files_hash(case)


def _scene_of(summary: Mapping[str, Any]) -> Scene:
    """Return the scene of results, with the contact model they were run with."""
    name = summary.get("scene")
    if not name:
        raise InputError("names no scene file", "summary", "give the scene itself to tkamb view")
    path = Path(name)
    if not path.exists():
        what = "the scene of these results is not there"
        raise InputError(what, path, "put it back, or run it again")
    contact = summary.get("contact") or {}
    used = {f"contact.{key}": value for key, value in contact.items() if value is not None}
    return load_scene(path, overrides_of_run(summary) | used, preset_of_run(summary))
