"""Style of all pictures: colours that colour-blind readers can distinguish, and SVG text.

Colours: Okabe & Ito (2008), Color Universal Design. Pressure: viridis, perceptually uniform.
"""

import re
from typing import TYPE_CHECKING, Any

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

    The SVG has no style element, because the page has the style of lines. All ids have the prefix
    `name`, so that they are unique in the page. The page's scripts draw over the first axes with
    these attributes of the SVG:
      `data-box`: left, right, top and bottom of the axes, points.
      `data-range`: values at the left and right end of the axes.
      `data-heights`: values at the lower and upper end of the axes.
    """
    from tkamb.show.svg import written

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
