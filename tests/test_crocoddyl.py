"""The action models of Crocoddyl; Crocoddyl must fit the installed Pinocchio.

`scripts/check_control` runs this file in an environment whose Crocoddyl and Pinocchio fit.
"""

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from test_knee import FOUNDATION, SCENE
from tkamb import crocoddyl_pair
from tkamb.errors import InputError


def test_a_pair_that_does_not_fit_is_refused_in_one_line(monkeypatch):
    """A process checks a pair that is not known; it may fail, or end by a signal."""
    monkeypatch.setattr(crocoddyl_pair, "TESTED", {("7.1", "8.2")})
    crocoddyl_pair.checked("7.1", "8.2")
    for program, why in (
        ("assert False, 'a cost of 0 for 0.164'", "a cost of 0 for 0.164"),
        ("import os; os.kill(os.getpid(), 11)", "exit status -11"),
    ):
        monkeypatch.setattr(crocoddyl_pair, "SELF_CHECK", program)
        with pytest.raises(InputError) as caught:
            crocoddyl_pair.checked("7.1", "9.0")
        message = str(caught.value)
        assert "Crocoddyl 7.1 does not fit Pinocchio 9.0" in message
        assert why in message
        assert '"crocoddyl==7.1" "pin==8.2"' in message
        assert "\n" not in message
    monkeypatch.setattr(crocoddyl_pair, "SELF_CHECK", "pass")
    crocoddyl_pair.checked("7.1", "9.0")


@pytest.fixture(scope="module")
def control():
    """Return `tkamb.crocoddyl`; skip if there is no Crocoddyl that fits."""
    pytest.importorskip("crocoddyl")
    try:
        import tkamb.crocoddyl
    except InputError as error:
        pytest.skip(str(error))
    return tkamb.crocoddyl


@pytest.fixture(scope="module")
def action(control):
    """Return a differential action model, a state and a control.

    A foot is fixed; the shank turns, and the femur slides and turns on it. The costs are of
    Crocoddyl and of tkamb.
    """
    import crocoddyl

    plain = tkamb.read_scene(tkamb.load_scene(SCENE, FOUNDATION))[0]
    model, joint = pin.Model(), 0
    model.gravity = pin.Motion(np.array([0, -9.81, 0, 0, 0, 0]))
    for name, kind in (("ankle", "RZ"), ("ap", "PX"), ("si", "PY"), ("knee", "RZ")):
        place = pin.SE3(np.eye(3), np.array([0, 0.4 if name == "ap" else 0.0, 0]))
        joint = model.addJoint(joint, getattr(pin, f"JointModel{kind}")(), place, name)
    for name, joint, height in (("tibia", 1, 0.0), ("insert", 1, 0.4), ("femur", 4, 0.0)):
        if name != "insert":
            body = pin.Inertia(5.0, np.array([0, 0.2, 0]), 0.1 * np.eye(3))
            model.appendBodyToJoint(joint, body, pin.SE3.Identity())
        place = pin.SE3(np.eye(3), np.array([0, height, 0]))
        model.addFrame(pin.Frame(name, joint, 0, place, pin.FrameType.BODY))
    points = (("femur", (0.03, 0.2, 0)), ("femur", (0.038, -0.012, 0)), ("tibia", (0.036, 0.34, 0)))
    knee = tkamb.Knee(
        model,
        implant=tkamb.Implant(plain.femoral, plain.insert),
        contact=tkamb.contact_model("foundation", resolution=2e-3),
        muscles=[tkamb.Muscle("quadriceps", points)],
        friction=0.05,
    )
    state = crocoddyl.StateMultibody(model)
    actuation, costs = crocoddyl.ActuationModelFull(state), crocoddyl.CostModelSum(state, 5)
    frame, target = model.getFrameId("femur"), np.array([0.1, 0.5, 0.0])
    for name, residual, weight in (
        ("control", crocoddyl.ResidualModelControl(state, 5), 1e-3),
        ("frame", crocoddyl.ResidualModelFrameTranslation(state, frame, target, 5), 10.0),
        ("contact", control.CondyleForces(state, knee, 5), 1e-5),
        ("pressure", control.CondylePressures(state, knee, 5), 1e-13),
    ):
        costs.addCost(name, crocoddyl.CostModelResidual(state, residual), weight)
    q = np.array([0.1, -6.9e-3, 0.0, 0.5])
    q[2] = knee.press(q, 800.0).pose.translation[1]
    x = np.concatenate([q, [0.1, 0.01, -0.01, 0.2]])
    dynamics = control.KneeDynamics(state, actuation, knee, costs, muscles=["quadriceps"])
    return dynamics, x, np.array([5.0, 1.0, -2.0, 3.0, 400.0])


def column_errors(computed, expected):
    """Return the largest error of each column, relative to its largest entry."""
    computed, expected = np.atleast_2d(computed), np.atleast_2d(expected)
    size = np.abs(expected).max(axis=0)
    return np.abs(computed - expected).max(axis=0) / np.maximum(size, 1e-6 * size.max())


def test_the_differential_model_agrees_with_numerical_differences(action):
    """NumDiff takes one-sided steps of 1.5e-8, in which a stiff contact changes by 1e-4."""
    import crocoddyl

    dynamics, x, u = action
    data = dynamics.createData()
    dynamics.calc(data, x, u)
    dynamics.calcDiff(data, x, u)
    model = crocoddyl.DifferentialActionModelNumDiff(dynamics, True)
    numbers = model.createData()
    model.calc(numbers, x, u)
    model.calcDiff(numbers, x, u)
    assert data.cost == pytest.approx(numbers.cost, rel=1e-12)
    for name in ("Fx", "Fu", "Lx", "Lu"):
        found = column_errors(getattr(data, name), getattr(numbers, name))
        assert found.max() < 1e-3, (name, found)


def test_a_force_residual_evaluates_the_contact_once(action, control, monkeypatch):
    import crocoddyl

    dynamics, x, u = action
    residual = control.CondyleForces(dynamics.state, dynamics.knee, 5)
    data = residual.createData(crocoddyl.DataCollectorAbstract())
    kind, evaluated = type(residual._data.probe), []
    at = kind.at
    monkeypatch.setattr(kind, "at", lambda self, pose: evaluated.append(pose) or at(self, pose))
    for move in (0.0, 1e-6):
        moved = np.array(x)
        moved[2] += move
        residual.calc(data, moved, u)
        residual.calcDiff(data, moved, u)
    assert len(evaluated) == 2
    assert data.r.sum() == pytest.approx(800.0, rel=0.1)
    forces, by_q = dynamics.knee.condyle_forces(moved[:4])
    assert data.r == pytest.approx(forces, rel=1e-12)
    assert data.Rx[:, :4] == pytest.approx(by_q, rel=1e-9)


def test_a_native_residual_reads_the_pose_of_the_frame(action):
    dynamics, x, u = action
    data, plain = dynamics.createData(), dynamics.knee.model.createData()
    dynamics.calc(data, x, u)
    pin.framesForwardKinematics(dynamics.knee.model, plain, x[:4])
    place = plain.oMf[dynamics.knee.model.getFrameId("femur")].translation
    expected = 5.0 * np.sum((place - [0.1, 0.5, 0.0]) ** 2)
    assert 10.0 * data.costs.costs["frame"].cost == pytest.approx(expected, rel=1e-12)


def test_the_implicit_step_agrees_with_central_differences(action, control):
    dynamics, x, u = action
    step = control.KneeStep(dynamics, 0.02)
    data = step.createData()
    step.calc(data, x, u)
    end = np.array(data.xnext)
    assert np.isfinite(end).all()
    step.calc(data, x + 0.05 * np.eye(8)[7], np.add(u, [20.0, 0, 0, 20.0, 500.0]))
    step.calc(data, x, u)
    assert (data.xnext == end).all()  # whatever was computed before
    step.calc(data, x, np.add(u, [1e5, 0, 0, 0, 0]))  # the first joint would turn many times
    assert np.isnan(data.xnext).all()
    step.calc(data, x, u)
    step.calcDiff(data, x, u)

    def after(x, u):
        other = step.createData()
        step.calc(other, x, u)
        return np.array(other.xnext)

    columns = []
    for k in range(8):
        move = (1e-7 if k in (1, 2) else 1e-6) * np.eye(8)[k]
        columns.append((after(x + move, u) - after(x - move, u)) / (2.0 * move[k]))
    found = column_errors(data.Fx, np.array(columns).T)
    assert found.max() < 1e-3, found
    ends = [
        (after(x, u + move) - after(x, u - move)) / (2.0 * move.sum())
        for move in np.diag([1e-3, 1e-3, 1e-3, 1e-3, 1e-2])
    ]
    assert column_errors(data.Fu, np.array(ends).T).max() < 1e-3


def test_external_forces_act_and_a_state_without_numbers_has_no_force(action, control):
    model, x, u = action
    knee, pushed = model.knee, pin.StdVec_Force([pin.Force.Zero()] * model.knee.model.njoints)
    pushed[1] = pin.Force(np.array([0.0, 50.0, 0.0, 0.0, 0.0, 4.0]))
    other = control.KneeDynamics(
        model.state, model.actuation, knee, model.costs, model.muscles, model.tensions, pushed
    )
    data = other.createData()
    other.calc(data, x, u)
    other.actuation.calc(data.actuation, x, u[: other.actuation.nu])
    q, v = x[: model.state.nq], x[model.state.nq :]
    tensions = other._tensions(u)
    expected = knee.forward_dynamics(q, v, data.actuation.tau, pushed, tensions)
    assert np.array(data.xout) == pytest.approx(expected, rel=1e-9, abs=1e-9)
    free = knee.forward_dynamics(q, v, data.actuation.tau, None, tensions)
    assert np.abs(expected - free).max() > 0.1
    residual = control.CondyleForces(model.state, knee, model.nu)
    found = residual.createData(data.collector)
    residual.calc(found, np.full(len(x), np.nan), u)
    assert np.isnan(found.r).all()


def test_the_example_of_the_page_converges(action):
    page = (Path(tkamb.__file__).parents[1] / "docs" / "plug_in.md").read_text(encoding="utf-8")
    (block,) = [b for b in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "FDDP" in b]
    model, x, _ = action
    names = {"knee": model.knee, "model": model.knee.model, "x0": np.array(x)}
    names["x0"][model.state.nq :] = 0.0
    exec(block, names)
    assert names["solver"].stop < 1e-6
