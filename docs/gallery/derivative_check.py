"""Check derivatives of forward dynamics in ten lines.

`pin.computeABADerivatives` holds external forces constant in the frames of the joints. The forces
of a knee change with the configuration, and turn with the bodies. The columns of da/dq agree with
central differences only with both parts, which `forward_dynamics_derivatives` contains.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
import trimesh

import tkamb

FILES = Path(tkamb.__file__).parent / "io" / "starter" / "files"
femoral, insert = (
    trimesh.load(FILES / f"{name}.stl").apply_scale(1e-3)
    for name in ("femoral_component", "insert")
)
model, joint = pin.Model(), 0
model.gravity = pin.Motion(np.array([0, -9.81, 0, 0, 0, 0]))
# A shank on an ankle; the femur above it has six knee joints.
names = ("ankle", "AP", "SI", "ML", "axial rotation", "adduction", "flexion")
for name, kind in zip(names, ("RZ", "PX", "PY", "PZ", "RY", "RX", "RZ"), strict=True):
    place = pin.SE3(np.eye(3), np.array([0, 0.4 if name == "AP" else 0.0, 0]))
    joint = model.addJoint(joint, getattr(pin, f"JointModel{kind}")(), place, name)
for name, joint, height in (("tibia", 1, 0.0), ("insert", 1, 0.4), ("femur", 7, 0.0)):
    inertia = pin.Inertia(4.0, np.array([0, 0.2, 0]), 0.05 * np.eye(3))
    if name != "insert":
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    place = pin.SE3(np.eye(3), np.array([0, height, 0]))
    model.addFrame(pin.Frame(name, joint, 0, place, pin.FrameType.BODY))
knee = tkamb.Knee(
    model,
    implant=tkamb.Implant(femoral, insert),
    contact=tkamb.contact_model("foundation", resolution=2e-3),
    friction=0.05,
)
q, v, tau = np.array([0.1, -6.9e-3, 0.0, 0.0, 0.02, 0.0, 0.4]), 0.1 * np.ones(7), np.zeros(7)
q[2] = knee.press(q, 1000.0).pose.translation[1]

# The check.
exact = knee.forward_dynamics_derivatives(q, v, tau)[0]
columns, steps = [], np.array([1e-5, 1e-8, 1e-8, 1e-8, 4e-7, 4e-7, 4e-7])  # m and rad
for step in np.diag(steps):
    ahead, behind = (knee.forward_dynamics(q + s * step, v, tau) for s in (1, -1))
    columns.append((ahead - behind) / (2 * step.sum()))
differences = np.array(columns).T
data = model.createData()
pin.computeABADerivatives(model, data, q, v, tau, knee.external_forces(q, v))
held = data.ddq_dq


def errors(derivative):
    """Return the error of each column, relative to its largest entry."""
    return np.abs(derivative - differences).max(axis=0) / np.abs(differences).max(axis=0)


figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
place = np.arange(len(names))
axes.bar(place - 0.2, errors(held), 0.4, label="forces held constant", color="#D55E00")
axes.bar(
    place + 0.2, errors(exact), 0.4, label="Knee.forward_dynamics_derivatives", color="#0072B2"
)
axes.set(yscale="log", ylabel="relative error of da/dq", ylim=(1e-10, 1e4))
axes.set_xticks(place, names, rotation=25)
axes.legend(fontsize=8)
figure.savefig("derivative_check.png", dpi=100)

print(f"largest errors: {errors(exact).max():.1e}, forces held constant {errors(held).max():.1e}")
assert errors(exact).max() < 1e-5, errors(exact)
assert errors(held).max() > 0.1
