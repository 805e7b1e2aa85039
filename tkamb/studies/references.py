"""Converged references: the limit of refined grids, stored with the case's hash.

A sphere on a linear layer has the elastic layer's solution. Elsewhere finite elements and the
lattice are solved to a tolerance of 1e-6 on ever finer grids. Approach and forces are their
common limit (Richardson); peak pressures and areas jump from node to node without order: theirs
are the average of the two finest grids. The uncertainty is the largest of three numbers: the
residual of the fit, the disagreement of the two families, and the distance between limit and
finest grids (half of it where the finest grids are the reference).
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.errors import ComputationError, InputError
from tkamb.files import write_text
from tkamb.geometry.frames import Array
from tkamb.studies.cases import Sphere, StudyCase
from tkamb.studies.elastic_layer import sphere_on_layer
from tkamb.studies.quantities import (
    Quantities,
    Raster,
    quantities,
    raster_map,
    raster_of,
)
from tkamb.units import MILLIMETRE

STORED = Path(__file__).with_name("references.json")
FAMILIES = ("fe", "lattice")
GRIDS_MM = (1.5, 1.25, 1.0, 0.8)
LARGE_GRIDS_MM = (2.0, 1.5, 1.25, 1.0)


@dataclass(frozen=True)
class ReferenceSettings:
    """How the studies' reference solutions are computed."""

    large_volume: float = 2e-5
    """m³: volume of an insert's bounding box from which only the coarser grids are used. Chosen:
    finer grids of it do not fit into memory."""
    tolerance: float = 1e-6
    """Relative tolerance of the reference solutions. Chosen: far below what is compared."""
    width_effect: float = 0.005
    """Relative difference of a block 3.4 times as wide as high from an endless layer. Computed."""


REFERENCE = ReferenceSettings()


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
        large = float(np.prod(np.ptp(case.pair.insert.vertices, axis=0))) > REFERENCE.large_volume
        grids_mm = LARGE_GRIDS_MM if large else GRIDS_MM
    solved: dict[str, Quantities] = {}
    finest: dict[str, float] = {}
    for family in FAMILIES:
        for grid in grids_mm:
            model = contact_model(family, grid, tolerance=REFERENCE.tolerance, cache=False)
            result = model.press(model.prepare(case.pair), case.load, case.pose)
            if result.status is not ContactStatus.OK:
                why = "; ".join(result.flags)
                raise ComputationError(f"reference {family} {grid:g} mm: {why}", case.name)
            solved[f"{family} {grid:g} mm"] = quantities(result)
            if family == "fe" and grid == min(grids_mm):
                finest = {f"{i} {j}": round(p, -2) for (i, j), p in raster_map(result).items()}
    values, uncertainty = _by_layer(case, case.sphere) if case.sphere else limits(solved)
    return Reference(case.hash, values, uncertainty, grids_mm, solved, finest)


def limits(solved: dict[str, Quantities]) -> tuple[Quantities, Quantities]:
    """Return values and uncertainties from what the grids gave; see the module.

    Args:
        solved: "fe 1 mm" -> values.
    """
    h = np.array([float(name.split()[1]) for name in solved]) * MILLIMETRE
    family = np.array([FAMILIES.index(name.split()[0]) for name in solved])
    values, uncertainty = {}, {}
    for name in next(iter(solved.values())):
        series = np.array([row[name] for row in solved.values()])
        finest = series[h <= np.unique(h)[:2].max()]
        limit, residual = common_limit(h, series, family)
        middle = float(finest.mean())
        if name == "approach" or name.endswith("force"):
            values[name], uncertainty[name] = limit, max(residual, abs(limit - middle))
        else:
            spread = float(np.ptp(finest) / 2)
            values[name], uncertainty[name] = middle, max(spread, abs(limit - middle) / 2)
    return values, uncertainty


def common_limit(h: Array, values: Array, family: Array) -> tuple[float, float]:
    """Return the limit h -> 0 that several families of grids share, and its uncertainty.

    Least squares of q0 + c_f h² over all families f (Richardson with the order of
    trilinear cells). The uncertainty is the largest of half the spread of the families' own
    limits and of the residuals.

    Args:
        h: (n,) m, cell sizes.
        values: (n,).
        family: (n,) number of the family of each.
    """
    kinds = np.unique(family)
    slopes = np.where(family[:, None] == kinds, h[:, None] ** 2, 0.0)
    matrix = np.column_stack([np.ones(len(h)), slopes])
    solution = np.linalg.lstsq(matrix, values, rcond=None)[0]
    residual = np.abs(matrix @ solution - values).max()
    own = []
    for kind in kinds:
        some = family == kind
        line = np.column_stack([np.ones(some.sum()), h[some] ** 2])
        own.append(np.linalg.lstsq(line, values[some], rcond=None)[0][0])
    return float(solution[0]), float(max(residual, 0.5 * (max(own) - min(own))))


def _by_layer(case: StudyCase, sphere: Sphere) -> tuple[Quantities, Quantities]:
    """Return the elastic layer's solution; the block's finite width is its uncertainty."""
    layer = sphere_on_layer(
        sphere.radius,
        sphere.thickness,
        case.load,
        case.pair.material.young_modulus,
        case.pair.material.poisson_ratio,
    )
    area = float(np.pi * layer.contact_radius**2)
    values = {
        "approach": layer.approach,
        "medial_force": case.load,
        "medial_mean_pressure": case.load / area,
        "medial_peak_pressure": float(layer.pressure.max()),
        "medial_area": area,
    }
    values |= {name.replace("medial", "lateral"): 0.0 for name in list(values) if "medial" in name}
    return values, {name: REFERENCE.width_effect * value for name, value in values.items()}


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
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(
            f"is not a file of references ({error})", path, "use --recompute"
        ) from None


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
    result = stored.get(case.name)
    if result is None or result.hash != case.hash:
        word = "is missing" if result is None else "belongs to an earlier version of the case"
        raise InputError(f"the reference {word}", f"case '{case.name}'", "use --recompute")
    return result
