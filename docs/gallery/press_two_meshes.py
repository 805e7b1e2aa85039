"""Press two meshes.

Contact needs no patient: two mesh files, a place of one in the other, a load. Each condyle's mean
pressure times its area is the force that it carries, and both together carry the load.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import tkamb
from tkamb.run.press import press_meshes

MESHES = Path(tkamb.__file__).parent / "io" / "starter" / "files"  # what `tkamb new` lays out

report = press_meshes(
    MESHES / "femoral_component.stl",
    MESHES / "insert.stl",
    1500.0,  # N
    units="mm",
    pose=(-6.9, 30.7, 0, 0, 0, 0),  # mm and degrees; the height does not matter
    contact="foundation",
    resolution_mm=2.0,
)
result = report.result
print("\n".join(report.lines()))

figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
x, z = 1e3 * result.points[:, 0], 1e3 * result.points[:, 2]
shown = axes.tripcolor(z, x, report.triangles, 1e-6 * result.pressure, shading="gouraud")
axes.set(xlabel="lateral (mm)", ylabel="anterior (mm)", aspect="equal")
figure.colorbar(shown, label="contact pressure (MPa)")
figure.savefig("press_two_meshes.png", dpi=100)

carried = sum(side.mean_pressure * side.area for side in (result.medial, result.lateral))
assert abs(carried / 1500.0 - 1.0) < 1e-3, carried
