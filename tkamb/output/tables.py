"""The report's tables: the motion at round places, and the frames to be read with care."""

from html import escape

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.output.axis import LABELS, HorizontalAxis
from tkamb.output.metrics import (
    body_weight,
    medial_share,
    residual_share,
    status_runs,
    tension_ratio,
)
from tkamb.results import Results

Entry = tuple[str, str, Array, int]
"""Heading, unit, values (f,), digits."""


def motion_table(results: Results, axis: HorizontalAxis) -> str:
    """Return the HTML table of the frames nearest to 0, 10, ..., or at even times."""
    entries = [entry for entry in _entries(results, axis) if np.isfinite(entry[2]).any()]
    head = "".join(
        f"<th>{escape(name)}<br><small>{escape(unit)}</small></th>" for name, unit, *_ in entries
    )
    body = "".join(
        "<tr>" + "".join(f"<td>{_number(v[k], digits)}</td>" for *_, v, digits in entries) + "</tr>"
        for k in axis.stops(13 if axis.kind == "flexion" else 11)
    )
    return f"<table class='numbers'><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def flags_table(results: Results, axis: HorizontalAxis) -> str:
    """Return the HTML table of the stretches of frames that are not ok."""
    rows = []
    for first, last, status in status_runs(results):
        frames = str(first) if first == last else f"{first}–{last}"
        place = axis.at(first) if first == last else f"{axis.at(first)} to {axis.at(last)}"
        numbers = "none" if np.isnan(results["force_total_N"][first]) else "given"
        rows.append(
            f"<tr><td>{frames}</td><td>{place}</td><td>{numbers}</td>"
            f"<td>{escape(plain_words(status))}</td></tr>"
        )
    if not rows:
        return "<p>Every frame is ok.</p>"
    name = LABELS[axis.kind].split(" (")[0]
    return (
        f"<table><thead><tr><th>frames</th><th>{name}</th><th>numbers</th><th>why</th></tr>"
        f"</thead><tbody>{''.join(rows)}</tbody></table>"
    )


def plain_words(status: str) -> str:
    """Return a status as a reader says it."""
    return "; ".join(word.strip().replace("_", " ") for word in status.split(";"))


def _entries(results: Results, axis: HorizontalAxis) -> list[Entry]:
    weight = body_weight(results)
    entries: list[Entry] = [("flexion", "deg", results["flexion_deg"], 1)]
    if axis.kind != "flexion":
        unit = "%" if axis.kind == "cycle" else "s"
        digits = 0 if axis.kind == "cycle" else 2
        entries.insert(0, (axis.kind, unit, axis.values, digits))
    entries.append(("total force", "BW", results["force_total_BW"], 2))
    for side in ("medial", "lateral"):
        entries.append((side, "N", results[f"{side}_force_N"], 0))
    entries.append(("medial share", "deform.", medial_share(results, "deformation"), 2))
    entries.append(("medial share", "equil.", medial_share(results, "equilibrium"), 2))
    for name, column, digits in (
        ("area", "area_mm2", 0),
        ("peak pressure", "peak_pressure_MPa", 1),
    ):
        unit = "mm²" if name == "area" else "MPa"
        for side in ("medial", "lateral"):
            entries.append((f"{side} {name}", unit, results[f"{side}_{column}"], digits))
    entries.append(("quadriceps", "BW", results["quadriceps_N"] / weight, 2))
    entries.append(("PL/Q", "–", tension_ratio(results, "patellar_ligament_N"), 2))
    entries.append(("PF/Q", "–", tension_ratio(results, "patellofemoral_N"), 2))
    entries.append(("residual", "% of SI", 100 * residual_share(results), 1))
    return entries


def _number(value: float, digits: int) -> str:
    if np.isnan(value):
        return "–"
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0 else text.replace("-", "−")
