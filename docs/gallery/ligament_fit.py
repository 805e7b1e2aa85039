"""The slack lengths of two ligaments, fitted to a laxity curve by gradient.

A laxity curve is the adduction of a loaded knee against an adduction moment. It is computed here
with known slack lengths, and the fit has to find them again. Only 150 N press the knee, so that the
larger moments lift one condyle: until then the curve says little about slack lengths.
`equilibrium(..., derivatives=True)` returns the derivative of the adduction by the slack lengths,
by the implicit function theorem. The same fit by finite differences needs three equilibria for each
moment and step.
"""

import time
from dataclasses import replace
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
model.gravity = pin.Motion.Zero()
hip = model.addJoint(0, pin.JointModelSpherical(), pin.SE3.Identity(), "hip")
thigh = pin.SE3(np.eye(3), np.array([0, -0.42, 0]))
shank = model.addJoint(hip, pin.JointModelFreeFlyer(), thigh, "knee")
for name, joint, place in (("femur", hip, thigh), ("tibia", shank, pin.SE3.Identity())):
    model.appendBodyToJoint(joint, pin.Inertia(4.0, np.zeros(3), 0.05 * np.eye(3)), place)
    model.addFrame(pin.Frame(name, joint, 0, place, pin.FrameType.BODY))


def collateral(name, z):
    """Return a ligament from epicondyle to shank."""
    ends = ("femur", (0.0, 0.0, z)), ("tibia", (0.0, -0.06, 0.8 * z))
    return tkamb.Ligament(name, *ends, tkamb.QuadraticToe(stiffness=3000.0), slack_length=0.088)


ligaments = [collateral("MCL", -0.04), collateral("LCL", 0.04)]
knee = tkamb.Knee(
    model,
    implant=tkamb.Implant(femoral, insert),
    ligaments=ligaments,
    contact=tkamb.contact_model("foundation", resolution=2e-3),
)
start = pin.neutral(model)
start[4:7] = 6.9e-3, -30.6e-3, 0.0  # of the shank, below the thigh
v, moments, calls = np.zeros(model.nv), np.linspace(-8.0, 8.0, 9), 0


def adductions(slack, derivatives=False):
    """Return the adduction (rad) under each moment, and its derivative by the slack lengths."""
    global calls
    pairs = zip(ligaments, slack, strict=True)
    changed = knee.with_ligaments([replace(one, slack_length=length) for one, length in pairs])
    found, slopes, q = [], [], start
    for moment in moments:
        fext = pin.StdVec_Force([pin.Force.Zero()] * model.njoints)
        fext[shank] = pin.Force(np.array([0, 150.0, 0]), np.array([moment, 0, 0]))
        state = changed.equilibrium(
            q, v, v, fext, released=("ap", "ml", "adduction"), derivatives=derivatives
        )
        assert not state.failed, state.reason
        calls += 1
        q = state.q
        found.append(state.coordinates[4])
        if derivatives:
            slopes.append(state.derivatives.by_slack_length[4])
    return np.array(found), np.array(slopes)


def by_differences(slack, step=1e-6):
    """Return the result of `adductions`, with derivatives by finite differences."""
    here = adductions(slack)[0]
    columns = [(adductions(slack + step * one)[0] - here) / step for one in np.eye(2)]
    return here, np.array(columns).T


def fit(values_and_slopes):
    """Return slack lengths (m) by Gauss-Newton, the number of equilibria, and seconds."""
    global calls
    calls, began, slack = 0, time.perf_counter(), np.array([0.0855, 0.0900])
    for _ in range(12):
        values, slopes = values_and_slopes(slack)
        step = np.linalg.lstsq(slopes, measured - values, rcond=None)[0]
        slack = slack + np.clip(step, -2e-3, 2e-3)
        if np.abs(step).max() < 1e-8:
            break
    return slack, calls, time.perf_counter() - began


true = np.array([0.0870, 0.0885])
measured = adductions(true)[0]
fits = {
    "gradient": fit(lambda slack: adductions(slack, derivatives=True)),
    "finite differences": fit(by_differences),
}
figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
axes.plot(np.degrees(measured), moments, "o", color="#0072B2", label="curve to be fitted")
first, last = np.array([0.0855, 0.0900]), fits["gradient"][0]
for slack, label, style in ((first, "first guess", ":"), (last, "fitted", "-")):
    axes.plot(np.degrees(adductions(slack)[0]), moments, style, color="#D55E00", label=label)
for name, (slack, count, seconds) in fits.items():
    print(f"{name}: {1e3 * slack.round(7)} mm, {count} equilibria, {seconds:.1f} s")
counts = ", ".join(f"{count} equilibria by {name}" for name, (_, count, _) in fits.items())
axes.set(xlabel="adduction (deg)", ylabel="adduction moment (N·m)")
axes.set_title(counts, fontsize=8)
axes.legend()
figure.savefig("ligament_fit.png", dpi=100)

for slack, _, _ in fits.values():
    assert np.abs(slack - true).max() < 2e-6, slack - true
assert 2 * fits["gradient"][1] < fits["finite differences"][1]
