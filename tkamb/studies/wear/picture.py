"""Maps of wear, creep, sliding, cross-shear and pressure from above, and the volume over cycles."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABELS = {
    "wear_depth_mm": "wear depth, mm",
    "creep_depth_mm": "creep depth, mm",
    "sliding_mm_per_cycle": "sliding in contact, mm a cycle",
    "cross_shear_ratio": "cross-shear ratio",
    "peak_pressure_MPa": "peak pressure, MPa",
}


def draw_wear(
    surface: Surface, maps: dict[str, Array], rows: Sequence[Mapping[str, float]], path: Path
) -> None:
    """Draw the maps over the insert from above, anterior up, the subject's right at the right.

    The last panel is the worn volume over the cycles, with its band where the rows have one.

    Args:
        surface: the insert, insert frame.
        maps: name -> value per vertex; what is not modelled is not among them.
        rows: the table.
        path: of a PNG.
    """
    from matplotlib.figure import Figure

    facing = surface.face_normals[:, 1] > 0
    x, z = surface.vertices[:, 0] / MILLIMETRE, surface.vertices[:, 2] / MILLIMETRE
    columns = (len(maps) + 2) // 2
    figure = Figure(figsize=(5.5 * columns, 8), layout="constrained")
    places = figure.subplots(2, columns).ravel()
    for axes, (name, values) in zip(places, maps.items(), strict=False):
        top = float(np.max(values)) or 1.0
        drawn = axes.tripcolor(
            z, x, surface.faces[facing], values, shading="gouraud", vmin=0, vmax=top
        )
        axes.set(
            aspect="equal", title=LABELS[name], xlabel="z (right), mm", ylabel="x (anterior), mm"
        )
        figure.colorbar(drawn, ax=axes, shrink=0.7)
    draw_volume(places[len(maps)], rows)
    for axes in places[len(maps) + 1 :]:
        axes.axis("off")
    figure.savefig(path, dpi=110, format="png")


def draw_volume(axes: "Axes", rows: Sequence[Mapping[str, float]]) -> None:
    """Draw the worn volume over the cycles; shaded: 5 to 95 % of the samples, dotted: median."""
    cycles = np.array([row["cycles"] for row in rows]) / 1e6
    axes.plot(cycles, [row["volume_mm3"] for row in rows], "k.-", label="as given")
    if "volume_mm3_p05" in rows[-1]:
        low, middle, high = ([row[f"volume_mm3_p{p}"] for row in rows] for p in ("05", "50", "95"))
        axes.fill_between(cycles, low, high, color="0.8", label="5 to 95 % of the samples")
        axes.plot(cycles, middle, "k:", label="their median")
        axes.legend()
    axes.set(title="worn volume, mm³", xlabel="million cycles", xlim=(0, None), ylim=(0, None))
