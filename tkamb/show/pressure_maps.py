"""Pressure on the insert seen from above, paths of the centres of pressure, and the button's map.

The view is from above: anterior is up, and the subject's right is on the right of the page. A left
knee is mirrored at input and mirrored back in the picture.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.run.maps import ContactMaps
from tkamb.run.metrics import lateral_axis_name, map_rows, stretches
from tkamb.run.metrics import peak as peak_of
from tkamb.show.axis import HorizontalAxis
from tkamb.show.levels import PageGrid, pressure_levels, touched_part
from tkamb.show.style import BLACK, GREY, PRESSURE_MAP, SIDE_COLOURS, new_figure, settings
from tkamb.units import MEGAPASCAL, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.run.results import Results


# mm: margin around the insert in a picture. Chosen by eye.
MARGIN_MM = 2.0
# mm: spacing of the grid on which pressures are drawn. Steps are then invisible.
STEP_MM = 0.3
# 1: share of the scale over which a map with small gradients fades at its rim. A steeper map fades
# over one spacing of the grid. Steps are then invisible.
RIM_SHARE = 0.03
# Number of grid points around the insert within which its smooth outline lies.
# Smoothing moves the outline by less.
OUTLINE_MARGIN = 8
# 1: standard deviation of the filter that smooths the outline, as a share of the map's edge
# length. 0.5 leaves steps visible and 1 rounds the notch.
OUTLINE_WIDTH = 0.7


LABEL_GAP_MM, LABEL_STEP_MM = 4.0, 2.6
"""mm: distance from a path to its labels, and between two labels."""
EDGE, ABOVE, BELOW, BETWEEN = 3.0, 17.0, 18.0, 6.0
"""Points: space to the left of maps, above each map for its title, below each map for its scale,
and between adjacent maps."""
BAR_LABELS, BAR_RATIO = 41.0, 30.0
"""Space to the right of a colour bar for its labels, points; ratio of its height to its width."""


class TopView:
    """The insert from above, in page coordinates: mm to the right and up.

    Args:
        lateral: direction of z of the insert frame, "lateral" or "medial".
    """

    def __init__(self, maps: ContactMaps, side: str, lateral: str) -> None:
        self.side = side
        self.sign = -1.0 if side == "left" and lateral == "lateral" else 1.0
        points = maps.points_m
        self.points = points
        self.across = self.sign * points[:, 2] / MILLIMETRE
        self.up = points[:, 0] / MILLIMETRE
        self.triangles = maps.triangles
        self.grid = PageGrid(points, self.triangles, self.sign, STEP_MM)
        self.grey = self.grid.sample(_shade(points, self.triangles))

    def page_coordinates(self, ap: Array, ml: Array) -> tuple[Array, Array]:
        """Return the page coordinates (mm) of x and z in the insert frame (mm)."""
        return self.sign * ml, ap

    @cached_property
    def insert_picture(self) -> tuple[Array, Array]:
        """Return grey level and opacity (rows, columns) of the insert, with a margin.

        The steps of the map's edge are smoothed: the outline is where the mean signed distance over
        about one triangle is zero.
        """
        from scipy.ndimage import distance_transform_edt, gaussian_filter  # takes 0.1 s to load

        grey = np.pad(self.grey, OUTLINE_MARGIN, constant_values=-1.0)
        over = grey >= 0
        far, nearest = distance_transform_edt(~over, return_indices=True)
        signed = distance_transform_edt(over) - far
        step = _edge_length_mm(self.points, self.triangles) / STEP_MM
        signed = gaussian_filter(signed, OUTLINE_WIDTH * step)
        return grey[tuple(nearest)], np.clip(0.5 + signed, 0.0, 1.0)

    @property
    def across_limits(self) -> tuple[float, float]:
        """Return the left and right end, mm."""
        return float(self.across.min() - MARGIN_MM), float(self.across.max() + MARGIN_MM)

    @property
    def up_limits(self) -> tuple[float, float]:
        """Return the lower and upper end, mm."""
        return float(self.up.min() - MARGIN_MM), float(self.up.max() + MARGIN_MM)

    def draw_insert(self, axes: Axes) -> None:
        """Draw the insert in greys that show its dishes, and set up the axes."""
        grey, opacity = self.insert_picture
        picture = colormaps["gray"](grey, bytes=True)
        picture[..., 3] = np.round(255 * opacity)
        left, right, low, high = self.grid.extent()
        margin = STEP_MM * OUTLINE_MARGIN
        extent = (left - margin, right + margin, low - margin, high + margin)
        _show(axes, picture, extent, 1.0)
        axes.set_xlim(self.across_limits)
        axes.set_ylim(self.up_limits)
        axes.set_aspect("equal")
        axes.set_axis_off()

    def draw_labels(self, axes: Axes, upward: str = "anterior") -> None:
        """Draw the labels of the upper side, medial and lateral, and a scale of 10 mm."""
        left, right = ("medial", "lateral") if self.side == "right" else ("lateral", "medial")
        style: Any = {"fontsize": 7.5, "color": GREY, "transform": axes.transAxes}
        axes.text(0.0, -0.01, left, ha="left", va="top", **style)
        axes.text(1.0, -0.01, right, ha="right", va="top", **style)
        axes.text(0.0, 1.0, f"{upward} ↑", ha="left", va="top", **style)
        axes.text(1.0, 1.0, self.side[0].upper(), ha="right", va="top", **style)
        low = self.up.min() - 3.0
        axes.plot([-5, 5], [low, low], color=GREY, linewidth=2, clip_on=False)
        axes.text(0, low - 0.8, "10 mm", ha="center", va="top", fontsize=7, color=GREY)


def top_view(results: "Results") -> TopView | None:
    """Return the view of the run's insert; None without maps."""
    if results.maps is None or len(results.maps.triangles) == 0:
        return None
    side = str(results.summary.get("side", "right"))
    return TopView(results.maps, side, lateral_axis_name(results))


def mapped_frames(results: "Results", axis: HorizontalAxis, count: int = 8) -> list[int]:
    """Return at most `count` frames with a map, spread over the motion, with that of the largest
    pressure.
    """
    frames = np.array(sorted(map_rows(results)), int)
    if not len(frames):
        return []
    chosen = {int(frames[np.argmin(np.abs(frames - stop))]) for stop in axis.stops(count)}
    peak = frame_of_peak(results)
    if peak is not None and peak not in chosen:
        if len(chosen) >= count:
            chosen.remove(min(chosen, key=lambda frame: abs(frame - peak)))
        chosen.add(peak)
    return sorted(chosen)


def frame_of_peak(results: "Results") -> int | None:
    """Return the frame of the largest pressure; None if this frame has no map."""
    largest = peak_of(results, "<side>_peak_pressure_MPa")
    return largest.frame if largest is not None and largest.frame in map_rows(results) else None


def draw_maps(
    results: "Results", view: TopView, axis: HorizontalAxis, frames: Sequence[int]
) -> Figure:
    """Return a figure of pressure maps of some frames, on a scale from 0 to the run's largest."""
    largest = 0.0 if results.maps is None else float(np.nanmax(results.maps.peaks_Pa)) / MEGAPASCAL
    scale = Normalize(0.0, largest if largest > 0 else 1.0)
    across = min(4, len(frames))
    down = -(-len(frames) // across)
    ratio = np.ptp(view.up) / np.ptp(view.across)
    with settings():
        figure = new_figure(11.0, down * (10.0 / 4 * ratio + 0.75))
        grid, beside = place_maps(figure, down, across, 26.0)
        for axes, frame in zip(grid, frames, strict=False):
            draw_map(axes, view, results, frame, scale)
            axes.set_title(_caption(results, axis, frame), fontsize=8.5)
        for axes in grid[len(frames) :]:
            axes.set_axis_off()
        bar = pressure_bar(figure, scale, cax=beside)
        stress = results.summary.get("yield_stress_MPa")
        if stress is not None and stress < float(scale.vmax or 1.0):
            bar.ax.axhline(stress, color="white", linewidth=1.5)
            bar.ax.text(-0.25, stress, "yield", ha="right", va="center", fontsize=7.5)
    return figure


def draw_map(
    axes: Axes,
    view: TopView,
    results: "Results",
    frame: int,
    scale: Normalize,
) -> None:
    """Draw a frame's pressure map and centres of pressure."""
    assert results.maps is not None
    row = map_rows(results)[frame]
    view.draw_insert(axes)
    data = results.maps.frame_data(row)
    draw_pressure(axes, view, data["pressure_Pa"] / MEGAPASCAL, scale, data["gap_m"])
    _draw_centres(axes, view, results, frame)
    view.draw_labels(axes)


def place_maps(figure: Figure, down: int, across: int, gap: float) -> tuple[list[Axes], Axes]:
    """Return the axes of maps, row by row, and the axes of their colour bar to the right.

    The labels' sizes are known, so no layout engine is needed.

    Args:
        gap: distance between maps and colour bar, points.
    """
    figure.set_layout_engine("none")
    width, height = 72 * figure.get_size_inches()
    tall = height / down - ABOVE - BELOW
    long = height - ABOVE - BELOW
    thick = long / BAR_RATIO
    right = gap + thick + BAR_LABELS
    wide = (width - EDGE - right + BETWEEN) / across - BETWEEN

    def place(x: float, y: float, across: float, up: float) -> Axes:
        return figure.add_axes((x / width, y / height, across / width, up / height))

    maps = [
        place(EDGE + k * (wide + BETWEEN), (down - 1 - row) * height / down + BELOW, wide, tall)
        for row in range(down)
        for k in range(across)
    ]
    return maps, place(width - BAR_LABELS - thick, BELOW, thick, long)


def pressure_bar(figure: Figure, scale: Normalize, **place: Any) -> Colorbar:
    """Return the colour bar of pressure maps with a common scale, MPa."""
    bar = figure.colorbar(ScalarMappable(scale, PRESSURE_MAP), **place)
    bar.set_label("contact pressure (MPa)")
    return bar


def draw_paths(
    results: "Results", view: TopView, axis: HorizontalAxis, frames: Sequence[int]
) -> Figure:
    """Return a figure of the paths of both centres of pressure on the insert."""
    with settings():
        figure = new_figure(5.4, 3.7)
        axes = figure.add_subplot()
        view.draw_insert(axes)
        for side, colour in SIDE_COLOURS.items():
            x, y = view.page_coordinates(results[f"{side}_cop_ap_mm"], results[f"{side}_cop_ml_mm"])
            parts = stretches(np.column_stack([x, y]) * MILLIMETRE)
            for number, part in enumerate(parts):
                line = np.full(len(x), np.nan)
                line[part] = x[part]
                name = f"path-{side}" + (f"-{number}" if number else "")
                axes.plot(line, y, color=colour, linewidth=1.6, gid=name)
            _label_stops(axes, x, y, axis, frames, colour)
        view.draw_labels(axes)
    return figure


def _edge_length_mm(points: Array, triangles: NDArray[np.int64]) -> float:
    edges = points[triangles] - points[np.roll(triangles, 1, axis=1)]
    return float(np.median(np.linalg.norm(edges, axis=-1))) / MILLIMETRE


def _shade(points: Array, triangles: NDArray[np.int64]) -> Array:
    """Return a grey level (n,), for light obliquely from above."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal *= np.where(normal[:, 1:2] < 0, -1.0, 1.0)
    summed = np.zeros_like(points)
    for k in range(3):
        np.add.at(summed, triangles[:, k], normal)
    length = np.linalg.norm(summed, axis=1)
    summed /= np.where(length > 0, length, 1.0)[:, None]
    light = np.array([0.5, 0.8, -0.33])
    return 0.55 + 0.4 * np.clip(summed @ (light / np.linalg.norm(light)), 0.0, 1.0)


def draw_pressure(
    axes: Axes, view: TopView, pressure: Array, scale: Normalize, gap: Array | None = None
) -> None:
    """Draw the pressure of one frame over the insert.

    Args:
        pressure: pressure at the map points, (n,), in the scale's unit.
        scale: colour scale that begins at 0.
        gap: gap at the map points, m, (n,). It locates the edge of the contact between the points.
    """
    peak = float(scale.vmax or 1.0)
    apart = None if gap is None else gap[None]
    level = view.grid.sample(pressure_levels(pressure[None], apart, view.triangles, peak)[0])
    if (level > 0).any():
        part = touched_part(level > 0)
        level = level[part]
        picture = colormaps[PRESSURE_MAP](np.maximum(level, 0.0), bytes=True)
        change = np.hypot(*np.gradient(level))  # change over one spacing of the grid
        picture[..., 3] = 255 * np.clip(0.5 + level / np.maximum(change, RIM_SHARE), 0.0, 1.0)
        _show(axes, picture, view.grid.extent(*part), 1.5)


def _show(
    axes: Axes,
    picture: NDArray[np.uint8],
    extent: tuple[float, float, float, float],
    height: float,
) -> None:
    axes.imshow(picture, extent=extent, interpolation="none", zorder=height, clip_on=False)


def _draw_centres(axes: Axes, view: TopView, results: "Results", frame: int) -> None:
    for side in SIDE_COLOURS:
        x, y = view.page_coordinates(
            results[f"{side}_cop_ap_mm"][frame], results[f"{side}_cop_ml_mm"][frame]
        )
        draw_centre(axes, x, y)


def draw_centre(axes: Axes, x: Array, y: Array) -> None:
    """Draw a centre of pressure at page coordinates, mm."""
    axes.plot(x, y, "+", color="white", markersize=7, markeredgewidth=2.4)
    axes.plot(x, y, "+", color=BLACK, markersize=6, markeredgewidth=1.1)


def _caption(results: "Results", axis: HorizontalAxis, frame: int) -> str:
    force = results["force_total_BW"][frame]
    peak = "; peak pressure" if frame == frame_of_peak(results) else ""
    return f"{axis.label.split(' (')[0]} {axis.at(frame)}, {force:.2f} BW{peak}"


def _label_stops(
    axes: Axes, x: Array, y: Array, axis: HorizontalAxis, frames: Sequence[int], colour: str
) -> None:
    """Draw dots at ends and `frames` of a path, labelled with the position on the axis."""
    finite = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if not len(finite):
        return
    first, last = int(finite[0]), int(finite[-1])
    chosen = sorted({first, last, *(k for k in frames if np.isfinite(x[k] + y[k]))})
    outward = 1.0 if np.nanmean(x) > 0 else -1.0
    column = outward * (np.nanmax(outward * x) + LABEL_GAP_MM)
    words = {first: "start ", last: "end "} if last > first else {}
    order = sorted(chosen, key=lambda k: y[k])
    for frame, height in zip(order, _spread(y[order], LABEL_STEP_MM), strict=True):
        axes.plot([x[frame], column], [y[frame], height], color=GREY, linewidth=0.5, zorder=2.5)
        axes.plot(x[frame], y[frame], "o", color=colour, ms=4, mec="white", zorder=3)
        axes.text(
            column + 0.5 * outward,
            height,
            words.get(frame, "") + axis.at(frame),
            ha="left" if outward > 0 else "right",
            va="center",
            fontsize=8,
            color=BLACK,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )


def _spread(heights: Array, step: float) -> Array:
    """Return increasing heights at least `step` apart."""
    count = np.arange(len(heights))
    raised = np.maximum.accumulate(heights - step * count) + step * count
    return raised - 0.5 * float(np.mean(raised - heights))


COUNT = 8
"""Number of maps."""


def draw_button_maps(results: "Results", axis: HorizontalAxis) -> Figure | None:
    """Return the button's maps in some frames, with that of the largest pressure; None without
    maps.
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
