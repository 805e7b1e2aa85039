"""An optimal squat, with and without the contact force in its cost.

A planar leg stands on its fixed foot and carries half of the trunk. Crocoddyl finds the torques at
ankle and hip and the tension of the quadriceps that lower the hip by 12 cm and lift it again. The
second motion also pays for the forces of the condyles: the trunk leans forward, and the peak
contact force falls.
"""

import time
from pathlib import Path

import crocoddyl
import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
import trimesh

import tkamb
from tkamb.crocoddyl import CondyleForces, KneeDynamics, KneeStep

FILES = Path(tkamb.__file__).parent / "io" / "starter" / "files"
NODES, STEP, DEPTH = 40, 0.03, 0.12  # steps of 30 ms; the hip sinks by 0.12 m
femoral, insert = (
    trimesh.load(FILES / f"{name}.stl").apply_scale(1e-3)
    for name in ("femoral_component", "insert")
)


def leg() -> pin.Model:
    """Return ankle, shank, knee in the sagittal plane, thigh, hip and trunk; x forward, y up."""
    model, joint = pin.Model(), 0
    model.gravity = pin.Motion(np.array([0, -9.81, 0, 0, 0, 0]))
    parts = {  # joint: its place on the last one (m), mass (kg), its centre (m), moment of inertia
        "ankle": (pin.JointModelRZ(), 0.0, (3.6, 0.24, 0.05)),
        "knee_ap": (pin.JointModelPX(), 0.40, None),
        "knee_si": (pin.JointModelPY(), 0.0, None),
        "knee_flexion": (pin.JointModelRZ(), 0.0, (8.0, 0.24, 0.13)),
        "trunk": (pin.JointModelRZ(), 0.42, (25.0, 0.28, 1.2)),
    }
    for name, (kind, height, body) in parts.items():
        joint = model.addJoint(joint, kind, pin.SE3(np.eye(3), np.array([0, height, 0])), name)
        if body is not None:
            mass, centre, inertia = body
            inertia = pin.Inertia(mass, np.array([0, centre, 0]), inertia * np.eye(3))
            model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    for name, joint, height in (
        ("tibia", 1, 0.0),
        ("insert", 1, 0.40),
        ("femur", 4, 0.0),
        ("hip_centre", 4, 0.42),
    ):
        place = pin.SE3(np.eye(3), np.array([0, height, 0]))
        model.addFrame(pin.Frame(name, joint, 0, place, pin.FrameType.BODY))
    return model


model = leg()
points = (("femur", (0.03, 0.20, 0)), ("femur", (0.038, -0.012, 0)), ("tibia", (0.036, 0.345, 0)))
knee = tkamb.Knee(
    model,
    implant=tkamb.Implant(femoral, insert),
    contact=tkamb.contact_model("foundation", resolution=4e-3),
    ligaments=[
        tkamb.Ligament(
            name,
            ("femur", (x, 0.0, z)),
            ("tibia", (0.0, 0.34, z)),
            law="quadratic-toe",
            stiffness=4000.0,
            slack_length=0.058,
        )
        for name, x, z in (("MCL", -0.004, -0.04), ("LCL", -0.004, 0.04))
    ],
    muscles=[tkamb.Muscle("quadriceps", points)],
    frames={"hip": "hip_centre"},
)


class Torques(crocoddyl.ActuationModelAbstract):
    """Torques at ankle and hip."""

    def calc(self, data, x, u=None):
        """Set the torques."""
        data.tau = data.dtau_du @ u if u is not None else np.zeros(self.state.nv)

    def calcDiff(self, data, x, u=None):
        """The torques do not depend on x."""

    def createData(self):
        """Return data with the constant derivative by u."""
        data = crocoddyl.ActuationDataAbstract(self)
        data.dtau_du = np.eye(self.state.nv)[:, [0, 4]]
        return data


def standing(flexion: float) -> tuple[np.ndarray, np.ndarray]:
    """Return state and controls at rest, with the hip above the ankle."""
    q = np.array([-flexion / 2, 0.0, 0.0, flexion, -flexion / 2])
    height = knee.press(q, 400.0).pose[1, 3]
    q[2] += height - knee.pose(q).translation[1]
    u = np.array([0.0, 0.0, 300.0])  # ankle, hip (N·m), quadriceps (N)
    for _ in range(30):  # Newton: accelerations are zero
        tau = np.array([u[0], 0, 0, 0, u[1]])
        args = q, np.zeros(5), tau
        tensions = {"quadriceps": u[2]}
        a = knee.forward_dynamics(*args, tensions=tensions)
        if np.abs(a).max() < 1e-8:
            break
        by_q, _, by_tau = knee.forward_dynamics_derivatives(*args, tensions=tensions)
        more = knee.forward_dynamics(*args, tensions={"quadriceps": u[2] + 1.0})
        step = -np.linalg.solve(np.column_stack([by_q[:, 1:3], by_tau[:, [0, 4]], more - a]), a)
        step *= min(1.0, 2e-4 / np.abs(step[:2]).max())
        q[1:3] += step[:2]
        u += step[2:]
    assert np.abs(a).max() < 1e-6, a
    return np.concatenate([q, np.zeros(5)]), u


state = crocoddyl.StateMultibody(model)
start, rest = standing(np.radians(15.0))
data = model.createData()
pin.framesForwardKinematics(model, data, start[:5])
hip = data.oMf[model.getFrameId("hip_centre")].translation.copy()


def squat(contact_weight: float):
    """Return the solver after it has found a squat."""

    def costs(hip_weight: float, end_weight: float):
        total = crocoddyl.CostModelSum(state, 3)

        def add(name, residual, weights, weight):
            activation = crocoddyl.ActivationModelWeightedQuad(np.asarray(weights, float))
            total.addCost(name, crocoddyl.CostModelResidual(state, activation, residual), weight)

        control = crocoddyl.ResidualModelControl(state, rest)
        add("controls", control, [50.0**-2, 50.0**-2, 1000.0**-2], 1.0)
        posture = crocoddyl.ResidualModelState(state, start, 3)
        add("posture", posture, [0.3, 0, 0, 0.3, 0.3, 0.1, 0.1, 0.1, 0.1, 0.1], 1.0)
        if end_weight:
            add("end", posture, [1, 0, 0, 1, 1, 1, 1, 1, 1, 1], end_weight)
        if hip_weight:
            target = hip - [0, DEPTH, 0]
            frame = model.getFrameId("hip_centre")
            place = crocoddyl.ResidualModelFrameTranslation(state, frame, target, 3)
            add("hip", place, [0, 1, 0], hip_weight)
        if contact_weight:
            add("contact", CondyleForces(state, knee, 3), [500.0**-2] * 2, contact_weight)
        return total

    def node(step: float, hip_weight: float = 0.0, end_weight: float = 0.0):
        torques = Torques(state, 2)
        dynamics = KneeDynamics(
            state, torques, knee, costs(hip_weight, end_weight), muscles=["quadriceps"]
        )
        return KneeStep(dynamics, step)

    running = [node(STEP, 2e4 if k == NODES // 2 else 0.0) for k in range(NODES)]
    problem = crocoddyl.ShootingProblem(start, running, node(0.0, end_weight=1e2))
    problem.nthreads = 1
    solver = crocoddyl.SolverFDDP(problem)
    solver.th_stop = 1e-6
    solver.setCallbacks([crocoddyl.CallbackVerbose()])
    solver.solve([start] * (NODES + 1), [rest] * NODES, 60)
    return solver


began, solvers = time.perf_counter(), {}
for name, weight in (("without", 0.0), ("with", 1.0)):
    solvers[f"{name} contact force in the cost"] = squat(weight)
seconds = time.perf_counter() - began

figure, axes = plt.subplots(1, 4, figsize=(11.0, 3.2), layout="constrained")
instants, peaks = STEP * np.arange(NODES + 1), []
for colour, (name, solver) in zip(("tab:blue", "tab:red"), solvers.items(), strict=True):
    xs = np.array(solver.xs)
    forces = np.array([knee.condyle_forces(x[:5])[0].sum() for x in xs])
    pressure = [knee.evaluate(x[:5]) for x in xs]
    pressure = [max(c.peak_pressure for c in (p.medial, p.lateral) if c) / 1e6 for p in pressure]
    peaks.append(forces.max())
    axes[0].plot(instants, np.degrees(xs[:, 3]), color=colour, label=name)
    axes[1].plot(instants, forces, color=colour)
    axes[2].plot(instants, pressure, color=colour)
    middle = model.createData()
    pin.framesForwardKinematics(model, middle, xs[NODES // 2, :5])
    head = middle.oMi[5].act(np.array([0.0, 0.5, 0.0]))
    chain = np.array([middle.oMi[j].translation for j in (1, 4, 5)] + [head])
    axes[3].plot(chain[:, 0], chain[:, 1], "o-", color=colour)
for ax, label in zip(
    axes,
    ("knee flexion (deg)", "contact force (N)", "peak pressure (MPa)", "height (m)"),
    strict=True,
):
    ax.set(xlabel="time (s)", ylabel=label)
axes[3].set(xlabel="forward (m)", title="posture at the deepest point", aspect="equal")
axes[0].legend(fontsize=7)
figure.savefig("optimal_squat.png", dpi=100)

for name, solver in solvers.items():
    print(f"{name}: {solver.iter} iterations, stop {solver.stop:.1e}")
print(f"{seconds:.0f} s; peak contact force {peaks[0]:.0f} N and {peaks[1]:.0f} N")
assert all(solver.stop <= 1e-6 for solver in solvers.values())
assert peaks[1] < 0.95 * peaks[0], peaks
