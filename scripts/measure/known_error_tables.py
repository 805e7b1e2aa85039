"""Tables of docs/known_errors.md, from scripts/data/known_error_cases.json."""

from collections.abc import Sequence

from error_cases import SITUATIONS
from error_rows import COMPARED, ErrorRow

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
