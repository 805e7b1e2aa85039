"""The numbers of a frame in words, as the viewer shows them."""

from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.output.axis import HorizontalAxis
from tkamb.output.metrics import body_weight, medial_share
from tkamb.view.drawing import Reading

if TYPE_CHECKING:
    from tkamb.results import Results


def readings(results: "Results", axis: HorizontalAxis) -> tuple[Reading, ...]:
    """Return the lines of numbers; what no frame has is left out."""
    weight = body_weight(results)
    hip = np.sqrt(sum(results[f"hip_force_{a}_N"] ** 2 for a in ("ap", "si", "ml")))
    ground = np.sqrt(sum(results[f"ground_reaction_{a}_N"] ** 2 for a in ("ap", "si", "ml")))
    rows = [
        _number("flexion", results["flexion_deg"], "°", 1),
        _turned("adduction", results["adduction_deg"], "varus", "valgus"),
        _turned("axial rotation", results["axial_rotation_deg"], "ext.", "int."),
        _force("contact force", results["force_total_N"], weight),
        _both("· by deformation", results, "{}_force_N", " BW", 2, 1.0 / weight),
        _both("· by equilibrium", results, "{}_force_equilibrium_N", " BW", 2, 1.0 / weight),
        _number("· medial share, deform.", 100 * medial_share(results, "deformation"), " %", 0),
        _number("· medial share, equil.", 100 * medial_share(results, "equilibrium"), " %", 0),
        _both("peak pressure", results, "{}_peak_pressure_MPa", " MPa", 1),
        _both("contact area", results, "{}_area_mm2", " mm²", 0),
        _force("quadriceps", results["quadriceps_N"], weight),
        _force("patellar ligament", results["patellar_ligament_N"], weight),
        _force("patellofemoral", results["patellofemoral_N"], weight),
        _force("hip", hip, weight),
        _force("ground reaction", ground, weight),
    ]
    time = tuple(f"{t:.2f} s" for t in results["time_s"])
    shown = [row for row in rows if any(value != "–" for value in row.values)]
    return (Reading("time", time), *shown)


def places(axis: HorizontalAxis) -> tuple[str, ...]:
    """Return where in the motion each frame is, in words."""
    words = {"flexion": "{} of flexion", "cycle": "{} of the cycle", "time": "{}"}[axis.kind]
    return tuple(words.format(axis.at(k)) for k in range(len(axis.values)))


def _number(name: str, values: Array, unit: str, digits: int) -> Reading:
    return Reading(name, tuple(_text(value, unit, digits) for value in values))


def _force(name: str, values: Array, weight: float) -> Reading:
    return Reading(
        name,
        tuple(
            f"{value / weight:.2f} BW ({value:.0f} N)" if np.isfinite(value) else "–"
            for value in values
        ),
    )


def _turned(name: str, angles: Array, positive: str, negative: str) -> Reading:
    """Return angles without a sign, with the word for their direction."""
    words = (positive if angle >= 0 else negative for angle in np.round(angles, 1))
    return Reading(
        name,
        tuple(
            f"{abs(angle):.1f}° {word}" if np.isfinite(angle) else "–"
            for angle, word in zip(angles, words, strict=True)
        ),
    )


def _both(
    name: str, results: "Results", pattern: str, unit: str, digits: int, scale: float = 1.0
) -> Reading:
    """Return medial and lateral values in one line."""
    medial, lateral = (scale * results[pattern.format(side)] for side in ("medial", "lateral"))
    return Reading(
        name,
        tuple(
            f"M {_text(m, '', digits)} · L {_text(x, '', digits)}{unit}"
            if np.isfinite(m) or np.isfinite(x)
            else "–"
            for m, x in zip(medial, lateral, strict=True)
        ),
    )


def _text(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f}{unit}".replace("-", "−") if np.isfinite(value) else "–"
