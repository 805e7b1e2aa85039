"""A bearing that slides on its tray.

The bottom of the same insert is fixed, or free to slide on a polished tray (mobile). The mobile
insert is more compliant, so that the femoral component penetrates deeper under the same load.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import tkamb
from tkamb.run.press import press_meshes

MESHES = Path(tkamb.__file__).parent / "io" / "starter" / "files"

approach = {
    bearing: press_meshes(
        MESHES / "femoral_component.stl",
        MESHES / "insert.stl",
        1500.0,
        pose=(-6.9, 30.7, 0, 0, 0, 0),
        contact="lattice-linear",
        resolution_mm=4.0,
        bearing=bearing,
        options={"cache": False},
    ).as_dict()["approach_mm"]
    for bearing in ("fixed", "mobile")
}

figure, axes = plt.subplots(figsize=(4, 3.2), layout="constrained")
axes.bar(approach.keys(), approach.values(), color=["#0072B2", "#D55E00"])
axes.set_ylabel("approach (mm)")
figure.savefig("mobile_bearing.png", dpi=100)

ratio = approach["mobile"] / approach["fixed"]
assert 1.0 < ratio < 1.5, ratio
