"""Contact and ligaments as `fext` in your own Pinocchio model.

The leg has a thigh that hangs from the world by a ball joint, a knee with six degrees of freedom,
and a shank. The implant's meshes, two collateral ligaments and a contact model make a `tkamb.Knee`,
whose forces are an argument of `pin.rnea`. The femur is lowered onto the insert, and the vertical
force of the joint rises with the contact.
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

model = pin.Model()  # or pin.buildModelFromUrdf("leg.urdf")
model.gravity = pin.Motion(np.array([0, -9.81, 0, 0, 0, 0]))
hip = model.addJoint(0, pin.JointModelSpherical(), pin.SE3.Identity(), "my_hip")
thigh = pin.SE3(np.eye(3), np.array([0, -0.42, 0]))  # axes of the femoral component
model.appendBodyToJoint(hip, pin.Inertia(9.0, np.zeros(3), 0.1 * np.eye(3)), thigh)
model.addFrame(pin.Frame("my_thigh", hip, 0, thigh, pin.FrameType.BODY))
knee_joint = model.addJoint(hip, pin.JointModelFreeFlyer(), thigh, "my_knee")
model.appendBodyToJoint(
    knee_joint, pin.Inertia(4.0, np.zeros(3), 0.05 * np.eye(3)), pin.SE3.Identity()
)
model.addFrame(pin.Frame("my_shank", knee_joint, 0, pin.SE3.Identity(), pin.FrameType.BODY))


def collateral(name, z):
    """Return a ligament from epicondyle to shank, slack below 90 mm."""
    ends = ("my_thigh", (0.0, 0.0, z)), ("my_shank", (0.0, -0.06, 0.8 * z))
    return tkamb.Ligament(name, *ends, tkamb.QuadraticToe(stiffness=3000.0), slack_length=0.090)


knee = tkamb.Knee(
    model,
    implant=tkamb.Implant(femoral, insert),
    ligaments=[collateral("MCL", -0.04), collateral("LCL", 0.04)],
    contact=tkamb.contact_model("foundation", resolution=2e-3),
    friction=0.05,
    frames={"femur": "my_thigh", "tibia": "my_shank"},
)

data, warm, v = model.createData(), knee.create_data(), np.zeros(model.nv)
heights, lift = np.linspace(31.2e-3, 30.5e-3, 29), []
for height in heights:
    q = pin.neutral(model)
    q[4:7] = 6.9e-3, -height, 0.0  # of the shank, below the thigh
    tau = pin.rnea(model, data, q, v, v, knee.external_forces(q, v, data=warm))
    lift.append(tau[4])  # what the knee joint must do to the shank, up

figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
axes.plot(1e3 * heights, lift, color="#0072B2")
axes.axhline(4 * 9.81, color="#888888", linestyle=":", label="weight of the shank")
axes.set(xlabel="femur above the insert's bottom (mm)", ylabel="force of the knee joint (N)")
axes.invert_xaxis()
axes.legend()
figure.savefig("knee_fext.png", dpi=100)

pressed = knee.evaluate(q).wrench_on_insert[1]
pull = knee.external_forces(q, v)[knee_joint].linear[1] - pressed  # of the ligaments, up
assert abs(tau[4] - (4 * 9.81 - pressed - pull)) < 1e-6, tau
assert pressed < -100.0, pressed
