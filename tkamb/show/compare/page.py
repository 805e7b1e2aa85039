"""A comparison as one self-contained page."""

import math
from collections.abc import Sequence
from typing import Any

from tkamb.errors import InputError
from tkamb.run import metrics
from tkamb.run.metrics import failed
from tkamb.show.axis import UNITS
from tkamb.show.compare.comparison import Comparison, Difference
from tkamb.show.compare.figures import (
    QUANTITIES,
    draw_maps,
    draw_quantity,
    run_colour,
    shown_frame,
)
from tkamb.show.headline import muscle_limits, peak_legend, peak_words, peaks_of
from tkamb.show.pages import asset, policy_sources, render
from tkamb.show.style import svg_text

POLICY = (
    "default-src 'none'; style-src-elem {style}; style-src-attr 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'"
)
FIRST = (
    "force_total_N", "force_total_BW", "medial_force_N", "lateral_force_N",
    "medial_peak_pressure_MPa", "lateral_peak_pressure_MPa", "medial_area_mm2", "lateral_area_mm2",
    "medial_cop_ap_mm", "lateral_cop_ap_mm", "quadriceps_N", "patellar_ligament_N",
    "patellofemoral_N", "approach_mm",
)  # fmt: skip
"""Columns of the table that is printed and shown first; the page has the others below it."""


def headline(comparison: Comparison) -> list[Difference]:
    """Return the differences of the most important columns."""
    return [one for name in FIRST for one in comparison.differences if one.column == name]


def check_frame(comparison: Comparison, frame: int | None) -> int:
    """Return the frame of the first run at which maps are shown.

    Raises:
        InputError: the first run has no such frame.
    """
    count = len(comparison.runs[0].results)
    if frame is None:
        return shown_frame(comparison)
    if not -count <= frame < count:
        what = f"there is no frame {frame} in {comparison.runs[0].label}"
        raise InputError(what, "--frame", f"0 to {count - 1}")
    return frame % count


def comparison_html(comparison: Comparison, frame: int | None = None) -> str:
    """Return the page: different settings, curves, maps at a frame, differences.

    Raises:
        InputError: the first run has no such frame.
    """
    frame = check_frame(comparison, frame)
    style = asset("tkamb.show", "report.css") + asset("tkamb.show.compare", "compare.css")
    maps = draw_maps(comparison, frame)
    first = headline(comparison)
    return render(
        "tkamb.show.compare",
        "compare.html",
        policy=POLICY.format(style=policy_sources(style)),
        style=style,
        title=" and ".join(run.label for run in comparison.runs),
        kind=comparison.kind,
        runs=[_run(comparison, number) for number in range(len(comparison.runs))],
        peaks=peak_lines(comparison),
        notes=comparison.notes,
        plots=_plots(comparison),
        maps=None if maps is None else svg_text(maps, "maps"),
        first=_rows(comparison, first),
        rest=_rows(comparison, [one for one in comparison.differences if one not in first]),
    )


def _run(comparison: Comparison, number: int) -> dict[str, Any]:
    run = comparison.runs[number]
    contact = run.results.summary.get("contact") or {}
    model = contact.get("model", "contact not modelled")
    at = f" at {contact['resolution_mm']:g} mm" if contact.get("resolution_mm") else ""
    return {
        "label": run.label,
        "colour": run_colour(number),
        "folder": str(run.folder),
        "contact": f"{model}{at}",
        "frames": len(run.results),
        "failed": int(failed(run.results).sum()),
    }


def _plots(comparison: Comparison) -> list[dict[str, str]]:
    result = []
    for number, quantity in enumerate(QUANTITIES):
        figure = draw_quantity(comparison, quantity)
        if figure is not None:
            svg = svg_text(figure, f"plot{number}")
            result.append({"title": quantity.title, "unit": quantity.unit, "svg": svg})
    return result


def _rows(comparison: Comparison, differences: Sequence[Difference]) -> list[list[str]]:
    unit = UNITS[comparison.kind]
    return [
        [
            one.run,
            one.column,
            f"{one.max_abs:.4g}",
            f"{one.percent:.3g}" if math.isfinite(one.percent) else "–",
            f"{one.at_frame} ({one.at:.4g}{unit})" if one.max_abs else "–",
            f"{one.rms:.4g}",
            f"{one.mean:+.4g}" if one.mean else "0",
            str(one.frames),
        ]
        for one in differences
    ]


def peak_lines(comparison: Comparison) -> list[str]:
    """Return each run's peak forces with their bands, and its peak pressure, a line each."""
    lines = []
    for run in comparison.runs:
        peaks = peaks_of(run.results.summary)
        if peaks:
            words = ", ".join(f"{name} {peak_words(one)}" for name, one in peaks.items())
            lines.append(f"{run.label}: peak {words} BW, {peak_legend(peaks)}")
        if pressure := metrics.peak_pressure(run.results):
            words = f"peak pressure {pressure['MPa']:.1f} MPa, {pressure['side']}"
            words += f", at {pressure['time_s']:.4g} s"
            words += f", where {pressure['doubt']}" if pressure["doubt"] else ""
            lines.append(f"{run.label}: {words}")
        limits = muscle_limits(run.results)
        lines += [f"{run.label}: {limits.line()}"] if limits is not None else []
    return lines


def table_lines(comparison: Comparison) -> list[str]:
    """Return each run's peak forces, notes and the first differences as lines of text."""
    heads = ["run", "column", "max", "% of peak", "at frame", "rms", "mean", "frames"]
    rows = [heads, *_rows(comparison, headline(comparison))]
    widths = [max(len(row[k]) for row in rows) for k in range(len(heads))]
    table = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
    if len(rows) == 1:
        table = ["no differences could be computed"]
    notes = [f"note: {note}" for note in comparison.notes]
    return [*peak_lines(comparison), *notes, *(line.rstrip() for line in table)]
