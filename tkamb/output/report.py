"""The report: one page that stands by itself, for a biomechanist to read in a minute."""

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb.atomic import write_text
from tkamb.output.axis import HorizontalAxis, horizontal_axis
from tkamb.output.cursor import SCRIPT, cursor_bar
from tkamb.output.headline import cards
from tkamb.output.metrics import body_weight, failed, flagged
from tkamb.output.panel import Panel
from tkamb.output.panels import centre_panel, panels
from tkamb.output.plots import draw_panel
from tkamb.output.policy import sources
from tkamb.output.pressure_maps import draw_maps, draw_paths, mapped_frames, top_view
from tkamb.output.provenance import provenance_rows, sentences
from tkamb.output.report_style import CSS, NOTEBOOK_CSS
from tkamb.output.style import svg_text
from tkamb.output.tables import flags_table, motion_table, strain_table

if TYPE_CHECKING:
    from tkamb.results import Results

POLICY = (
    f"default-src 'none'; script-src {sources(SCRIPT)}; style-src-elem {sources(CSS)}; "
    "style-src-attr 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
)
"""The page runs its own script and loads nothing; the plots set their colours in attributes."""


def write_report(results: "Results", path: str | Path) -> None:
    """Write the report of a run as one self-contained HTML page, whole or not at all.

    Raises:
        InputError: the folder cannot be written, or the summary lacks the body mass.
    """
    write_text(Path(path), report_html(results))


def report_html(results: "Results") -> str:
    """Return the report as HTML: vector plots, pictures and style are inside the page."""
    axis = horizontal_axis(results)
    title = escape(_title(results.summary))
    return (
        "<!DOCTYPE html>\n"
        f'<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        f"<title>{title}</title>\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{CSS}</style></head>\n<body>\n"
        f"<header><h1>{title}</h1><p>{_subtitle(results)}</p></header>\n"
        f"{_summary_section(results, axis)}{_maps_section(results, axis)}"
        f"{_plots_section(results, axis)}{_tables_section(results, axis)}"
        f"{_provenance_section(results)}{cursor_bar(results, axis)}</body></html>\n"
    )


def headline_html(results: "Results") -> str:
    """Return the headline numbers alone, with their style, for notebooks."""
    boxes = "".join(card.html() for card in cards(results, horizontal_axis(results)))
    title = escape(_title(results.summary))
    return (
        f"<div class='tkamb'><style>{NOTEBOOK_CSS}</style><h2>{title}</h2>"
        f"<p>{_subtitle(results)}</p><div class='cards'>{boxes}</div></div>"
    )


def _title(summary: dict[str, Any]) -> str:
    if summary.get("title"):
        return str(summary["title"])
    scene = Path(str(summary.get("scene", "tkamb run")))
    name = scene.parent.name if scene.stem == "scene" and scene.parent.name else scene.stem
    return name.upper() if len(name) <= 3 else name.replace("_", " ").capitalize()


def _subtitle(results: "Results") -> str:
    summary = results.summary
    contact = summary.get("contact") or {}
    weight = body_weight(results)
    parts = [
        f"{summary['side']} knee" if summary.get("side") else "",
        f"{summary['body_mass_kg']:g} kg; one body weight (BW) is {weight:.0f} N",
        _contact_words(contact),
    ]
    return " · ".join(escape(part) for part in parts if part)


def _contact_words(contact: dict[str, Any]) -> str:
    if not contact:
        return "contact not modelled"
    words = f"contact: {contact.get('model', 'unnamed')}"
    if contact.get("resolution_mm"):
        words += f" at {contact['resolution_mm']:g} mm"
    if contact.get("material"):
        words += f", {contact['material']}"
    return words


def _summary_section(results: "Results", axis: HorizontalAxis) -> str:
    boxes = "".join(card.html() for card in cards(results, axis))
    notes = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences(results.summary))
    listed = f"<h2>What to know</h2><ul class='notes'>{notes}</ul>" if notes else ""
    return f"<section><div class='cards'>{boxes}</div>{listed}</section>\n"


def _maps_section(results: "Results", axis: HorizontalAxis) -> str:
    view = top_view(results)
    frames = mapped_frames(results, axis)
    if view is None or not frames:
        return ""
    maps = svg_text(draw_maps(results, view, axis, frames), "maps")
    paths = svg_text(draw_paths(results, view, axis, frames), "paths")
    centres = _plot(centre_panel(results), results, axis)
    side = results.summary.get("side", "right")
    return (
        "<section><h2>Pressure on the insert</h2>"
        f"<figure class='wide'>{maps}<figcaption>Insert of the {escape(str(side))} knee from "
        "above, anterior up. Crosses: centres of pressure. One colour scale for the whole run."
        "</figcaption></figure>"
        "<div class='grid'>"
        f"<figure id='figure-paths'><h3>Paths of the centres of pressure</h3>{paths}"
        "<figcaption>Blue: medial, red: lateral; broken where a centre jumps. Dots: the frames "
        "above.</figcaption></figure>"
        f"{centres}</div></section>\n"
    )


def _plots_section(results: "Results", axis: HorizontalAxis) -> str:
    drawn = "".join(_plot(panel, results, axis) for panel in panels(results))
    return (
        f"<section><h2>Over the motion</h2>{_marks(results)}"
        f"<div class='grid'>{drawn}</div></section>\n"
    )


def _plot(panel: Panel, results: "Results", axis: HorizontalAxis) -> str:
    picture = svg_text(draw_panel(panel, results, axis), panel.name)
    kind = " class='warning'" if panel.warning else ""
    note = f"<figcaption{kind}>{escape(panel.note)}</figcaption>" if panel.note else ""
    return (
        f"<figure class='plot' id='figure-{panel.name}'><h3>{escape(panel.title)}"
        f" <small>({escape(panel.unit)})</small></h3>{picture}"
        f"<p class='readout'></p>{note}</figure>"
    )


def _marks(results: "Results") -> str:
    words = ["Lines run in time order."]
    if flagged(results).any():
        words.append("Orange ticks at the bottom: frames to be read with care.")
    if failed(results).any():
        words.append("Crosses at the bottom: frames that failed; the lines are broken there.")
    return f"<p class='legend'>{' '.join(words)}</p>"


def _tables_section(results: "Results", axis: HorizontalAxis) -> str:
    return (
        "<section><h2>Numbers</h2>"
        f"{motion_table(results, axis)}"
        "<p class='legend'>Recorded frames nearest to each place; nothing is interpolated. "
        "All columns of all frames are in results.csv.</p>"
        f"{strain_table(results.summary)}"
        f"<h2>Frames to be read with care</h2>{flags_table(results, axis)}</section>\n"
    )


def _provenance_section(results: "Results") -> str:
    rows = provenance_rows(results.summary)
    return f"<section><h2>Where it comes from</h2><table class='keys'>{rows}</table></section>\n"
