"""Figures written as SVG for a page: what they have in common is found once."""

import io
from functools import lru_cache
from typing import Any

from matplotlib.backends.backend_mixed import MixedModeRenderer
from matplotlib.backends.backend_svg import FigureCanvasSVG, RendererSVG
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.textpath import text_to_path


class Renderer(RendererSVG):
    """Draws as matplotlib's own does, but measures a text once for all figures."""

    def _get_font_height_metrics(self, prop: FontProperties) -> tuple[float, float, float]:
        """Return what matplotlib asks for since 3.11: ascent, descent and line gap, points."""
        return _letter_heights(prop.copy())

    def get_text_width_height_descent(
        self, s: str, prop: FontProperties, ismath: Any
    ) -> tuple[float, float, float]:
        """Return the size of a line of text, points."""
        return _text_size(s, prop.copy(), ismath)


def written(figure: Figure, dpi: int) -> str:
    """Return a figure as a whole SVG document in points.

    Args:
        figure: not laid out yet; its layout engine does so.
        dpi: of pictures that are not given point by point.
    """
    buffer = io.StringIO()
    FigureCanvasSVG(figure)  # a layout measures with it
    figure.set_dpi(72)
    width, height = figure.get_size_inches()
    nothing = {"Date": None, "Creator": None}
    vectors = Renderer(72 * width, 72 * height, buffer, image_dpi=dpi, metadata=nothing)
    renderer: Any = MixedModeRenderer(figure, width, height, dpi, vectors)
    figure.draw(renderer)
    renderer.finalize()
    return buffer.getvalue()


@lru_cache(maxsize=4096)
def _text_size(text: str, letters: FontProperties, ismath: Any) -> tuple[float, float, float]:
    return text_to_path.get_text_width_height_descent(text, letters, ismath)


@lru_cache(maxsize=64)
def _letter_heights(letters: FontProperties) -> tuple[float, float, float]:
    font = get_font(findfont(letters))
    table, head = font.get_sfnt_table("OS/2"), font.get_sfnt_table("head")
    assert table is not None and head is not None  # DejaVu, which comes with matplotlib, has both
    points = letters.get_size_in_points() / head["unitsPerEm"]
    ascent, descent = points * table["sTypoAscender"], -points * table["sTypoDescender"]
    return ascent, descent, points * table["sTypoLineGap"]
