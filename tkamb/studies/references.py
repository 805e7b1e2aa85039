"""Converged references: the limit of refined grids, stored with the case's hash.

Finite elements and the lattice are solved to a tolerance of 1e-6 on ever finer grids; their
common limit is the reference, and where they disagree is its uncertainty. Areas jump from
node to node without order: theirs, and mean pressures, are the average of the two finest
grids. On the linear sphere the limit is checked against the elastic layer's solution.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tkamb.contact.model import ContactStatus
from tkamb.contact.registry import contact_model
from tkamb.errors import ComputationError, InputError
from tkamb.output.atomic import write_text
from tkamb.studies.cases import StudyCase
from tkamb.studies.quantities import (
    Quantities,
    Raster,
    common_limit,
    quantities,
    raster_map,
    raster_of,
)
from tkamb.units import MILLIMETRE

STORED = Path(__file__).with_name("references.json")
FAMILIES = ("fe", "lattice")
GRIDS_MM = (1.5, 1.25, 1.0, 0.8)
LARGE_GRIDS_MM = (2.0, 1.5, 1.25, 1.0)
LARGE = 2e-5
"""m³: of an insert's bounding box from which on the coarser grids must do."""
TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Reference:
    """The converged answer of a case.

    Args:
        hash: of the case.
        values: approach (m), condyles' forces (N), pressures (Pa) and areas (m²).
        uncertainty: of each, same units.
        grids_mm: cell sizes that went into it.
        solved: what each grid gave: "fe 1 mm" -> values.
        map: "i j" -> Pa, pressure of the finest finite elements on a raster of 1 mm.
    """

    hash: str
    values: Quantities
    uncertainty: Quantities
    grids_mm: tuple[float, ...]
    solved: dict[str, Quantities]
    map: dict[str, float]

    @property
    def raster(self) -> Raster:
        """The map by raster place."""
        return raster_of(self.map)


def compute_reference(case: StudyCase, grids_mm: tuple[float, ...] | None = None) -> Reference:
    """Solve a case on refined grids and return their common limit.

    Args:
        case: the case.
        grids_mm: cell sizes; default by the size of the insert.

    Raises:
        ComputationError: a grid did not converge.
    """
    if grids_mm is None:
        large = float(np.prod(np.ptp(case.pair.insert.vertices, axis=0))) > LARGE
        grids_mm = LARGE_GRIDS_MM if large else GRIDS_MM
    solved: dict[str, Quantities] = {}
    finest: dict[str, float] = {}
    for family in FAMILIES:
        for grid in grids_mm:
            model = contact_model(family, grid, tolerance=TOLERANCE, cache=False)
            result = model.press(model.prepare(case.pair), case.load, case.pose)
            if result.status is not ContactStatus.OK:
                why = "; ".join(result.flags)
                raise ComputationError(f"reference {family} {grid:g} mm: {why}", case.name)
            solved[f"{family} {grid:g} mm"] = quantities(result)
            if family == "fe" and grid == min(grids_mm):
                finest = {f"{i} {j}": round(p, -2) for (i, j), p in raster_map(result).items()}
    values, uncertainty = _limits(solved)
    return Reference(case.hash, values, uncertainty, grids_mm, solved, finest)


def _limits(solved: dict[str, Quantities]) -> tuple[Quantities, Quantities]:
    h = np.array([float(name.split()[1]) for name in solved]) * MILLIMETRE
    family = np.array([FAMILIES.index(name.split()[0]) for name in solved])
    values, uncertainty = {}, {}
    for name in next(iter(solved.values())):
        series = np.array([row[name] for row in solved.values()])
        if name.endswith(("area", "mean_pressure")):
            fine = series[h <= np.unique(h)[:2].max()]
            values[name], uncertainty[name] = float(fine.mean()), float(np.ptp(fine) / 2)
        else:
            values[name], uncertainty[name] = common_limit(h, series, family)
    return values, uncertainty


def read_references(path: Path = STORED) -> dict[str, Reference]:
    """Return case name -> reference of a stored file; nothing if there is no file.

    Raises:
        InputError: the file is not one of references.
    """
    if not path.exists():
        return {}
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {
            name: Reference(**{**entry, "grids_mm": tuple(entry["grids_mm"])})
            for name, entry in stored.items()
        }
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"is no file of references ({error})", path, "use --recompute") from None


def write_references(references: dict[str, Reference], path: Path) -> None:
    """Store references."""
    content = {name: asdict(reference) for name, reference in references.items()}
    text = json.dumps(content, indent=1, default=float)
    write_text(path, text + "\n")


def reference_of(case: StudyCase, stored: dict[str, Reference]) -> Reference:
    """Return the stored reference of a case.

    Raises:
        InputError: there is none, or the case has changed since.
    """
    found = stored.get(case.name)
    if found is None or found.hash != case.hash:
        word = "is missing" if found is None else "belongs to an earlier version of the case"
        raise InputError(f"the reference {word}", f"case '{case.name}'", "use --recompute")
    return found
