"""Figures for a page: axes placed by the sizes of their labels, and SVG text.

The size of each text is computed once for all figures.
"""

import base64
import io
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

# Points: margin around all labels of a figure. Chosen by eye.
EDGE_POINTS = 3.0
# Points: length of a tick and the gap to its label. Chosen by eye.
TICK_POINTS = 6.5
# Points: size of letters at ticks. Chosen by eye.
TICK_LABEL_POINTS = 9.0


def set_place(axes: Axes, x: float, bottom: float, wide: float, tall: float) -> None:
    """Set the position of axes in their figure, points; switch off the figure's layout engine."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.set_layout_engine("none")
    width, height = 72 * figure.get_size_inches()
    axes.set_position((x / width, bottom / height, wide / width, tall / height))


def leave_unmeasured(axis: Axis) -> None:
    """Make the layout engine ignore the tick labels of an axis, which saves their measurement."""
    for tick in axis.get_major_ticks(len(axis.get_majorticklocs())):
        tick.label1.set_in_layout(False)
        tick.label2.set_in_layout(False)


def shown_labels(axis: Axis) -> list[tuple[float, float]]:
    """Return position (0 to 1 along the axis) and width (points) of each visible tick label."""
    low, high = axis.get_view_interval()
    ticks = axis.get_majorticklocs()
    labels = axis.get_major_formatter().format_ticks(list(ticks))
    places = [(tick - low) / (high - low) for tick in ticks]
    return [
        (place, text_width(label, TICK_LABEL_POINTS))
        for place, label in zip(places, labels, strict=True)
        if 0.0 <= place <= 1.0
    ]


def label_width(axis: Axis) -> float:
    """Return the width of the widest tick label of an axis, points."""
    return max((width for _, width in shown_labels(axis)), default=0.0)


def overhang(axis: Axis, length: float) -> tuple[float, float]:
    """Return how far tick labels of a horizontal axis extend past its left and right end, points.

    Args:
        length: length of the axis, points.
    """
    labels = shown_labels(axis)
    margin = max((0.5 * width - place * length for place, width in labels), default=0.0)
    right = max((0.5 * width - (1.0 - place) * length for place, width in labels), default=0.0)
    return max(margin, 0.0), max(right, 0.0)


class Renderer(RendererSVG):
    """SVG renderer that measures each text once for all figures.

    A picture with `interpolation="none"` is stored once in a figure, in its own resolution. The
    browser smooths it. It is not clipped.
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
        """Draw a picture (rows, columns, 4). With a transform, its resolution is preserved."""
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
        """Return ascent, descent and line gap, points. Matplotlib 3.11 and later call this."""
        return _letter_heights(prop.copy())

    def get_text_width_height_descent(
        self, s: str, prop: FontProperties, ismath: Any
    ) -> tuple[float, float, float]:
        """Return the size of a line of text, points."""
        return _text_size(s, prop.copy(), ismath)


def written(figure: Figure, dpi: int) -> str:
    """Return a figure as an SVG document in points."""
    buffer = io.StringIO()
    FigureCanvasSVG(figure)  # the layout engine measures with this canvas
    figure.set_dpi(72)
    width, height = figure.get_size_inches()
    no_metadata = {"Date": None, "Creator": None}
    vectors = Renderer(72 * width, 72 * height, buffer, image_dpi=dpi, metadata=no_metadata)
    renderer: Any = MixedModeRenderer(figure, width, height, dpi, vectors)
    figure.draw(renderer)
    renderer.finalize()
    return buffer.getvalue()


def png_address(picture: NDArray[np.uint8]) -> str:
    """Return a grey picture (rows, columns) or RGBA (rows, columns, 4) as a PNG data address."""
    image, buffer = Image.fromarray(picture), io.BytesIO()
    if picture.ndim == 3 and (picture[..., :1] == picture[..., 1:3]).all():
        image = image.convert("LA")
    image.save(buffer, "PNG")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def text_width(text: str, size: float) -> float:
    """Return the width of a line of text, points. Call it within `style.settings`.

    Args:
        size: size of the letters, points.
    """
    return _text_size(text, FontProperties(size=size), False)[0]


@lru_cache(maxsize=4096)
def _text_size(text: str, letters: FontProperties, ismath: Any) -> tuple[float, float, float]:
    return text_to_path.get_text_width_height_descent(text, letters, ismath)


@lru_cache(maxsize=64)
def _letter_heights(letters: FontProperties) -> tuple[float, float, float]:
    font = get_font(findfont(letters))
    table, head = font.get_sfnt_table("OS/2"), font.get_sfnt_table("head")
    assert table is not None and head is not None  # matplotlib's DejaVu font has these tables
    points = letters.get_size_in_points() / head["unitsPerEm"]
    ascent, descent = points * table["sTypoAscender"], -points * table["sTypoDescender"]
    return ascent, descent, points * table["sTypoLineGap"]
