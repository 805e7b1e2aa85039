"""A contact model swapped in a plugged-in knee.

The same knee has three contact models in turn: only the argument `contact` changes. The example
compares the stiffness of each under 1500 N, which implicit integration or optimisation needs.
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
model = pin.Model()
model.addFrame(pin.Frame("tibia", 0, 0, pin.SE3.Identity(), pin.FrameType.BODY))
joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "femur_free")
model.addFrame(pin.Frame("femur", joint, 0, pin.SE3.Identity(), pin.FrameType.BODY))
q, v = pin.neutral(model), np.zeros(6)
q[0] = -6.9e-3

stiffness = {}
for name in ("hertz", "foundation", "lattice"):
    contact = tkamb.contact_model(name, resolution=3e-3)
    knee = tkamb.Knee(model, implant=tkamb.Implant(femoral, insert), contact=contact)
    data, there = knee.create_data(), q.copy()
    there[1] = knee.press(q, 1500.0).pose.translation[1]
    force = -knee.external_forces(there, v, data=data)[joint].linear
    stiffness[name] = 1e-6 * knee.stiffness(there, v, data)[1, 1]
    assert abs(force[1] + 1500.0) < 5.0, force

figure, axes = plt.subplots(figsize=(5, 2.4), layout="constrained")
axes.barh(list(stiffness), list(stiffness.values()), color="#0072B2")
axes.set(xlabel="stiffness along the load (kN/mm)")
figure.savefig("knee_swap.png", dpi=100)

low, high = min(stiffness.values()), max(stiffness.values())
assert 1.0 < high / low < 3.0, stiffness
