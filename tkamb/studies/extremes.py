"""Extreme cases of the stability study: a base case with one or two extreme parameters."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
import trimesh

from tkamb.contact.materials import material
from tkamb.contact.pair import Bearing, ContactPair
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import Array, knee_pose
from tkamb.geometry.surface import Surface
from tkamb.studies.cases import Height, balls, block, dishes, flat
from tkamb.units import DEGREE, MEGAPASCAL, MILLIMETRE

# Vertices of a ring of the condyles. A coarse mesh suffices, because all compared models use it.
SECTORS = 48


Shape = Literal["usual", "swapped", "lip", "spike", "subdivided", "slivers"]
"""Shape of the two bodies. swapped: the bodies are exchanged. lip: the insert has a steep anterior
rim of 6 mm. spike: one femoral vertex is pulled out by 3 mm. subdivided: each femoral triangle is
divided into four. slivers: one vertex of each femoral ring is moved almost onto the next."""


@dataclass(frozen=True)
class Extreme:
    """A contact problem in numbers. Lengths are in mm, angles in deg.

    Args:
        load_N: force along -y, N.
        thickness_mm: thickness of the insert under the lowest points of the dishes.
        aspect: length of the insert along x, relative to the base case.
        nu: Poisson's ratio of the insert.
        modulus_MPa: Young's modulus of the insert, MPa.
        linear: whether Hooke's law replaces Ramberg-Osgood.
        conformity: radius of the condyles over the radius of the dishes; 0: a flat insert.
        apart_mm: half the distance between the condyles; 0: a single condyle.
        bearing: "fixed" or "mobile".
        shape: shape of the bodies, see `Shape`.
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
        """pose_femoral_in_insert, shape (4, 4)."""
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
