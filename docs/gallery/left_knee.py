"""A left knee.

The meshes of a left knee are the mirror images of those of a right knee. tkamb computes a left knee
as its mirror image and converts its places back: the forces are the same, and the centres of
pressure are on the other side.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import trimesh

import tkamb
from tkamb.run.press import press_meshes

MESHES = Path(tkamb.__file__).parent / "io" / "starter" / "files"
NAMES = ("femoral_component.stl", "insert.stl")
SETTINGS = {"contact": "foundation", "resolution_mm": 2.0}

with tempfile.TemporaryDirectory() as folder:
    for name in NAMES:
        mesh = trimesh.load(MESHES / name)
        mesh.apply_transform(np.diag([1.0, 1.0, -1.0, 1.0]))  # turns the triangles over, too
        mesh.export(Path(folder) / name)
    right = press_meshes(
        *(MESHES / n for n in NAMES), 1500.0, pose=(-6.9, 30.7, 0, 0, 3, 0), **SETTINGS
    )
    left = press_meshes(
        *(Path(folder) / n for n in NAMES),
        1500.0,
        pose=(-6.9, 30.7, 0, 0, -3, 0),
        side="left",
        **SETTINGS,
    )
places = [
    [one.as_dict()[side]["cop_mm"] for side in ("medial", "lateral")] for one in (right, left)
]

figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
for name, cops, colour in zip(
    ("right", "left"), np.array(places), ("#0072B2", "#D55E00"), strict=True
):
    axes.plot(cops[:, 2], cops[:, 0], "o", color=colour, label=f"{name} knee")
    axes.annotate(" medial", (cops[0, 2], cops[0, 0]), fontsize=8)
axes.set(xlabel="to the subject's right (mm)", ylabel="anterior (mm)")
axes.margins(x=0.25)
axes.legend()
figure.savefig("left_knee.png", dpi=100)

force = [one.result.medial.force for one in (right, left)]
assert abs(force[0] / force[1] - 1.0) < 1e-4, force
