"""An optimal squat by Crocoddyl, with peak pressure or contact force in its cost, and without.

A planar leg stands on its fixed foot and carries half of the trunk. Crocoddyl finds the torques at
ankle and hip and the tension of the quadriceps that bend the knee and stretch it again. The first
guess stands still; the weight of the wanted 80 degrees grows in steps, and each solution is the
next first guess. At the last weight the effort balances the bend at about 40 degrees. From this
squat two others start: the smooth peak pressures of both condyles, or their contact forces, in the
middle half of the motion enter the cost, again with weights that grow in steps.

Two things did not converge. With the force in the cost of every node, a weight of 0.1 ended at
steps of 0.002 and a stop of 1e-3: the last controls change by half. With a pressure weight of 0.3
in the middle half, the search did not end within two minutes.
"""

import time
from pathlib import Path

import crocoddyl
import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
import trimesh

import tkamb
from tkamb.crocoddyl import CondyleForces, CondylePressures, KneeDynamics, KneeStep

FILES = Path(tkamb.__file__).parent / "io" / "starter" / "files"
NODES, STEP, DEEPEST = 24, 0.05, np.radians(80.0)  # steps of 50 ms; deepest knee flexion
PRESSED = range(NODES // 4, 3 * NODES // 4 + 1)  # nodes with pressure or force in their cost
femoral, insert = (
    trimesh.load(FILES / f"{name}.stl").apply_scale(1e-3)
    for name in ("femoral_component", "insert")
)

model, joint = pin.Model(), 0  # x forward, y up
model.gravity = pin.Motion(np.array([0, -9.81, 0, 0, 0, 0]))
for name, kind, height, body in (  # height on the last joint (m); mass (kg), its height, inertia
    ("ankle", "RZ", 0.0, (3.6, 0.24, 0.05)),
    ("knee_ap", "PX", 0.40, None),
    ("knee_si", "PY", 0.0, None),
    ("knee_flexion", "RZ", 0.0, (8.0, 0.24, 0.13)),
    ("trunk", "RZ", 0.42, (25.0, 0.28, 1.2)),
):
    place = pin.SE3(np.eye(3), np.array([0, height, 0]))
    joint = model.addJoint(joint, getattr(pin, f"JointModel{kind}")(), place, name)
    if body is not None:
        mass, centre, inertia = body
        inertia = pin.Inertia(mass, np.array([0, centre, 0]), inertia * np.eye(3))
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
for name, joint, height in (("tibia", 1, 0.0), ("insert", 1, 0.40), ("femur", 4, 0.0)):
    place = pin.SE3(np.eye(3), np.array([0, height, 0]))
    model.addFrame(pin.Frame(name, joint, 0, place, pin.FrameType.BODY))
points = (("femur", (0.03, 0.20, 0)), ("femur", (0.038, -0.012, 0)), ("tibia", (0.036, 0.345, 0)))
knee = tkamb.Knee(
    model,
    implant=tkamb.Implant(femoral, insert),
    contact=tkamb.contact_model("foundation", resolution=1e-3),
    ligaments=[
        tkamb.Ligament(
            name,
            ("femur", (-0.004, 0.0, z)),
            ("tibia", (0.0, 0.34, z)),
            tkamb.QuadraticToe(stiffness=4000.0),
            slack_length=0.088,
        )
        for name, z in (("MCL", -0.04), ("LCL", 0.04))
    ],
    muscles=[tkamb.Muscle("quadriceps", points)],
)
state, data = crocoddyl.StateMultibody(model), knee.create_data()
DRIVEN = np.eye(5)[:, [0, 4]]  # torques at ankle and hip


class Torques(crocoddyl.ActuationModelAbstract):
    """Torques at ankle and hip."""

    def calc(self, data, x, u=None):
        """Set the torques."""
        data.tau = data.dtau_du @ u if u is not None else np.zeros(5)

    def calcDiff(self, data, x, u=None):
        """The torques do not depend on x."""

    def createData(self):
        """Return data with the constant derivative by u."""
        data = crocoddyl.ActuationDataAbstract(self)
        data.dtau_du = DRIVEN
        return data


def standing(q, u):
    """Return the translations of the knee and controls without acceleration, by Newton's method."""
    v = np.zeros(5)
    for n in range(300):
        tensions, more = {"quadriceps": u[2]}, {"quadriceps": u[2] + 1.0}
        args = q, v, DRIVEN @ u[:2]
        a = knee.forward_dynamics(*args, tensions=tensions, data=data)
        if np.abs(a).max() < 1e-6:
            return q, u
        by_q, _, by_tau = knee.forward_dynamics_derivatives(*args, tensions=tensions, data=data)
        by_pull = knee.forward_dynamics(*args, tensions=more, data=data) - a
        step = np.linalg.solve(np.column_stack([by_q[:, 1:3], by_tau @ DRIVEN, by_pull]), -a)
        step *= min(1.0, (2e-4 if n < 100 else 1e-5) / np.abs(step[:2]).max())
        q, u = q + np.array([0.0, *step[:2], 0.0, 0.0]), u + step[2:]
        u[2] = max(u[2], 0.0)
    raise RuntimeError("no equilibrium")


bend = np.radians(15.0)  # the hip is above the ankle, and the trunk is upright
q = np.array([-bend / 2, 0.0, 0.0, bend, -bend / 2])
q[2] = knee.press(q, 400.0).pose.translation[1]
q, rest = standing(q, np.array([0.0, 0.0, 300.0]))
start = np.concatenate([q, np.zeros(5)])


def squat(flexion_weight, xs, us, pressure_weight=0.0, force_weight=0.0):
    """Return the solver after it has found a squat, from a first guess of states and controls."""

    def node(step, bend_weight=0.0, end_weight=0.0, pressed=False):
        costs = crocoddyl.CostModelSum(state, 3)

        def add(name, residual, weights, weight):
            activation = crocoddyl.ActivationModelWeightedQuad(np.asarray(weights, float))
            costs.addCost(name, crocoddyl.CostModelResidual(state, activation, residual), weight)

        control = crocoddyl.ResidualModelControl(state, rest)
        posture = crocoddyl.ResidualModelState(state, start, 3)
        bent = crocoddyl.ResidualModelState(state, np.array([0, 0, 0, DEEPEST, *np.zeros(6)]), 3)
        add("controls", control, [50.0**-2, 50.0**-2, 1000.0**-2], 1.0)  # N·m and N
        add("posture", posture, [0.3, 0, 0, 0.3, 0.3, 0.1, 0.1, 0.1, 0.1, 0.1], 1.0)
        add("end", posture, [1, 0, 0, 1, 1, 1, 1, 1, 1, 1], end_weight)
        add("bend", bent, [0, 0, 0, 1, 0, 0, 0, 0, 0, 0], bend_weight)
        for residual, unit, weight in (
            (CondylePressures, 1e7, pressure_weight),  # 10 MPa
            (CondyleForces, 1e3, force_weight),  # 1 kN
        ):
            if pressed and weight:
                add(residual.__name__, residual(state, knee, 3), [unit**-2] * 2, weight)
        dynamics = KneeDynamics(state, Torques(state, 2), knee, costs, muscles=["quadriceps"])
        return KneeStep(dynamics, step)

    running = [
        node(STEP, flexion_weight if k == NODES // 2 else 0.0, pressed=k in PRESSED)
        for k in range(NODES)
    ]
    problem = crocoddyl.ShootingProblem(start, running, node(0.0, end_weight=1e2))
    problem.nthreads = 1  # models in Python
    solver = crocoddyl.SolverFDDP(problem)
    solver.th_stop = 1e-6
    converged = solver.solve(xs, us, 60, True)
    weights = flexion_weight, pressure_weight, force_weight
    print(f"weights {weights}: {solver.iter} iterations, stop {solver.stop:.1e}")
    assert converged
    assert solver.iter > 0
    assert solver.stop <= 1e-6
    return solver


def sequence(xs, us, calls):
    """Return states and controls of the last of several squats, each the next first guess."""
    for weights in calls:
        solver = squat(xs=xs, us=us, **weights)
        xs, us = list(solver.xs), list(solver.us)
    return xs, us


began = time.perf_counter()
bends = [{"flexion_weight": weight} for weight in (3, 8, 20)]
plain = sequence([start] * (NODES + 1), [rest] * NODES, bends)
found = {
    "without": plain,
    "with peak pressure": sequence(
        *plain, [bends[-1] | {"pressure_weight": weight} for weight in (0.03, 0.1)]
    ),
    "with contact force": sequence(
        *plain, [bends[-1] | {"force_weight": weight} for weight in (0.1, 0.3)]
    ),
}
seconds = time.perf_counter() - began

figure, axes = plt.subplots(1, 4, figsize=(12.0, 3.2), layout="constrained")
instants, peaks = STEP * np.arange(NODES + 1), []
for (words, (xs, _)), colour in zip(found.items(), ("#666666", "#0072B2", "#D55E00"), strict=True):
    states = np.array(xs)
    contacts = [knee.evaluate(x[:5]) for x in states]
    sides = [[one for one in (c.medial, c.lateral) if one is not None] for c in contacts]
    flexion = np.degrees(states[:, 3])
    force = [sum(one.force for one in pair) for pair in sides]
    pressure = [1e-6 * max(one.peak_pressure for one in pair) for pair in sides]
    for ax, values in zip(axes, (flexion, force, pressure), strict=False):
        ax.plot(instants, values, color=colour, label=words)
    place = model.createData()
    pin.forwardKinematics(model, place, states[np.argmax(flexion), :5])
    head = place.oMi[5].act(np.array([0.0, 0.5, 0.0]))
    chain = np.array([place.oMi[j].translation for j in (1, 4, 5)] + [head])
    axes[3].plot(chain[:, 0], chain[:, 1], "o-", color=colour)
    peaks.append((max(flexion), max(force), max(pressure)))
    print(f"{words}: to %.1f degrees, %.0f N, %.2f MPa" % peaks[-1])
labels = "knee flexion (deg)", "contact force (N)", "peak pressure (MPa)", "height (m)"
for ax, label in zip(axes, labels, strict=True):
    ax.set(xlabel="time (s)", ylabel=label)
axes[3].set(xlabel="forward (m)", aspect="equal", xlim=(-0.4, 0.6))
axes[0].legend(fontsize=7, loc="lower center")
figure.savefig("optimal_squat.png", dpi=100)

print(f"{seconds:.0f} s")
without, with_pressure, with_force = peaks
assert 35.0 < without[0] < 45.0, without
assert with_pressure[2] < without[2] - 0.1, peaks
assert with_force[1] < 0.95 * without[1], peaks
