"""Converged references of the studies' cases: the limit of refined grids.

The reference of a sphere on a linear layer is the exact solution below (`sphere_on_layer`). Other
cases are solved by finite elements and by the lattice, to a tolerance of 1e-6, on ever finer grids:

- Approach and forces: the common limit of both families (Richardson extrapolation).
- Peak pressures and areas jump from node to node, without an order of convergence: the mean of the
  two finest grids.
- Uncertainty: the largest of the residual of the fit, the difference of the two families, and the
  distance between the limit and the finest grids (half of it for peak pressures and areas).

References are stored with the hash of their case.

A rigid sphere on an elastic layer that is bonded to a rigid base, without friction: under an
axisymmetric pressure with the Hankel transform P(k) the surface moves by

    u(r) = 2 (1 - nu²)/E ∫ L(k t) P(k) J0(k r) dk
    L(w) = (2 κ sinh 2w - 4 w)/(2 κ cosh 2w + 1 + κ² + 4 w²),   κ = 3 - 4 nu

Elliptic integrals give the half-space part (L = 1), quadrature gives the rest.

Reference: Johnson, Contact Mechanics (1985), sections 3.4 and 5.8.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.special import ellipe, ellipk, j0, j1

from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.errors import ComputationError, InputError
from tkamb.files import write_text
from tkamb.geometry.frames import Array
from tkamb.studies.cases import Sphere, StudyCase
from tkamb.studies.measures import (
    Quantities,
    Raster,
    are_quantities,
    is_map,
    quantities,
    raster_map,
    raster_of,
)
from tkamb.units import MILLIMETRE


@dataclass(frozen=True)
class ElasticLayerSettings:
    """The numerical solution of a layer under a sphere."""

    rings: int = 160
    """Rings of constant pressure under the sphere. Chosen: twice as many change the result by less
    than is compared."""
    half_space_wave_number: float = 60.0
    """Wave number times thickness beyond which the layer is a half space. Chosen: the difference is
    below rounding."""


ELASTIC_LAYER = ElasticLayerSettings()


@dataclass(frozen=True, eq=False)
class LayerContact:
    """The contact.

    Args:
        contact_radius: m.
        approach: m.
        radii: (n,) m, middles of the rings.
        pressure: (n,) Pa.
    """

    contact_radius: float
    approach: float
    radii: Array
    pressure: Array


def sphere_on_layer(
    radius: float, thickness: float, load: float, young_modulus: float, poisson_ratio: float
) -> LayerContact:
    """Return the contact of a sphere (paraboloid) that carries a load.

    Args:
        radius: m, of the sphere.
        thickness: m, of the layer.
        load: N.
        young_modulus: Pa, of the layer.
        poisson_ratio: Poisson's ratio of the layer.
    """
    low, high = 1e-6, 0.5 * thickness + 0.2 * radius
    for _ in range(60):
        middle = 0.5 * (low + high)
        result, force = _indented(radius, thickness, middle, young_modulus, poisson_ratio)
        low, high = (middle, high) if force < load else (low, middle)
    return result


def _indented(
    radius: float, thickness: float, contact: float, young: float, nu: float
) -> tuple[LayerContact, float]:
    """Return the contact of a given radius and its load (N)."""
    angle = np.linspace(0.0, np.pi / 2, ELASTIC_LAYER.rings + 1)
    edges, middles = contact * np.sin(angle), contact * np.sin((angle[1:] + angle[:-1]) / 2)
    disk = _disks(middles, edges[1:], thickness, young, nu)
    full = np.zeros((ELASTIC_LAYER.rings + 1, ELASTIC_LAYER.rings + 1))
    full[: ELASTIC_LAYER.rings, : ELASTIC_LAYER.rings] = disk - np.column_stack(
        [np.zeros(ELASTIC_LAYER.rings), disk[:, :-1]]
    )
    full[: ELASTIC_LAYER.rings, ELASTIC_LAYER.rings] = -1.0
    root = np.sqrt(1 - (middles[-2:] / contact) ** 2)
    full[ELASTIC_LAYER.rings, ELASTIC_LAYER.rings - 2 : ELASTIC_LAYER.rings] = [root[1], -root[0]]
    solution = np.linalg.solve(full, np.append(-(middles**2) / (2 * radius), 0.0))
    pressure = solution[: ELASTIC_LAYER.rings]
    force = float(pressure @ (np.pi * np.diff(edges**2)))
    return LayerContact(contact, float(solution[ELASTIC_LAYER.rings]), middles, pressure), force


def _disks(at: Array, radii: Array, thickness: float, young: float, nu: float) -> Array:
    """Return the displacement (n, m) at radii `at` (n,) under unit pressure on disks (m,)."""
    r, b = at[:, None], radii[None]
    share = np.minimum(r / b, b / r) ** 2
    inside = 4 * b / np.pi * ellipe(share)
    outside = 4 * r / np.pi * (ellipe(share) - (1 - share) * ellipk(share))
    half_space = np.where(r < b, inside, outside) / 2
    nodes, weights = np.polynomial.legendre.leggauss(400)
    w = (nodes + 1) * ELASTIC_LAYER.half_space_wave_number / 2
    k, kappa = w / thickness, 3 - 4 * nu
    layer = (2 * kappa * np.sinh(2 * w) - 4 * w) / (
        2 * kappa * np.cosh(2 * w) + 1 + kappa**2 + 4 * w**2
    ) - 1
    transform = radii[:, None] * j1(k[None] * radii[:, None]) / k
    step = layer * weights * ELASTIC_LAYER.half_space_wave_number / 2 / thickness
    rest = j0(k[None] * at[:, None]) @ (step * transform).T
    return 2 * (1 - nu**2) / young * (half_space + rest)


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
        hash: hash of the case.
        values: approach (m), condyles' forces (N), pressures (Pa) and areas (m²).
        uncertainty: uncertainty of each value, same units.
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


def is_reference(reference: Reference, case: StudyCase) -> bool:
    """Return whether a kept reference is one of a case, with all numbers."""
    values = (reference.values, reference.uncertainty, *reference.solved.values())
    return (
        reference.hash == case.hash
        and all(are_quantities(one) for one in values)
        and is_map(reference.map)
    )


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
