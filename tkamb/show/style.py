"""Style of all pictures, and figures for a page: axes placed by their labels, and SVG text.

Colours: Okabe & Ito (2008), Color Universal Design. Pressure: viridis, perceptually uniform.

The size of each text is computed once for all figures.
"""

import base64
import io
import re
from functools import lru_cache
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


BLACK, GREY = "#1a1a1a", "#767676"
BLUE, SKY = "#0072B2", "#56B4E9"
VERMILLION, ORANGE = "#D55E00", "#E69F00"
GREEN, PURPLE = "#009E73", "#CC79A7"
MEDIAL, LATERAL = BLUE, VERMILLION
SIDE_COLOURS = {"medial": MEDIAL, "lateral": LATERAL}
SUPERIOR, ANTERIOR, RIGHT = "#5D3A9B", "#2A9D8F", "#7B8B00"
"""Colours of forces along the insert axes, and of moments and rotations about these axes."""
QUADRICEPS, PATELLAR_LIGAMENT, PATELLOFEMORAL, HIP = "#882255", "#CC79A7", "#664400", "#6666EE"
GROUND = "#388C54"
LIST = ("#332288", "#A6761D", "#009E73", "#AA4499")
"""Colours of ligaments and muscles, assigned anew in each plot because there are too many."""
LIGAMENT = LIST[3]
"""Colour of all ligaments together."""
FORCE_COLOURS = {
    "ground reaction": GROUND,
    "hip": HIP,
    "quadriceps": QUADRICEPS,
    "patellar ligament": PATELLAR_LIGAMENT,
    "patellofemoral": PATELLOFEMORAL,
    "medial condyle": MEDIAL,
    "lateral condyle": LATERAL,
    "knee": BLACK,
}
"""Force that is drawn as an arrow -> its colour, also in plots."""
CYCLE = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK, GREY)
PRESSURE_MAP = "viridis"

SETTINGS: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "axes.labelsize": 9,
    "axes.titlesize": 9,
    "axes.titley": 1.0,  # fixed, because searching the place takes 5 % of a report's time
    "axes.edgecolor": "#8a8a8a",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.8,
    "lines.solid_capstyle": "round",
    "path.simplify": False,
    "xtick.color": BLACK,
    "ytick.color": BLACK,
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 2.2,
    "svg.fonttype": "none",
    "svg.hashsalt": "tkamb",
}


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure, size in inches. It needs no display."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def settings() -> Any:
    """Return the matplotlib context in which figures are drawn and written."""
    import matplotlib as mpl

    return mpl.rc_context(SETTINGS)


def svg_text(figure: "Figure", name: str, dpi: int = 150) -> str:
    """Return the figure as inline SVG that scales with the page.

    It has no style element, because the page has the style of lines, and unique ids with the prefix
    `name`. For the page's scripts the first axes have `data-box`: left, right, top and bottom,
    points. `data-range`: values at their left and right end. `data-heights`: values at their lower
    and upper end.
    """

    with settings():
        text = written(figure, dpi)
    text = text[text.index("<svg") :]
    text = re.sub(r"<(metadata|style)\b.*?</\1>", "", text, flags=re.DOTALL)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r' xmlns(:xlink)?="[^"]*"', "", text)
    text = text.replace("xlink:href=", "href=")
    text = text.replace("<svg", f"<svg {_box(figure)}", 1)
    text = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{name}-\1"', text)
    return re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", text)


def _box(figure: "Figure") -> str:
    axes = figure.axes[0]
    width, height = 72 * figure.get_size_inches()
    position = axes.get_position()
    edges = (
        position.x0 * width,
        position.x1 * width,
        (1 - position.y1) * height,
        (1 - position.y0) * height,
    )
    box = " ".join(f"{edge:.2f}" for edge in edges)
    (low, high), (foot, head) = axes.get_xlim(), axes.get_ylim()
    return (
        f'data-box="{box}" data-range="{low:.9g} {high:.9g}" data-heights="{foot:.9g} {head:.9g}"'
    )


def legend_above(axes: "Axes", columns: int = 4) -> None:
    """Put the legend above the plot, left-aligned."""
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=columns,
        borderaxespad=0.2,
        columnspacing=1.4,
        handletextpad=0.5,
    )


# Points: margin around all labels of a figure. Chosen by eye.
EDGE_POINTS = 3.0
# Points: length of a tick and the gap to its label. Chosen by eye.
TICK_POINTS = 6.5
# Points: size of letters at ticks. Chosen by eye.
TICK_LABEL_POINTS = 9.0


def set_place(axes: Axes, x: float, bottom: float, wide: float, tall: float) -> None:
    """Set the position of axes, points; switch off the figure's layout engine."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.set_layout_engine("none")
    width, height = 72 * figure.get_size_inches()
    axes.set_position((x / width, bottom / height, wide / width, tall / height))


def leave_unmeasured(axis: Axis) -> None:
    """Make the layout engine ignore an axis' tick labels, which saves time."""
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
    """Return how far tick labels extend past both ends of an axis of a `length`, points."""
    labels = shown_labels(axis)
    margin = max((0.5 * width - place * length for place, width in labels), default=0.0)
    right = max((0.5 * width - (1.0 - place) * length for place, width in labels), default=0.0)
    return max(margin, 0.0), max(right, 0.0)


class Renderer(RendererSVG):
    """SVG renderer that measures each text once for all figures.

    A picture with `interpolation="none"` is stored once, unclipped, in its own resolution; the
    browser smooths it.
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
    """Return the width of a line of text, points. Call it within `style.settings`; the size is in
    points.
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
