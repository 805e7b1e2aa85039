"""Reproduction of a run: verification, packs with scene and inputs, and a second computation.

Inputs are recorded under their names relative to the scene's folder, which are the same on every
machine.
"""

import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb import __version__, code_identity
from tkamb.errors import InputError
from tkamb.files import MESH_BYTES, check_replaced, sha256_of
from tkamb.run.columns import KINDS, SECONDS
from tkamb.run.identity import CODE, CONTACT_CODE, contact_code, overrides_of_run, preset_of_run
from tkamb.run.results_folder import (
    BUTTON_NAME,
    CSV_NAME,
    MAPS_NAME,
    METADATA_NAME,
    REPORT_NAME,
    SUMMARY_NAME,
    UNCERTAINTY_NAMES,
    differences,
    read_results,
    read_summary,
)

if TYPE_CHECKING:
    from tkamb.run.results import Results

INPUTS_NAME = "inputs"
"""Folder of a pack with scene and inputs."""
README_NAME = "README.txt"
RERUN_TOLERANCE = 2e-3
"""1: largest difference of a column in a second computation, as a share of its largest value or of
one unit, whichever is larger. It is the force tolerance of the lattice, the largest tolerance of
the built-in contact models: another processor may end an iteration one step earlier, which was not
studied. Measured on one x86 processor against a run with one thread, largest of all columns:

    knee bend, lattice, 5 frames: again 0, two threads 3e-7, OpenBLAS's kernels for Nehalem 2e-6,
        the lowest dependencies 3e-7, Python 3.13 with the newest dependencies 0
    knee bend, foundation, adduction released, 5 frames: two threads 0, Nehalem 2e-12
    gait with all muscles, four coordinates released, 4 frames: two threads 0, others 1e-9"""
COUNTS = ("iterations", "contact_trials", "coupling_iterations", "condition_number")
"""Columns that depend on the way of the solver, not on its result."""


@dataclass(frozen=True)
class Verdict:
    """The verification of a results folder.

    Args:
        notes: messages on other facts, such as another version of the code.
    """

    differs: tuple[str, ...]
    notes: tuple[str, ...]
    inputs: int

    def lines(self) -> list[str]:
        """Return the messages as lines of text."""
        end = f"results and {self.inputs} input file(s) have not changed since the run"
        return [*self.differs, *self.notes, *([] if self.differs else [end])]


def verify_results(directory: str | Path, inputs: str | Path | None = None) -> Verdict:
    """Compare a folder with the SHA-256 in its summary.json.

    Nothing is written.

    Args:
        inputs: folder with copies of scene and inputs, at any depth. Default: the folder `inputs`
            of a pack, if there is one, else the folder of the run.
    """
    directory = Path(directory)
    check_replaced(directory)
    summary = read_summary(directory)
    if not isinstance(summary.get("versions"), Mapping):
        raise InputError("was not written by tkamb run", directory / SUMMARY_NAME)
    changes = differences(directory, summary)
    if not isinstance(summary.get("files"), Mapping):
        changes.append("has no SHA-256: an earlier tkamb wrote it, so nothing can be checked")
    try:
        read_results(directory, check=False)
    except InputError as error:
        changes.append(str(error))
    recorded = summary.get("inputs") or {}
    folder = inputs_folder(directory, summary, inputs)
    changes += [line for name, sha in recorded.items() if (line := _input(folder / name, sha))]
    return Verdict(tuple(changes), tuple(_notes(summary)), len(recorded))


def _input(path: Path, recorded: str) -> str | None:
    path = Path(os.path.normpath(path))
    try:
        same = sha256_of(path, MESH_BYTES) == recorded  # the limit of input files
    except InputError as error:
        return f"input {error}"
    return None if same else f"input {path} has changed since it was read"


def _notes(summary: Mapping[str, Any]) -> list[str]:
    identity = summary.get("identity")
    identity = identity if isinstance(identity, Mapping) else {}
    notes, made_by = [], identity.get("version of tkamb")
    code, this = str(identity.get(CODE)), code_identity()
    if made_by != __version__ or code != this:
        notes.append(
            f"computed by other code (tkamb {made_by}, {code[:12]}; "
            f"this is {__version__}, {this[:12]})"
        )
    contact = summary.get("contact")
    if CONTACT_CODE in identity and isinstance(contact, Mapping):
        notes += _plug_in_note(str(contact.get("model")), identity[CONTACT_CODE])
    if summary.get("unfinished_frames"):
        notes.append(f"unfinished: {summary['unfinished_frames']} frames are still to be computed")
    return notes


def _plug_in_note(model: str, code: str) -> list[str]:
    try:
        same = contact_code(model) == code
    except InputError as error:
        return [f"the code of the contact model cannot be compared: {error}"]
    return [] if same else [f"computed by another code of the contact model '{model}'"]


def scene_name(summary: Mapping[str, Any]) -> str:
    """Return the file name of a run's scene."""
    if not summary.get("scene"):
        hint = "write the scene to a file and run it again"
        raise InputError("names no scene file", SUMMARY_NAME, hint)
    return str(summary["scene"]).replace("\\", "/").rpartition("/")[2]


def inputs_folder(
    directory: Path, summary: Mapping[str, Any], given: str | Path | None = None
) -> Path:
    """Return the folder of a run's scene, or of its copy below `given`."""
    packed = directory / INPUTS_NAME
    root = packed if given is None and packed.is_dir() else given
    if root is None:
        return Path(str(summary.get("scene") or "")).parent
    root, name = Path(root), scene_name(summary)
    if not root.is_dir():
        raise InputError("is no folder", root, "give the folder with scene and inputs")
    recorded = (summary.get("inputs") or {}).get(name)
    copies = sorted(root.rglob(name), key=lambda path: (len(path.parts), str(path)))
    same = [path for path in copies if path.is_file() and sha256_of(path) == recorded]
    if not same + copies:
        raise InputError(f"has no {name}", root, "give the folder with scene and inputs")
    return (same + copies)[0].parent


@dataclass(frozen=True)
class Rerun:
    """A second computation of a run.

    Args:
        columns: column -> largest difference, as a share of its largest value or of one unit.
    """

    columns: Mapping[str, float]
    statuses: int
    frames: int

    @property
    def different(self) -> list[str]:
        """Messages on columns that differ by more than the tolerance, worst first."""
        order = sorted(self.columns.items(), key=lambda item: -item[1])
        rows = [
            f"{name} differs by {100 * value:.3g} %"
            for name, value in order
            if not value <= RERUN_TOLERANCE
        ]
        return rows + ([f"the status of {self.statuses} frames differs"] if self.statuses else [])

    def line(self) -> str:
        """Return the result in one sentence."""
        worst = max(self.columns, key=lambda name: self.columns[name])
        return (
            f"computed again: {self.frames} frames, {len(self.columns)} columns, largest "
            f"difference {100 * self.columns[worst]:.2g} % ({worst}), tolerance "
            f"{100 * RERUN_TOLERANCE:g} %"
        )


def rerun(directory: str | Path, inputs: str | Path | None = None) -> Rerun:
    """Compute a run again and compare all columns with the stored ones.

    Args:
        inputs: as in `verify_results`.
    """
    from tkamb.io.scene import load_scene
    from tkamb.run.simulation import simulate

    stored = read_results(directory)
    folder = inputs_folder(Path(directory), stored.summary, inputs)
    path = folder / scene_name(stored.summary)
    scene = load_scene(path, overrides_of_run(stored.summary), preset_of_run(stored.summary))
    first, stop, step = stored.summary["identity"]["choice of frames"]
    contact = stored.summary.get("contact") or {}
    again = simulate(
        scene,
        frames=slice(first, stop, step),
        contact=contact.get("model"),
        resolution_mm=contact.get("resolution_mm"),
        scene_path=path,
    )
    return compared_runs(stored, again)


def compared_runs(stored: "Results", again: "Results") -> Rerun:
    """Return the differences of the columns of two computations of a run."""
    if len(stored) != len(again):
        what = f"has {len(stored)} frames, its scene gives {len(again)}"
        raise InputError(what, "results", "`tkamb verify` names changed inputs")
    result = {}
    for name, values in stored.columns.items():
        if KINDS.get(name) == "text" or name in COUNTS or name.endswith(SECONDS):
            continue
        other = again.columns.get(name, np.full(len(again), np.nan))
        both = np.isfinite(values) & np.isfinite(other)
        if (np.isfinite(values) != np.isfinite(other)).any():
            result[name] = float("inf")
        elif both.any():
            scale = max(1.0, float(np.abs(values[both]).max()))
            result[name] = float(np.abs(values - other)[both].max()) / scale
    changed = sum(a != b for a, b in zip(stored.status, again.status, strict=True))
    return Rerun(result, changed, len(stored))


def pack(directory: str | Path, archive: str | Path) -> int:
    """Write a results folder with its scene and inputs into one zip archive.

    In `inputs` are all files that the run read, at the same places relative to each other, so that
    the scene finds them.

    Returns:
        Number of input files.
    """
    directory, archive = Path(directory), Path(archive)
    if archive.suffix.lower() != ".zip":
        raise InputError("is not a .zip file", archive, f"give a name like {archive.stem}.zip")
    summary = read_summary(directory)
    scene_name(summary)
    changes = verify_results(directory).differs
    if changes:
        raise InputError(changes[0], directory, "`tkamb verify` lists all changes; run it again")
    folder = inputs_folder(directory, summary)
    absolute = [name for name in summary["inputs"] if os.path.isabs(name)]
    if absolute:
        hint = "write its path relative to the scene, or copy it beside the scene"
        raise InputError(
            "is named by an absolute path, which no other machine has", absolute[0], hint
        )
    files = [Path(os.path.normpath(folder / name)) for name in summary["inputs"]]
    root = Path(os.path.commonpath([path.parent for path in files]))
    own = (CSV_NAME, METADATA_NAME, SUMMARY_NAME, MAPS_NAME, BUTTON_NAME, REPORT_NAME)
    names = own + UNCERTAINTY_NAMES
    archive.parent.mkdir(parents=True, exist_ok=True)
    try:
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as target:
            target.writestr(README_NAME, README.format(version=__version__))
            for name in names:
                if (directory / name).is_file():
                    target.write(directory / name, name)
            for path in files:
                target.write(path, f"{INPUTS_NAME}/{path.relative_to(root).as_posix()}")
    except OSError as error:
        archive.unlink(missing_ok=True)
        raise InputError(f"cannot be written ({error.strerror})", archive) from None
    return len(files)


README = """Results of tkamb {version} with the scene and all files that it read (folder inputs).

    pip install tkamb=={version}
    tkamb verify .            # have results and inputs changed since the run?
    tkamb verify . --rerun    # compute again and compare all columns

summary.json names the versions of all packages. report.html shows the results.
The licence of the inputs is that of their owners.
"""


@contextmanager
def unpacked(path: str | Path) -> Iterator[Path]:
    """Provide the results folder of a path: the folder itself, or the content of a pack."""
    path = Path(path)
    if path.suffix.lower() != ".zip" or path.is_dir():
        yield path
        return
    with TemporaryDirectory(prefix="tkamb-") as folder:
        try:
            with zipfile.ZipFile(path) as archive:
                archive.extractall(folder)
        except (OSError, zipfile.BadZipFile) as error:
            raise InputError(f"cannot be read as an archive ({error})", path) from None
        yield Path(folder)
