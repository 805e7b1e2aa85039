"""The plots of the report: their lines and notes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.io.activities import PEAKS_BW, peaks_words
from tkamb.run.columns import is_ligament, ligament_of
from tkamb.run.known_errors import is_large, short_error_words
from tkamb.run.metrics import (
    body_weight,
    lateral_axis_name,
    medial_share,
    residual_effect,
    residual_share,
    split_undetermined,
    tension_ratio,
)
from tkamb.show.style import (
    ANTERIOR,
    BLACK,
    GREY,
    LIST,
    PATELLAR_LIGAMENT,
    PATELLOFEMORAL,
    QUADRICEPS,
    RIGHT,
    SIDE_COLOURS,
    SUPERIOR,
)

if TYPE_CHECKING:
    from tkamb.run.results import Results


# 1: two curves coincide if their largest distance is below this share of their height.
# A line is about 1.5 points wide in a plot of 220 points.
LINE_WIDTH_SHARE = 0.005


@dataclass(frozen=True, eq=False)
class Line:
    """One curve, with a `name` unique in its panel.

    Args:
        values: (f,) values in the unit of the panel.
        band: (3, f) 5th, 50th and 95th percentile of the samples; None: there are none.
        wide_band: (2, f) 5th and 95th percentile with the discrepancy of the method; None: unknown.
        behind: whether the curve is drawn broad and pale behind the other curves.
    """

    name: str
    label: str
    values: Array
    colour: str
    dashed: bool = False
    band: Array | None = None
    wide_band: Array | None = None
    behind: bool = False


@dataclass(frozen=True, eq=False)
class Panel:
    """One plot.

    Args:
        level: (value, label) of a horizontal reference line; None: no line.
        span: (low, high, label) of a shaded range behind the curves; None: no range.
        second: (factor, unit) of a second vertical axis on the right; None: no second axis.
        limits: ends of the vertical axis; None: they follow from the curves.
    """

    name: str
    title: str
    unit: str
    lines: tuple[Line, ...]
    note: str = ""
    level: tuple[float, str] | None = None
    span: tuple[float, float, str] | None = None
    second: tuple[float, str] | None = None
    limits: tuple[float, float] | None = None
    warning: bool = False


def panels(results: "Results") -> tuple[Panel, ...]:
    """Return the plots that have numbers in this run, in the report's order."""
    makers: tuple[Callable[[Results], Panel], ...] = (
        _total, _condyles, _share, _sensitivity, _extensor, _ratios, _areas, _pressures, _yield,
        _post, _button_force, _button_area, _button_pressure, _button_centre,
        _patella_shift, _patella_turns, _external, _ground, _ligaments, _residuals,
        _residual_moment, _hip_force, _hip_moment, _motion, _slip, _adjustment, _adjustment_effect,
    )  # fmt: skip
    panels_made = (_without_empty_lines(make(results)) for make in makers)
    return tuple(panel for panel in panels_made if panel.lines)


def _without_empty_lines(panel: Panel) -> Panel:
    """Remove lines of NaN only, and dash lines over others."""
    lines = tuple(line for line in panel.lines if np.isfinite(line.values).any())
    return replace(panel, lines=_none_hidden(lines))


def _none_hidden(lines: Sequence[Line]) -> tuple[Line, ...]:
    shown: list[Line] = []
    for line in lines:
        covers = any(_coincide(line.values, earlier.values) for earlier in shown)
        shown.append(replace(line, dashed=True) if covers and not line.behind else line)
    return tuple(shown)


def _coincide(values: Array, others: Array) -> bool:
    """Return whether curves (f,) coincide in all frames of both."""
    finite = np.isfinite(values) & np.isfinite(others)
    if not finite.any():
        return False
    height = float(np.ptp(np.concatenate([values[finite], others[finite]])))
    distance = float(np.abs(values - others)[finite].max())
    return distance <= LINE_WIDTH_SHARE * height


def _line(
    results: "Results",
    column: str,
    label: str,
    colour: str,
    dashed: bool = False,
    scale: float = 1.0,
) -> Line:
    values = results.columns.get(column, np.full(len(results), np.nan))
    band, wide = results.band(column), results.band_with_discrepancy(column)
    return Line(
        column,
        label,
        values * scale,
        colour,
        dashed,
        None if band is None else band * scale,
        None if wide is None else wide * scale,
    )


def _components(results: "Results", stem: str, unit: str, scale: float = 1.0) -> tuple[Line, ...]:
    right = lateral_axis_name(results)
    return (
        _line(results, f"{stem}_si_{unit}", "superior", SUPERIOR, scale=scale),
        _line(results, f"{stem}_ap_{unit}", "anterior", ANTERIOR, scale=scale),
        _line(results, f"{stem}_ml_{unit}", right, RIGHT, scale=scale),
    )


def _both_sides(
    results: "Results", column: str, label: str = "", dashed: bool = False, scale: float = 1.0
) -> tuple[Line, ...]:
    return tuple(
        _line(results, f"{side}_{column}", f"{side}{label}", colour, dashed, scale)
        for side, colour in SIDE_COLOURS.items()
    )


def _total(results: "Results") -> Panel:
    scale = 1 / body_weight(results)
    total = _line(results, "force_total_BW", "resultant", BLACK)
    parts = _components(results, "force", "N", scale)
    lines = (total, replace(parts[0], label="superior–inferior", dashed=True), *parts[1:])
    lines += (_measured(results, "total", "measured, axial", BLACK),)
    note = "Force on the insert. SI is positive in compression. Residuals are not included."
    activity, span = results.summary.get("activity"), None
    if activity in PEAKS_BW:
        result = PEAKS_BW[activity].values()
        span = (min(result), max(result), "in vivo")
        note += " " + peaks_words(activity)
    return Panel("forces", "Tibiofemoral contact force", "BW", lines, note, span=span)


def _condyles(results: "Results") -> Panel:
    scale = 1 / body_weight(results)
    lines = (
        *_both_sides(results, "force_N", ", deformation", scale=scale),
        *_both_sides(results, "force_equilibrium_N", ", equilibrium", dashed=True, scale=scale),
        *(_measured(results, s, f"{s}, measured", colour) for s, colour in SIDE_COLOURS.items()),
    )
    note = (
        "Deformation: the contact model presses with the total load at the recorded adduction. "
        "Equilibrium: from the equilibrium of coronal moments."
    )
    return Panel("condyles", "Medial and lateral force, two estimates", "BW", lines, note)


def _measured(results: "Results", name: str, label: str, colour: str) -> Line:
    line = _line(results, f"measured_{name}_N", label, colour, scale=1 / body_weight(results))
    return replace(line, behind=True)


def _share(results: "Results") -> Panel:
    lines = (
        Line("deformation", "by deformation", medial_share(results, "deformation"), BLACK),
        Line("equilibrium", "by equilibrium", medial_share(results, "equilibrium"), GREY, True),
    )
    title, unit = "Medial share of the load", "medial / (medial + lateral)"
    panel = Panel("share", title, unit, lines, level=(0.5, "even"), limits=(0.0, 1.0))
    unknown = int(split_undetermined(results).sum())
    if not unknown:
        return panel
    note = (
        f"The share by deformation is not determined in {unknown} of {len(results)} frames: "
        "an adduction error of 0.5 deg shifts more than a quarter of the load to the other "
        "condyle, or one condyle carries the whole load."
    )
    return replace(panel, note=note, warning=True)


def _sensitivity(results: "Results") -> Panel:
    name = "medial_force_per_adduction_N_per_deg"
    lines = (_line(results, name, "medial force", BLACK),)
    note = (
        "Change of the medial force by deformation per degree of adduction, at constant load. "
        "The error of the adduction from fluoroscopy is about 0.5 deg."
    )
    return Panel("sensitivity", "Sensitivity of the split to adduction", "N/deg", lines, note)


def _extensor(results: "Results") -> Panel:
    scale = 1 / body_weight(results)
    tangential = ("patellofemoral_tangential_N", "patellofemoral, tangential", PATELLOFEMORAL, True)
    lines = (
        _line(results, "quadriceps_N", "quadriceps", QUADRICEPS, scale=scale),
        _line(results, "patellar_ligament_N", "patellar ligament", PATELLAR_LIGAMENT, scale=scale),
        _line(results, "patellofemoral_N", "patellofemoral", PATELLOFEMORAL, scale=scale),
        _line(results, *tangential, scale=scale),
    )
    return Panel("extensor", "Extensor mechanism", "BW", lines)


def _ratios(results: "Results") -> Panel:
    ligament = tension_ratio(results, "patellar_ligament_N")
    patella = tension_ratio(results, "patellofemoral_N")
    lines = (
        Line("PL/Q", "patellar ligament, PL/Q", ligament, PATELLAR_LIGAMENT),
        Line("PF/Q", "patellofemoral, PF/Q", patella, PATELLOFEMORAL),
    )
    note = (
        "PL/Q: tension of the patellar ligament divided by the tension of the quadriceps. PF/Q: "
        "patellofemoral force divided by the tension of the quadriceps."
    )
    return Panel("ratios", "Ratios to the quadriceps tension", "force / quadriceps", lines, note)


def _areas(results: "Results") -> Panel:
    lines = _both_sides(results, "area_mm2")
    return _with_known_error(results, Panel("areas", "Contact area", "mm²", lines), ("area",))


def _with_known_error(results: "Results", panel: Panel, names: tuple[str, ...]) -> Panel:
    error = results.summary.get("known_error")
    if error is None:
        return panel
    note = short_error_words(error, names)
    return replace(panel, note=note, warning=is_large(error, names))


def centre_panel(results: "Results") -> Panel:
    """Return the anterior positions of the centres of pressure over the motion."""
    lines = _both_sides(results, "cop_ap_mm")
    title = "Anterior position of the centres of pressure"
    note = "Position along the x axis of the insert. Zero is the middle of the insert's bottom."
    return _without_empty_lines(Panel("centres", title, "mm", lines, note))


def _pressures(results: "Results") -> Panel:
    lines = (
        *_both_sides(results, "peak_pressure_MPa", ", peak"),
        *_both_sides(results, "mean_pressure_MPa", ", mean", dashed=True),
    )
    stress = results.summary.get("yield_stress_MPa")
    level = None if stress is None else (float(stress), f"yield {stress:g} MPa")
    panel = Panel("pressures", "Contact pressure", "MPa", lines, level=level)
    return _with_known_error(results, panel, ("peak_pressure", "mean_pressure"))


def _yield(results: "Results") -> Panel:
    lines = _both_sides(results, "area_above_yield", scale=100)
    if not any(np.nanmax(line.values, initial=0) > 0 for line in lines):
        lines = ()
    return Panel("above_yield", "Contact area above yield", "% of the condyle's area", lines)


def _post(results: "Results") -> Panel:
    scale, right = 1 / body_weight(results), lateral_axis_name(results)
    lines = (
        _line(results, "post_force_N", "total", BLACK, scale=scale),
        _line(results, "post_force_ap_N", "anterior", ANTERIOR, scale=scale),
        _line(results, "post_force_si_N", "inferior", SUPERIOR, scale=scale),
        _line(results, "post_force_ml_N", right, RIGHT, scale=scale),
    )
    note = "Force on the insert, without friction. The contact force includes it."
    return Panel("post", "Force of the cam on the post", "BW", lines, note)


def _button_force(results: "Results") -> Panel:
    scale = 1 / body_weight(results)
    lines = (
        _line(results, "button_force_N", "total", BLACK, scale=scale),
        *(
            _line(results, f"button_{side}_force_N", f"{side} facet", colour, scale=scale)
            for side, colour in SIDE_COLOURS.items()
        ),
    )
    note = "Forces of the contact on the button, at the pose of the patella."
    return Panel("button_force", "Force on the patellar button", "BW", lines, note)


def _button_pressure(results: "Results") -> Panel:
    lines = (
        _line(results, "button_peak_pressure_MPa", "peak", BLACK),
        _line(results, "button_mean_pressure_MPa", "mean", GREY, True),
    )
    note = "The error of the contact model was not measured at the patella."
    return Panel("button_pressure", "Pressure on the patellar button", "MPa", lines, note)


def _button_area(results: "Results") -> Panel:
    lines = (_line(results, "button_area_mm2", "contact area", BLACK),)
    return Panel("button_area", "Contact area of the patellar button", "mm²", lines)


def _button_centre(results: "Results") -> Panel:
    right = lateral_axis_name(results)
    lines = (
        _line(results, "button_cop_si_mm", "superior", SUPERIOR),
        _line(results, "button_cop_ml_mm", right, RIGHT),
    )
    note = "From the middle of the button's back."
    return Panel("button_centre", "Centre of pressure on the button", "mm", lines, note)


def _patella_turns(results: "Results") -> Panel:
    lines = (
        _line(results, "patella_tilt_deg", "tilt", SUPERIOR),
        _line(results, "patella_rotation_deg", "rotation", ANTERIOR),
    )
    note = (
        "Tilt is positive if the lateral edge is nearer to the femur, rotation if the superior "
        "pole is lateral."
    )
    return Panel("patella_turns", "Tilt and rotation of the patella", "deg", lines, note)


def _patella_shift(results: "Results") -> Panel:
    lines = (_line(results, "patella_shift_mm", "lateral", RIGHT),)
    return Panel("patella_shift", "Shift of the patella", "mm", lines)


def _external(results: "Results") -> Panel:
    lines = (
        _line(results, "external_flexion_moment_Nm", "flexing", RIGHT),
        _line(results, "external_adduction_moment_Nm", "adducting", ANTERIOR),
    )
    height = results.summary.get("height_mm")
    second = None
    if height:
        second = (100 / (body_weight(results) * float(height) * 1e-3), "% BW·height")
    return Panel("external", "External knee moments", "N·m", lines, second=second)


def _ground(results: "Results") -> Panel:
    lines = _components(results, "ground_reaction", "N", 1 / body_weight(results))
    return Panel("ground", "Ground reaction along the insert axes", "BW", lines)


def _ligaments(results: "Results") -> Panel:
    names = [name for name in results.columns if is_ligament(name)]
    bundles: dict[str, list[str]] = {}
    for name in names:
        strand = ligament_of(name)
        bundle = strand.rstrip("0123456789").rstrip("_") if len(names) > len(LIST) else strand
        bundles.setdefault(bundle or strand, []).append(name)
    lines = tuple(
        _bundle(results, bundle, strands, k) for k, (bundle, strands) in enumerate(bundles.items())
    )
    summed = len(bundles) < len(names)
    note = (
        f"{len(names)} strands. Strands whose names differ only in a number are summed."
        if summed
        else ""
    )
    return Panel("ligaments", "Ligament tension", "N", lines, note)


def _bundle(results: "Results", bundle: str, strands: Sequence[str], position: int) -> Line:
    """Return the strands' summed tension, NaN where all are NaN."""
    tension = np.array([results[name] for name in strands])
    missing = np.isnan(tension).all(axis=0)
    values = np.where(missing, np.nan, np.nansum(tension, axis=0))
    colour = LIST[position % len(LIST)]
    label = bundle.replace("_", " ") + (f" ({len(strands)})" if len(strands) > 1 else "")
    name = strands[0] if len(strands) == 1 else bundle
    return Line(name, label, values, colour, position >= len(LIST))


def _residuals(results: "Results") -> Panel:
    with np.errstate(divide="ignore", invalid="ignore"):
        percent = 100 / np.abs(results["force_si_N"])
        lines = (
            Line("size", "magnitude", 100 * residual_share(results), BLACK),
            Line("ap", "anterior", results["residual_ap_N"] * percent, ANTERIOR),
            Line("ml", lateral_axis_name(results), results["residual_ml_N"] * percent, RIGHT),
            Line(
                "effect",
                "effect of ±10 mm on the total",
                100 * residual_effect(results),
                GREY,
                True,
            ),
        )
    note = (
        "Forces that equilibrium needs in addition to the modelled loads. An exact model has none. "
        "Dashed: change of the total contact force if the residuals act 10 mm above or below the "
        "midpoint of the contact points."
    )
    return Panel("residuals", "Residual forces", "% of the SI contact force", lines, note)


def _residual_moment(results: "Results") -> Panel:
    lines = (
        _line(results, "residual_axial_Nm", "axial", SUPERIOR),
        _line(results, "residual_coronal_Nm", "coronal, one condyle off", ANTERIOR),
        _line(results, "residual_flexion_Nm", "flexion, no quadriceps", RIGHT),
    )
    return Panel("residual_moment", "Residual moments", "N·m", lines)


def _hip_force(results: "Results") -> Panel:
    lines = _components(results, "hip_force", "N", 1 / body_weight(results))
    return Panel("hip_force", "Intersegmental force on the femur at the hip", "BW", lines)


def _hip_moment(results: "Results") -> Panel:
    lines = _components(results, "hip_moment", "Nm")
    note = "Moment about the named axes. The effect of muscles across the hip is included."
    return Panel("hip_moment", "Intersegmental moment on the femur at the hip", "N·m", lines, note)


def _motion(results: "Results") -> Panel:
    lines = [
        _line(results, "adduction_deg", "adduction", ANTERIOR),
        _line(results, "axial_rotation_deg", "axial rotation", SUPERIOR),
    ]
    if results.summary.get("axis", "flexion") != "flexion":
        lines.insert(0, _line(results, "flexion_deg", "flexion", RIGHT))
    note = (
        "Rotations of Grood and Suntay. Adduction is positive in varus. Axial rotation is positive "
        "if the femur turns outwards."
    )
    return Panel("motion", "Knee rotations", "deg", tuple(lines), note)


def _slip(results: "Results") -> Panel:
    note = (
        "Slip is the difference of the arc lengths that the contact travels on femur and insert. "
        "Slip due to axial rotation is not included. Condyles of equal radius have equal "
        "slip."
    )
    return Panel("slip", "Slip since the first frame", "mm", _both_sides(results, "slip_mm"), note)


def _adjustment(results: "Results") -> Panel:
    lines = (
        _line(results, "adjust_translation_mm", "translation, mm", BLACK),
        _line(results, "adjust_coronal_deg", "coronal angle, deg", ANTERIOR),
    )
    return Panel("adjustment", "Femoral adjustment before contact", "mm or deg", lines)


def _adjustment_effect(results: "Results") -> Panel:
    lines = (
        _line(results, "adjust_force_change_BW", "total force, BW", BLACK),
        _line(results, "adjust_share_change", "medial share (by equilibrium)", GREY, True),
    )
    note = "Adjusted minus recorded pose. A frame is flagged if its total changes by > 0.01 BW."
    return Panel("adjustment_effect", "Effect of the adjustment", "BW or share", lines, note)
