"""Figures as SVG: they equal matplotlib's, and repeated pictures are stored once."""

import base64
import io
import re

import numpy as np
import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG
from PIL import Image

from tkamb.show.style import new_figure, settings, written


def labelled_figure(size):
    figure = new_figure(4.0, 3.0)
    axes = figure.add_subplot()
    axes.plot([0.0, 1.0], [-2.0, 30.0], label="lower g")
    axes.set_title("a title\nof two lines", fontsize=size)
    axes.text(0.5, 0.0, "turned: $x^2$", rotation=30.0, fontsize=size)
    axes.legend()
    return figure


@pytest.mark.parametrize("size", [7.0, 12.0])
def test_texts_have_the_same_positions_as_in_matplotlib(size):
    expected = io.StringIO()
    with settings():
        text = written(labelled_figure(size), 150)
        figure = labelled_figure(size)
        figure.set_dpi(150)
        FigureCanvasSVG(figure).print_svg(expected, metadata={"Date": None, "Creator": None})
    assert text == expected.getvalue()


def test_a_repeated_picture_is_stored_once_in_its_own_resolution():
    colours = np.random.default_rng(1).integers(0, 255, (5, 7, 4), np.uint8)
    greys = np.repeat(colours[..., :1], 4, axis=2)
    with settings():
        figure = new_figure(4.0, 2.0)
        figure.set_layout_engine("none")
        for k in range(2):
            axes = figure.add_axes((0.5 * k, 0.0, 0.5, 1.0))
            axes.set_axis_off()
            axes.set(xlim=(0.0, 14.0), ylim=(0.0, 10.0))
            for picture in (greys, colours):
                place = {"extent": (0.0, 7.0, 2.0, 7.0), "aspect": "auto"}
                axes.imshow(picture, interpolation="none", clip_on=False, **place)
        text = written(figure, 150)
    addresses = re.findall(r'href="data:image/png;base64,([^"]+)"', text)
    assert len(addresses) == 2 and "pixelated" not in text
    for address, picture in zip(addresses, (greys, colours), strict=True):
        image = Image.open(io.BytesIO(base64.b64decode(address))).convert("RGBA")
        np.testing.assert_array_equal(np.asarray(image), picture)
    placed = re.findall(r'href="#(\w+)" transform="matrix\(([^)]+)\)', text)
    assert [name for name, _ in placed] == ["picture0", "picture1"] * 2
    for (_, matrix), left in zip(placed, (0.0, 0.0, 144.0, 144.0), strict=True):
        a, b, c, d, e, f = map(float, matrix.split())
        corners = np.array([[0.0, 0.0], [7.0, 5.0]]) @ [[a, b], [c, d]] + [e, f]
        np.testing.assert_allclose(corners - [left, 0.0], [[0.0, 43.2], [72.0, 115.2]], atol=1e-4)
