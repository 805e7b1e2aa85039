"""The dissertation's tables D-1 to D-12 (Sharma 2008), and the errors in them.

The tables are kept as printed. `corrected` gives table D-12 with the two NKII columns exchanged,
which is the one change that a comparison needs. Other findings are data beside the tables
(`dissertation_findings.toml`); the functions here compute them from the tables.
"""

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array

GRAVITY = 9.80665
"""m/s²."""
MEDIAL_FORCE, LATERAL_FORCE, MEDIAL_AREA, LATERAL_AREA, MEDIAL_PRESSURE, LATERAL_PRESSURE = range(
    1, 7
)
QUADRICEPS, PATELLAR_LIGAMENT, PATELLOFEMORAL, AP_FORCE, ML_FORCE, SI_FORCE = range(7, 13)
"""Numbers of the tables."""
_FOLDER = Path(__file__).parent


@dataclass(frozen=True, eq=False)
class Table:
    """One table: mean and standard deviation per percentage of the bend and design.

    Args:
        number: 1 for D-1.
        page: page of appendix D, counted by its running heads.
        heading: printed heading, with the unit.
        unit: "BW", "mm2" or "MPa".
        percent: (11,) % of the deep knee bend (not degrees).
        mean: (11, 6) in the unit, columns as in `designs()`.
        deviation: (11, 6) standard deviation over the subjects.
    """

    number: int
    page: int
    heading: str
    unit: str
    percent: Array
    mean: Array
    deviation: Array


@cache
def _read(name: str) -> dict[str, Any]:
    return tomllib.loads((_FOLDER / f"dissertation_{name}.toml").read_text(encoding="utf-8"))


def designs() -> tuple[str, ...]:
    """Return the six designs in the order of the tables' columns."""
    return tuple(_read("tables")["columns"])


def subjects(design: str) -> int:
    """Return the number of subjects with a design."""
    return int(_read("tables")["subjects"][design])


def findings() -> tuple[dict[str, Any], ...]:
    """Return the errors in the tables; each row names its check and the cells."""
    return tuple(_read("findings")["finding"])


@cache
def table(number: int) -> Table:
    """Return table D-`number` as printed.

    Raises:
        InputError: no such table.
    """
    for row in _read("tables")["table"]:
        if row["number"] == number:
            values = np.array(row["rows"], float)
            return Table(
                number=number,
                page=row["page"],
                heading=row["heading"],
                unit=row["unit"],
                percent=values[:, 0],
                mean=values[:, 1::2],
                deviation=values[:, 2::2],
            )
    raise InputError(f"there is no table D-{number}", "dissertation", "give 1 to 12")


def corrected(number: int) -> Table:
    """Return a table as printed; in D-12 the NKII columns are exchanged."""
    printed = table(number)
    if number != SI_FORCE:
        return printed
    order = list(range(len(designs())))
    one, other = designs().index("NKII UCP"), designs().index("NKII CP")
    order[one], order[other] = other, one
    return Table(
        number,
        printed.page,
        printed.heading,
        printed.unit,
        printed.percent,
        printed.mean[:, order],
        printed.deviation[:, order],
    )


def implied_mass() -> Array:
    """Return the body mass (11, 6) kg that pressures, areas and forces imply together.

    m = (A_m p_m + A_l p_l) / ((F_m + F_l) g), A mm², p MPa, F BW: the tables' own mean pressure is
    force over area, so this is the mass by which the forces in BW were multiplied, up to the
    difference between a mean of ratios and a ratio of means.
    """
    force = sum(
        table(area).mean * table(pressure).mean
        for area, pressure in ((MEDIAL_AREA, MEDIAL_PRESSURE), (LATERAL_AREA, LATERAL_PRESSURE))
    )
    weights = table(MEDIAL_FORCE).mean + table(LATERAL_FORCE).mean
    return np.asarray(force / weights / GRAVITY)


def si_surplus(corrected_columns: bool) -> Array:
    """Return SI force minus the sum of both condyles' forces (11, 6) BW.

    A component is at most the whole, so rounding apart it must not be positive, and with shear of
    0.4 BW at most it is only a little negative.
    """
    upright = (corrected if corrected_columns else table)(SI_FORCE).mean
    return np.asarray(upright - table(MEDIAL_FORCE).mean - table(LATERAL_FORCE).mean)


def patellar_surplus() -> Array:
    """Return PF - |Q - PL| (11, 6) BW. If it is negative, the patella cannot be in equilibrium.

    Three forces on a body of small mass close a triangle, whatever their directions.
    """
    difference = table(QUADRICEPS).mean - table(PATELLAR_LIGAMENT).mean
    return np.asarray(table(PATELLOFEMORAL).mean - np.abs(difference))


def unexplained_pull() -> Array:
    """Return SI force - PL - 1 BW (11, 6) BW, the least force of other muscles and ligaments.

    Along the tibia, contact = ground reaction + patellar ligament + the rest. One leg's ground
    reaction is below 1 BW in a slow bend, and the ligament pulls along the tibia with its whole
    force at most.
    """
    return np.asarray(corrected(SI_FORCE).mean - table(PATELLAR_LIGAMENT).mean - 1.0)
