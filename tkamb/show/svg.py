"""Figures for a page: axes placed by the sizes of their labels, and SVG text.

The size of each text is computed once for all figures.
"""

import base64
import io
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backend_bases import GraphicsContextBase
from matplotlib.backends.backend_mixed import MixedModeRenderer
from matplotlib.backends.backend_svg import FigureCanvasSVG, RendererSVG
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.textpath import text_to_path
from matplotlib.transforms import Affine2DBase
from numpy.typing import NDArray
from PIL import Image


@dataclass(frozen=True)
class LabelPlaceSettings:
    """Room around the labels of a figure."""

    edge_points: float = 3.0
    """Points around all labels of a figure. Chosen by eye."""
    tick_points: float = 6.5
    """Points that ticks with their gap take. Chosen by eye."""
    tick_label_points: float = 9.0
    """Points: size of letters. Chosen by eye."""


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


class Renderer(RendererSVG):
    """Draws like matplotlib's own renderer, but measures each text once for all figures.

    Pictures given point by point (`interpolation="none"`) are smoothed by whoever shows them and
    stand once in a figure, however often they are drawn; they are not clipped.
    """

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._pictures: dict[bytes, str] = {}

    def draw_image(
        self,
        gc: GraphicsContextBase,
        x: float,
        y: float,
        im: Any,
        transform: Affine2DBase | None = None,
    ) -> None:
        """Draw a picture (rows, columns, 4); with a transform (points) it is given by points."""
        if transform is None:
            return super().draw_image(gc, x, y, im)
        content, (rows, columns) = im.tobytes(), im.shape[:2]
        if content not in self._pictures:
            self._pictures[content] = name = f"picture{len(self._pictures)}"
            size = {"width": str(columns), "height": str(rows)}
            self.writer.start("defs")
            self.writer.element("image", id=name, href=png_address(im), **size)
            self.writer.end("defs")
        to_page = [[1.0, 0.0, x], [0.0, -1.0, self.height - y], [0.0, 0.0, 1.0]]
        placed = to_page @ transform.get_matrix() @ np.diag([1 / columns, 1 / rows, 1.0])
        matrix = " ".join(f"{value:.7g}" for value in placed[:2].T.ravel())
        name = self._pictures[content]
        self.writer.element("use", href=f"#{name}", transform=f"matrix({matrix})")

    def _get_font_height_metrics(self, prop: FontProperties) -> tuple[float, float, float]:
        """Return ascent, descent and line gap, points, which matplotlib needs since 3.11."""
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
        dpi: resolution of pictures that are not given point by point.
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


def png_address(picture: NDArray[np.uint8]) -> str:
    """Return a picture, (rows, columns) of greys or (rows, columns, 4), as a PNG data address."""
    image, buffer = Image.fromarray(picture), io.BytesIO()
    if picture.ndim == 3 and (picture[..., :1] == picture[..., 1:3]).all():
        image = image.convert("LA")
    image.save(buffer, "PNG")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def text_width(text: str, size: float) -> float:
    """Return the width of a line of text in letters of a size, points; within `settings`."""
    return _text_size(text, FontProperties(size=size), False)[0]


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
