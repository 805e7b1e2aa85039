"""Pressure on the patellar button, seen from the femur: superior is up."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from tkamb.run.metrics import lateral_axis_name, map_rows
from tkamb.show.axis import HorizontalAxis
from tkamb.show.pressure_maps import TopView, draw_centre, draw_pressure, place_maps, pressure_bar
from tkamb.show.style import new_figure, settings
from tkamb.units import MEGAPASCAL

if TYPE_CHECKING:
    from tkamb.run.results import Results

COUNT = 8
"""Number of maps."""


def draw_button_maps(results: "Results", axis: HorizontalAxis) -> Figure | None:
    """Return a figure of the button's pressure maps in some frames; None without maps.

    The frame of the largest pressure is one of them.
    """
    maps, rows = results.button_maps, map_rows(results, results.button_maps)
    if maps is None or not rows or not len(maps.triangles):
        return None
    peak = results["button_peak_pressure_MPa"]
    known = np.array(sorted(rows), int)
    chosen = {int(known[np.argmin(np.abs(known - stop))]) for stop in axis.stops(COUNT)}
    largest = int(known[np.nanargmax(peak[known])])
    if largest not in chosen:  # it replaces the nearest frame
        chosen.discard(min(chosen, key=lambda frame: abs(frame - largest)))
    frames = sorted({*chosen, largest})
    view = TopView(maps, str(results.summary.get("side", "right")), lateral_axis_name(results))
    scale = Normalize(0.0, float(peak[largest]))
    across = min(4, len(frames))
    down = -(-len(frames) // across)
    with settings():
        figure = new_figure(11.0, down * (10.0 / 4 * np.ptp(view.up) / np.ptp(view.across) + 0.75))
        grid, beside = place_maps(figure, down, across, 26.0)
        for axes, frame in zip(grid, frames, strict=False):
            view.draw_insert(axes)
            data = maps.frame_data(rows[frame])
            draw_pressure(axes, view, data["pressure_Pa"] / MEGAPASCAL, scale, data["gap_m"])
            centre = (results[f"button_cop_{place}_mm"][frame] for place in ("si", "ml"))
            draw_centre(axes, *view.page_coordinates(*centre))
            view.draw_labels(axes, upward="superior")
            words = "; peak pressure" if frame == largest else ""
            name = f"{axis.label.split(' (')[0]} {axis.at(frame)}"
            axes.set_title(f"{name}, {results['button_force_N'][frame]:.0f} N{words}", fontsize=8.5)
        for axes in grid[len(frames) :]:
            axes.set_axis_off()
        pressure_bar(figure, scale, cax=beside)
    return figure
