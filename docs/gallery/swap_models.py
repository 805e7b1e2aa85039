"""Swap contact models.

The same bodies, pose and load by three models, which differ in what they assume: `hertz` knows two
curvatures, `foundation` has springs side by side, `lattice-linear` carries shear; add `lattice`,
which yields too and takes longer. All of them balance the load; what each is known to be off by
stands in the table of `tkamb tradeoff`.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import tkamb
from tkamb.run.press import press_meshes

MESHES = Path(tkamb.__file__).parent / "io" / "starter" / "files"
MODELS = ("hertz", "foundation", "lattice-linear")

found = {
    name: press_meshes(
        MESHES / "femoral_component.stl",
        MESHES / "insert.stl",
        1500.0,
        pose=(-6.9, 30.7, 0, 0, 0, 0),
        contact=name,
        resolution_mm=3.0,
    ).as_dict()
    for name in MODELS
}

figure, grid = plt.subplots(1, 3, figsize=(9, 2.4), layout="constrained")
for axes, quantity in zip(grid, ("approach_mm", "peak_pressure_MPa", "area_mm2"), strict=True):
    values = [one.get(quantity) or one["medial"][quantity] for one in found.values()]
    axes.barh(list(found), values, color="#0072B2")
    axes.set_title(quantity + ("" if quantity == "approach_mm" else ", medial"), fontsize=9)
figure.savefig("swap_models.png", dpi=100)

worst = max(abs(one["reaction_N"] / 1500.0 - 1.0) for one in found.values())
assert worst < 1e-3, worst
