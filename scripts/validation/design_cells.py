"""One cell of tables D-3 to D-6: a condyle of a design, pressed with the force in the table.

Each condyle is pressed alone, so that it carries the table's force whatever the medial-lateral
split. Inputs that the source does not publish are assumptions with a range: flexion at a percentage
of the bend, AP position of the condyle on its dish, axial rotation of the femur on the insert, and
size of the implant.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.stats import qmc

from tkamb.contact import materials
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactResult, ContactStatus
from tkamb.geometry.condyles import condyle_faces
from tkamb.geometry.frames import Array, knee_pose
from tkamb.geometry.surface import Surface
from tkamb.studies.designs.design import Design
from tkamb.units import DEGREE, MEGAPASCAL, MILLIMETRE
from validation import dissertation

Condyle = Literal["medial", "lateral"]
RANGES = {
    "flexion_start_deg": (0.0, 8.0),
    "flexion_end_deg": (95.0, 125.0),
    "ap_mm": (-4.0, 4.0),
    "axial_rotation_deg": (-8.0, 8.0),
    "mobile_axial_rotation_deg": (-2.0, 2.0),
    "size": (0.93, 1.07),
}
"""Ranges of the assumed inputs. Flexion is linear in the percentage of the bend. AP of the contact
is relative to the dish's low point. A mobile insert turns with the femur, so that the rotation
between them is small. Neighbouring sizes of a family differ by about 7 %."""


@dataclass(frozen=True)
class Assumption:
    """Assumed inputs of one knee that the source does not publish.

    Args:
        flexion_start: flexion at 0 % of the bend, rad.
        flexion_end: flexion at 100 % of the bend, rad.
        ap: distance of the contact in front of the dish's low point, m.
        axial_rotation: external rotation of the femur on the insert, rad.
        size: factor on every length of the implant.
    """

    flexion_start: float
    flexion_end: float
    ap: float
    axial_rotation: float
    size: float


@dataclass(frozen=True)
class Cell:
    """Results of a pressed condyle.

    Args:
        area: contact area, m².
        overlap: area of the undeformed insert that the femur overlaps, m²: the area in the source.
        force: contact force, N.
    """

    area: float
    overlap: float
    force: float

    @property
    def mean_pressure(self) -> float:
        """Force over contact area, Pa."""
        return self.force / self.area

    @property
    def overlap_pressure(self) -> float:
        """Force over the overlapping area, Pa: the mean pressure in the source."""
        return self.force / self.overlap


def nominal(mobile: bool = False) -> Assumption:
    """Return the middle of every range."""
    return _assumption(np.full(5, 0.5), mobile)


def assumptions(count: int, mobile: bool, seed: int = 2008) -> tuple[Assumption, ...]:
    """Return the nominal case and a Latin hypercube of `count` over the ranges."""
    sample = qmc.LatinHypercube(d=5, rng=np.random.default_rng(seed)).random(count)
    return (nominal(mobile), *(_assumption(row, mobile) for row in sample))


def _assumption(share: Array, mobile: bool) -> Assumption:
    axial = "mobile_axial_rotation_deg" if mobile else "axial_rotation_deg"
    names = ("flexion_start_deg", "flexion_end_deg", "ap_mm", axial, "size")
    start, end, ap, turn, size = (
        float(np.interp(s, (0.0, 1.0), RANGES[n])) for s, n in zip(share, names, strict=True)
    )
    return Assumption(start * DEGREE, end * DEGREE, ap * MILLIMETRE, turn * DEGREE, size)


class PressedDesign:
    """A design whose condyles are pressed one at a time; geometry is prepared once.

    Another size is the same problem in other units: with every length times s and every force
    times s², stresses stay and areas grow by s². So a size is pressed with F/s² on the size that
    was prepared, and its areas are multiplied by s².

    Args:
        design: the implant.
        resolution_mm: cell size of the lattice.
    """

    def __init__(self, design: Design, resolution_mm: float = 2.0):
        self.design = design
        self.model = contact_model("lattice", resolution=resolution_mm * 1e-3, cache=False)
        self.source_rule = contact_model(
            "lattice", resolution=resolution_mm * 1e-3, cache=False, pressure_rule="source"
        )
        self._states: dict[str, Any] = {}

    def cell(self, condyle: Condyle, percent: float, load: float, case: Assumption) -> Cell | None:
        """Press one condyle with `load` (N); None if the press fails."""
        state, square = self._prepared(condyle), case.size**2
        result = self.model.press(state, load / square, self.pose(condyle, percent, case))
        carried = result.medial or result.lateral
        if result.status is not ContactStatus.OK or carried is None:
            return None
        # the same pose with the source's rule for the area
        again = self.source_rule.evaluate(state, result.pose, result)
        overlap = again.medial or again.lateral
        if overlap is None:
            return None
        return Cell(carried.area * square, overlap.area * square, carried.force * square)

    def press_alone(
        self,
        condyle: Condyle,
        flexion: float,
        load: float,
        axial_rotation: float = 0.0,
        shift: float = 0.0,
    ) -> ContactResult:
        """Press one condyle at a flexion (rad) with `load` (N).

        The condyle is over its low point, rotated about its vertical by axial_rotation (rad) and
        moved anteriorly by shift (m).
        """
        pose = self.pose(condyle, 0.0, Assumption(flexion, flexion, 0.0, axial_rotation, 1.0))
        pose[0, 3] += shift
        return self.model.press(self._prepared(condyle), load, pose)

    def press_both(self, flexion: float, load: float) -> ContactResult:
        """Press the whole component at a flexion (rad) with `load` (N) over its low points."""
        if "both" not in self._states:
            self._states["both"] = self.model.prepare(self.whole())
        pose = self.pose("medial", 0.0, Assumption(flexion, flexion, 0.0, 0.0, 1.0))
        return self.model.press(self._states["both"], load, pose)

    def _prepared(self, condyle: Condyle) -> Any:
        if condyle not in self._states:
            self._states[condyle] = self.model.prepare(self.pair(condyle))
        return self._states[condyle]

    def pair(self, condyle: Condyle) -> ContactPair:
        """Return one condyle, cut open in the middle, and the insert, m."""
        both = self.whole()
        medial, lateral = condyle_faces(both.femoral, 0.0)
        alone = both.femoral.faces[medial if condyle == "medial" else lateral]
        used, faces = np.unique(alone, return_inverse=True)
        femoral = Surface(both.femoral.vertices[used], faces.reshape(-1, 3), "femoral")
        return replace(both, femoral=femoral)

    def whole(self) -> ContactPair:
        """Return the femoral component and the insert, m."""
        femoral, insert = (
            Surface(vertices * MILLIMETRE, faces, name)
            for name, (vertices, faces) in (
                ("femoral", self.design.femoral.mesh()),
                ("insert", self.design.insert.mesh()),
            )
        )
        material = materials.material("polyethylene")
        return ContactPair(femoral, insert, material, self.design.bearing)

    def pose(self, condyle: Condyle, percent: float, case: Assumption) -> Array:
        """Return the pose in which a condyle touches its dish `ap` in front of the low point.

        On a dish of radius R a condyle of radius r touches where the normals agree: its centre
        lies (1 - r/R) ap in front of the low point.
        """
        femoral, insert = self.design.femoral, self.design.insert
        sign, profile, dish = (
            (-1.0, femoral.profile, insert.medial_dish_radii)
            if condyle == "medial"
            else (1.0, femoral.lateral_profile, insert.lateral_dish_radii)
        )
        flexion = np.interp(percent, (0.0, 100.0), (case.flexion_start, case.flexion_end))
        radius = profile.radii[np.searchsorted(profile.joints, flexion)]
        apex = np.array([*profile.point(flexion), sign * femoral.ridge_half])
        pose = knee_pose([0.0, 0.0, 0.0, case.axial_rotation, 0.0, float(flexion)])
        apex_point = pose[:3, :3] @ apex * MILLIMETRE
        outer = dish[0] if case.ap > 0 else dish[1]
        low = insert.low_point_ap * MILLIMETRE
        pose[0, 3] = low + (1.0 - radius / outer) * case.ap / case.size - apex_point[0]
        pose[2, 3] = sign * insert.dish_half * MILLIMETRE - apex_point[2]
        return pose


def table_force(design: str, condyle: Condyle, row: int) -> float:
    """Return the table's force on a condyle, N: BW times the mass that the tables imply."""
    column = dissertation.designs().index(design)
    number = dissertation.MEDIAL_FORCE if condyle == "medial" else dissertation.LATERAL_FORCE
    weight = dissertation.implied_mass()[:, column].mean() * dissertation.GRAVITY
    return float(dissertation.table(number).mean[row, column] * weight)


def table_cell(design: str, condyle: Condyle, row: int) -> tuple[float, float]:
    """Return the table's area (mm²) and mean pressure (MPa) of a cell."""
    column = dissertation.designs().index(design)
    area, pressure = (
        (dissertation.MEDIAL_AREA, dissertation.MEDIAL_PRESSURE)
        if condyle == "medial"
        else (dissertation.LATERAL_AREA, dissertation.LATERAL_PRESSURE)
    )
    return tuple(float(dissertation.table(n).mean[row, column]) for n in (area, pressure))  # type: ignore[return-value]


def in_public_units(cells: Iterable[Cell]) -> Array:
    """Return (n, 4): area and overlap, mm², and mean pressure over each, MPa."""
    rows = [
        (
            c.area / MILLIMETRE**2,
            c.overlap / MILLIMETRE**2,
            c.mean_pressure / MEGAPASCAL,
            c.overlap_pressure / MEGAPASCAL,
        )
        for c in cells
    ]
    return np.array(rows)
