"""Does it converge?

A result that still changes with the spacing of the map's points has not converged. This example
compares the approach by `foundation` at four spacings with the finest one. Do the same with your
own bodies before you publish.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import tkamb
from tkamb.run.press import press_meshes

MESHES = Path(tkamb.__file__).parent / "io" / "starter" / "files"
SPACINGS = np.array([4.0, 2.0, 1.0, 0.5])  # mm

approach = np.array(
    [
        press_meshes(
            MESHES / "femoral_component.stl",
            MESHES / "insert.stl",
            1500.0,
            pose=(-6.9, 30.7, 0, 0, 0, 0),
            contact="foundation",
            resolution_mm=spacing,
        ).as_dict()["approach_mm"]
        for spacing in SPACINGS
    ]
)
error = np.abs(approach[:-1] / approach[-1] - 1.0)

figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
axes.loglog(SPACINGS[:-1], 100 * error, "o-", color="#0072B2")
axes.set(xlabel="spacing (mm)", ylabel="approach, off the finest by (%)")
axes.set_xticks(SPACINGS[:-1], [f"{spacing:g}" for spacing in SPACINGS[:-1]], minor=False)
axes.set_yticks([0.5, 1, 2, 4], ["0.5", "1", "2", "4"])
axes.minorticks_off()
figure.savefig("convergence.png", dpi=100)

assert error[2] < 0.01, error
