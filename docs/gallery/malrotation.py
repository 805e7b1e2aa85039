"""A component five degrees malrotated.

The femoral component is rotated about the long axis by five degrees in both directions, and stays
there. One condyle then takes nearly all of the load, and the peak rises by a fifth. This knee is
symmetric: internal and external rotation give the same peak within the faceting of the meshes.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import tkamb
from tkamb.run.press import press_meshes

MESHES = Path(tkamb.__file__).parent / "io" / "starter" / "files"
ROTATIONS = np.array([-5.0, -2.5, 0.0, 2.5, 5.0])  # deg

sides = {"medial": [], "lateral": []}
for rotation in ROTATIONS:
    report = press_meshes(
        MESHES / "femoral_component.stl",
        MESHES / "insert.stl",
        1500.0,
        pose=(-6.9, 30.7, 0, 0, rotation, 0),
        contact="foundation",
        resolution_mm=2.0,
    )
    for name, peaks in sides.items():
        peaks.append(1e-6 * getattr(report.result, name).peak_pressure)

figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
for (name, peaks), colour in zip(sides.items(), ("#0072B2", "#D55E00"), strict=True):
    axes.plot(ROTATIONS, peaks, "o-", color=colour, label=name)
axes.set(xlabel="rotation of the femoral component (deg)", ylabel="peak pressure (MPa)")
axes.legend()
figure.savefig("malrotation.png", dpi=100)

worst = np.max(list(sides.values()), axis=0)
off = abs(worst[0] / worst[-1] - 1.0)
assert off < 0.03, off
