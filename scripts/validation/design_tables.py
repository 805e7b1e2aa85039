"""Comparison of tables D-3 to D-6 with parametric designs, pressed with the tables' forces."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.studies.designs.design import load_design
from validation import dissertation
from validation.design_cells import (
    Condyle,
    PressedDesign,
    assumptions,
    in_public_units,
    table_cell,
    table_force,
)

FOLDERS = {
    "Sigma FB": "sigma_fb",
    "Sigma MB": "sigma_mb",
    "CR-Flex": "cr_flex",
    "LPS-Flex": "lps_flex",
    "NKII UCP": "nkii_ucp",
    "NKII CP": "nkii_cp",
}
"""Name of a design in the tables -> folder in models/designs."""
CONDYLES: tuple[Condyle, Condyle] = ("medial", "lateral")
QUANTITIES = ("area_mm2", "overlap_mm2", "mean_pressure_MPa", "overlap_pressure_MPa")
"""Contact area, area by the source's rule, and force over each."""


@dataclass(frozen=True)
class DesignTableSettings:
    """Tables of designs."""

    samples: int = 6
    """Number of samples besides the nominal case. Chosen because the table then takes hours."""


DESIGN_TABLE = DesignTableSettings()


def pressed_row(
    pressed: PressedDesign,
    name: str,
    condyle: Condyle,
    row: int,
    samples: int = DESIGN_TABLE.samples,
) -> dict[str, Any]:
    """Press one condyle at one percentage of the bend over all assumptions.

    Returns:
        design, condyle, percent, force_N, carried (of how many), and per quantity
        [nominal, least, median, largest].
    """
    force = table_force(name, condyle, row)
    percent = float(dissertation.table(1).percent[row])
    cases = assumptions(samples, pressed.design.bearing == "mobile")
    cells = [pressed.cell(condyle, percent, force, case) for case in cases]
    result = in_public_units(cell for cell in cells if cell is not None)
    spread = np.stack(
        [result[0], result.min(axis=0), np.median(result, axis=0), result.max(axis=0)], axis=1
    )
    values = {q: np.round(spread[i], 3).tolist() for i, q in enumerate(QUANTITIES)}
    return {
        "design": name,
        "condyle": condyle,
        "percent": percent,
        "force_N": round(force, 1),
        "carried": [len(result), len(cases)],
        **values,
    }


def press_tables(
    folder: Path,
    rows: Iterable[int] = range(11),
    resolution_mm: float = 2.0,
    announce: Callable[[str], None] = lambda words: None,
) -> list[dict[str, Any]]:
    """Press every design, condyle and percentage; see `pressed_row`.

    Args:
        folder: models/designs.
        rows: row numbers of the tables; 0 is the start of the bend.
        resolution_mm: cell size of the lattice.
        announce: function that gets a line of text per finished design.
    """
    result = []
    for name in dissertation.designs():
        pressed = PressedDesign(load_design(folder / FOLDERS[name]), resolution_mm)
        result += [pressed_row(pressed, name, c, row) for c in CONDYLES for row in rows]
        announce(name)
    return result


def compared(row: dict[str, Any]) -> dict[str, bool]:
    """Return per quantity whether the table's mean lies within the range over the assumptions."""
    index = int(np.flatnonzero(dissertation.table(1).percent == row["percent"])[0])
    area, pressure = table_cell(row["design"], row["condyle"], index)
    text = dict(zip(QUANTITIES, (area, area, pressure, pressure), strict=True))
    return {q: row[q][1] <= value <= row[q][3] for q, value in text.items()}


def overlapping(row: dict[str, Any]) -> dict[str, bool]:
    """Return per quantity whether our range and the table's mean ± one deviation overlap."""
    index = int(np.flatnonzero(dissertation.table(1).percent == row["percent"])[0])
    column = dissertation.designs().index(row["design"])
    shift = 0 if row["condyle"] == "medial" else 1
    text = {}
    for quantity in QUANTITIES:
        base = dissertation.MEDIAL_PRESSURE if "pressure" in quantity else dissertation.MEDIAL_AREA
        table = dissertation.table(base + shift)
        mean, deviation = table.mean[index, column], table.deviation[index, column]
        _, low, _, high = row[quantity]
        text[quantity] = bool(low <= mean + deviation and high >= mean - deviation)
    return text


def by_design(rows: Sequence[dict[str, Any]], quantity: str, condyle: Condyle) -> Array:
    """Return nominal values (11, 6) of a quantity, columns as in the tables."""
    percent = dissertation.table(1).percent.tolist()
    values = np.full((11, 6), np.nan)
    for row in rows:
        if row["condyle"] == condyle:
            at = percent.index(row["percent"]), dissertation.designs().index(row["design"])
            values[at] = row[quantity][0]
    return values


def pairs_in_order(ours: Array, table: Array) -> tuple[int, int]:
    """Return the number of pairs of designs in the table's order, and the number of all pairs.

    Args:
        ours: (6,) one number per design.
        table: (6,) the table's numbers.
    """
    pairs = list(combinations(range(len(table)), 2))
    right = sum((ours[i] - ours[j]) * (table[i] - table[j]) > 0 for i, j in pairs)
    return int(right), len(pairs)
