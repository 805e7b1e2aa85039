"""Geometries outside the pairs of `error_cases`, and the errors of the contact models on them.

The reference is that of the known errors: `fe` at 0.5 mm. On each geometry an error must be within
the stated one, or the press must be flagged or state "not measured".
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh

from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.geometry.frames import Array, pose
from tkamb.geometry.surface import Surface
from tkamb.run.known_errors import ContactSituation, KnownError, stated_error
from tkamb.studies.cases import block
from tkamb.studies.measures import errors, quantities
from tkamb.units import DEGREE, MILLIMETRE

Height = Callable[[Array, Array], Array]
QUANTITIES = ("approach", "force", "mean_pressure", "peak_pressure", "area")
COMPARED = (("lattice", 1.0), ("foundation", 1.0))
"""Contact models and spacings, mm."""
SIZE, SPACING = 14.0, 0.25
"""mm: edge length of the inserts, and distance of their vertices, like those of `error_cases`."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """Two bodies and a load; lengths of the functions in mm.

    Args:
        name: name in the table.
        top: height of the insert's top at x and z, mm.
        bottom: height of its bottom at x and z, mm.
        load: N.
        radius: radius of the ball, mm; a pair is the radii along x and z.
        place: x and z of the ball, mm.
        facet: angle of the ball's facets, deg.
        apart: half the distance of two balls, mm; 0: one ball.
        varus: angle of the two balls about x, deg.
        poisson_ratio: of the insert.
        cone: half the angle of a cone instead of a ball, deg from the horizontal; 0: a ball.
    """

    name: str
    top: Height
    load: float
    radius: float = 18.0
    bottom: Height = lambda x, z: np.zeros_like(x)
    place: tuple[float, float] = (0.3, 0.2)
    facet: float = 2.0
    apart: float = 0.0
    varus: float = 0.0
    poisson_ratio: float = 0.45
    cone: float = 0.0

    def pair(self) -> ContactPair:
        """Return the two bodies."""
        width = (SIZE * MILLIMETRE, (SIZE + 2 * self.apart) * MILLIMETRE)
        plate = block(_metres(self.top), width, SPACING * MILLIMETRE)
        below = plate.vertices[:, 1] < 1e-9
        x, z = plate.vertices[below, 0] / MILLIMETRE, plate.vertices[below, 2] / MILLIMETRE
        vertices = plate.vertices.copy()
        vertices[below, 1] = self.bottom(x, z) * MILLIMETRE
        insert = Surface(vertices, plate.faces, "insert")
        polyethylene = replace(material("polyethylene"), poisson_ratio=self.poisson_ratio)
        return ContactPair(self._femoral(), insert, polyethylene)

    def _femoral(self) -> Surface:
        count = round(360.0 / self.facet)
        if self.cone:
            radius, height = 8.0, 8.0 * np.tan(self.cone * DEGREE)
            mesh = trimesh.creation.cone(radius, height, sections=count)
            mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
            mesh.apply_translation([0.0, height, 0.0])
        else:
            mesh = trimesh.creation.uv_sphere(self.radius, count=[count // 2, count])
            mesh.apply_translation([0.0, self.radius, 0.0])
        vertices, faces = np.asarray(mesh.vertices) * MILLIMETRE, np.asarray(mesh.faces)
        if not self.apart:
            return Surface(vertices, faces, "ball")
        shift = np.array([0.0, 0.0, self.apart * MILLIMETRE])
        both = np.concatenate([vertices - shift, vertices + shift])
        return Surface(both, np.concatenate([faces, faces + len(vertices)]), "condyles")

    @property
    def pose(self) -> Array:
        """pose_femoral_in_insert (4, 4); its height does not matter."""
        c, s = np.cos(self.varus * DEGREE), np.sin(self.varus * DEGREE)
        x, z = np.array(self.place) * MILLIMETRE
        return pose([[1, 0, 0], [0, c, -s], [0, s, c]], [x, 0.1, z])


def _metres(height: Height) -> Height:
    return lambda x, z: MILLIMETRE * np.asarray(height(x / MILLIMETRE, z / MILLIMETRE), float)


def _level(thickness: float) -> Height:
    return lambda x, z: np.full_like(x, thickness)


def geometries() -> Iterator[Geometry]:
    """Yield the geometries."""
    yield Geometry(
        "pocket of 3 mm below", _level(6), 400.0,
        bottom=lambda x, z: 3.0 * (np.hypot(x, z) < 3.0),
    )  # fmt: skip
    yield Geometry("slot of 2 mm below", _level(6), 400.0, bottom=lambda x, z: 2.0 * (abs(x) < 2.0))
    yield Geometry(
        "hole of 1.5 mm below, 1 mm left", _level(6), 400.0,
        bottom=lambda x, z: 5.0 * (np.hypot(x - 2.0, z) < 1.5),
    )  # fmt: skip
    yield Geometry(
        "overhang", _level(6), 300.0, bottom=lambda x, z: 3.0 * (x > 2.0), place=(3.0, 0.2)
    )
    yield Geometry("free side at 4.5 mm", _level(9), 300.0, place=(2.5, 0.2))
    yield Geometry("cone of 4 deg", _level(6), 400.0, cone=4.0)
    yield Geometry(
        "groove with two radii",
        lambda x, z: 5.0 + np.where(z > 0, z**2 / 44.0, z**2 / 64.0),
        700.0,
    )
    yield Geometry("plate of 3 mm, nu 0.45", _level(3), 500.0, 30.0)
    yield Geometry("plate of 3 mm, nu 0.495", _level(3), 500.0, 30.0, poisson_ratio=0.495)
    yield Geometry("facets of 3 deg", _level(6), 400.0, facet=3.0)
    yield Geometry("facets of 6 deg", _level(6), 400.0, facet=6.0)
    yield Geometry("facets of 10 deg", _level(6), 400.0, facet=10.0)
    yield Geometry("stepped top", lambda x, z: 6.0 - 0.4 * (x > 1.0), 400.0, place=(-0.5, 0.2))
    yield Geometry("post nearby", lambda x, z: 5.0 + 4.0 * (x > 4.0), 120.0, 5.0, place=(-1.5, 0.2))
    for varus in (0.15, -0.15):
        yield Geometry(
            f"two balls, {varus:+g} deg", lambda x, z: 5.0 + (abs(z) - 6.0) ** 2 / 60.0, 700.0,
            14.0, place=(0.2, 0.4), apart=6.0, varus=varus,
        )  # fmt: skip


def reference(geometry: Geometry, spacing_mm: float = 0.5) -> dict[str, float]:
    """Return the quantities by `fe`; empty if it fails."""
    result = _pressed(geometry, "fe", spacing_mm)
    return quantities(result) if result.status is ContactStatus.OK else {}


def verdict(
    geometry: Geometry, model: str, spacing_mm: float, true: dict[str, float]
) -> dict[str, Any]:
    """Return errors, stated errors and verdict ("inside", "flagged", "not measured", "outside")."""
    result = _pressed(geometry, model, spacing_mm)
    row: dict[str, Any] = {"geometry": geometry.name, "contact": model, "mm": spacing_mm}
    if result.status is not ContactStatus.OK:
        return row | {"verdict": "refused", "why": "; ".join(result.flags)}
    found = errors(quantities(result), true)
    stated = stated_error(model, spacing_mm, "polyethylene", None, ContactSituation.of(result))
    row |= {"errors": {name: round(found[name], 4) for name in QUANTITIES}}
    if not isinstance(stated, KnownError):
        return row | {"verdict": "not measured", "why": stated}
    limits = {name: getattr(stated, name) for name in QUANTITIES}
    beyond = [name for name in QUANTITIES if found[name] > (limits[name] or 1.0)]
    word = "inside" if not beyond else "flagged" if result.flags else "outside"
    return row | {"verdict": word, "why": "; ".join([*beyond, *result.flags])}


def _pressed(geometry: Geometry, model: str, spacing_mm: float) -> Any:
    keeps = {"cache": False} if model in ("fe", "lattice") else {}
    contact = contact_model(model, resolution=spacing_mm * MILLIMETRE, **keeps)
    return contact.press(contact.prepare(geometry.pair()), geometry.load, geometry.pose)
