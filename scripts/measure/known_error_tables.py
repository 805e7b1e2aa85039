"""Tables of docs/known_errors.md: errors on the pairs of bodies, and the stated errors."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from error_cases import SITUATIONS
from error_rows import COMPARED, ErrorRow
from tkamb.run.known_errors import LEAST_PAIRS, STORED

HEADS = {
    "approach": "approach",
    "mean_pressure": "mean p",
    "peak_pressure": "peak p",
    "area": "area",
}


def tables(rows: Sequence[ErrorRow]) -> list[str]:
    """Return the lines of the page's block."""
    names = " | ".join(f"{HEADS[name]} %" for name in COMPARED)
    lines = [
        f"| material | contact | mm | situation | pairs | {names} "
        f"| held-out pairs | {names} | covered |",
        "| --- | --- | ---: | --- | ---: |" + " ---: |" * (2 * len(COMPARED) + 2),
    ]
    keys = dict.fromkeys((row.material, row.contact, row.resolution_mm) for row in rows)
    for key in keys:
        own = [r for r in rows if (r.material, r.contact, r.resolution_mm) == key]
        for place in SITUATIONS:
            stated, held = (
                [r for r in own if r.situation == place and r.errors and r.held_out is held_out]
                for held_out in (False, True)
            )
            if not stated and not held:
                continue
            limits = {
                name: max((r.errors[name] for r in own if r.errors and not r.held_out), default=0.0)
                for name in COMPARED
            }
            judged = [r.errors[name] <= limits[name] for r in held for name in COMPARED]
            covered = f"{100 * sum(judged) / len(judged):.0f} %" if judged else "–"
            cells = [key[0], key[1], f"{key[2]:g}", place, str(len(stated)), *_worst(stated)]
            lines.append("| " + " | ".join([*cells, str(len(held)), *_worst(held), covered]) + " |")
    pairs = {(r.case, r.held_out) for r in rows}
    apart = [r.uncertainty for r in rows]
    uncertain = ", ".join(
        f"{100 * max(u[name] for u in apart):.2g} % in {HEADS[name]}" for name in COMPARED
    )
    lines += [
        "",
        f"{len(pairs)} pairs, {sum(held for _, held in pairs)} of them held out. The references "
        f"themselves are uncertain by at most {uncertain}.",
    ]
    return lines


def _worst(rows: Sequence[ErrorRow]) -> list[str]:
    """Return the largest error of each quantity in per cent."""
    if not rows:
        return ["–"] * len(COMPARED)
    return [f"{100 * max(row.errors[name] for row in rows):.2g}" for name in COMPARED]


def stated_entries() -> list[dict[str, Any]]:
    """Return the content of `tkamb/run/known_errors.json`."""
    entries: list[dict[str, Any]] = json.loads(STORED.read_text(encoding="utf-8"))
    return entries


def stated_table(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the table of the errors that presses and runs state.

    Args:
        entries: content of `tkamb/run/known_errors.json`.
    """
    names = ("approach", "force", "mean_pressure", "peak_pressure", "area")
    heads = " | ".join(f"{({'force': 'condyle force'} | HEADS)[name]} %" for name in names)
    lines = [
        f"| material | contact | mm | pairs | cases | {heads} | thickness/radius | nu | covered |",
        "| --- | --- | ---: |" + " ---: |" * (len(names) + 5),
    ]
    for entry in entries:
        few = entry["pairs"] < LEAST_PAIRS or not entry["range"]
        shares = ["–" if few or entry[n] is None else f"{100 * entry[n]:.2g}" for n in names]
        ends = [entry["range"].get(n) for n in ("thickness_over_radius", "poisson_ratio")]
        spans = [
            " to ".join(dict.fromkeys(f"{value:.3g}" for value in span)) if span else "–"
            for span in ends
        ]
        covered = "–" if entry["covered"] is None else f"{100 * entry['covered']:.0f} %"
        cells = [entry["material"], entry["contact"], f"{entry['resolution_mm']:g}"]
        cells += [str(entry["pairs"]), str(entry["cases"]), *shares, *spans, covered]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def other_table(kept: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the table of geometries outside the measured pairs.

    Args:
        kept: content of scripts/data/other_geometries.json.
    """
    names = ("approach", "force", "mean_pressure", "peak_pressure", "area")
    heads = " | ".join(f"{({'force': 'condyle force'} | HEADS)[name]} %" for name in names)
    lines = [
        f"| geometry | contact, 1 mm | {heads} | stated error | reason |",
        "| --- | --- |" + " ---: |" * len(names) + " --- | --- |",
    ]
    for entry in kept.values():
        for row in entry["rows"]:
            found = row.get("errors", {})
            shares = [f"{100 * found[name]:.2g}" if name in found else "–" for name in names]
            cells = [row["geometry"], row["contact"], *shares, row["verdict"], row["why"]]
            lines.append(f"| {' | '.join(cells)} |")
    return lines
