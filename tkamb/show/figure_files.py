"""The figures of a run as files for print: SVG, PDF and PNG of every plot of the report."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

from tkamb import __version__
from tkamb.show.axis import HorizontalAxis, horizontal_axis
from tkamb.show.headline import run_title
from tkamb.show.panels import centre_panel, panels
from tkamb.show.plots import Sheet
from tkamb.show.pressure_maps import draw_maps, draw_paths, mapped_frames, top_view
from tkamb.show.style import settings

if TYPE_CHECKING:
    from tkamb.run.results import Results

PRINT_DPI = 300
"""Dots per inch of a PNG: what journals ask for in figures of lines and grey levels."""
FORMATS = ("svg", "pdf", "png")


def write_figures(results: "Results", folder: Path) -> list[str]:
    """Write every plot and map of a run in each of `FORMATS` and return the names without suffix.

    Each file holds the title, the unit, the licence of the results and the version of tkamb.
    """
    names = []
    for name, words, figure in _figures(results, horizontal_axis(results)):
        names.append(name)
        for kind in FORMATS:
            metadata = figure_metadata(results, words, kind)
            with settings():
                figure.savefig(folder / f"{name}.{kind}", dpi=PRINT_DPI, metadata=metadata)
    return names


def _figures(results: "Results", axis: HorizontalAxis) -> Iterator[tuple[str, str, Figure]]:
    drawn = [*panels(results), centre_panel(results)]
    if results.summary.get("muscle_groups"):
        from tkamb.show.muscles import muscle_panels

        drawn += muscle_panels(results)
    sheet = Sheet(results, axis)
    for panel in drawn:
        if panel.lines:
            yield panel.name, f"{panel.title} ({panel.unit})", sheet.draw(panel)
    view, frames = top_view(results), mapped_frames(results, axis)
    if view is not None and frames:
        yield "maps", "Pressure on the insert (MPa)", draw_maps(results, view, axis, frames)
        yield "paths", "Paths of the centres of pressure", draw_paths(results, view, axis, frames)


def figure_metadata(results: "Results", words: str, kind: str) -> dict[str, Any]:
    """Return the metadata of a figure file, under the keys of its format."""
    title = f"{run_title(results.summary)}: {words}"
    software = f"tkamb {__version__}"
    source = f"scene SHA-256 {results.summary.get('scene_sha256', 'unknown')}"
    licence = licence_of(results.summary)
    if kind == "png":
        return {"Title": title, "Software": software, "Description": source, "Copyright": licence}
    if kind == "pdf":
        return {"Title": title, "Creator": software, "Subject": source, "Keywords": licence}
    return {
        "Title": title,
        "Creator": software,
        "Description": source,
        "Rights": licence,
        "Date": None,  # so that the same run has the same file
    }


def licence_of(summary: Any) -> str:
    """Return the licence of the results, from [output] licence."""
    return str(summary.get("licence") or "not stated by the scene ([output] licence)")
