"""Published contact numbers with simple geometry, recomputed.

Every function returns {id of `published.toml`: our value in the unit named there}.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.contact import materials
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.contact.result import CondyleContact, ContactResult, ContactStatus
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, knee_pose
from tkamb.studies.cases import balls, block, dishes, flat
from tkamb.studies.designs.design import Design, load_design
from tkamb.studies.references import sphere_on_layer
from tkamb.units import DEGREE, MEGAPASCAL, MILLIMETRE
from validation.design_cells import PressedDesign
from validation.design_tables import FOLDERS
from validation.film import worst_errors

Values = dict[str, float]
UPRIGHT = knee_pose([0.0] * 6)


@dataclass(frozen=True)
class BenchmarkSettings:
    """Presses on implants that are compared with publications."""

    sensel: float = 1.27 * MILLIMETRE
    """m: edge of a sensel of the pressure film in the publications."""
    resolution_mm: float = 2.0
    """mm: resolution of every press on an implant. Chosen because the page then takes minutes."""


BENCHMARK = BenchmarkSettings()


def _model(name: str, resolution_mm: float, **options: Any) -> Any:
    cached = name.startswith(("lattice", "fe"))
    return contact_model(
        name, resolution=resolution_mm * 1e-3, **({"cache": False} if cached else {}), **options
    )


def _only(result: ContactResult) -> CondyleContact:
    condyle = result.medial or result.lateral
    if result.status is not ContactStatus.OK or condyle is None:
        raise ComputationError(f"a benchmark cannot be pressed: {', '.join(result.flags)}")
    return condyle


def spheres() -> Values:
    """Return a sphere on a bonded layer over the exact solution, and forces at doubled depth.

    The contact is four cells in radius.
    """
    radius, thickness, load = 22e-3, 8e-3, 1500.0
    linear = materials.material("polyethylene-linear")
    exact = sphere_on_layer(radius, thickness, load, linear.young_modulus, linear.poisson_ratio)
    pair = ContactPair(balls(radius, 0.0), block(flat(thickness), (20e-3, 20e-3)), linear)
    model = _model("lattice-linear", 0.8)
    result = model.press(model.prepare(pair), load, UPRIGHT)
    condyle = _only(result)
    values = {
        "layer_approach": result.approach / exact.approach,
        "layer_peak": condyle.peak_pressure / exact.pressure.max(),
        "layer_radius": np.sqrt(condyle.area / np.pi) / exact.contact_radius,
    }
    for name, key in (("hertz", "hertz"), ("foundation-linear", "foundation")):
        model = _model(name, 0.25)
        state = model.prepare(pair)
        values[f"doubled_depth_{key}"] = _doubled(model, state)
    return values


def _doubled(model: Any, state: Any, depth: float = 5e-5) -> float:
    """Return the ratio of the reactions at twice an approach and at the approach."""
    touch = model.press(state, 0.0, UPRIGHT).pose
    force = []
    for times in (1.0, 2.0):
        pose = touch.copy()
        pose[1, 3] -= times * depth
        force.append(-model.evaluate(state, pose).wrench_on_insert[1])
    return float(force[1] / force[0])


def _plate_on_box() -> ContactPair:
    """Return the source's patch test: a rigid plate wider than a box that is fixed below."""
    plate = block(flat(10e-3), (20e-3, 20e-3), 2e-3, "plate")
    box = block(flat(3e-3), (12e-3, 12e-3))
    return ContactPair(plate, box, materials.material("polyethylene-linear"))


def patch() -> Values:
    """Return pressures under a rigid plate on a box, 1000 N, 1 mm."""
    pair, result = _plate_on_box(), {}
    for name, key, options in (
        ("fe", "fe", {}),
        ("lattice-source", "source", {"pressure_rule": "source"}),
    ):
        model = _model(name, 1.0, **options)
        pressure = model.press(model.prepare(pair), 1000.0, UPRIGHT).pressure
        loaded = pressure[pressure > 0.0]
        result[f"patch_{key}_max"] = loaded.max() / MEGAPASCAL
        result[f"patch_{key}_min"] = loaded.min() / MEGAPASCAL
    return result


def refinement() -> Values:
    """Return differences (%) of the approach at 1.5 mm from finite elements of 0.75 mm."""
    pair = _plate_on_box()

    def approach(name: str, size_mm: float) -> float:
        model = _model(name, size_mm)
        return float(model.press(model.prepare(pair), 1000.0, UPRIGHT).approach)

    fine = approach("fe", 0.75)
    return {
        f"refinement_{key}": 100.0 * abs(approach(name, 1.5) / fine - 1.0)
        for name, key in (("lattice-source", "source"), ("lattice-linear", "lattice"))
    }


def speed(trade_off: Path) -> Values:
    """Return the ratio of the times of finite elements and the source's lattice, per position.

    Both on the two condyles with cells of 2 mm, as `tkamb tradeoff` measured them in one run.

    Args:
        trade_off: JSON of the trade-off study.
    """
    rows = json.loads(trade_off.read_text(encoding="utf-8"))
    seconds = {
        row["contact"]: row["warm_seconds"]
        for row in rows
        if (row["case"], row["resolution_mm"]) == ("two condyles", 2.0)
    }
    return {"speed_source": seconds["calculix C3D8I"] / seconds["lattice-source"]}


def against_fe(
    designs: Path,
    name: str = "nkii_cp",
    flexions: Sequence[float] = (15.0, 60.0, 105.0),
    size_mm: float = BENCHMARK.resolution_mm,
    fe_size_mm: float = BENCHMARK.resolution_mm,
) -> Values:
    """Return the source's lattice and ours against finite elements on an implant.

    One condyle, 1200 N, at flexions (deg), with cells of `size_mm` and `fe_size_mm`. Mean
    pressures and areas of the source's lattice follow the source's rule, those of the finite
    elements and of ours the contact area.
    """
    design = load_design(designs / name)
    fe = _pressed(design, "fe", flexions, size_mm=fe_size_mm)
    result = {}
    kinds: tuple[tuple[str, str, dict[str, Any]], ...] = (
        ("lattice-source", "source", {"pressure_rule": "source"}),
        ("lattice", "lattice", {}),
    )
    for model, key, options in kinds:
        ours = _pressed(design, model, flexions, size_mm=size_mm, **options)
        pairs = list(zip(ours, fe, strict=True))
        result[f"{key}_approach"] = max(abs(a[0] - b[0]) for a, b in pairs) / MILLIMETRE
        area = max(abs(a[1].area - b[1].area) for a, b in pairs)
        result[f"{key}_area"] = area / MILLIMETRE**2
        for what in ("peak", "mean"):
            pressure, exact = (
                np.array([getattr(p[i][1], f"{what}_pressure") for p in pairs]) for i in (0, 1)
            )
            result[f"{key}_{what}"] = 100.0 * float(np.abs(pressure / exact - 1.0).max())
    return result


def _pressed(
    design: Design,
    name: str,
    flexions: Iterable[float],
    load: float = 1200.0,
    size_mm: float = BENCHMARK.resolution_mm,
    **options: Any,
) -> list[tuple[float, CondyleContact]]:
    """Return approach (m) and medial condyle of one contact model at flexions (deg)."""
    pressed = PressedDesign(design, size_mm)
    pressed.model = _model(name, size_mm, **options)
    rows = []
    for flexion in flexions:
        result = pressed.press_alone("medial", flexion * DEGREE, load)
        rows.append((result.approach, _only(result)))
    return rows


def foundation(designs: Path) -> Values:
    """Return the elastic foundation's peak pressure against finite elements.

    Three designs with symmetric condyles, whole components, 2400 N at 15 and 60 deg.
    """
    worst = {"linear": 0.0, "nonlinear": 0.0}
    for name in ("sigma_fb", "sigma_mb", "lps_flex"):
        design = load_design(designs / name)
        peaks = {m: _both(design, m) for m in ("fe", "foundation-linear", "foundation")}
        for law, model in (("linear", "foundation-linear"), ("nonlinear", "foundation")):
            excess = peaks[model] / peaks["fe"] - 1.0
            worst[law] = max(worst[law], *(excess if law == "linear" else np.abs(excess)))
    return {f"foundation_{law}_peak": 100.0 * value for law, value in worst.items()}


def _both(design: Design, name: str) -> Array:
    """Return peak pressures (2,) Pa of the medial condyle at 15 and 60 deg, whole component."""
    pressed = PressedDesign(design, BENCHMARK.resolution_mm)
    pressed.model = _model(name, BENCHMARK.resolution_mm)
    results = [pressed.press_both(flexion * DEGREE, 2400.0) for flexion in (15.0, 60.0)]
    return np.array([_only(result).peak_pressure for result in results])


def given_load_or_approach() -> Values:
    """Return the ratio of the foundation's errors at a given load and a given approach, toroid."""
    linear = materials.material("polyethylene-linear")
    femoral = balls(25e-3, 0.0, waist=0.8)
    pair = ContactPair(femoral, block(dishes(9e-3, 50e-3, 0.0), (26e-3, 26e-3)), linear)
    fe, bed = _model("fe", 1.5), _model("foundation-linear", 0.5)
    states = fe.prepare(pair), bed.prepare(pair)
    exact = fe.press(states[0], 800.0, UPRIGHT)
    at_load = bed.press(states[1], 800.0, UPRIGHT)
    at_depth = bed.evaluate(states[1], exact.pose)
    peak = _only(exact).peak_pressure
    errors = [abs(_only(r).peak_pressure / peak - 1.0) for r in (at_load, at_depth)]
    return {"foundation_given_load": errors[0] / errors[1]}


def film() -> Values:
    """Return the worst errors of a matrix sensor, median over contacts of knee replacements.

    Hertz ellipses of 100, 150 and 200 mm² and of aspect 1 to 3: what tables D-3 and D-4 hold.
    """
    result = []
    for area in (100.0, 150.0, 200.0):
        for aspect in (1.0, 2.0, 3.0):
            a = np.sqrt(area / np.pi * aspect) * MILLIMETRE
            result.append(worst_errors((a, a / aspect), BENCHMARK.sensel))
    return {f"film_{k}": 100.0 * float(np.median([row[k] for row in result])) for k in result[0]}


def measured_stress(designs: Path) -> Values:
    """Return the median contact stress (MPa) of the six designs at 2000 N per knee."""
    flexions = (0.0, 15.0, 60.0)
    result = np.array(
        [
            [
                c.mean_pressure
                for _, c in _pressed(load_design(designs / f), "lattice", flexions, 1e3)
            ]
            for f in FOLDERS.values()
        ]
    )
    middle = np.median(result, axis=0) / MEGAPASCAL
    return {f"stress_{int(f)}": float(p) for f, p in zip(flexions, middle, strict=True)}


def _variant(designs: Path, dish: float, coronal: float, thickness: float = 9.0) -> PressedDesign:
    """Return the fixed Sigma's femur on other dishes of sagittal and coronal radius, mm."""
    design = load_design(designs / "sigma_fb")
    insert = replace(
        design.insert,
        medial_dish_radii=(dish, dish),
        lateral_dish_radii=(dish, dish),
        coronal_radius=coronal,
        thickness=thickness,
        post=None,
    )
    return PressedDesign(
        replace(design, articulation=replace(design.articulation, insert=insert)),
        BENCHMARK.resolution_mm,
    )


def _peak(pressed: PressedDesign, flexion: float, load: float, turn: float = 0.0) -> float:
    """Return the peak pressure (Pa) with the femur turned by `turn` deg about the knee's middle."""
    shift = pressed.design.femoral.ridge_half * MILLIMETRE * np.sin(turn * DEGREE)
    result = pressed.press_alone("medial", flexion * DEGREE, load, turn * DEGREE, shift)
    return _only(result).peak_pressure


def conformity(designs: Path) -> Values:
    """Return the effect of conformity on peak pressure at 3000 N per knee, 0, 60 and 90 deg.

    Conforming: dishes of 50 mm along and 20.6 mm across under a femur of 20 mm across; less
    conforming: 80 and 23.5 mm.
    """
    high, low = _variant(designs, 50.0, 20.6), _variant(designs, 80.0, 23.5)
    result = {
        f"conformity_{f}": 100.0 * (1.0 - _peak(high, f, 1500.0) / _peak(low, f, 1500.0))
        for f in (0, 60, 90)
    }
    rises = [_peak(p, 0, 1500.0, 10.0) / _peak(p, 0, 1500.0) - 1.0 for p in (high, low)]
    return {**result, "malrotation": 100.0 * (rises[0] - rises[1])}


def thickness_and_plane(designs: Path) -> Values:
    """Return the effects of thickness and plane of conformity on peak pressure, at 60 deg.

    Conformity r/R is raised by a tenth, across from 0.85 and along from 0.5.
    """
    peak = {t: _peak(_variant(designs, 58.0, 21.5, t), 60, 1500.0) for t in (6.0, 8.0, 10.0, 12.0)}
    along, across = 25.5 / 0.5, 20.0 / 0.85
    base = _peak(_variant(designs, along, across), 60, 1500.0)
    tighter = [
        _peak(_variant(designs, along, across / 1.1), 60, 1500.0),
        _peak(_variant(designs, along / 1.1, across), 60, 1500.0),
    ]
    falls = [base - p for p in tighter]
    return {
        "thickness": (peak[6.0] - peak[8.0]) / (peak[10.0] - peak[12.0]),
        "conformity_plane": falls[0] / falls[1],
    }
