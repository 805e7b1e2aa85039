"""The cases of the studies: two bodies, a pose and a load; changes of the shipped knee bend."""

import csv
import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, knee_pose
from tkamb.io.given_material import given_material
from tkamb.studies.bodies import balls, block, dishes, flat
from tkamb.units import DEGREE, MILLIMETRE

SHIPPED_SCENE = Path(__file__).parents[2] / "models" / "deep_knee_bend" / "scene.toml"
KNEE_CASES = Path(__file__).with_name("knee_cases.json")
RECORDINGS = ("motion.csv", "tibia.csv", "ground_reaction.csv")
"""Of the shipped knee bend."""
FLEXIONS_DEG = (15.0, 60.0, 105.0)
"""deg: flexions of the cases of the shipped knee, and of a user's scene if it reaches them."""


@dataclass(frozen=True)
class Sphere:
    """A sphere on a flat layer: radius and thickness, m."""

    radius: float
    thickness: float


@dataclass(frozen=True, eq=False)
class StudyCase:
    """One contact problem.

    Args:
        name: of the case.
        label: one line.
        pair: the two bodies.
        pose: (4, 4) pose_femoral_in_insert; its y does not matter.
        load: N, along -y.
        sphere: the case as a sphere on a linear layer, if it is one.
    """

    name: str
    label: str
    pair: ContactPair
    pose: Array
    load: float
    sphere: Sphere | None = None

    @property
    def hash(self) -> str:
        """SHA-256 of bodies, material, pose and load."""
        pair = self.pair
        return content_hash(pair, [self.pose, np.array(self.load)], (pair.material, pair.bearing))

    def nearby(self, steps: float) -> Array:
        """Return the pose some frames later: each 0.06 mm back, 0.2 deg flexed, 0.06 deg turned."""
        turn = np.array([-0.06 * MILLIMETRE, 0, 0, 0.06 * DEGREE, 0, 0.2 * DEGREE])
        moved = knee_pose(steps * turn)
        pose = self.pose.copy()
        pose[:3, :3] = moved[:3, :3] @ self.pose[:3, :3]
        pose[0, 3] += moved[0, 3]
        return pose


def content_hash(pair: ContactPair, arrays: Sequence[Array], words: tuple[Any, ...]) -> str:
    """Return the SHA-256 of two bodies, further arrays, and words as they are printed.

    Numbers are rounded to 1e-12 and zeros have no sign, so that rounding does not make another
    case."""
    digest = hashlib.sha256()
    meshes = [a for body in (pair.femoral, pair.insert) for a in (body.vertices, body.faces)]
    for array in (*meshes, *arrays):
        digest.update(np.ascontiguousarray(np.round(array, 12) + 0).tobytes())
    digest.update(repr(words).encode())
    return digest.hexdigest()


def case_names(scene: Path | None = None) -> tuple[str, ...]:
    """Return the names of the cases that can be made here.

    Args:
        scene: a user's scene, whose cases come last.
    """
    names = list(_ANALYTIC)
    if SHIPPED_SCENE.exists():
        names += [f"knee {flexion:g} deg" for flexion in FLEXIONS_DEG]
    if scene is not None:
        names += [f"scene {flexion:g} deg" for flexion in FLEXIONS_DEG]
    return tuple(names)


def study_case(name: str, scene: Path | None = None) -> StudyCase:
    """Return the case of that name.

    Raises:
        InputError: no such case.
    """
    if name in _ANALYTIC:
        return _ANALYTIC[name](name)
    if name not in case_names(scene):
        raise InputError(f"no case '{name}'", hint=f"there are: {', '.join(case_names(scene))}")
    if name.startswith("knee") or scene is None:
        return _shipped(name)
    return _of_scene(name, scene, float(name.split()[1]))


def _sphere(name: str) -> StudyCase:
    sphere = Sphere(40e-3, 10e-3)
    insert = block(flat(sphere.thickness), (34e-3, 34e-3), 1e-3)
    pair = ContactPair(balls(sphere.radius, 0.0), insert, material("polyethylene-linear"))
    return StudyCase(name, "sphere of 40 mm on 10 mm, linear", pair, np.eye(4), 700.0, sphere)


def _two_condyles(name: str) -> StudyCase:
    """Return two condyles of 22 mm, 22 mm apart, on a nonlinear insert of 8 mm."""
    label, dish_radius, varus_deg = BICONDYLAR[name]
    insert = block(dishes(8e-3, dish_radius, 11e-3), (30e-3, 46e-3))
    pair = ContactPair(balls(22e-3, 11e-3), insert, material("polyethylene"))
    return StudyCase(name, label, pair, knee_pose([0, 0, 0, 0, varus_deg * DEGREE, 0]), 2000.0)


BICONDYLAR = {
    "two condyles": ("two condyles of 22 mm in dishes of 34 mm, nonlinear", 34e-3, 0.0),
    "conforming": ("two condyles of 22 mm in dishes of 24 mm, nonlinear", 24e-3, 0.0),
    "varus": ("two condyles, 0.3 deg of varus, nonlinear", 34e-3, 0.3),
}
"""Name -> label, radius of the dishes (m), varus (deg)."""
_ANALYTIC = {"sphere": _sphere, **dict.fromkeys(BICONDYLAR, _two_condyles)}


def _shipped(name: str) -> StudyCase:
    """Return a case of the shipped knee's meshes at a stored pose and load.

    Pose and load are those of the knee bend when its references were computed. They are kept when
    its motion or muscles change.
    """
    from tkamb.geometry.flat_bottom import insert_placement
    from tkamb.io.recordings.meshes import load_surface

    stored = json.loads(KNEE_CASES.read_text(encoding="utf-8"))[name]
    folder = SHIPPED_SCENE.parent
    femoral = load_surface(folder / "femoral_component.stl", "mm", name="femoral component")
    insert = load_surface(folder / "insert.stl", "mm", name="insert", closed=True)
    insert = insert.moved(insert_placement(insert))
    pair = ContactPair(femoral, insert, material(stored["material"]), stored["bearing"])
    return StudyCase(name, stored["label"], pair, np.array(stored["pose"]), stored["load_N"])


def _of_scene(name: str, path: Path, flexion: float) -> StudyCase:
    from tkamb.io.scene import load_scene
    from tkamb.io.scene.case import load_case
    from tkamb.run.mechanics import Mechanics

    case = load_case(load_scene(path))
    table, insert = case.scene.contact, case.scene.implant.insert
    if table is None or insert is None or case.femoral is None or case.insert is None:
        raise InputError("has no [contact]", path, "the trade-off needs two bodies")
    mechanics = Mechanics(case)
    k = int(np.argmin(np.abs(case.motion.coordinates[:, 5] - flexion * DEGREE)))
    load = float(mechanics.frame(k).loads.contact_force[1])
    if not load > 0:
        raise InputError(f"frame {k} has no compressive contact force", path)
    pair = ContactPair(
        case.femoral, case.insert, given_material(case.scene.insert_material), insert.bearing
    )
    label = f"{path.parent.name} at {case.motion.coordinates[k, 5] / DEGREE:.0f} deg, {load:.0f} N"
    return StudyCase(name, label, pair, mechanics.poses[k], load)


def copied_scene(folder: Path) -> Path:
    """Copy the shipped knee bend into a folder and return its scene file there."""
    shutil.copytree(SHIPPED_SCENE.parent, folder, dirs_exist_ok=True)
    return folder / SHIPPED_SCENE.name


def change_recording(path: Path, change: Callable[[list[str], Array], Array]) -> None:
    """Write a recorded table anew.

    Args:
        path: a .csv file.
        change: takes the columns' names and the rows (n, columns), returns the new rows.
    """
    with open(path, encoding="utf-8", newline="") as file:
        lines = list(csv.reader(file))
    rows = change(lines[0], np.array(lines[1:], float))
    with open(path, "w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([lines[0], *([repr(float(v)) for v in row] for row in rows)])


def thin_out(folder: Path, step: int) -> None:
    """Leave only every `step`-th row of the recordings in a folder."""
    for name in RECORDINGS:
        change_recording(folder / name, lambda head, rows: rows[::step])


def stretch_time(folder: Path, scale: float) -> None:
    """Make the recordings in a folder take `scale` times as long."""

    def stretched(head: list[str], rows: Array) -> Array:
        rows[:, head.index("time_s")] *= scale
        return rows

    for name in RECORDINGS:
        change_recording(folder / name, stretched)
