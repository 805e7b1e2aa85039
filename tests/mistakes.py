"""A test bench for mistakes: it edits a copy of a scene, and checks whether tkamb reports them.

Only the rigid-body equations of a few frames are computed. Meshes are read once, since edits change
only their positions.
"""

import csv
import hashlib
import re
import shutil
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes import MODEL, as_toml
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.errors import TkambError
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.run.plausibility.plausibility import Plausibility
from tkamb.run.read_scene import recording_of
from tkamb.run.status import frame_status

DM = MODEL.parent / "dm"
DATA = MODEL.parents[2] / "shared" / "data" / "dm"
NUMBER = re.compile(r"-?\d[\d.]*(e[+-]?\d+)?")


@dataclass(frozen=True)
class Outcome:
    """The outcome of a scene: its refusal, or questions and flags, and forces."""

    refused: str
    words: frozenset[str]
    forces: np.ndarray

    def notices(self, untouched):
        """Return whether there is a refusal, or a question or flag that the original lacks."""
        return bool(self.refused) or bool(self.words - untouched.words)

    def same(self, untouched):
        """Return whether all forces agree with the original scene to 1e-9."""
        if self.refused or self.forces.shape != untouched.forces.shape:
            return False
        return np.allclose(self.forces, untouched.forces, rtol=1e-9, atol=1e-9, equal_nan=True)


def cached(factory, store):
    """Return a factory that caches its results by its arguments."""

    def make(*arguments, **named):
        key = (factory.__name__, *map(_key, arguments), *map(_key, sorted(named.items())))
        if key not in store:
            store[key] = factory(*arguments, **named)
        return store[key]

    return make


def _key(value):
    vertices = getattr(value, "vertices", None)
    return str(value) if vertices is None else hashlib.sha1(vertices.tobytes()).hexdigest()


def keep_meshes(monkeypatch):
    """Cache meshes, their repair and their search trees."""
    store = {}
    for module, name in (
        ("tkamb.io.recordings.meshes", "load_surface"),
        ("tkamb.geometry.closest", "ClosestPointQuery"),
        ("tkamb.knee.extensor", "PatellofemoralContact"),
    ):
        place = __import__(module, fromlist=[name])
        monkeypatch.setattr(place, name, cached(getattr(place, name), store))


class Bench:
    """A scene in its own folder for repeated edits.

    Args:
        folder: folder of the scene's files.
        content: keys of the scene.
        frames: frames to compute.
    """

    def __init__(self, folder, content, frames):
        self.folder, self.content, self.frames = Path(folder), content, frames
        self.files = sorted(self.folder.glob("*"))
        self.texts = {path.name: path.read_text(encoding="utf-8") for path in self.files}
        self.untouched = self.outcome()

    def outcome(self, edit=None):
        """Return the outcome of an edit, a function of (scene content, file name -> text)."""
        content, texts = tomllib.loads(as_toml(self.content)), dict(self.texts)
        if edit is not None:
            edit(content, texts)
        for name, text in texts.items():
            path = self.folder / name
            if path.read_text(encoding="utf-8") != text:
                path.write_text(text, encoding="utf-8")
        scene = self.folder / "scene.toml"
        scene.write_text(as_toml(content), encoding="utf-8")
        try:
            return self._run(scene)
        except TkambError as error:
            return Outcome(str(error), frozenset(), np.zeros(0))

    def _run(self, scene):
        case = load_case(load_scene(scene))
        contact = case.scene.contact
        if contact is not None:  # contact is not computed, but its settings are checked
            contact_model(contact.model, resolution=contact.resolution_mm * 1e-3, **contact.options)
            material(contact.material)
        recording = recording_of(case)
        plausibility = Plausibility(case, recording)
        words = {NUMBER.sub("#", question.text) for question in plausibility.questions}
        forces = []
        for k in self.frames:
            frame = recording.loads(k)
            status = frame_status(case, k, frame, plausibility.flags(k, frame))
            flags = [] if status == "ok" else status.split("; ")
            words |= {f"{k}: {NUMBER.sub('#', word)}" for word in flags}
            values = {**frame.loads.values, **frame.geometry.tensions}
            forces += [*frame.loads.contact_force, *(values[name] for name in sorted(values))]
        return Outcome("", frozenset(words), np.array(forces))


def shipped_bench(folder):
    """Return the bench of the shipped knee with five frames."""
    for path in MODEL.iterdir():
        if path.suffix in (".csv", ".urdf"):
            shutil.copy(path, folder)
    content = tomllib.loads((MODEL / "scene.toml").read_text(encoding="utf-8"))
    for part in content["implant"].values():
        part["mesh"] = str(MODEL / part["mesh"])
    content["motion"]["frames"] = 5
    return Bench(folder, content, (0, 2, 4))


def dm_bench(folder):
    """Return the bench of subject DM without patella, for one stride."""
    shutil.copy(DM / "patient.urdf", folder)
    content = tomllib.loads((DM / "scene.toml").read_text(encoding="utf-8"))
    for name in ("patella", "quadriceps", "patellar_ligament"):
        del content[name]
    del content["implant"]["patella"]
    for part in content["implant"].values():
        part["mesh"] = str((DM / part["mesh"]).resolve())
    for table, every in (("motion", 1), ("ground_reaction", 10), ("tibia", 1)):
        path = (DM / content[table]["file"]).resolve()
        text = path.read_text(encoding="utf-8")
        (folder / path.name).write_text(text if table == "motion" else _cut(text, every))
        content[table]["file"] = path.name
    content["motion"]["frames"] = 21
    return Bench(folder, content, (4, 9, 17))


def _cut(text, every):
    """Return the header and every `every`-th row of a recording between 3 and 6.5 s."""
    header, rows, column = [], [], None
    for line in filter(str.strip, text.splitlines()):
        cells = line.split("\t") if "\t" in line else line.split()
        if column is None or not cells[0].strip().lstrip("-").replace(".", "").isdigit():
            header.append(line)
            if any(cell.strip().lower() == "time" for cell in cells):
                column = [cell.strip().lower() for cell in cells].index("time")
        elif 3.0 <= float(cells[column]) <= 6.5:
            rows.append(line)
    return "\n".join([*header, *rows[::every]]) + "\n"


def cells_of(text, separator=","):
    """Return the rows of a CSV text."""
    return list(csv.reader(text.splitlines(), delimiter=separator))


def text_of(rows, separator=","):
    """Return rows as CSV text."""
    return "\n".join(separator.join(row) for row in rows) + "\n"


def set_key(content, dotted, value):
    """Set a dotted key of the scene; None removes it."""
    *tables, key = dotted.split(".")
    for name in tables:
        content = content[int(name)] if isinstance(content, list) else content.setdefault(name, {})
    if value is None:
        content.pop(key)
    else:
        content[key] = value
