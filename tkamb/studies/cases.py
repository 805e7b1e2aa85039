"""Cases of the studies: contacts of spheres and dishes, the shipped knee, and extremes.

Bodies have a simple shape (spheres, dishes, flat blocks), or are the shipped knee at stored poses,
or the knee of a user's scene.
"""

import csv
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from tkamb.contact.materials import material
from tkamb.contact.pair import Bearing, ContactPair
from tkamb.errors import InputError
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import Array, Index, knee_pose
from tkamb.geometry.surface import Surface
from tkamb.io.given_material import given_material
from tkamb.units import DEGREE, MEGAPASCAL, MILLIMETRE

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
"""deg: flexions of the cases of a knee. A user's scene gives the nearest frames."""


@dataclass(frozen=True)
class Sphere:
    """Dimensions of a sphere on a flat layer: radius and layer thickness, m."""

    radius: float
    thickness: float


@dataclass(frozen=True, eq=False)
class StudyCase:
    """One contact problem.

    Args:
        pose: pose_femoral_in_insert, (4, 4); its y has no effect.
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

    Numbers are rounded to 1e-12 and zeros lose their sign, so that round-off has no effect.
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
    """Return two condyles of radius 22 mm, 22 mm apart, on a nonlinear insert of 8 mm."""
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
    """Copy the shipped knee bend into a folder and return its scene file."""
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


# Vertices of a ring of the condyles. A coarse mesh suffices, because all compared models use it.
SECTORS = 48


Shape = Literal["usual", "swapped", "lip", "spike", "subdivided", "slivers"]
"""Shape of the two bodies. swapped: the bodies are exchanged. lip: the insert has a steep anterior
rim of 6 mm. spike: one femoral vertex is pulled out by 3 mm. subdivided: each femoral triangle is
divided into four. slivers: one vertex of each femoral ring is moved almost onto the next."""


@dataclass(frozen=True)
class Extreme:
    """A contact problem in numbers: mm and deg.

    Args:
        load_N: force along -y, N.
        thickness_mm: thickness of the insert under the lowest points of the dishes.
        aspect: length of the insert along x, relative to the base case.
        linear: whether Hooke's law replaces Ramberg-Osgood.
        conformity: radius of the condyles over the radius of the dishes; 0: a flat insert.
        apart_mm: half the distance between the condyles; 0: a single condyle.
    """

    load_N: float = 1500.0
    thickness_mm: float = 8.0
    resolution_mm: float = 2.0
    aspect: float = 1.0
    nu: float = 0.45
    modulus_MPa: float = 561.5
    linear: bool = False
    radius_mm: float = 22.0
    waist: float = 1.0
    conformity: float = 0.65
    apart_mm: float = 11.0
    ap_mm: float = 0.0
    ml_mm: float = 0.0
    varus_deg: float = 0.0
    flexion_deg: float = 0.0
    axial_deg: float = 0.0
    bearing: Bearing = "fixed"
    rough_mm: float = 0.0
    facet_deg: float = 0.6
    shape: Shape = "usual"
    model: str = "lattice"

    @property
    def pair(self) -> ContactPair:
        """The two bodies."""
        apart, radius = self.apart_mm * MILLIMETRE, self.radius_mm * MILLIMETRE
        thick = self.thickness_mm * MILLIMETRE
        height = flat(thick)
        if self.conformity > 0:
            height = dishes(thick, radius / self.conformity, apart)
        if self.shape == "lip":
            height = _lipped(height)
        size = (26e-3 * self.aspect, 46e-3 if apart else 26e-3)
        insert = block(height, size, 1e-3)
        femoral = _roughened(
            balls(radius, apart, self.waist, self.facet_deg, SECTORS), self.rough_mm
        )
        femoral = _shaped(femoral, self.shape)
        if self.shape == "swapped":
            femoral, insert = insert, femoral.moved(insert_placement(femoral))
        name = "polyethylene-linear" if self.linear else "polyethylene"
        young = self.modulus_MPa * MEGAPASCAL
        insert_material = material(name, young_modulus=young, poisson_ratio=self.nu)
        return ContactPair(femoral, insert, insert_material, self.bearing)

    @property
    def pose(self) -> Array:
        """pose_femoral_in_insert, (4, 4)."""
        angles = np.array([self.axial_deg, self.varus_deg, self.flexion_deg]) * DEGREE
        return knee_pose([self.ap_mm * MILLIMETRE, 0.0, self.ml_mm * MILLIMETRE, *angles])

    @property
    def label(self) -> str:
        """Differences from the base case, as "load_N=1, nu=0.499"."""
        base = vars(replace(Extreme(), model=self.model))
        return ", ".join(f"{k}={v}" for k, v in vars(self).items() if v != base[k]) or "base case"


def _lipped(height: Height) -> Height:
    """Return the height with a rim of 6 mm that rises between x = 9 mm and x = 10 mm."""
    return lambda x, z: height(x, z) + 6 * MILLIMETRE * np.clip(x / MILLIMETRE - 9.0, 0.0, 1.0)


def _shaped(surface: Surface, shape: Shape) -> Surface:
    vertices, faces = surface.vertices.copy(), surface.faces
    if shape == "spike":
        vertices[np.argmin(vertices[:, 1])] -= [0.0, 3 * MILLIMETRE, 0.0]
    elif shape == "slivers":
        first = np.arange(1, len(vertices) - SECTORS - 1, SECTORS)
        vertices[first] += 0.98 * (vertices[first + 1] - vertices[first])
    elif shape == "subdivided":
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    return Surface(np.asarray(vertices), np.asarray(faces, np.int64), surface.name)


def _roughened(surface: Surface, noise_mm: float) -> Surface:
    if noise_mm == 0:
        return surface
    rng = np.random.default_rng(2008)
    vertices = surface.vertices + rng.normal(0.0, noise_mm * MILLIMETRE, surface.vertices.shape)
    return Surface(vertices, surface.faces, surface.name)


ALONE: dict[str, tuple[object, ...]] = {
    "load_N": (0.01, 1.0, 10.0, 100.0, 500.0, 3000.0, 5000.0, 8000.0, 15000.0, 50000.0),
    "thickness_mm": (0.01, 0.1, 0.5, 1.0, 2.1, 3.0, 4.0, 6.0, 12.0, 20.0, 30.0),
    "resolution_mm": (0.9, 1.3, 1.7, 2.5, 3.0, 4.0, 6.0, 9.0),
    "aspect": (0.4, 0.6, 1.5, 2.5, 4.0),
    "nu": (0.0, 0.1, 0.3, 0.4, 0.48, 0.49, 0.495, 0.499, 0.4999),
    "modulus_MPa": (0.1, 1.0, 10.0, 100.0, 2000.0, 2e4, 2e5),
    "linear": (True,),
    "radius_mm": (3.0, 6.0, 12.0, 40.0, 80.0, 300.0),
    "waist": (0.05, 0.2, 0.5, 2.0),
    "conformity": (0.0, 0.2, 0.4, 0.9, 0.95, 0.99, 0.999),
    "apart_mm": (0.0,),
    "ap_mm": (-14.0, -12.5, -10.0, -6.0, 6.0, 10.0, 12.0, 13.0, 16.0),
    "ml_mm": (-12.0, -8.0, -4.0, 4.0, 8.0, 11.5, 14.0),
    "varus_deg": (-10.0, -5.0, -2.0, -0.5, 0.1, 0.3, 1.0, 3.0, 8.0, 15.0),
    "flexion_deg": (-30.0, 30.0, 60.0, 90.0, 120.0, 160.0),
    "axial_deg": (-40.0, -15.0, 15.0, 40.0, 89.0),
    "bearing": ("mobile",),
    "rough_mm": (0.001, 0.01, 0.05, 0.1),
    "facet_deg": (0.2, 2.0, 5.0, 11.0),
    "shape": ("swapped", "lip", "spike", "subdivided", "slivers"),
}
"""Extreme values of one parameter at a time."""

TOGETHER: tuple[tuple[str, tuple[object, ...], str, tuple[object, ...]], ...] = (
    ("load_N", (10.0, 6000.0, 20000.0), "thickness_mm", (2.1, 4.0, 20.0)),
    ("load_N", (10.0, 6000.0, 20000.0), "conformity", (0.0, 0.9, 0.99, 0.999)),
    ("load_N", (10.0, 6000.0, 20000.0), "varus_deg", (0.3, 2.0, 8.0)),
    ("load_N", (10.0, 6000.0, 20000.0), "nu", (0.0, 0.3, 0.49)),
    ("load_N", (10.0, 6000.0, 20000.0), "ap_mm", (-12.5, 11.0, 13.0)),
    ("load_N", (10.0, 6000.0, 20000.0), "radius_mm", (6.0, 80.0)),
    ("load_N", (10.0, 6000.0, 20000.0), "bearing", ("mobile",)),
    ("load_N", (10.0, 6000.0, 20000.0), "rough_mm", (0.01, 0.1)),
    ("load_N", (10.0, 6000.0, 20000.0), "modulus_MPa", (10.0, 2e4)),
    ("load_N", (10.0, 6000.0), "apart_mm", (0.0,)),
    ("thickness_mm", (3.0, 20.0), "conformity", (0.0, 0.95)),
    ("thickness_mm", (3.0, 20.0), "nu", (0.0, 0.49)),
    ("thickness_mm", (3.0, 20.0), "bearing", ("mobile",)),
    ("conformity", (0.0, 0.95, 0.99), "varus_deg", (0.3, 2.0)),
    ("conformity", (0.0, 0.95, 0.99), "nu", (0.0, 0.49)),
    ("conformity", (0.0, 0.95), "rough_mm", (0.02, 0.1)),
    ("ap_mm", (-11.0, 11.0), "ml_mm", (-8.0, 8.0)),
    ("flexion_deg", (90.0, 160.0), "waist", (0.2, 0.5)),
    ("flexion_deg", (90.0, 160.0), "varus_deg", (-3.0, 3.0)),
    ("apart_mm", (0.0,), "ap_mm", (8.0, 12.0)),
    ("apart_mm", (0.0,), "conformity", (0.0, 0.99)),
    ("resolution_mm", (1.3, 3.0, 4.0), "thickness_mm", (3.0, 20.0)),
    ("resolution_mm", (1.3, 3.0, 4.0), "conformity", (0.0, 0.99)),
)
"""Extreme values of two parameters at a time."""

OTHER_MODELS = (
    *("hertz", "foundation", "foundation-linear"),
    *("lattice-linear", "lattice-source", "fe"),
)
HARDEST: tuple[dict[str, object], ...] = (
    {},
    {"load_N": 0.01},
    {"load_N": 20000.0},
    {"thickness_mm": 2.1},
    {"nu": 0.499},
    {"nu": 0.0},
    {"conformity": 0.0},
    {"conformity": 0.999},
    {"varus_deg": 8.0},
    {"ap_mm": 13.0},
    {"apart_mm": 0.0},
    {"flexion_deg": 160.0},
    {"rough_mm": 0.1},
    {"bearing": "mobile"},
    {"thickness_mm": 0.01},
    {"nu": 0.4999},
    {"shape": "swapped"},
    {"shape": "lip", "ap_mm": 8.0},
    {"shape": "spike"},
    {"shape": "subdivided"},
)
"""Extremes on which `OTHER_MODELS` are tested."""

BESIDE_CALCULIX: tuple[dict[str, object], ...] = (
    {"linear": True},
    {},
    {"linear": True, "varus_deg": 0.5},
    {"linear": True, "conformity": 0.9},
    {"linear": True, "nu": 0.3},
    {"linear": True, "load_N": 10000.0},
    {"linear": True, "thickness_mm": 4.0},
    {"linear": True, "modulus_MPa": 2000.0},
)
"""Extremes with stored results of CalculiX. `lattice` and `fe` solve them on cells of 3 mm."""


def extremes() -> Iterator[Extreme]:
    """Return all extreme cases without duplicates."""
    unique = set()
    for extreme in _all():
        if extreme not in unique:
            unique.add(extreme)
            yield extreme


def _all() -> Iterator[Extreme]:
    base = Extreme()
    yield base
    for name, values in ALONE.items():
        for value in values:
            yield replace(base, **{name: value})  # type: ignore[arg-type]
    for one, firsts, other, seconds in TOGETHER:
        for first, second in product(firsts, seconds):
            yield replace(base, **{one: first, other: second})  # type: ignore[arg-type]
    for model, changes in product(OTHER_MODELS, HARDEST):
        yield replace(base, model=model, **changes)  # type: ignore[arg-type]
    yield from beside_calculix()


def beside_calculix() -> Iterator[Extreme]:
    """Return the extreme cases with a stored result of CalculiX."""
    base = replace(Extreme(), resolution_mm=3.0)
    for changes, model in product(BESIDE_CALCULIX, ("lattice", "fe")):
        yield replace(base, model=model, **changes)  # type: ignore[arg-type]
