"""Places of plots in their figures, from the known sizes of their labels, without a layout
engine."""

from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.axis import Axis

from tkamb.show.svg import text_width


@dataclass(frozen=True)
class LabelPlaceSettings:
    """Room around the labels of a figure."""

    edge_points: float = 3.0
    """Points around all labels of a figure. Chosen by looks."""
    tick_points: float = 6.5
    """Points that ticks with their gap take. Chosen by looks."""
    tick_label_points: float = 9.0
    """Points: size of letters. Chosen by looks."""


LABEL_PLACE = LabelPlaceSettings()


def set_place(axes: Axes, x: float, bottom: float, wide: float, tall: float) -> None:
    """Put axes at a place in their figure (points); its layout engine is not used."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.set_layout_engine("none")
    width, height = 72 * figure.get_size_inches()
    axes.set_position((x / width, bottom / height, wide / width, tall / height))


def leave_unmeasured(axis: Axis) -> None:
    """Have an axis draw its labels without measuring them first."""
    for tick in axis.get_major_ticks(len(axis.get_majorticklocs())):
        tick.label1.set_in_layout(False)
        tick.label2.set_in_layout(False)


def shown_labels(axis: Axis) -> list[tuple[float, float]]:
    """Return an axis' labels: where each stands, 0 to 1 along the axis, and its width (points)."""
    low, high = axis.get_view_interval()
    ticks = axis.get_majorticklocs()
    labels = axis.get_major_formatter().format_ticks(list(ticks))
    places = [(tick - low) / (high - low) for tick in ticks]
    return [
        (place, text_width(label, LABEL_PLACE.tick_label_points))
        for place, label in zip(places, labels, strict=True)
        if 0.0 <= place <= 1.0
    ]


def label_width(axis: Axis) -> float:
    """Return the width (points) of a vertical axis' labels."""
    return max((width for _, width in shown_labels(axis)), default=0.0)


def overhang(axis: Axis, length: float) -> tuple[float, float]:
    """Return how far labels of a horizontal axis reach beyond its left and right end, points."""
    labels = shown_labels(axis)
    margin = max((0.5 * width - place * length for place, width in labels), default=0.0)
    right = max((0.5 * width - (1.0 - place) * length for place, width in labels), default=0.0)
    return max(margin, 0.0), max(right, 0.0)
