"""Maps of wear, creep, sliding, cross-shear and pressure, seen from above."""

from pathlib import Path

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

LABELS = {
    "wear_depth_mm": "wear depth, mm",
    "creep_depth_mm": "creep depth, mm",
    "sliding_mm_per_cycle": "sliding in contact, mm a cycle",
    "cross_shear_ratio": "cross-shear ratio",
    "peak_pressure_MPa": "peak pressure, MPa",
}


def draw_maps(surface: Surface, maps: dict[str, Array], path: Path) -> None:
    """Draw the maps over the insert from above, anterior up, the subject's right at the right.

    Args:
        surface: the insert, insert frame.
        maps: name -> value per vertex; what is not modelled is not among them.
        path: of a PNG.
    """
    from matplotlib.figure import Figure

    facing = surface.face_normals[:, 1] > 0
    x, z = surface.vertices[:, 0] / MILLIMETRE, surface.vertices[:, 2] / MILLIMETRE
    columns = (len(maps) + 1) // 2
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
    for axes in places[len(maps) :]:
        axes.axis("off")
    figure.savefig(path, dpi=110, format="png")
