"""A drop test: a femur falls on the insert.

The insert is fixed. A femoral component with a mass of 60 kg slides down a rail from a height of
one millimetre. `tkamb.knee.integrate.implicit_step` takes the time steps. By the midpoint rule the
femur keeps bouncing. By implicit Euler, which dissipates energy, it comes to rest where the contact
carries its weight.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
import trimesh

import tkamb
from tkamb.knee.integrate import implicit_step

FILES = Path(tkamb.__file__).parent / "io" / "starter" / "files"
femoral, insert = (
    trimesh.load(FILES / f"{name}.stl").apply_scale(1e-3)
    for name in ("femoral_component", "insert")
)
MASS, STEP = 60.0, 1e-3

model = pin.Model()
model.gravity = pin.Motion(np.array([0, -9.81, 0, 0, 0, 0]))
model.addFrame(pin.Frame("tibia", 0, 0, pin.SE3.Identity(), pin.FrameType.BODY))
rail = model.addJoint(0, pin.JointModelPY(), pin.SE3(np.eye(3), np.array([-6.9e-3, 0, 0])), "rail")
model.appendBodyToJoint(rail, pin.Inertia(MASS, np.zeros(3), np.eye(3)), pin.SE3.Identity())
model.addFrame(pin.Frame("femur", rail, 0, pin.SE3.Identity(), pin.FrameType.BODY))
knee = tkamb.Knee(
    model,
    implant=tkamb.Implant(femoral, insert),
    contact=tkamb.contact_model("foundation", resolution=3e-3),
)
rest = knee.press(np.zeros(1), MASS * 9.81).pose.translation[1]

figure, axes = plt.subplots(figsize=(5.4, 3.4), layout="constrained")
for theta, name in ((0.5, "midpoint"), (1.0, "implicit Euler")):
    q, v, data = np.array([rest + 1e-3]), np.zeros(1), knee.create_data()
    height = []
    for _ in range(200):
        q, v = implicit_step(knee, q, v, STEP, theta=theta, data=data)
        height.append(1e3 * (q[0] - rest))
    axes.plot(1e3 * STEP * np.arange(200), height, label=name)
axes.set(xlabel="time (ms)", ylabel="height above rest (mm)")
axes.legend()
figure.savefig("knee_drop.png", dpi=100)

assert abs(height[-1]) < 0.02, height[-1]  # mm: Euler's has come to rest
