"""Identity of a run: hashes of scene, files and code. `case_of_results` checks it.

Two runs with the same identity compute the same numbers; it therefore includes the code of
plug-ins.
"""

import hashlib
import json
import os
import shlex
from collections.abc import Mapping
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb import __version__, code_identity
from tkamb.errors import InputError
from tkamb.files import named_files, sha256_of

if TYPE_CHECKING:
    from tkamb.io.scene import Scene
    from tkamb.io.scene.case import Case
    from tkamb.run.results import Results


GROUPS = {
    "tkamb.contact": "contact model",
    "tkamb.ligaments": "ligament law",
    "tkamb.wear": "wear law",
}
"""Group of entry points -> kind of the plug-ins of the group."""


CODE, CONTACT_CODE = "code of tkamb", "code of the contact model"
"""Keys of the identity for the hashes of tkamb and of a plug-in."""
SUFFIXES = (".py", ".so", ".pyd")


def contact_code(model: str) -> str | None:
    """Return the SHA-256 of the package of a contact model; None for a built-in model."""
    from tkamb.contact.registry import BUILT_IN, contact_class  # only where contact is modelled

    return None if model in BUILT_IN else package_code(contact_class(model).__module__)


def foreign_code(thing: object) -> str | None:
    """Return the SHA-256 of the package that defines an object's class; None for tkamb."""
    module = type(thing).__module__
    return None if module.partition(".")[0] == "tkamb" else package_code(module)


def package_code(module: str) -> str:
    """Return the SHA-256 of the package of a module: source files and compiled extensions.

    Args:
        module: dotted name. For a module without a package only its file is hashed.

    Raises:
        ImportError: there is no such package.
    """
    spec = find_spec(module.partition(".")[0])
    if spec is None:
        raise ImportError(f"no package of module '{module}'")
    digest = hashlib.sha256()
    for root in spec.submodule_search_locations or ():
        files = (path for path in Path(root).rglob("*") if path.suffix in SUFFIXES)
        for path in sorted(filter(Path.is_file, files)):
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    if spec.submodule_search_locations is None and spec.origin is not None:
        digest.update(Path(spec.origin).read_bytes())
    return digest.hexdigest()


def scene_hash(scene: "Scene") -> str:
    """Return the SHA-256 of a validated scene and of the content of all files that it names.

    A copy of scene and files in another place has the same hash.
    """
    return hashlib.sha256(json.dumps(scene_content(scene)).encode()).hexdigest()


def scene_content(scene: "Scene") -> Any:
    """Return the scene as JSON types, with the SHA-256 of the content in place of each path."""
    unused: dict[str, Any] = {"base": True, "output": {"directory"}, "wear": True}
    unused |= {} if scene.material else {"material": True}
    if scene.contact and scene.contact.patellofemoral is None:  # the hash of earlier releases
        unused["contact"] = {"patellofemoral"}
    if scene.patella and not scene.patella.released:
        unused["patella"] = {"released", "head", "ligament"}
    return _with_content(scene.model_dump(exclude=unused))


def _with_content(value: Any) -> Any:
    if isinstance(value, Path):
        files = [value, *(named_files(value) if value.suffix.lower() == ".osim" else ())]
        return [sha256_of(path) for path in files] if value.is_file() else value.name
    if isinstance(value, dict):
        return {str(key): _with_content(item) for key, item in value.items()}
    return [_with_content(one) for one in value] if isinstance(value, list | tuple) else value


def settings_hash(scene: "Scene") -> str:
    """Return the SHA-256 of a validated scene without the files that it names."""
    content = json.dumps(relative_paths(scene.model_dump(exclude={"wear", "base"}), None))
    return hashlib.sha256(content.encode()).hexdigest()


def relative_paths(value: Any, folder: Path | None) -> Any:
    """Return nested tables as JSON types, with paths relative to a folder; None: their names."""
    if isinstance(value, Path):
        return value.name if folder is None else relative_name(value, folder)
    if isinstance(value, dict):
        return {str(key): relative_paths(item, folder) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [relative_paths(item, folder) for item in value]
    return value


def relative_name(path: Path, folder: Path) -> str:
    """Return a path relative to a folder with "/"; the absolute path on another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # Windows: another drive
        return path.as_posix()


def run_identity(case: "Case", frames: range) -> dict[str, Any]:
    """Return the identity of a run: hashes of scene, files and code, frames and version."""
    identity = {
        "scene": settings_hash(case.scene),
        "content of a file": files_hash(case),
        "choice of frames": [frames.start, frames.stop, frames.step],
        "version of tkamb": __version__,
        CODE: code_identity(),
    }
    contact = case.scene.contact
    foreign = None if contact is None else contact_code(contact.model)
    return identity if foreign is None else identity | {CONTACT_CODE: foreign}


def files_hash(case: "Case") -> str:
    """Return the SHA-256 of the files that the run reads."""
    digest = hashlib.sha256()
    for path in _files_read(case):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def input_hashes(case: "Case", scene: Path | None) -> dict[str, str]:
    """Return name -> SHA-256 of the scene file, its base and all files that the run reads.

    Names are relative to the folder of the scene file, or absolute without one.
    """
    from tkamb.io.scene.scene import scene_files

    if scene is None:
        return {str(path): sha256_of(path) for path in _files_read(case)}
    folder = scene.absolute().parent
    paths = [*scene_files(scene.absolute()), *(path.absolute() for path in _files_read(case))]
    return {relative_name(path, folder): sha256_of(path) for path in paths}


def _files_read(case: "Case") -> list[Path]:
    unread = {"output"} | ({"implant"} if case.femoral is None else set())
    named = files_in(case.scene.model_dump(exclude=unread))
    models = [path for path in named if path.suffix.lower() == ".osim"]
    return [*named, *(other for path in models for other in named_files(path))]


def files_in(value: Any) -> list[Path]:
    """Return the paths of existing files in nested dictionaries and lists."""
    if isinstance(value, Path):
        return [value] if value.is_file() else []
    if isinstance(value, dict):
        value = list(value.values())
    return [p for item in value for p in files_in(item)] if isinstance(value, list | tuple) else []


RUN_AGAIN = "run it again: tkamb run"


def case_of_results(results: "Results") -> "Case":
    """Return the case of a results folder, read from the scene that its summary names."""
    from tkamb.io.scene.case import load_case

    summary = results.summary
    case, scene = load_case(_scene_of(summary)), summary.get("scene")
    same = scene_hash(case.scene) == summary.get("scene_sha256")
    if not same and same_files(case, summary):
        has_overrides = "overrides" in summary
        what = "has changed since these results were computed"
        what += "" if has_overrides else ", or was run with --set"
        raise InputError(what, scene, run_again(summary))
    if not same:
        what = "a mesh or table of the scene has changed since these results were computed"
        raise InputError(what, scene, run_again(summary))
    return case


def overrides_of_run(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted key -> value of the keys changed by `--set`."""
    return dict(summary.get("overrides") or {})


def preset_of_run(summary: Mapping[str, Any]) -> str | None:
    """Return the preset of a run; None without one."""
    preset = summary.get("preset") or {}
    return preset.get("name")


def run_again(summary: Mapping[str, Any]) -> str:
    """Return the shell command that repeats the run of a summary."""
    options = (f"{key}={json.dumps(value)}" for key, value in overrides_of_run(summary).items())
    preset = preset_of_run(summary)
    study = [] if preset is None else [f"--as {shlex.quote(preset)}"]
    changed = (f"--set {shlex.quote(one)}" for one in options)
    return " ".join([RUN_AGAIN, str(summary["scene"]), *study, *changed])


def same_files(case: "Case", summary: Mapping[str, Any]) -> bool:
    """Return whether meshes and tables are unchanged since the run; True if it stored no hash."""
    result = (summary.get("identity") or {}).get("content of a file")
    return result is None or result == files_hash(case)


def _scene_of(summary: Mapping[str, Any]) -> "Scene":
    from tkamb.io.scene import load_scene

    name = summary.get("scene")
    if not name:
        raise InputError("names no scene file", "summary", "give the scene itself to tkamb view")
    path = Path(name)
    if not os.path.exists(path):
        what = "the scene of these results does not exist"
        raise InputError(what, path, "restore the file, or run the scene again")
    contact = summary.get("contact") or {}
    used = {f"contact.{key}": value for key, value in contact.items() if value is not None}
    return load_scene(path, overrides_of_run(summary) | used, preset_of_run(summary))


def raised_in(error: BaseException) -> str | None:
    """Return the plug-in that raised an error, with the line of its code; None: no plug-in.

    Calls of other packages, such as NumPy, are ignored; the deepest remaining one raised it.
    """
    plug_ins = {
        point.value.partition(":")[0].partition(".")[0]: f"{kind} '{point.name}'"
        for group, kind in GROUPS.items()
        for point in entry_points(group=group)
    }
    result, trace = None, error.__traceback__
    while trace is not None:
        package = str(trace.tb_frame.f_globals.get("__name__")).partition(".")[0]
        if package == "tkamb":
            result = None
        elif package in plug_ins:
            file = Path(trace.tb_frame.f_code.co_filename).name
            result = f"{plug_ins[package]} ({package}, {file}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return result
