"""Maps of wear, creep, sliding and cross-shear, seen from above."""

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
}


def draw_maps(surface: Surface, maps: dict[str, Array], path: Path) -> None:
    """Draw the maps over the insert from above, anterior up, the subject's right at the right.

    Args:
        surface: the insert, insert frame.
        maps: name -> value per vertex.
        path: of a PNG.
    """
    from matplotlib.figure import Figure

    facing = surface.face_normals[:, 1] > 0
    x, z = surface.vertices[:, 0] / MILLIMETRE, surface.vertices[:, 2] / MILLIMETRE
    figure = Figure(figsize=(11, 8), layout="constrained")
    for axes, (name, label) in zip(figure.subplots(2, 2).ravel(), LABELS.items(), strict=True):
        top = float(np.max(maps[name])) or 1.0
        drawn = axes.tripcolor(
            z, x, surface.faces[facing], maps[name], shading="gouraud", vmin=0, vmax=top
        )
        axes.set(aspect="equal", title=label, xlabel="z (right), mm", ylabel="x (anterior), mm")
        figure.colorbar(drawn, ax=axes)
    figure.savefig(path, dpi=110, format="png")
