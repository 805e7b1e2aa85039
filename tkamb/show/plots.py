"""Line plots of a run, drawn in time order against flexion, cycle or time."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import (
    MaxNLocator,
    MultipleLocator,
)

from tkamb.errors import InputError, must_be
from tkamb.run.metrics import failed, flagged
from tkamb.show.axis import HorizontalAxis, horizontal_axis
from tkamb.show.panels import Line, Panel, centre_panel, panels
from tkamb.show.style import (
    BLACK,
    EDGE_POINTS,
    GREY,
    ORANGE,
    TICK_POINTS,
    label_width,
    leave_unmeasured,
    legend_above,
    new_figure,
    set_place,
    settings,
    text_width,
)

if TYPE_CHECKING:
    from tkamb.run.results import Results

WIDTH, HEIGHT = 5.4, 3.1
DEFAULT = ("forces", "condyles", "ratios", "pressures")
TITLE_PAD, LEGEND_ROW = 8.0, 14.0
"""Points: distance of a plot from its title if there is no legend; addition to this distance for
each row of the legend."""
FOOT, OVERHANG, AXIS_LABEL = 31.5, 13.0, 13.0
"""Points: height of the labels under a plot; half the width of the last tick label; width of the
label of the vertical axis."""
SIDE_LABEL, LEGEND = 8.0, 8.5
"""Points: font sizes of the labels beside a plot and of the legend."""


# Points: distance of an axis label from the edge of the figure. Chosen by eye.
LABEL_OFFSET_POINTS = 12.0
# 1: gap between axes and the text beside them, as a share of the figure's width. Chosen by eye.
SIDE_GAP = 0.01
# 1: opacity of the band around a line, 0 to 1. Chosen by eye.
BAND_OPACITY = 0.16
# 1: opacity of the band that includes the discrepancy, 0 to 1. Chosen by eye.
WIDE_BAND_OPACITY = 0.07


HANDLE, COLUMN_GAP = 2.7, 1.4
"""Width of a legend handle with its gap, and gap between columns, in font sizes of the legend."""
DASHES = (0, (4, 2))
SPAN = "#e2e2e2"
STANCE = "#eef3f7"


class Sheet:
    """A figure on which the plots of a run are drawn one after the other.

    Axes and ticks take most of a plot's time and are reused. A plot that `_place_alone` cannot
    place has a separate figure.
    """

    def __init__(self, results: "Results", axis: HorizontalAxis, width: float = WIDTH) -> None:
        self._results, self._axis, self._width = results, axis, width
        self._axes = self._new_axes()

    def draw(self, panel: Panel) -> Figure:
        """Return a plot with marks of flagged and failed frames along the bottom.

        The SVG id of a curve is "line-" and the name of its line. The figure is valid until the
        next call.
        """
        with settings():
            self._clear()
            self._draw_on(self._axes, panel)
            axes = self._axes
            if not _place_alone(axes, panel):
                axes = self._new_axes()
                self._draw_on(axes, panel)
        figure = axes.get_figure(root=True)
        assert figure is not None
        return figure

    def _new_axes(self) -> Axes:
        with settings():
            return new_figure(self._width, HEIGHT).add_subplot()

    def _draw_on(self, axes: Axes, panel: Panel) -> None:
        _draw_stances(axes, self._axis)
        _draw_lines(axes, panel, self._axis)
        _label_axes(axes, panel, self._axis)
        mark_frames(axes, self._results, self._axis)
        legend_above(axes, _legend_columns(panel))

    def _clear(self) -> None:
        axes = self._axes
        for drawn in (*axes.lines, *axes.patches, *axes.collections, *axes.texts, *axes.child_axes):
            drawn.remove()
        axes.set_yscale("linear")
        axes.relim()
        axes.autoscale()


def plot(results: "Results", *names: str, axis: str | None = None) -> Figure:
    """Return the plots of a run in one matplotlib figure, which notebooks show.

    Args:
        results: results of a run.
        names: names of panels in the report ("forces", "condyles", "pressures", ...). Default:
            forces, condyles, ratios and pressures, if the run has them.
        axis: "flexion", "cycle" or "time"; default: the axis of the run.

    Raises:
        InputError: a plot or the axis does not exist.
    """
    from tkamb.run.results import Results

    must_be(results, Results, "plot", "give the results of a run")
    by_name = {panel.name: panel for panel in (*panels(results), centre_panel(results))}
    unknown = [name for name in names if name not in by_name]
    if unknown:
        raise InputError(
            f"the run has no plot '{unknown[0]}'", "plot", f"it has {', '.join(by_name)}"
        )
    chosen = [by_name[name] for name in names or DEFAULT if name in by_name]
    horizontal = horizontal_axis(results, axis)
    with settings():
        rows = max(1, -(-len(chosen) // 2))
        figure = new_figure(2 * WIDTH, rows * HEIGHT)
        for k, panel in enumerate(chosen):
            axes = figure.add_subplot(rows, min(2, len(chosen)), k + 1)
            _draw_lines(axes, panel, horizontal)
            _label_axes(axes, panel, horizontal)
            mark_frames(axes, results, horizontal)
            columns = _legend_columns(panel)
            above = TITLE_PAD + LEGEND_ROW * -(-len(panel.lines) // columns)
            axes.set_title(panel.title, loc="left", pad=above, fontweight="bold")
            legend_above(axes, columns)
    return figure


def _place_alone(axes: Axes, panel: Panel) -> bool:
    """Place the axes of a plot so that its labels fit, and return whether this was possible.

    The result equals matplotlib's slow constrained layout. It is impossible with a power of ten
    above a vertical axis, or too wide a legend.
    """
    for second in axes.child_axes:
        second.apply_aspect()  # the second axis takes its range from the first
    sides = [one.yaxis for one in (axes, *axes.child_axes)]
    widths = [label_width(side) for side in sides]
    if any(side.get_major_formatter().get_offset() for side in sides):
        return False
    first, *others = (
        EDGE_POINTS + TICK_POINTS + width + (AXIS_LABEL if side.get_label_text() else 0.0)
        for side, width in zip(sides, widths, strict=True)
    )
    words = [one[-1] for one in (panel.level, panel.span) if one]
    lines = [line for one in words for line in one.split(" ", 1)]
    outside = max((text_width(line, SIDE_LABEL) for line in lines), default=0.0)
    figure = axes.get_figure(root=True)
    assert figure is not None
    width, height = 72 * figure.get_size_inches()
    right = max(EDGE_POINTS + outside + SIDE_GAP * width, OVERHANG, *others)
    columns = _legend_columns(panel)
    if _legend_width(panel, columns) > width - first - EDGE_POINTS:
        return False
    rows = -(-len(panel.lines) // columns)
    top = EDGE_POINTS + LEGEND * (1.0 + rows + 0.5 * (rows - 1))
    wide, tall = width - first - right, height - FOOT - top
    set_place(axes, first, FOOT, wide, tall)
    axes.xaxis.set_label_coords(0.5, (LABEL_OFFSET_POINTS - FOOT) / tall)
    for side, place in zip(sides, (LABEL_OFFSET_POINTS, width - LABEL_OFFSET_POINTS), strict=False):
        side.set_label_coords((place - first) / wide, 0.5, axes.transAxes)
    for axis in (axes.xaxis, *sides):
        leave_unmeasured(axis)
    return True


def _legend_width(panel: Panel, columns: int) -> float:
    """Return the width of the legend made by `legend_above`, points."""
    texts = [text_width(line.label, LEGEND) for line in panel.lines]
    rows = -(-len(texts) // columns)
    wide = [max(texts[k : k + rows]) for k in range(0, len(texts), rows)]
    return sum(wide) + LEGEND * (HANDLE * len(wide) + COLUMN_GAP * (len(wide) - 1) + 1.0)


def mark_frames(axes: Axes, results: "Results", axis: HorizontalAxis) -> None:
    """Mark flagged frames with ticks and failed frames with crosses along the bottom."""
    transform = axes.get_xaxis_transform()
    for mask, marker, colour, name in (
        (flagged(results), "|", ORANGE, "flagged"),
        (failed(results), "x", BLACK, "failed"),
    ):
        if mask.any():
            x = axis.values[mask]
            axes.plot(
                x,
                np.full(len(x), 0.025),
                linestyle="none",
                marker=marker,
                color=colour,
                markersize=7 if marker == "|" else 5,
                markeredgewidth=1.6,
                transform=transform,
                gid=f"frames-{name}",
            )


def _draw_stances(axes: Axes, axis: HorizontalAxis) -> None:
    for on, off in axis.stances:
        axes.axvspan(on, off, facecolor=STANCE, edgecolor="none", zorder=0.2, gid="stance")


def _draw_lines(axes: Axes, panel: Panel, axis: HorizontalAxis) -> None:
    for line in panel.lines:
        x, y = axis.broken(line.values)
        dashes = DASHES if line.dashed else "-"
        gid = f"line-{line.name}"
        broad: Any = {"linewidth": 5.0, "alpha": 0.28, "zorder": 1.5} if line.behind else {}
        axes.plot(x, y, color=line.colour, linestyle=dashes, label=line.label, gid=gid, **broad)
        if line.band is not None and not line.dashed:
            _draw_band(axes, line, axis)


def _draw_band(axes: Axes, line: Line, axis: HorizontalAxis) -> None:
    """Shade the 5th to 95th percentile, and draw the median dotted."""
    assert line.band is not None
    (x, low), (_, middle), (_, high) = (axis.broken(one) for one in line.band)
    opacity, name = BAND_OPACITY, f"band-{line.name}"
    axes.fill_between(x, low, high, color=line.colour, alpha=opacity, linewidth=0, gid=name)
    if line.wide_band is not None:
        (x_wide, least), (_, most) = (axis.broken(one) for one in line.wide_band)
        pale, name = WIDE_BAND_OPACITY, f"wide-band-{line.name}"
        axes.fill_between(x_wide, least, most, color=line.colour, alpha=pale, linewidth=0, gid=name)
    axes.plot(x, middle, color=line.colour, linestyle=":", linewidth=1, gid=f"median-{line.name}")


def _legend_columns(panel: Panel) -> int:
    return 2 if sum(len(line.label) + 6 for line in panel.lines) > 72 else 4


def _label_axes(axes: Axes, panel: Panel, axis: HorizontalAxis) -> None:
    axes.set_xlabel(axis.label)
    axes.set_ylabel(panel.unit if panel.unit != "–" else "")
    low, high = float(np.min(axis.values)), float(np.max(axis.values))
    margin = 0.01 * (high - low) or 0.5
    axes.set_xlim(low - margin, high + margin)
    if axis.kind != "time" and high - low > 40:
        axes.xaxis.set_major_locator(MultipleLocator(20 if high - low > 70 else 10))
    _scale_vertically(axes, panel)
    if panel.level:
        _draw_level(axes, *panel.level)
    if panel.span:
        _draw_span(axes, *panel.span)
    if panel.second:
        _draw_second(axes, *panel.second)


def _scale_vertically(axes: Axes, panel: Panel) -> None:
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    drawn = [line.values for line in panel.lines]
    drawn += [one.band.ravel() for one in panel.lines if one.band is not None and not one.dashed]
    values = [one[np.isfinite(one)] for one in drawn]
    values.append(np.zeros(1))
    values.append(np.array(panel.level[:1] if panel.level else ()))
    values.append(np.array(panel.span[:2] if panel.span else ()))
    low, high = (float(f(np.concatenate(values))) for f in (np.min, np.max))
    if panel.limits:
        low, high = panel.limits
    span = high - low if high > low else 1.0
    axes.set_ylim(low - 0.06 * span, high + 0.04 * span)
    axes.axhline(0, color=GREY, linewidth=0.8, zorder=1)


def _draw_level(axes: Axes, value: float, label: str) -> None:
    axes.axhline(value, color=GREY, linewidth=1, linestyle=":", zorder=1, gid="level")
    transform = axes.get_yaxis_transform()
    words = label.replace(" ", "\n", 1)
    axes.text(1.01, value, words, transform=transform, va="center", fontsize=8, color=GREY)


def _draw_span(axes: Axes, low: float, high: float, label: str) -> None:
    """A range of one value appears as a line."""
    axes.axhspan(low, high, facecolor=SPAN, edgecolor=SPAN, linewidth=2, zorder=0.5, gid="span")
    middle, transform = 0.5 * (low + high), axes.get_yaxis_transform()
    words = label.replace(" ", "\n", 1)
    axes.text(1.01, middle, words, transform=transform, va="center", fontsize=8, color=GREY)


def _draw_second(axes: Axes, factor: float, unit: str) -> None:
    def to_second(value: Any) -> Any:
        return np.asarray(value, float) * factor

    def to_first(value: Any) -> Any:
        return np.asarray(value, float) / factor

    right = axes.secondary_yaxis("right", functions=(to_second, to_first))
    right.set_ylabel(unit)
    right.spines["right"].set_visible(True)
