"""The report's tables: the motion at round places, and the frames to be read with care."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.run.metrics import (
    body_weight,
    medial_share,
    residual_share,
    tension_ratio,
)
from tkamb.show.axis import HorizontalAxis

if TYPE_CHECKING:
    from tkamb.run.results import Results

Entry = tuple[str, str, Array, int]
"""Heading, unit, values (f,), digits."""

NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@dataclass(frozen=True)
class TextTable:
    """A table of texts.

    Args:
        headings: of the columns; where they have units, (name, unit).
        rows: as long as the headings, but for a strain table's first cell, the bundle.
    """

    headings: Sequence[Any]
    rows: Sequence[Sequence[str]]


def motion_table(results: "Results", axis: HorizontalAxis) -> TextTable:
    """Return the frames nearest to 0, 10, ..., or at even times."""
    entries = [entry for entry in _entries(results, axis) if np.isfinite(entry[2]).any()]
    stops = axis.stops(13 if axis.kind == "flexion" else 11)
    return TextTable(
        [(name, unit) for name, unit, *_ in entries],
        [[_number(values[k], digits) for *_, values, digits in entries] for k in stops],
    )


def strain_table(summary: Mapping[str, Any]) -> TextTable | None:
    """Return the ligaments' strains in per cent, which reveal a wrong insertion."""
    result = summary.get("ligament_strain")
    if not result:
        return None
    return TextTable(
        [f"{angle:g}°" for angle in result["flexion_deg"]],
        [
            [name, *("–" if one is None else _number(100.0 * one, 1) for one in strain)]
            for name, strain in result["strain"].items()
        ],
    )


def flag_rows(results: "Results", axis: HorizontalAxis) -> list[tuple[str, str, str, str]]:
    """Return the statuses other than "ok": reason, number of frames, frames, and their places."""
    return [
        (reason, str(len(frames)), _stretches(frames), _positions(frames, axis))
        for reason, frames in reasons(results.status).items()
    ]


def reasons(statuses: Sequence[str]) -> dict[str, list[int]]:
    """Return reason in plain words -> its frames, failures first.

    Reasons that differ only in a number are one, with the range of the number.
    """
    result: dict[str, list[tuple[int, str]]] = {}
    for frame, status in enumerate(statuses):
        failure = status.startswith("failed")
        for position, word in enumerate(status.removeprefix("failed:").split(";")):
            words = word.strip().replace("_", " ")
            if words and words != "ok":
                words = f"failed: {words}" if failure and position == 0 else words
                result.setdefault(NUMBER.sub("#", words), []).append((frame, words))
    rows = {
        _with_ranges([words for _, words in one]): [k for k, _ in one] for one in result.values()
    }
    return dict(sorted(rows.items(), key=lambda item: not item[0].startswith("failed")))


def _with_ranges(variants: Sequence[str]) -> str:
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


def _positions(frames: Sequence[int], axis: HorizontalAxis) -> str:
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
