"""Design file: the published dimensions of one implant, and the meshes made from them.

The keys are the fields of `FemoralComponent`, `Cam`, `Insert` and `Post`, each with its unit as
suffix.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.optimize import brentq

from tkamb.contact.pair import Bearing
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, knee_pose
from tkamb.io.toml_text import read_toml
from tkamb.studies.designs import solids
from tkamb.studies.designs.femoral import Cam, FemoralComponent
from tkamb.studies.designs.insert import Insert, Post

MEDIAL, LATERAL = -1.0, 1.0
PHI_REACH, Z_REACH = np.radians(30.0), 9.0
"""rad, mm: half the size of the search area."""


# Number of times that the search area around the lowest point of a condyle is halved.
# 18 leave 4e-6 of the area's size.
HALVINGS = 18
# rad: largest difference of the adduction from the initial guess. Both condyles
# touch within it.
LARGEST_ADDUCTION = 0.04


@dataclass(frozen=True)
class TouchingPose:
    """Pose at which both condyles touch: SI position, mm, adduction, rad, and the medial and
    lateral contact point in the insert frame, mm, (2, 3)."""

    si: float
    adduction: float
    points: Array


@dataclass(frozen=True)
class Articulation:
    """A femoral component on an insert, as analytic surfaces without a mesh."""

    femoral: FemoralComponent
    insert: Insert

    def lowest(self, pose: Array, flexion: float, side: float) -> tuple[float, Array]:
        """Return the smallest vertical gap under a condyle, mm, and the insert point (3,) there.

        Args:
            pose: pose_femoral_in_insert, mm, (4, 4).
            flexion: flexion, rad; the search begins at this angle of the femoral normal.
        """
        phi, z = flexion, side * self.femoral.ridge_half
        reach = np.array([PHI_REACH, Z_REACH])
        step = np.linspace(-1.0, 1.0, 9)
        for _ in range(HALVINGS):
            phis = np.clip(phi + reach[0] * step[:, None], *self.femoral.profile.range)
            zs = z + reach[1] * step[None, :]
            points = self.femoral.surface(phis, zs) @ pose[:3, :3].T + pose[:3, 3]
            gaps = points[..., 1] - self.insert.height(points[..., 0], points[..., 2])
            row, column = np.unravel_index(np.argmin(gaps), gaps.shape)
            phi, z = phis[row, 0], zs[0, column]
            reach = reach * 0.5
        gap, point = float(gaps[row, column]), points[row, column]
        return gap, np.array([point[0], point[1] - gap, point[2]])

    def touch(
        self, ap: float, ml: float, axial_rotation: float, flexion: float, guess: float = 0.0
    ) -> TouchingPose:
        """Return the pose at which both condyles touch, at an AP and ML position, mm, and angles,
        rad.

        Args:
            guess: initial guess of the adduction, rad.
        """

        def pose(adduction: float) -> Array:
            return knee_pose([ap, 0.0, ml, axial_rotation, adduction, flexion])

        def difference(adduction: float) -> float:
            femoral = pose(adduction)
            gaps = [self.lowest(femoral, flexion, side)[0] for side in (LATERAL, MEDIAL)]
            return gaps[0] - gaps[1]

        bounds = guess - LARGEST_ADDUCTION, guess + LARGEST_ADDUCTION
        adduction = brentq(difference, *bounds, xtol=1e-12)
        femoral = pose(adduction)
        medial, lateral = (self.lowest(femoral, flexion, side) for side in (MEDIAL, LATERAL))
        return TouchingPose(
            -(medial[0] + lateral[0]) / 2.0, adduction, np.stack([medial[1], lateral[1]])
        )


DESIGN_FILE = "design.toml"
FEMORAL_MESH, INSERT_MESH, TRAY_MESH = "femoral_component.stl", "insert.stl", "tray.stl"
CAM_MESH = "femoral_component_with_cam.stl"
_Part = TypeVar("_Part", FemoralComponent, Cam, Insert, Post)


@dataclass(frozen=True)
class Design:
    """One implant.

    Args:
        symmetric: whether both condyles have the same J-curve.
        articulation: femoral component and insert, mm.
        sources: group of dimensions -> its source.
    """

    name: str
    title: str
    bearing: Bearing
    symmetric: bool
    articulation: Articulation
    sources: Mapping[str, str]

    @property
    def femoral(self) -> FemoralComponent:
        """The femoral component."""
        return self.articulation.femoral

    @property
    def insert(self) -> Insert:
        """The insert."""
        return self.articulation.insert

    def write_meshes(self, folder: Path) -> tuple[Path, ...]:
        """Write the parts as binary STL files in mm and return the paths.

        A femoral component with a cam is written with and without it.
        """
        folder.mkdir(parents=True, exist_ok=True)
        meshes = {
            FEMORAL_MESH: self.femoral.mesh(),
            INSERT_MESH: self.insert.mesh(),
            TRAY_MESH: self.insert.tray(),
        }
        if self.femoral.cam is not None:
            meshes[CAM_MESH] = self.femoral.mesh_with_cam()
        for name, (vertices, faces) in meshes.items():
            solids.write_stl(folder / name, vertices, faces)
        return tuple(folder / name for name in meshes)


def load_design(folder: str | Path) -> Design:
    """Read design.toml of a folder."""
    file = Path(folder) / DESIGN_FILE
    rows = read_toml(file, what="design file")
    unknown = set(rows) - {"title", "bearing", "femoral", "cam", "insert", "post", "sources"}
    if unknown:
        raise InputError(f"unknown key '{min(unknown)}'", file, "see models/designs/README.md")
    bearing = rows.get("bearing", "fixed")
    if bearing not in ("fixed", "mobile"):
        raise InputError(f"'{bearing}' is not a bearing", file, "give fixed or mobile")
    post = _part(Post, rows["post"], file) if "post" in rows else None
    cam = _part(Cam, rows["cam"], file) if "cam" in rows else None
    femoral = _part(FemoralComponent, {**rows.get("femoral", {}), "cam": cam}, file)
    insert = _part(Insert, {**rows.get("insert", {}), "post": post}, file)
    return Design(
        name=Path(folder).resolve().name,
        title=str(rows.get("title", Path(folder).name)),
        bearing=bearing,
        symmetric=femoral.medial_arcs == femoral.lateral_arcs,
        articulation=Articulation(femoral, insert),
        sources=rows.get("sources", {}),
    )


UNITS = ("_deg_mm", "_deg", "_mm")


def _part(kind: type[_Part], table: Mapping[str, Any], file: Path) -> _Part:
    names = {field.name for field in fields(kind)}
    values = {}
    for key, value in table.items():
        unit = next((u for u in UNITS if key.endswith(u)), "")
        name = key.removesuffix(unit)
        if name not in names or (not unit and name not in ("cam", "post")):
            raise InputError(
                f"unknown key '{key}'", file, f"keys, before the unit: {', '.join(sorted(names))}"
            )
        values[name] = _tuples(value)
    if "medial_arcs" in values:
        values.setdefault("lateral_arcs", values["medial_arcs"])
    if "medial_dish_radii" in values:
        values.setdefault("lateral_dish_radii", values["medial_dish_radii"])
    try:
        return kind(**values)
    except TypeError as error:
        raise InputError(f"{kind.__name__}: {error}", file, "give the missing keys") from None


def _tuples(value: Any) -> Any:
    return tuple(_tuples(x) for x in value) if isinstance(value, list) else value
