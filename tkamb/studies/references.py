"""Reference solutions of the studies: limits of refined grids, and closed forms.

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

The formulas are independent of the models' code. F is the load, d the approach, E Young's modulus
and nu Poisson's ratio.

- plate: a rigid flat plate on a block of height h and area A with nu = 0. The stress is F/A
  everywhere. The approach is d = h eps(F/A), with the material's curve eps(sigma) = sigma/E +
  alpha (sigma0/E) (sigma/sigma0)^n. A model is exact on any grid while the plastic strain is small.
  Large plastic strain widens the block, which the fixed bottom resists. A column of an elastic
  foundation follows p = sigma(-ln(1 - d/h)), so its approach is d = h (1 - exp(-eps)).
- slide: the plate on a mobile bearing, for any nu and strain. Two nodes of the bottom are fixed
  to prevent rigid motion. This stiffens the block by up to 2 %.
- kept: the plate with the operator cache on disk, which already contains the operator of another
  modulus. Each modulus must have its own operator.
- layer: a rigid sphere on a linear layer bonded to a rigid base (`sphere_on_layer`).
- bed: a paraboloid on a bed of springs of pressure p(e), F = 2 pi R h int_0^(d/h) p(e) de.
- hertz: the sphere on a half-space, a³ = 3 F R / (4 E*), d = a²/R, p0 = 3 F / (2 pi a²).

References: Johnson, Contact Mechanics (1985), sections 3.4, 4.2, 4.3 and 5.8,
doi:10.1017/CBO9781139171731; Ramberg & Osgood, NACA TN 902 (1943).
"""

import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk, j0, j1

from tkamb.contact.materials import Material, material
from tkamb.contact.pair import Bearing, ContactPair
from tkamb.contact.registry import contact_class, contact_model
from tkamb.contact.result import ContactResult, ContactStatus
from tkamb.errors import ComputationError, InputError
from tkamb.files import write_text
from tkamb.geometry.frames import Array, Mask
from tkamb.geometry.surface import Surface
from tkamb.studies.cases import Sphere, StudyCase, balls, block, flat
from tkamb.studies.measures import (
    Quantities,
    Raster,
    environment,
    quantities,
    raster_map,
    raster_of,
)
from tkamb.units import MEGAPASCAL, MILLIMETRE

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
        radii: mean radii of the pressure rings, m, (n,).
        pressure: pressure of the rings, Pa, (n,).
    """

    contact_radius: float
    approach: float
    radii: Array
    pressure: Array


def sphere_on_layer(
    radius: float, thickness: float, load: float, young_modulus: float, poisson_ratio: float
) -> LayerContact:
    """Return the contact of a sphere (a paraboloid) on a layer, in SI units."""
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
    """Solve a case on grids of the given or default cell sizes, mm.

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
    """Return values and uncertainties (see the module) from "fe 1 mm" -> its values."""
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
    """Return the common limit h -> 0 of several families f of grids, and its uncertainty.

    The limit q0 is of a least-squares fit q0 + c_f h² (Richardson extrapolation of trilinear
    cells). The uncertainty is the larger of the largest residual and half the range of the
    families' separate limits.

    Args:
        h: cell sizes, m, (n,).
        values: results, (n,).
        family: number of the family of each grid, (n,).
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
    """Return the exact solution; its uncertainty is the effect of a finite width."""
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
    """Return case name -> reference of a file; empty if the file does not exist."""
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
    """Return the stored reference of a case."""
    result = stored.get(case.name)
    if result is None or result.hash != case.hash:
        word = "is missing" if result is None else "belongs to an earlier version of the case"
        raise InputError(f"the reference {word}", f"case '{case.name}'", "use --recompute")
    return result


CURVE = {"alpha": 0.0389, "reference_stress": 8.4194 * MEGAPASCAL, "exponent": 4.5485}
"""Published Ramberg-Osgood parameters of the polyethylene of these cases (`docs/contact.md`)."""


# mm: side of the block under the plate. Cells of 2 and 3 mm divide it.
BLOCK_SIDE_MM = 24.0
# mm: cell size of the "kept" cases. The cache does not store the smaller operators
# of larger cells.
KEPT_GRID_MM = 0.9
# Approach of the plate on Sharma's springs over its approach on the elastic solid. The springs
# have nu = 0.35 for every material and are too stiff at free sides. Measured.
SHARMA_APPROACH_RATIO = 0.6808


TOLERANCES: dict[str, tuple[float, float]] = {
    "plate": (5e-3, 0.01),
    "kept": (5e-3, 0.01),
    "slide": (0.03, 0.03),
    "layer": (0.03, 0.09),
    "bed": (0.01, 0.06),
    "hertz": (0.01, 0.01),
}
"""Largest relative errors of approach and pressure. For plates they are a few times the solver's
tolerance, otherwise 1.5 times the measured discretisation error."""


@dataclass(frozen=True)
class ClosedForm:
    """A contact with a closed-form solution.

    Args:
        kind: "plate", "slide", "kept", "layer", "bed" or "hertz".
        load_N: force along -y, N.
        thickness_mm: height of the block, mm.
        modulus_MPa: Young's modulus, MPa.
        nu: Poisson's ratio; "plate" and "kept" need 0.
        linear: whether Hooke's law replaces Ramberg-Osgood.
        radius_mm: radius of the sphere, mm; 0 for a plate.
        resolution_mm: cell size, mm.
    """

    kind: str
    model: str
    load_N: float = 5000.0
    thickness_mm: float = 8.0
    modulus_MPa: float = 561.5
    nu: float = 0.0
    linear: bool = False
    radius_mm: float = 0.0
    resolution_mm: float = 3.0

    @property
    def label(self) -> str:
        """The values that differ from the default, as "plate: load_N=1"."""
        base = vars(ClosedForm(self.kind, self.model))
        changed = [f"{k}={v}" for k, v in vars(self).items() if v != base[k]]
        return f"closed form, {self.kind}: {', '.join(changed) or 'as it is'}"

    @property
    def material(self) -> Material:
        """Material of the block."""
        properties = {"young_modulus": self.modulus_MPa * MEGAPASCAL, "poisson_ratio": self.nu}
        if self.linear:
            return material("polyethylene-linear", **properties)
        return material("polyethylene", **properties, **CURVE)

    @property
    def pair(self) -> ContactPair:
        """The two bodies."""
        thick = self.thickness_mm * MILLIMETRE
        side = (
            BLOCK_SIDE_MM * MILLIMETRE if self.plate else 2.5 * self.radius_mm**0.5 * 1.6e-3 + 6e-3
        )
        side = 6e-3 * round(side / 6e-3)
        insert = block(flat(thick), (side, side), 3e-3)
        femoral = _plate(2 * side) if self.plate else balls(self.radius_mm * MILLIMETRE, 0.0)
        bearing: Bearing = "mobile" if self.kind == "slide" else "fixed"
        return ContactPair(femoral, insert, self.material, bearing)

    @property
    def plate(self) -> bool:
        """Whether the femoral component is a plate."""
        return self.kind in ("plate", "slide", "kept")


def press_closed_form(case: ClosedForm) -> tuple[ContactResult, ContactPair]:
    """Press a case. A "kept" case first stores the operator of another modulus in its cache.

    Raises:
        ComputationError: the cache does not contain one operator for each modulus.
    """
    pair = case.pair
    fields = getattr(contact_class(case.model), "__dataclass_fields__", {})
    options = {"cache": case.kind == "kept"} if "cache" in fields else {}
    model = contact_model(case.model, resolution=case.resolution_mm * MILLIMETRE, **options)
    if case.kind != "kept":
        return model.press(model.prepare(pair), case.load_N, np.eye(4)), pair
    with (
        tempfile.TemporaryDirectory(prefix="tkamb-stability-") as folder,
        environment({"TKAMB_CACHE_DIR": folder}),
    ):
        model.prepare(replace(case, modulus_MPa=0.5 * case.modulus_MPa).pair)
        state = model.prepare(pair)
        files = len(list(Path(folder).glob("*.operator")))
        if files != 2:
            raise ComputationError(
                f"{files} operators are in the cache after two materials", case.label
            )
        return model.press(state, case.load_N, np.eye(4)), pair


def relative_errors(case: ClosedForm, result: ContactResult) -> dict[str, float]:
    """Return the relative errors of approach and pressure against the closed form."""
    approach, pressure = solution(case)
    if case.model == "lattice-source":
        mean_pressure = result.pressure.mean()  # each node has the same tributary area
    elif case.plate:
        mean_pressure = np.median(result.pressure[_inner(result)])
    else:
        mean_pressure = max(side.peak_pressure for side in (result.medial, result.lateral) if side)
    if case.kind == "hertz" and result.medial is not None:
        mean = 1.5 * result.medial.mean_pressure  # the mean is two thirds of the peak
        mean_pressure = max(mean_pressure, mean, key=lambda value: abs(value / pressure - 1.0))
    return {
        "approach": abs(result.approach / approach - 1.0),
        "pressure": abs(float(mean_pressure) / pressure - 1.0),
    }


def solution(case: ClosedForm) -> tuple[float, float]:
    """Return the exact approach, m, and pressure, Pa: mean under a plate, peak under a sphere."""
    load, thick = case.load_N, case.thickness_mm * MILLIMETRE
    young, radius = case.modulus_MPa * MEGAPASCAL, case.radius_mm * MILLIMETRE
    if case.plate:
        stress = load / (BLOCK_SIDE_MM * MILLIMETRE) ** 2
        strain = _strain(case, stress)
        if case.model == "foundation":
            strain = 1.0 - np.exp(-strain)
        if case.model == "lattice-source":
            strain *= SHARMA_APPROACH_RATIO
        return thick * strain, stress
    if case.kind == "layer":
        layer = sphere_on_layer(radius, thick, load, young, case.nu)
        return layer.approach, float(layer.pressure.max())
    if case.kind == "hertz":
        contact = (0.75 * load * radius * (1 - case.nu**2) / young) ** (1 / 3)
        return contact**2 / radius, 1.5 * load / (np.pi * contact**2)
    column = _column(case)

    def excess(strain: float) -> float:
        return float(2 * np.pi * radius * thick * quad(column, 0.0, strain)[0]) - load

    strain = float(brentq(excess, 1e-9, 0.49, xtol=1e-12))
    return thick * strain, column(strain)


def closed_forms(quick: bool) -> Iterator[ClosedForm]:
    """Yield one case per model and kind of solution, and extreme cases unless `quick`."""
    solids = ("lattice", "lattice-linear", "fe")
    for model in (*solids, "lattice-source", "foundation", "foundation-linear"):
        yield ClosedForm("plate", model)
    yield ClosedForm("slide", "lattice", 10000.0, nu=0.45)
    yield ClosedForm("kept", "lattice-linear", resolution_mm=KEPT_GRID_MM)
    yield ClosedForm("hertz", "hertz", 100.0, 10.0, nu=0.45, radius_mm=22.0, resolution_mm=1.0)
    yield _wide("layer", "lattice-linear", linear=True)
    for model in ("foundation", "foundation-linear"):
        yield _wide("bed", model)
    if not quick:
        yield from _more_closed_forms(solids)


def _wide(
    kind: str, model: str, load_N: float = 3000.0, nu: float = 0.3, **options: bool
) -> ClosedForm:
    """Return a sphere of 300 mm on 12 mm: the contact spans several cells of 3 mm."""
    return ClosedForm(kind, model, load_N, 12.0, nu=nu, radius_mm=300.0, **options)


def _more_closed_forms(solids: tuple[str, ...]) -> Iterator[ClosedForm]:
    for model, load in product(solids, (0.01, 1.0, 100.0, 2000.0)):
        yield ClosedForm("plate", model, load)
    yield ClosedForm("plate", "lattice-linear", 50000.0, modulus_MPa=2000.0)
    for model, nu in product(("lattice", "fe"), (0.0, 0.3, 0.49, 0.4999)):
        yield ClosedForm("slide", model, 10000.0, nu=nu)
    for model, thick in product(solids, (1.0, 3.0, 30.0)):
        yield ClosedForm("plate", model, thickness_mm=thick)
    for model, young in product(solids, (100.0, 2000.0, 2e5)):
        yield ClosedForm("plate", model, modulus_MPa=young, linear=True)
    for model, nu in product(("lattice-linear", "fe"), (0.0, 0.45, 0.49, 0.4999)):
        yield _wide("layer", model, nu=nu, linear=True)
    for model, load in product(("foundation", "foundation-linear"), (1000.0, 10000.0)):
        yield _wide("bed", model, load)
    for load, nu in product((100.0, 1000.0), (0.0, 0.4999)):
        yield ClosedForm("hertz", "hertz", load, 30.0, nu=nu, radius_mm=22.0, resolution_mm=1.0)
    yield ClosedForm("kept", "fe", resolution_mm=KEPT_GRID_MM)


def _strain(case: ClosedForm, stress: float) -> float:
    young = case.modulus_MPa * MEGAPASCAL
    strain = stress / young
    if case.linear or case.model.endswith("linear"):
        return strain
    reference = CURVE["reference_stress"]
    plastic = CURVE["alpha"] * reference / young * (stress / reference) ** CURVE["exponent"]
    return strain + plastic


def _column(case: ClosedForm) -> Callable[[float], float]:
    """Return the pressure, Pa, of a column of the bed at a strain e = d/h.

    Linear: M e with M = E (1 - nu)/((1 + nu)(1 - 2 nu)). Otherwise: the stress at which the
    Ramberg-Osgood strain is -(M/E) ln(1 - e).
    """
    nu, young = case.nu, case.modulus_MPa * MEGAPASCAL
    confined = (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    if case.model == "foundation-linear":
        return lambda strain: young * confined * strain

    def pressure(strain: float) -> float:
        confined_strain = -confined * np.log1p(-strain)
        highest = young * confined_strain + 1.0
        return float(brentq(lambda s: _strain(case, s) - confined_strain, 0.0, highest))

    return pressure


def _inner(result: ContactResult) -> Mask:
    """Return which map points lie a fifth of the block's side from its edges."""
    across = np.abs(result.points[:, [0, 2]]).max(axis=1)
    inner: Mask = across < 0.3 * BLOCK_SIDE_MM * MILLIMETRE
    return inner


def _plate(side: float) -> Surface:
    box = block(flat(10 * MILLIMETRE), (side, side), side / 2)
    return Surface(box.vertices, box.faces, "plate")
