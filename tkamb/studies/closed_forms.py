"""Contacts with a closed-form solution, on which every family of contact models is tested.

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

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

from tkamb.contact.materials import Material, material
from tkamb.contact.pair import Bearing, ContactPair
from tkamb.contact.registry import contact_class, contact_model
from tkamb.contact.result import ContactResult
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Mask
from tkamb.geometry.surface import Surface
from tkamb.studies.cases import balls, block, flat
from tkamb.studies.measures import environment
from tkamb.studies.references import sphere_on_layer
from tkamb.units import MEGAPASCAL, MILLIMETRE

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
        """Description with the values that differ from the default, as "plate: load_N=1"."""
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
    """Return a case of a sphere of 300 mm on 12 mm. The contact spans several cells of 3 mm."""
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
    """Return the pressure, Pa, of a column of the bed as a function of its strain e = d/h.

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
    """Return which map points lie at least a fifth of the block's side from its edges."""
    across = np.abs(result.points[:, [0, 2]]).max(axis=1)
    inner: Mask = across < 0.3 * BLOCK_SIDE_MM * MILLIMETRE
    return inner


def _plate(side: float) -> Surface:
    box = block(flat(10 * MILLIMETRE), (side, side), side / 2)
    return Surface(box.vertices, box.faces, "plate")
