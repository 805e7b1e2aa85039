"""docs/validation.md: published numbers and tkamb's, from the results of `scripts/validate`."""

import math
import tomllib
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from validation import dissertation, patella
from validation.design_tables import (
    CONDYLES,
    QUANTITIES,
    by_design,
    compared,
    overlapping,
    pairs_in_order,
)

Row = dict[str, Any]
WORDS = {
    "area_mm2": "contact area",
    "overlap_mm2": "overlapping area (the source's rule)",
    "mean_pressure_MPa": "force over contact area",
    "overlap_pressure_MPa": "force over overlapping area (the source's rule)",
}

MADE = """\
Made by `{command}` on {date}, tkamb {version}, in {cpu_minutes:.0f} minutes of processor time.
Published values and their sources are in `scripts/validation/*.toml`, those of tkamb in
`scripts/data/validation.json`. The radii of the designs were chosen before the first comparison and
not changed. Two benchmarks were changed after the first comparison, which turned four misses into
hits. The load on the bonded layer was increased, because 60 N gave a contact only two cells wide.
The effect of malrotation became a difference for rotation about the middle of the knee, instead of
a ratio for rotation about the axis of one condyle."""
COUNTED = """\
Each condyle is loaded by itself with the force of the table, for the body mass that areas and
pressures of the design imply. The contact model is `lattice` at 2 mm. The assumed inputs are
flexion at 0 and 100 % of the bend, AP position, axial rotation and size. They have their nominal
values, and those of a Latin hypercube. "In" counts the cells whose mean lies in the range of these
results. "Meets" counts the cells whose mean ± one standard deviation overlaps that range."""
ORDERED = """\
"Pairs in order" counts the pairs of designs whose means over the bend have the order of the table.
"FB / MB" is the mean of Sigma FB (fixed bearing) over that of Sigma MB (mobile bearing). "Trends"
counts the designs whose change from 0 to 100 % of the bend has the sign of the table."""
BENT = """\
Designs from `scripts/make/designs` in a few frames of the shipped knee bend, `lattice` at 2 mm."""
CELLS = """\
tkamb: nominal result (range over the assumed inputs). Table: mean ± standard deviation. Areas are
in mm², pressures in MPa. "Contact" is the area where the surfaces touch, "overlap" the area by the
rule of the source."""


@cache
def published() -> dict[str, Any]:
    """Return sources, values, and values that are not compared."""
    text = (Path(__file__).parent / "published.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def hit(value: Row, ours: float) -> bool:
    """Return whether our value lies within the published band."""
    return bool(value["low"] <= ours <= value["high"])


def badge(values: dict[str, float]) -> str:
    """Return the line that counts the values within their bands."""
    rows = [row for row in published()["value"] if row["id"] in values]
    within = sum(hit(row, values[row["id"]]) for row in rows)
    line = f"**{within} of {len(rows)} published values are within their band.**"
    line += " The band is that of the source, or the one stated beside the value."
    missing = len(published()["value"]) - len(rows)
    return line if not missing else f"{line} {missing} more are not computed yet."


def page(stored: dict[str, Any]) -> str:
    """Return the page's text from the stored JSON."""
    parts = [
        _head(stored),
        _values(stored["values"]),
        patella.section(),
        _not_compared(),
        _findings(),
        _counts(stored["tables"]),
        _order(stored["tables"]),
        _bends(stored["bends"]),
        _cells(stored["tables"]),
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _head(stored: dict[str, Any]) -> list[str]:
    within = Counter(q for row in stored["tables"] for q, yes in compared(row).items() if yes)
    cells = len(stored["tables"])
    result = ", ".join(f"{WORDS[q]} {within[q]}" for q in QUANTITIES)
    return [
        "# Comparison with published values",
        "",
        "This page compares results of tkamb with experiments and models of other groups.",
        "",
        badge(stored["values"]),
        "",
        f"The tables D-3 to D-6 of Sharma (2008) have {cells} cells for each quantity. Numbers of "
        f"cells within the range of tkamb over the assumed inputs: {result}.",
        "",
        MADE.format(**stored),
    ]


def _values(values: dict[str, float]) -> list[str]:
    sources = {s["key"]: s for s in published()["source"]}
    lines = [
        "## Values",
        "",
        "| source | quantity | published | tkamb | |",
        "| --- | --- | ---: | ---: | --- |",
    ]
    for row in published()["value"]:
        unit = f" {row['unit']}" if row["unit"] else ""
        text = f"{_band(row['low'], row['high'])}{unit} ({row['band']})"
        ours, verdict = "", "not computed yet"
        if row["id"] in values:
            ours = f"{_number(values[row['id']])}{unit}"
            verdict = "hit" if hit(row, values[row["id"]]) else "**missed**"
        name = sources[row["source"]]["cited"].split(",")[0].split(" (")[0]
        lines.append(f"| {name} | {row['says']} | {text} | {ours} | {verdict} |")
    lines += ["", "Sources, and the part that was read:", ""]
    for source in sources.values():
        doi = f", doi:{source['doi']}" if source["doi"] else ""
        lines.append(f"- {source['cited']}{doi}: {source['read']}")
    return lines


def _not_compared() -> list[str]:
    lines = ["## Not compared, and why", ""]
    for row in published()["not_compared"]:
        doi = f", doi:{row['doi']}" if row["doi"] else ""
        why = row["why"][0].upper() + row["why"][1:]
        lines.append(f"- {row['cited']}{doi}: {row['says']}. {why}.")
    return lines


def _findings() -> list[str]:
    lines = ["## Errors in tables D-1 to D-12", ""]
    for row in dissertation.findings():
        tables = ", ".join(f"D-{n}" for n in row["tables"])
        lines.append(f"- {row['name']} ({tables}). {row['says']}")
    return lines


def _counts(rows: Sequence[Row]) -> list[str]:
    lines = [
        "## Tables D-3 to D-6: how many cells",
        "",
        COUNTED,
        "",
        "| design | condyle | "
        + " | ".join(f"{WORDS[q]}: in, meets" for q in QUANTITIES)
        + " | of |",
        "| --- | --- |" + " ---: |" * (len(QUANTITIES) + 1),
    ]
    for name in dissertation.designs():
        for condyle in CONDYLES:
            some = [r for r in rows if (r["design"], r["condyle"]) == (name, condyle)]
            counts = [
                f"{sum(compared(r)[q] for r in some)}, {sum(overlapping(r)[q] for r in some)}"
                for q in QUANTITIES
            ]
            lines.append(f"| {name} | {condyle} | " + " | ".join(counts) + f" | {len(some)} |")
    return lines


def _order(rows: Sequence[Row]) -> list[str]:
    lines = [
        "## Ranking and trends",
        "",
        ORDERED,
        "",
        "| quantity | condyle | pairs in order | FB / MB tkamb | FB / MB table | trends |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
    ]
    for quantity in QUANTITIES:
        for shift, condyle in enumerate(CONDYLES):
            base = (
                dissertation.MEDIAL_PRESSURE if "pressure" in quantity else dissertation.MEDIAL_AREA
            )
            table, ours = dissertation.table(base + shift).mean, by_design(rows, quantity, condyle)
            right, pairs = pairs_in_order(ours.mean(axis=0), table.mean(axis=0))
            fixed, mobile = (dissertation.designs().index(f"Sigma {b}") for b in ("FB", "MB"))
            ratios = [m.mean(axis=0)[fixed] / m.mean(axis=0)[mobile] for m in (ours, table)]
            trend = int((np.sign(ours[-1] - ours[0]) == np.sign(table[-1] - table[0])).sum())
            lines.append(
                f"| {WORDS[quantity]} | {condyle} | {right} of {pairs} | {ratios[0]:.2f} | "
                f"{ratios[1]:.2f} | {trend} of {table.shape[1]} |"
            )
    return lines


def _bends(bends: Sequence[Row]) -> list[str]:
    lines = [
        "## Each design in the deep knee bend",
        "",
        BENT,
        "",
        "| design | frames | failed | peak BW | peak MPa | medial share by equilibrium |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in bends:
        low, high = row["medial_share"]
        lines.append(
            f"| {row['design']} | {row['frames']} | {row['failed']} | {row['peak_force_BW']:.2f} | "
            f"{row['peak_pressure_MPa']:.1f} | {low:.2f} to {high:.2f} |"
        )
    return lines


def _cells(rows: Sequence[Row]) -> list[str]:
    lines = [
        "## Every cell",
        "",
        CELLS,
        "",
        "| design | condyle | % | N | area: contact | overlap | table "
        "| pressure: contact | overlap | table |",
        "| --- | --- | ---: | ---: |" + " ---: |" * 6,
    ]
    percent = dissertation.table(1).percent.tolist()
    for row in rows:
        at = percent.index(row["percent"]), dissertation.designs().index(row["design"])
        shift = CONDYLES.index(row["condyle"])
        text = []
        for number in (dissertation.MEDIAL_AREA, dissertation.MEDIAL_PRESSURE):
            table = dissertation.table(number + shift)
            text.append(f"{table.mean[at]:g} ± {table.deviation[at]:g}")
        spread = {q: f"{row[q][0]:.3g} ({row[q][1]:.3g} to {row[q][3]:.3g})" for q in QUANTITIES}
        lines.append(
            f"| {row['design']} | {row['condyle']} | {row['percent']:g} | {row['force_N']:.0f} | "
            f"{spread['area_mm2']} | {spread['overlap_mm2']} | {text[0]} | "
            f"{spread['mean_pressure_MPa']} | {spread['overlap_pressure_MPa']} | {text[1]} |"
        )
    return lines


def _band(low: float, high: float) -> str:
    if math.isinf(high):
        return f"above {low:g}"
    return f"{low:g} to {high:g}"


def _number(value: float) -> str:
    return f"{value:.3g}"
