"""Contact problems for the studies: two bodies, a pose and a load.

Some cases have bodies of simple shape (spheres, dishes, flat blocks). Others are the shipped knee
at stored poses, or the knee of a user's scene. The last functions of the module change the
recordings of the shipped knee bend.
"""

import csv
import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index, knee_pose
from tkamb.geometry.surface import Surface
from tkamb.io.given_material import given_material
from tkamb.units import DEGREE, MILLIMETRE

Height = Callable[[Array, Array], Array]


def balls(
    radius: float,
    apart: float,
    waist: float = 1.0,
    finest_deg: float = 0.3,
    sectors: int = 96,
) -> Surface:
    """Return one or two spheroids whose lowest points are at y = -radius.

    Args:
        radius: sagittal radius of curvature at the lowest point, m.
        apart: z of the lateral centre, m; the medial one is at -apart. 0: a single spheroid.
        waist: frontal radius of curvature at the lowest point over the sagittal radius.
        finest_deg: angle between the rings of vertices near the lowest point, deg.
    """
    vertices, faces = _ball(radius, waist, finest_deg, sectors)
    if apart == 0:
        return Surface(vertices, faces, "ball")
    shift = np.array([0.0, 0.0, apart])
    condyles = np.concatenate([vertices - shift, vertices + shift])
    return Surface(condyles, np.concatenate([faces, faces + len(vertices)]), "condyles")


def block(
    height: Height, size: tuple[float, float], spacing: float = 0.5e-3, name: str = "insert"
) -> Surface:
    """Return a closed block on y = 0 whose upper surface is y = height(x, z).

    Args:
        height: height of the upper surface, m, as a function of the arrays x and z, m.
        size: lengths along x and z, m.
        spacing: distance between the vertices of the upper surface, m.
    """
    x, z = (np.linspace(-s / 2, s / 2, max(3, round(s / spacing) + 1)) for s in size)
    gx, gz = np.meshgrid(x, z, indexing="ij")
    top = np.stack([gx, np.broadcast_to(height(gx, gz), gx.shape), gz], axis=-1).reshape(-1, 3)
    number = np.arange(gx.size).reshape(gx.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    upper = np.concatenate([_corners(a, d, c), _corners(a, c, b)])
    rim = np.concatenate([number[:, 0], number[-1, 1:], number[-2::-1, -1], number[0, -2:0:-1]])
    after, n = np.roll(rim, -1), gx.size
    walls = [_corners(rim, after, after + n), _corners(rim, after + n, rim + n)]
    vertices = np.concatenate([top, top * [1.0, 0.0, 1.0]])
    return Surface(vertices, np.concatenate([upper, upper[:, ::-1] + n, *walls]), name)


def flat(thickness: float) -> Height:
    """Return the height function of a flat upper surface at `thickness`, m."""
    return lambda x, z: np.full_like(x, thickness)


def dishes(thickness: float, radius: float, apart: float, rim: float = 2e-3) -> Height:
    """Return the height function of two parabolic dishes with a flat rim; apart = 0: one dish.

    Args:
        thickness: thickness under the lowest points of the dishes, m.
        radius: radius of curvature at the lowest points, m.
        apart: z of the middle of the lateral dish, m; the medial middle is at -apart.
        rim: height of the rim above the lowest points, m.
    """

    def height(x: Array, z: Array) -> Array:
        distance = np.hypot(x, np.abs(z) - apart)
        return thickness + np.minimum(distance**2 / (2 * radius), rim)

    return height


def _corners(*numbers: NDArray[Any]) -> Index:
    return np.stack([n.ravel() for n in numbers], axis=1).astype(np.int64)


def _ball(radius: float, waist: float, finest_deg: float, sectors: int) -> tuple[Array, Index]:
    polar = np.radians(
        np.concatenate([np.arange(finest_deg, 24, finest_deg), np.linspace(24, 180, 50)[:-1]])
    )
    around = np.arange(sectors) * 2 * np.pi / sectors
    rings = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            -np.outer(np.cos(polar), np.ones(sectors)),
            np.sqrt(waist) * np.outer(np.sin(polar), np.sin(around)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = radius * np.concatenate([[[0, -1, 0]], rings, [[0, 1, 0]]])
    first = np.arange(sectors)
    second = (first + 1) % sectors
    parts = [_corners(np.zeros_like(first), 1 + first, 1 + second)]
    for row in range(len(polar) - 1):
        a, b = 1 + row * sectors, 1 + (row + 1) * sectors
        parts += [
            _corners(a + first, b + first, b + second),
            _corners(a + first, b + second, a + second),
        ]
    last = 1 + (len(polar) - 1) * sectors
    parts.append(_corners(last + first, np.full_like(first, len(vertices) - 1), last + second))
    return vertices, np.concatenate(parts)


SHIPPED_SCENE = Path(__file__).parents[2] / "models" / "deep_knee_bend" / "scene.toml"
KNEE_CASES = Path(__file__).with_name("knee_cases.json")
RECORDINGS = ("motion.csv", "tibia.csv", "ground_reaction.csv")
"""Recorded tables of the shipped knee bend."""
FLEXIONS_DEG = (15.0, 60.0, 105.0)
"""deg: flexions of the cases of a knee. A user's scene gives the frames nearest to them."""


@dataclass(frozen=True)
class Sphere:
    """Dimensions of a sphere on a flat layer: radius and layer thickness, m."""

    radius: float
    thickness: float


@dataclass(frozen=True, eq=False)
class StudyCase:
    """One contact problem.

    Args:
        pose: pose_femoral_in_insert, shape (4, 4); its y has no effect.
        load: force along -y, N.
        sphere: dimensions, if the case is a sphere on a linear layer.
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
        """Return the pose `steps` frames later.

        Each frame adds 0.06 mm posteriorly, 0.2 deg of flexion and 0.06 deg of axial rotation.
        """
        increment = np.array([-0.06 * MILLIMETRE, 0, 0, 0.06 * DEGREE, 0, 0.2 * DEGREE])
        moved = knee_pose(steps * increment)
        pose = self.pose.copy()
        pose[:3, :3] = moved[:3, :3] @ self.pose[:3, :3]
        pose[0, 3] += moved[0, 3]
        return pose


def content_hash(pair: ContactPair, arrays: Sequence[Array], words: tuple[Any, ...]) -> str:
    """Return the SHA-256 of two bodies, further arrays, and the repr of further values.

    Numbers are rounded to 1e-12 and zeros lose their sign, so that round-off does not change the
    hash.
    """
    digest = hashlib.sha256()
    meshes = [a for body in (pair.femoral, pair.insert) for a in (body.vertices, body.faces)]
    for array in (*meshes, *arrays):
        digest.update(np.ascontiguousarray(np.round(array, 12) + 0).tobytes())
    digest.update(repr(words).encode())
    return digest.hexdigest()


def case_names(scene: Path | None = None) -> tuple[str, ...]:
    """Return the names of the available cases, those of a user's scene file last."""
    names = list(_ANALYTIC)
    if SHIPPED_SCENE.exists():
        names += [f"knee {flexion:g} deg" for flexion in FLEXIONS_DEG]
    if scene is not None:
        names += [f"scene {flexion:g} deg" for flexion in FLEXIONS_DEG]
    return tuple(names)


def study_case(name: str, scene: Path | None = None) -> StudyCase:
    """Return the case with a given name; `scene` is a user's scene file."""
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
    """Return a case of two condyles of radius 22 mm, 22 mm apart, on a nonlinear insert of 8 mm."""
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
    from tkamb.run.read_scene import recording_of

    case = load_case(load_scene(path))
    table, insert = case.scene.contact, case.scene.implant.insert
    if table is None or insert is None or case.femoral is None or case.insert is None:
        raise InputError("has no [contact]", path, "the trade-off needs two bodies")
    recording = recording_of(case)
    k = int(np.argmin(np.abs(case.motion.coordinates[:, 5] - flexion * DEGREE)))
    load = float(recording.loads(k).loads.contact_force[1])
    if not load > 0:
        raise InputError(f"frame {k} has no compressive contact force", path)
    pair = ContactPair(
        case.femoral, case.insert, given_material(case.scene.insert_material), insert.bearing
    )
    label = f"{path.parent.name} at {case.motion.coordinates[k, 5] / DEGREE:.0f} deg, {load:.0f} N"
    return StudyCase(name, label, pair, recording.poses[k], load)


def copied_scene(folder: Path) -> Path:
    """Copy the shipped knee bend into a folder and return the path of the copied scene file."""
    shutil.copytree(SHIPPED_SCENE.parent, folder, dirs_exist_ok=True)
    return folder / SHIPPED_SCENE.name


def change_recording(path: Path, change: Callable[[list[str], Array], Array]) -> None:
    """Overwrite the rows (n, columns) of a .csv file with `change(column names, rows)`."""
    with open(path, encoding="utf-8", newline="") as file:
        lines = list(csv.reader(file))
    rows = change(lines[0], np.array(lines[1:], float))
    with open(path, "w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([lines[0], *([repr(float(v)) for v in row] for row in rows)])


def thin_out(folder: Path, step: int) -> None:
    """Remove all rows but every `step`-th from the recordings in a folder."""
    for name in RECORDINGS:
        change_recording(folder / name, lambda head, rows: rows[::step])


def stretch_time(folder: Path, scale: float) -> None:
    """Multiply the duration of the recordings in a folder by `scale`."""

    def stretched(head: list[str], rows: Array) -> Array:
        rows[:, head.index("time_s")] *= scale
        return rows

    for name in RECORDINGS:
        change_recording(folder / name, stretched)
