"""The report of a run: one self-contained HTML page.

A slider selects a frame and moves a cursor in every plot. The page holds the values of the frames
as JSON, rounded to five digits; of a long recording it shows a few hundred frames. Without scripts,
and on paper, the page has no cursor.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.files import write_text
from tkamb.geometry.frames import Array
from tkamb.run.claims import split_of
from tkamb.run.metrics import body_weight, failed, flagged
from tkamb.show.axis import (
    EVENLY_SHOWN,
    LABELS,
    HorizontalAxis,
    horizontal_axis,
    results_at,
    shown_frames,
)
from tkamb.show.frame_maps import draw_insert, frame_maps, largest_pressure
from tkamb.show.headline import cards, run_title
from tkamb.show.pages import asset, policy_sources, render
from tkamb.show.panels import Panel, centre_panel, panels
from tkamb.show.plots import WIDTH, Sheet
from tkamb.show.pressure_maps import (
    draw_button_maps,
    draw_maps,
    draw_paths,
    mapped_frames,
    top_view,
)
from tkamb.show.sections import (
    conclusions,
    flag_rows,
    lead,
    methods,
    motion_table,
    strain_table,
    wear_section,
)
from tkamb.show.style import svg_text

if TYPE_CHECKING:
    from tkamb.run.results import Results

Progress = Callable[[Sequence[Panel]], Iterable[Panel]]

PACKAGE = "tkamb.show"
POLICY = (
    "default-src 'none'; script-src {script}; style-src-elem {style}; "
    "style-src-attr 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
)
"""Security policy: the browser runs only the page's script and loads nothing from elsewhere."""
THIRD = 2 / 3 * WIDTH
"""Inches: width of a plot in a row of three."""
SCRIPTS = ("cursor.js", "units.js", "insert.js", "downloads.js", "start.js")
"""Scripts of the page, in their order."""
COLOURS = (
    "Lines run in time order. In every plot blue is medial, orange lateral, black the resultant. "
    "Violet is superior–inferior, teal is anterior–posterior and olive is medial–lateral. A moment "
    "or rotation has the colour of its axis. The colour of a ligament or muscle applies within "
    "one plot only."
)
PROVENANCE = (
    "scene", "scene_sha256", "started", "command", "versions", "seconds", "contact", "frame",
)  # fmt: skip
"""Keys of the summary that the page shows unchanged."""


def write_report(results: "Results", path: str | Path) -> None:
    """Write the report of a run as one self-contained HTML page."""
    write_text(Path(path), report_html(results))


def report_html(results: "Results", progress: Progress = lambda drawn: drawn) -> str:
    """Return the report as a self-contained HTML page."""
    axis, shown = horizontal_axis(results), shown_frames(results)
    drawn = results_at(results, shown)
    drawn_axis = horizontal_axis(drawn)
    style = asset(PACKAGE, "report.css")
    script = "\n".join(asset(PACKAGE, name) for name in SCRIPTS)
    sheet = Sheet(drawn, drawn_axis)
    maps, force = _maps(drawn, drawn_axis, sheet), drawn["force_total_N"]
    return render(
        PACKAGE,
        "report.html",
        policy=POLICY.format(script=policy_sources(script), style=policy_sources(style)),
        style=style,
        script=script,
        title=run_title(results.summary),
        subtitle=_subtitle(results),
        lead=lead(results, axis),
        cards=cards(results, axis),
        conclusions=conclusions(results),
        sentences=_sentences(results.summary),
        maps=maps,
        legend=_legend(drawn, drawn_axis, len(results)),
        plots=[_plot(panel, sheet) for panel in progress(panels(drawn))],
        button=_button(drawn, drawn_axis),
        muscles=_muscles(drawn, drawn_axis),
        wear=wear_section(results),
        motion=motion_table(results, axis),
        strain=strain_table(results.summary),
        flags=flag_rows(results, axis),
        axis_name=LABELS[axis.kind].split(" (")[0],
        methods=methods(results.summary) if "scene_tables" in results.summary else None,
        provenance=_provenance(results.summary),
        last_frame=len(drawn) - 1,
        first_frame=int(np.nanargmax(force)) if np.isfinite(force).any() else 0,
        cursor=_cursor_data(drawn, drawn_axis)
        | {"frames": shown.tolist(), "maps": maps and maps["frames"]},
    )


def _subtitle(results: "Results") -> str:
    summary = results.summary
    contact = summary.get("contact") or {}
    weight = body_weight(results)
    parts = [
        f"{summary['side']} knee" if summary.get("side") else "",
        f"{summary['body_mass_kg']:g} kg; one body weight (BW) is {weight:.0f} N",
        _contact_words(contact, summary.get("material") or {}),
    ]
    return " · ".join(part for part in parts if part)


def _contact_words(contact: dict[str, Any], material: dict[str, Any]) -> str:
    if not contact:
        return "contact not modelled"
    words = f"contact: {contact.get('model', 'unnamed')}"
    if contact.get("resolution_mm"):
        words += f" at {contact['resolution_mm']:g} mm"
    name = material.get("name") or contact.get("material")
    if name:
        words += f", {name}"
    if material:
        modulus, ratio = material["young_modulus_MPa"], material["poisson_ratio"]
        words += f" (E {modulus:.4g} MPa, ν {ratio:.3g}, {material['law']})"
    return words


def _maps(results: "Results", axis: HorizontalAxis, sheet: Sheet) -> dict[str, Any] | None:
    view, frames = top_view(results), mapped_frames(results, axis)
    if view is None or not frames:
        return None
    return {
        "insert": svg_text(draw_insert(view, largest_pressure(results)), "map"),
        "frames": frame_maps(results, view),
        "pictures": svg_text(draw_maps(results, view, axis, frames), "maps"),
        "paths": svg_text(draw_paths(results, view, axis, frames), "paths"),
        "centres": _plot(centre_panel(results), sheet),
        "side": view.side,
        "apart": split_of(results.columns).estimate == "equilibrium",
    }


def _button(results: "Results", axis: HorizontalAxis) -> str | None:
    figure = draw_button_maps(results, axis)
    return None if figure is None else svg_text(figure, "button")


def _muscles(results: "Results", axis: HorizontalAxis) -> dict[str, Any] | None:
    if not results.summary.get("muscle_groups"):
        return None
    from tkamb.show.muscles import HELD, draw_activations, muscle_panels, reserve_words

    figure, sheet = draw_activations(results, axis), Sheet(results, axis, THIRD)
    return {
        "activations": None if figure is None else svg_text(figure, "activations"),
        "emg": bool(results.summary.get("emg")),
        "plots": [_plot(panel, sheet) for panel in muscle_panels(results)],
        "held": HELD,
        "reserves": reserve_words(results.summary),
    }


def _plot(panel: Panel, sheet: Sheet) -> dict[str, Any]:
    return {"panel": panel, "svg": svg_text(sheet.draw(panel), panel.name)}


def _legend(results: "Results", axis: HorizontalAxis, computed: int) -> list[str]:
    sentences = [COLOURS]
    if len(results) < computed:
        sentences.append(
            f"The plots, the maps and the slider show {len(results)} of the {computed} computed "
            "frames: every "
            f"{computed / EVENLY_SHOWN:.0f}th, and those of the largest value of each quantity. "
            "All numbers and tables are of all frames; results.csv and contact.h5 hold them."
        )
    if results.bands:
        sentences.append(
            "Shaded: 5 to 95 % of the samples with varied inputs. Dotted: median of the samples. "
            "Solid lines: inputs as given."
        )
    if axis.stances:
        words = "Shaded blue-grey: stance, the foot on its force plate"
        offs = results.summary["gait"]["toe_off_percent"] if axis.kind == "cycle" else ()
        words += "".join(f"; toe-off at {off:.0f} % of the cycle" for off in offs)
        sentences.append(f"{words}.")
    if results.band_with_discrepancy("force_total_N") is not None:
        sentences.append(
            "Paler and wider: 5 to 95 % with the discrepancy of the method added, which was "
            "estimated from measured knees."
        )
    if flagged(results).any():
        sentences.append("Orange ticks at the bottom: frames to be read with care.")
    if failed(results).any():
        sentences.append("Crosses at the bottom: frames that failed. The lines have gaps there.")
    return sentences


def _sentences(summary: dict[str, Any]) -> list[str]:
    result: list[str] = []
    for key in ("residuals", "assumptions"):
        value = summary.get(key) or []
        result.extend([value] if isinstance(value, str) else [str(item) for item in value])
    missing = summary.get("not_modelled")
    if missing:
        result.append("Not modelled: " + ", ".join(map(str, missing)) + ".")
    return list(dict.fromkeys(result))


def _provenance(summary: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        (key.replace("_", " ").replace("sha256", "SHA-256"), _text(summary[key]))
        for key in PROVENANCE
        if summary.get(key) not in (None, "", {}, [])
    ]


def _text(value: Any) -> str:
    if isinstance(value, dict):
        filled = {str(k).replace("_", " "): v for k, v in value.items() if v not in (None, {}, [])}
        return ", ".join(f"{name} {_text(item)}" for name, item in filled.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _cursor_data(results: "Results", axis: HorizontalAxis) -> dict[str, Any]:
    drawn = (*panels(results), centre_panel(results))
    if results.summary.get("muscle_groups"):
        from tkamb.show.muscles import muscle_panels

        drawn += muscle_panels(results)
    name = axis.label.split(" (")[0]
    return {
        "name": run_title(results.summary),
        "axis": axis.label,
        "bodyWeight": body_weight(results),
        "x": _round(axis.values),
        "place": [f"{name} {axis.at(k)}" for k in range(len(results))],
        "status": results.status,
        "panels": {
            panel.name: {"unit": panel.unit, "lines": _cursor_lines(panel)}
            for panel in drawn
            if panel.lines
        },
    }


def _cursor_lines(panel: Panel) -> list[dict[str, Any]]:
    """Return a panel's curves, with decimals that resolve about a hundredth to a thousandth of its
    largest value.
    """
    largest = max(float(np.nanmax(np.abs(line.values))) for line in panel.lines)
    digits = int(np.clip(2 - np.floor(np.log10(largest)), 0, 4)) if largest > 0 else 0
    return [
        {
            "label": line.label,
            "colour": line.colour,
            "dashed": line.dashed,
            "digits": digits,
            "values": _round(line.values),
        }
        for line in panel.lines
    ]


def _round(values: Array) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]
