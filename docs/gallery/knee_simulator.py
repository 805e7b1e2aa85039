"""A virtual knee simulator in thirty lines.

Flexion is constant, and a load acts on a fixed line. AP, ML, axial rotation and adduction are free,
with springs alone, as in a force-controlled machine of ISO 14243-1. The femur oscillates and comes
to rest. `Knee.equilibrium` finds the same pose without time steps.
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

model, joint = pin.Model(), 0
model.gravity = pin.Motion.Zero()
model.addFrame(pin.Frame("tibia", 0, 0, pin.SE3.Identity(), pin.FrameType.BODY))
JOINTS = {"ap": "PX", "si": "PY", "ml": "PZ", "axial": "RY", "adduction": "RX"}
for name, kind in JOINTS.items():
    joint = model.addJoint(joint, getattr(pin, f"JointModel{kind}")(), pin.SE3.Identity(), name)
model.appendBodyToJoint(joint, pin.Inertia(4.0, np.zeros(3), 0.01 * np.eye(3)), pin.SE3.Identity())
model.addFrame(pin.Frame("femur", joint, 0, pin.SE3.Identity(), pin.FrameType.BODY))
springs = [  # four horizontal springs in front and behind, N per unit strain
    tkamb.Ligament(f"spring {x:+.2f} {z:+.2f}", ("femur", (0, 0, z)), ("tibia", (x, 0.03, z)),
                   tkamb.QuadraticToe(stiffness=2000.0), 0.09)
    for x in (-0.1, 0.1) for z in (-0.03, 0.03)
]  # fmt: skip
knee = tkamb.Knee(
    model,
    implant=tkamb.Implant(femoral, insert),
    ligaments=springs,
    contact=tkamb.contact_model("foundation", resolution=3e-3),
)
load = pin.Force(np.array([0, -1000.0, 0]), np.array([0, 0, 1000.0 * 5e-3]))  # 5 mm behind


def machine(q):
    """Return the load, which stays where it is in the laboratory, as forces on the joints."""
    data, forces = model.createData(), pin.StdVec_Force([pin.Force.Zero()] * model.njoints)
    pin.forwardKinematics(model, data, q)
    forces[joint] = data.oMi[joint].actInv(load)
    return forces


q, v, data = np.array([-9e-3, 0, 1e-3, 0, 0]), np.zeros(5), knee.create_data()
q[1] = knee.press(q, 1000.0).pose.translation[1]
drag, path = np.array([500.0, 3000.0, 500.0, 2.0, 2.0]), [1e3 * q]
for _ in range(80):
    q, v = implicit_step(
        knee, q, v, 0.01, fext=machine(q), theta=1.0, friction_of_joints=drag, data=data
    )
    path.append(1e3 * q)
found = knee.equilibrium(q, 0 * v, 0 * v, machine(q))

figure, axes = plt.subplots(figsize=(5.4, 3.4), layout="constrained")
path = np.array(path)
for k, name in ((0, "AP"), (2, "ML")):
    (line,) = axes.plot(0.01 * np.arange(len(path)), path[:, k], label=name)
    axes.axhline(1e3 * found.coordinates[k], color=line.get_color(), linestyle=":")
axes.set(xlabel="time (s)", ylabel="position (mm); dotted: equilibrium")
axes.legend()
figure.savefig("knee_simulator.png", dpi=100)

apart = np.abs(knee.coordinates(q) - found.coordinates)[:3].max()
assert apart < 1e-4, apart
