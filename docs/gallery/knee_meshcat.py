"""The knee in your own MeshCat window, and the pressure map at one q.

`Knee.show` adds implant, ligaments and pressure below the root node of an existing
`pin.visualize.MeshcatVisualizer`. Here the window is written into an HTML page.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import pinocchio as pin
import trimesh
from pinocchio.visualize import MeshcatVisualizer

import tkamb

FILES = Path(tkamb.__file__).parent / "io" / "starter" / "files"
femoral, insert = (
    trimesh.load(FILES / f"{name}.stl").apply_scale(1e-3)
    for name in ("femoral_component", "insert")
)
model = pin.Model()
model.addFrame(pin.Frame("tibia", 0, 0, pin.SE3.Identity(), pin.FrameType.BODY))
joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "femur_free")
model.addFrame(pin.Frame("femur", joint, 0, pin.SE3.Identity(), pin.FrameType.BODY))
knee = tkamb.Knee(
    model,
    implant=tkamb.Implant(femoral, insert),
    contact=tkamb.contact_model("foundation", resolution=1e-3),
)
q = pin.neutral(model)
q[0] = -6.9e-3
pressed = knee.press(q, 1500.0)

viewer = MeshcatVisualizer(model, pin.GeometryModel(), pin.GeometryModel())
viewer.initViewer(open=False)
viewer.loadViewerModel()
knee.show(viewer, q, contact=pressed)
page = viewer.viewer.static_html()  # or viewer.viewer.open()

points, triangles = 1e3 * pressed.points, knee.contact.state.triangles
figure, axes = plt.subplots(figsize=(5.4, 3.6), layout="constrained")
colours = axes.tripcolor(
    points[:, 2], points[:, 0], triangles, 1e-6 * pressed.pressure, shading="gouraud"
)
figure.colorbar(colours, label="pressure (MPa)")
axes.set(xlabel="to the right (mm)", ylabel="anterior (mm)", aspect="equal")
figure.savefig("knee_meshcat.png", dpi=100)

assert len(page) > 1e5, len(page)
total = pressed.medial.force + pressed.lateral.force
assert abs(total / 1500.0 - 1.0) < 0.02, total
