"""The cohort file: subjects, trials, designs and contact models, and the runs that they define.

It is a TOML file with paths relative to its folder, and an unknown key is an error. Every run is
the scene of a trial with overrides, like those of `tkamb run --set`.
"""

import hashlib
import itertools
import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator
from tqdm import tqdm

from tkamb.errors import InputError, names_near
from tkamb.files import sha256_of
from tkamb.io.recordings.recording_tables import Count, Number, SceneTable
from tkamb.io.scene import Scene, load_scene
from tkamb.io.toml_text import read_toml
from tkamb.run.identity import files_in, scene_hash
from tkamb.run.simulation import frames_slice

AXES = ("subject", "trial", "design", "contact")
GROUP_AXES = ("activity", *AXES[1:])
MOST_RUNS = 20_000
"""Largest number of runs; reading a scene takes 5 ms and a run a minute."""
Name = Annotated[str, Field(pattern=r"^[\w .+-]{1,60}$")]
Overrides = Annotated[
    dict[str, Any],
    Field(default_factory=dict, description="dotted key of the scene -> value, as in --set"),
]


class SubjectTable(SceneTable):
    """One subject: changes of the trials' scenes for this subject."""

    name: Name
    scale: Annotated[Number, Field(ge=0.7, le=1.4)] = Field(
        1.0, description="[patient] scale, for a synthetic subject of the same shape"
    )
    set: Overrides


class TrialTable(SceneTable):
    """One recording: the scene that uses it."""

    name: Name
    scene: Path
    activity: Name | None = Field(
        None, description="activity, by which runs can be grouped; default: the trial's name"
    )
    subjects: tuple[Name, ...] = Field(
        (), description="subjects who performed the trial; default: all"
    )
    set: Overrides


class DesignTable(SceneTable):
    """One implant: its meshes and other overrides."""

    name: Name
    femoral: Path | None = Field(None, description="mesh of the femoral component")
    insert: Path | None = Field(None, description="mesh of the insert")
    bearing: Literal["fixed", "mobile"] | None = None
    factors: dict[Name, Name] = Field(
        default_factory=dict,
        description="design parameter -> its value, for the figure of designs: the first parameter "
        "is on the horizontal axis, the others are in the legend",
    )
    scenes: dict[Name, Path] = Field(
        default_factory=dict,
        description="trial -> scene file that replaces the trial's scene for this implant",
    )
    set: Overrides


class ContactModelTable(SceneTable):
    """One contact model."""

    name: Name
    model: str | None = Field(
        None, description="contact model, as in `tkamb contact list`; default: the name"
    )
    resolution_mm: Annotated[Number, Field(gt=0)] | None = None
    set: Overrides


class CohortWearTable(SceneTable):
    """Wear of the insert of every run under the motion of that run.

    The closing of the cycle, the wear material and the wear law are those of [wear] in the scene.
    """

    cycles: Annotated[Count, Field(ge=1, le=10**9)] = 1_000_000
    updates: Annotated[Count, Field(ge=1, le=1000)] = Field(
        2, description="number of updates of the worn geometry"
    )
    frames_per_cycle: Annotated[Count, Field(ge=2, le=1000)] = 40


class CohortTable(SceneTable):
    """The cohort file.

    Its axes are subject, trial, design and contact. An axis without entries changes nothing.
    """

    title: str = "Cohort"
    frames: str = Field(":", description="frames of every trial, as a Python slice A:B:STEP")
    group_by: tuple[Literal["activity", "trial", "design", "contact"], ...] = Field(
        (), description="labels of a group; default: axes with more than one entry, except subject"
    )
    bin_deg: Annotated[Number, Field(ge=1, le=180)] = Field(
        10.0, description="width of a flexion bin"
    )
    map_flexion_deg: Annotated[Number, Field(ge=-30, le=170)] | None = Field(
        None,
        description="flexion of the frame that gives the pressure map; default: the frame of the "
        "largest force of each run",
    )
    wear: CohortWearTable | None = Field(
        None, description="wear in runs.csv and groups.csv; without this table it is not computed"
    )
    set: Overrides
    subject: tuple[SubjectTable, ...] = ()
    trial: Annotated[tuple[TrialTable, ...], Field(min_length=1)]
    design: tuple[DesignTable, ...] = ()
    contact: tuple[ContactModelTable, ...] = ()

    @model_validator(mode="after")
    def _names(self) -> Self:
        for axis in AXES:
            counts = Counter(entry.name for entry in getattr(self, axis))
            duplicates = sorted(name for name, count in counts.items() if count > 1)
            if duplicates:
                raise ValueError(f"[[{axis}]] has two entries called '{duplicates[0]}'")
        # A dictionary keeps the order of the file and makes the look-up fast.
        subjects = {entry.name: None for entry in self.subject}
        for trial in self.trial:
            for name in trial.subjects:
                if name not in subjects:
                    near = names_near(name, subjects)
                    raise ValueError(f"no subject '{name}' for trial '{trial.name}'; {near}")
        trials = [entry.name for entry in self.trial]
        for design in self.design:
            for name in design.scenes:
                if name not in trials:
                    near = names_near(name, trials)
                    raise ValueError(f"no trial '{name}' for design '{design.name}'; {near}")
        return self


@dataclass(frozen=True, eq=False)
class CohortRun:
    """One run of a cohort.

    Args:
        number: number in the table of runs, from 0.
        labels: "subject", "trial", "activity", "design", "contact" -> name; "" for an axis without
            entries.
        overrides: dotted key of the scene -> value.
    """

    number: int
    labels: dict[str, str]
    scene_path: Path
    overrides: dict[str, Any]
    scene: Scene

    @cached_property
    def scene_hash(self) -> str:
        """Return the SHA-256 of the scene and its files, as in summary.json."""
        return scene_hash(self.scene)

    def words(self) -> str:
        """Return the labels in one line."""
        return ", ".join(self.labels[axis] for axis in AXES if self.labels[axis])


@dataclass(frozen=True, eq=False)
class Cohort:
    """A cohort file and the runs that it defines.

    Args:
        runs: all runs, sorted by subject, trial, design and contact in the order of the file.
    """

    path: Path
    table: CohortTable
    runs: tuple[CohortRun, ...]

    @property
    def group_by(self) -> tuple[str, ...]:
        """Return the labels by which runs are grouped."""
        if self.table.group_by:
            return self.table.group_by
        varied = [a for a in GROUP_AXES if len({run.labels[a] for run in self.runs}) > 1]
        if "activity" in varied and "trial" in varied:  # trials of one activity are one group
            varied.remove("trial")
        return tuple(varied)

    @property
    def frames(self) -> slice:
        """Return the slice of the frames of every trial."""
        return _slice(self.table.frames, self.path)

    def identity(self) -> dict[str, Any]:
        """Return the inputs that identify the results of a cohort, without the code."""
        runs = [[run.labels, run.scene_hash] for run in self.runs]
        files = sorted({path for run in self.runs for path in files_in(run.scene.model_dump())})
        return {
            "table of runs": hashlib.sha256(json.dumps(runs).encode()).hexdigest(),
            "content of a file": {str(path): sha256_of(path) for path in files},
            "choice of frames": self.table.frames,
            "choice of maps": self.table.map_flexion_deg,
            **self._wear_identity(),
        }

    def _wear_identity(self) -> dict[str, Any]:
        wear = self.table.wear
        if wear is None:
            return {}
        tables = [run.scene.wear and run.scene.wear.model_dump(mode="json") for run in self.runs]
        return {"wear": [wear.model_dump(mode="json"), tables]}


def load_cohort(path: str | Path, frames: str | None = None) -> Cohort:
    """Read a cohort file and the scenes of its runs, but no meshes and recordings."""
    path = Path(path)
    content = read_toml(path, what="cohort file")
    if frames is not None:
        content["frames"] = frames
    try:
        table = CohortTable.model_validate(content)
    except ValidationError as error:
        raise _complaint(error, path) from None
    _slice(table.frames, path)
    return Cohort(path, table, tuple(_runs(table, path)))


def _runs(table: CohortTable, path: Path) -> list[CohortRun]:
    axes: list[Sequence[Any]] = [getattr(table, axis) or (None,) for axis in AXES]
    count = math.prod(map(len, axes))
    if count > MOST_RUNS:
        raise InputError(f"makes {count} runs, more than {MOST_RUNS}", path, "split it")
    result: list[CohortRun] = []
    each = tqdm(itertools.product(*axes), "reading scenes", count, unit="scene", disable=None)
    for subject, trial, design, contact in each:
        if trial.subjects and (subject is None or subject.name not in trial.subjects):
            continue
        labels = {
            "subject": subject.name if subject else "",
            "trial": trial.name,
            "activity": trial.activity or trial.name,
            "design": design.name if design else "",
            "contact": contact.name if contact else "",
        }
        overrides = dict(table.set)
        for entry in (trial, subject, design, contact):
            overrides |= _overrides(entry, path.parent)
        design_scene = design.scenes.get(trial.name) if design else None
        scene_path = path.parent / (design_scene or trial.scene)
        scene = _scene(scene_path, overrides, labels, path)
        result.append(CohortRun(len(result), labels, scene_path, overrides, scene))
    if not result:
        raise InputError(
            "makes no run", path, "give every subject at least one trial in [[trial]] subjects"
        )
    return result


def _scene(
    scene_path: Path, overrides: dict[str, Any], labels: dict[str, str], path: Path
) -> Scene:
    try:
        return load_scene(scene_path, overrides)
    except InputError as error:
        what = f"{' × '.join(filter(None, labels.values()))}: {error}"
        raise InputError(what, path) from None


def _overrides(entry: Any, folder: Path) -> dict[str, Any]:
    if entry is None:
        return {}
    result: dict[str, Any] = {}
    if isinstance(entry, SubjectTable) and entry.scale != 1.0:
        result["patient.scale"] = entry.scale
    if isinstance(entry, DesignTable):
        meshes = {"femoral": entry.femoral, "insert": entry.insert}
        result |= {
            f"implant.{part}.mesh": str((folder / mesh).absolute())
            for part, mesh in meshes.items()
            if mesh is not None
        }
        result |= {} if entry.bearing is None else {"implant.insert.bearing": entry.bearing}
    if isinstance(entry, ContactModelTable):
        result["contact.model"] = entry.model or entry.name
        if entry.resolution_mm is not None:
            result["contact.resolution_mm"] = entry.resolution_mm
    return result | entry.set


def _slice(text: str, path: Path) -> slice:
    try:
        return frames_slice(text)
    except ValueError as error:
        raise InputError(f"'frames': {error}", path) from None


def _complaint(error: ValidationError, path: Path) -> InputError:
    rank = {"extra_forbidden": 0, "missing": 2}
    first = min(error.errors(), key=lambda detail: rank.get(detail["type"], 1))
    key = ".".join(str(part) for part in first["loc"])
    if {detail["loc"][:1] for detail in error.errors()} >= {("motion",), ("implant",)}:
        return InputError("is a scene, not a cohort", path, "docs/cohort.md shows a cohort file")
    if first["type"] == "extra_forbidden":
        near = names_near(str(first["loc"][-1]), _keys_beside(first["loc"]))
        return InputError(f"unknown key '{key}'", path, f"remove it, or rename it: {near}")
    if first["type"] == "missing":
        return InputError(f"missing key '{key}'", path, "add it")
    message = first["msg"].removeprefix("Value error, ")
    return InputError(f"'{key}': {message}" if key else message, path)


def _keys_beside(location: tuple[int | str, ...]) -> list[str]:
    """Return the keys allowed beside an unknown one."""
    tables: dict[int | str, type[SceneTable]] = {
        "subject": SubjectTable,
        "trial": TrialTable,
        "design": DesignTable,
        "contact": ContactModelTable,
        "wear": CohortWearTable,
    }
    table = tables.get(location[0], CohortTable) if len(location) > 1 else CohortTable
    return list(table.model_fields)
