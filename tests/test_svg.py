"""Figures as SVG: written as matplotlib writes them, shared parts once."""

import io

import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG

from tkamb.output.style import new_figure, settings
from tkamb.output.svg import written


def labelled_figure(size):
    figure = new_figure(4.0, 3.0)
    axes = figure.add_subplot()
    axes.plot([0.0, 1.0], [-2.0, 30.0], label="lower g")
    axes.set_title("a title\nof two lines", fontsize=size)
    axes.text(0.5, 0.0, "turned: $x^2$", rotation=30.0, fontsize=size)
    axes.legend()
    return figure


@pytest.mark.parametrize("size", [7.0, 12.0])
def test_texts_measured_once_stand_where_matplotlib_puts_them(size):
    own = io.StringIO()
    with settings():
        found = written(labelled_figure(size), 150)
        figure = labelled_figure(size)
        figure.set_dpi(150)
        FigureCanvasSVG(figure).print_svg(own, metadata={"Date": None, "Creator": None})
    assert found == own.getvalue()
