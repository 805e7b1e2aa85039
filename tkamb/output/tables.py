"""The report's tables: the motion at round places, and the frames to be read with care."""

import re
from collections.abc import Mapping, Sequence
from html import escape
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.output.axis import LABELS, HorizontalAxis
from tkamb.output.metrics import (
    body_weight,
    medial_share,
    residual_share,
    tension_ratio,
)

if TYPE_CHECKING:
    from tkamb.results import Results

Entry = tuple[str, str, Array, int]
"""Heading, unit, values (f,), digits."""

NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def motion_table(results: "Results", axis: HorizontalAxis) -> str:
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


def strain_table(summary: Mapping[str, Any]) -> str:
    """Return the HTML table of the ligaments' strains, so that a wrong insertion is seen."""
    found = summary.get("ligament_strain")
    if not found:
        return ""
    head = "".join(f"<th>{angle:g}°</th>" for angle in found["flexion_deg"])
    rows = "".join(
        f"<tr><td>{escape(name)}</td>"
        + "".join(f"<td>{_number(_percent(value), 1)}</td>" for value in strain)
        + "</tr>"
        for name, strain in found["strain"].items()
    )
    return (
        "<details><summary>Ligament strain at three flexions, %</summary>"
        "<p class='legend'>Negative: slack. A bundle above about 10 % is attached at the wrong "
        "place or has the wrong slack length. –: no recorded frame within 10°.</p>"
        f"<table><thead><tr><th>bundle</th>{head}</tr></thead>"
        f"<tbody>{rows}</tbody></table></details>"
    )


def _percent(strain: float | None) -> float:
    return float("nan") if strain is None else 100.0 * strain


def flags_table(results: "Results", axis: HorizontalAxis) -> str:
    """Return the HTML table of what is not ok: one row per reason, and in which frames."""
    rows = "".join(
        f"<tr><td>{escape(reason)}</td><td>{len(frames)}</td><td>{_stretches(frames)}</td>"
        f"<td>{_places(frames, axis)}</td></tr>"
        for reason, frames in reasons(results.status).items()
    )
    if not rows:
        return "<p>Every frame is ok.</p>"
    name = LABELS[axis.kind].split(" (")[0]
    return (
        "<p class='legend'>Frames are counted from 0. A frame that failed holds no numbers for "
        "what failed.</p><table><thead><tr><th>why</th><th>how many</th><th>frames</th>"
        f"<th>{name}</th></tr></thead><tbody>{rows}</tbody></table>"
    )


def reasons(statuses: Sequence[str]) -> dict[str, list[int]]:
    """Return reason in plain words -> its frames, failures first.

    Reasons that differ only in a number are one, with the range of the number.
    """
    found: dict[str, list[tuple[int, str]]] = {}
    for frame, status in enumerate(statuses):
        failure = status.startswith("failed")
        for position, word in enumerate(status.removeprefix("failed:").split(";")):
            words = word.strip().replace("_", " ")
            if words and words != "ok":
                words = f"failed: {words}" if failure and position == 0 else words
                found.setdefault(NUMBER.sub("#", words), []).append((frame, words))
    merged = {_merged([words for _, words in one]): [k for k, _ in one] for one in found.values()}
    return dict(sorted(merged.items(), key=lambda item: not item[0].startswith("failed")))


def _merged(variants: Sequence[str]) -> str:
    """Return one text for texts that differ in their numbers: with the numbers' ranges."""
    columns = zip(*(NUMBER.findall(words) for words in variants), strict=True)
    ranges = []
    for numbers in columns:
        low, high = min(numbers, key=float), max(numbers, key=float)
        ranges.append(low if low == high else f"{low}–{high}")
    parts = NUMBER.split(variants[0])
    return "".join(a + b for a, b in zip_longest(parts, ranges, fillvalue=""))


def _runs(frames: Sequence[int]) -> list[tuple[int, int]]:
    runs: list[tuple[int, int]] = []
    for frame in frames:
        if runs and runs[-1][1] == frame - 1:
            runs[-1] = (runs[-1][0], frame)
        else:
            runs.append((frame, frame))
    return runs


def _stretches(frames: Sequence[int]) -> str:
    return ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in _runs(frames))


def _places(frames: Sequence[int], axis: HorizontalAxis) -> str:
    return ", ".join(
        axis.at(a) if a == b else f"{axis.at(a)} to {axis.at(b)}" for a, b in _runs(frames)
    )


def _entries(results: "Results", axis: HorizontalAxis) -> list[Entry]:
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
        ("peak", "peak_pressure_MPa", 1),
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
