"""Reference solutions of the studies' cases: the limit of refined grids.

The reference of a sphere on a linear layer is the exact solution below (`sphere_on_layer`). Other
cases are solved with finite elements and with the lattice, to a tolerance of 1e-6, on refined
grids:

- Approach and forces: the common limit of both models (Richardson extrapolation). Uncertainty: the
  largest of the residual of the fit, half the difference of the models' limits, and the distance
  from the limit to the finest grids.
- Pressures and areas: the mean over the two finest grids, because they have no order of
  convergence. Uncertainty: the larger of half their range and half the distance to the limit.

The exact solution is that of a rigid sphere, without friction, on an elastic layer of thickness t
bonded to a rigid base. Under an axisymmetric pressure with the Hankel transform P(k) the surface
displacement is

    u(r) = 2 (1 - nu²)/E ∫ L(k t) P(k) J0(k r) dk
    L(w) = (2 κ sinh 2w - 4 w)/(2 κ cosh 2w + 1 + κ² + 4 w²),   κ = 3 - 4 nu

Elliptic integrals give the part of a half-space (L = 1), quadrature gives the part of L - 1.

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
    quantities,
    raster_map,
    raster_of,
)
from tkamb.units import MILLIMETRE

# Rings of constant pressure under the sphere. Not studied.
RINGS = 160
# Wave number times thickness above which the layer is treated as a half-space. The
# difference is below round-off.
HALF_SPACE_WAVE_NUMBER = 60.0


@dataclass(frozen=True, eq=False)
class LayerContact:
    """Contact of a sphere on a layer.

    Args:
        contact_radius: radius of the contact area, m.
        approach: approach, m.
        radii: mean radii of the pressure rings, m, shape (n,).
        pressure: pressure of the rings, Pa, shape (n,).
    """

    contact_radius: float
    approach: float
    radii: Array
    pressure: Array


def sphere_on_layer(
    radius: float, thickness: float, load: float, young_modulus: float, poisson_ratio: float
) -> LayerContact:
    """Return the contact of a sphere (a paraboloid) under a load.

    Args:
        radius: radius of the sphere, m.
        thickness: thickness of the layer, m.
        load: load, N.
        young_modulus: Young's modulus of the layer, Pa.
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
    angle = np.linspace(0.0, np.pi / 2, RINGS + 1)
    edges, middles = contact * np.sin(angle), contact * np.sin((angle[1:] + angle[:-1]) / 2)
    disk = _disks(middles, edges[1:], thickness, young, nu)
    matrix = np.zeros((RINGS + 1, RINGS + 1))
    # a ring is the difference of two disks
    matrix[:RINGS, :RINGS] = disk - np.column_stack([np.zeros(RINGS), disk[:, :-1]])
    matrix[:RINGS, RINGS] = -1.0
    # at the edge of the contact the pressure falls as the square root of the distance
    root = np.sqrt(1 - (middles[-2:] / contact) ** 2)
    matrix[RINGS, RINGS - 2 : RINGS] = [root[1], -root[0]]
    solution = np.linalg.solve(matrix, np.append(-(middles**2) / (2 * radius), 0.0))
    pressure = solution[:RINGS]
    force = float(pressure @ (np.pi * np.diff(edges**2)))
    return LayerContact(contact, float(solution[RINGS]), middles, pressure), force


def _disks(at: Array, radii: Array, thickness: float, young: float, nu: float) -> Array:
    """Return displacements per pressure (n, k), m/Pa, at radii `at` (n,) under disks (k,)."""
    r, b = at[:, None], radii[None]
    share = np.minimum(r / b, b / r) ** 2
    inside = 4 * b / np.pi * ellipe(share)
    outside = 4 * r / np.pi * (ellipe(share) - (1 - share) * ellipk(share))
    half_space = np.where(r < b, inside, outside) / 2
    nodes, weights = np.polynomial.legendre.leggauss(400)
    w = (nodes + 1) * HALF_SPACE_WAVE_NUMBER / 2
    k, kappa = w / thickness, 3 - 4 * nu
    layer = (2 * kappa * np.sinh(2 * w) - 4 * w) / (
        2 * kappa * np.cosh(2 * w) + 1 + kappa**2 + 4 * w**2
    ) - 1
    transform = radii[:, None] * j1(k[None] * radii[:, None]) / k
    step = layer * weights * HALF_SPACE_WAVE_NUMBER / 2 / thickness
    difference = j0(k[None] * at[:, None]) @ (step * transform).T
    return 2 * (1 - nu**2) / young * (half_space + difference)


STORED = Path(__file__).with_name("references.json")
FAMILIES = ("fe", "lattice")
GRIDS_MM = (1.5, 1.25, 1.0, 0.8)
LARGE_GRIDS_MM = (2.0, 1.5, 1.25, 1.0)


# m³: volume of the insert's bounding box above which coarser grids are used. The
# finest grid of such an insert does not fit into memory.
LARGE_VOLUME = 2e-5
# Relative tolerance of the reference solutions. Far below the compared errors.
TOLERANCE = 1e-6
# Relative difference between a block 3.4 times as wide as high and an infinite layer. Computed.
WIDTH_EFFECT = 0.005


@dataclass(frozen=True, eq=False)
class Reference:
    """The reference solution of a case.

    Args:
        values: approach, m, and forces, N, pressures, Pa, and areas, m², of the condyles.
        uncertainty: uncertainty of each value, in the same unit.
        grids_mm: cell sizes of the solved grids, mm.
        solved: grid, as "fe 1 mm" -> its values.
        map: "i j" -> pressure, Pa, of the finest finite-element grid on a raster of 1 mm.
    """

    hash: str
    values: Quantities
    uncertainty: Quantities
    grids_mm: tuple[float, ...]
    solved: dict[str, Quantities]
    map: dict[str, float]

    @property
    def raster(self) -> Raster:
        """The map by raster point."""
        return raster_of(self.map)


def compute_reference(case: StudyCase, grids_mm: tuple[float, ...] | None = None) -> Reference:
    """Solve a case on grids of the given or default cell sizes, mm, and return its reference.

    Raises:
        ComputationError: a grid did not converge.
    """
    if grids_mm is None:
        large = float(np.prod(np.ptp(case.pair.insert.vertices, axis=0))) > LARGE_VOLUME
        grids_mm = LARGE_GRIDS_MM if large else GRIDS_MM
    solved: dict[str, Quantities] = {}
    finest: dict[str, float] = {}
    for family in FAMILIES:
        for grid in grids_mm:
            model = contact_model(
                family, resolution=grid * MILLIMETRE, tolerance=TOLERANCE, cache=False
            )
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
    """Return values and uncertainties (see the module) from "fe 1 mm" -> values of that grid."""
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
    """Return the common limit h -> 0 of several families of grids, and its uncertainty.

    The limit q0 is from a least-squares fit of q0 + c_f h² over all families f (Richardson
    extrapolation of trilinear cells). The uncertainty is the larger of the largest residual and
    half the range of the families' separate limits.

    Args:
        h: cell sizes, m, shape (n,).
        values: results on the grids, shape (n,).
        family: number of the family of each grid, shape (n,).
    """
    kinds = np.unique(family)
    slopes = np.where(family[:, None] == kinds, h[:, None] ** 2, 0.0)
    matrix = np.column_stack([np.ones(len(h)), slopes])
    solution = np.linalg.lstsq(matrix, values, rcond=None)[0]
    residual = np.abs(matrix @ solution - values).max()
    limits = []
    for kind in kinds:
        members = family == kind
        line = np.column_stack([np.ones(members.sum()), h[members] ** 2])
        limits.append(np.linalg.lstsq(line, values[members], rcond=None)[0][0])
    return float(solution[0]), float(max(residual, 0.5 * (max(limits) - min(limits))))


def _by_layer(case: StudyCase, sphere: Sphere) -> tuple[Quantities, Quantities]:
    """Return the exact solution of the layer. The uncertainty is the effect of a finite width."""
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
    return values, {name: WIDTH_EFFECT * value for name, value in values.items()}


def read_references(path: Path = STORED) -> dict[str, Reference]:
    """Return case name -> reference of a file; empty if the file does not exist.

    Raises:
        InputError: the file has other content.
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
    """Write references to a file."""
    content = {name: asdict(reference) for name, reference in references.items()}
    text = json.dumps(content, indent=1, default=float)
    write_text(path, text + "\n")


def reference_of(case: StudyCase, stored: dict[str, Reference]) -> Reference:
    """Return the stored reference of a case.

    Raises:
        InputError: the reference is missing, or belongs to an earlier version of the case.
    """
    result = stored.get(case.name)
    if result is None or result.hash != case.hash:
        word = "is missing" if result is None else "belongs to an earlier version of the case"
        raise InputError(f"the reference {word}", f"case '{case.name}'", "use --recompute")
    return result
