"""Probes of the lattice for a search of equilibrium: stiffness, and independence of other loads."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lattice_bodies import above, condyles, dished_insert, pair
from tkamb.contact.lattice import model as lattice_model
from tkamb.contact.lattice.linear import compliance
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model

LEVER = 0.02
"""m: half the distance of the condyles; makes rotations comparable to translations."""


@lru_cache
def prepared(name):
    """Return a model with cells of 2 mm and a small tolerance, for two spheres in a dish."""
    model = replace(contact_model(name, resolution=2e-3), tolerance=1e-6)
    bodies = pair(condyles(), dished_insert(), material("polyethylene"))
    return model, model.prepare(bodies)


def moved(pose, twist):
    """Return a pose after a small displacement (6,) of the point at the insert's origin."""
    turn = Rotation.from_rotvec(twist[3:]).as_matrix()
    result = pose.copy()
    result[:3] = turn @ pose[:3]
    result[:3, 3] += twist[:3]
    return result


def stiffness_by_differences(model, state, result, start):
    """Return the central differences (6, 6) of the wrench on the insert."""
    stiffness = np.zeros((6, 6))
    for column, step in enumerate([2e-6] * 3 + [1e-4] * 3):
        twist = step * np.eye(6)[column]
        ahead, behind = (
            model.evaluate(state, moved(result.pose, sign * twist), start).wrench_on_insert
            for sign in (1, -1)
        )
        stiffness[:, column] = (ahead - behind) / (2 * step)
    return stiffness


@pytest.mark.parametrize("name", ["lattice-linear", "lattice", "fe"])
def test_the_exact_tangent_is_the_derivative_of_the_wrench(name, monkeypatch):
    """The reference is solved in double precision, and by full Newton steps."""
    for module in (lattice_model, compliance):
        monkeypatch.setattr(module, "SINGLE", np.float64)
    newton = name != "lattice-linear"
    model = replace(
        contact_model(name, resolution=3e-3), tolerance=1e-9, newton=newton, cache=False
    )
    state = model.prepare(pair(condyles(), dished_insert(), material("polyethylene")))
    result, start = model.press_from(state, 800.0, above(x=0.5e-3, y=0.03))
    probe = model.probe(state, start)
    exact = sum(load.stiffness for load in probe.exact_tangent(probe.at(result.pose)).loads)
    for column in (0, 1, 3):  # AP, SI and adduction
        errors = []
        # The iteration stops before it follows a shorter step; a longer one may meet a kink.
        for step in (1e-7, 1e-6):
            twist = np.eye(6)[column] * (step if column < 3 else 40.0 * step)
            ahead, behind = (
                model.evaluate(state, moved(result.pose, sign * twist)).wrench_on_insert
                for sign in (1, -1)
            )
            slope = (ahead - behind) / (2.0 * twist[column])
            errors.append(np.abs(exact[:, column] - slope).max() / np.abs(slope).max())
        assert min(errors) < 1e-5, (column, errors)


@pytest.mark.parametrize(
    ("name", "load", "within"),
    [("lattice-linear", 1500.0, 0.01), ("lattice", 300.0, 0.03), ("lattice", 3000.0, 0.35)],
)
def test_the_stiffness_is_the_derivative_of_the_wrench(name, load, within):
    """Exact for Hooke's law. For yielding polyethylene it is larger, by the softening."""
    model, state = prepared(name)
    result, start = model.press_from(state, load, above(x=0.5e-3, y=0.03))
    contact = model.probe(state, start).at(result.pose)
    assert contact.tangent
    assert contact.exact == (name == "lattice-linear")
    scale = np.array([1.0, 1.0, 1.0, LEVER, LEVER, LEVER])
    scale = np.outer(scale, scale)
    given = sum(condyle.stiffness for condyle in contact.condyles.values()) / scale
    expected = stiffness_by_differences(model, state, result, start) / scale
    assert np.linalg.norm(given - expected) < within * np.linalg.norm(expected)
    assert given[1, 1] > 0.99 * expected[1, 1]


@pytest.mark.parametrize("name", ["lattice", "lattice-linear", "fe"])
@pytest.mark.parametrize("depth", [0.02, 0.5])
def test_a_light_contact_does_not_depend_on_a_heavy_one_before(name, depth):
    """The strains of the heavy contact first lift every node off the femur."""
    model, state = prepared(name)
    heavy, start = model.press_from(state, 15_000.0, above(y=0.03))
    pose = state.pair.pose_at_approach(heavy.pose, depth * 2e-4)
    cold, warm = model.evaluate(state, pose), model.evaluate(state, pose, start)
    force = np.linalg.norm(cold.nodal_force, axis=1).sum()
    assert force > 5.0
    assert warm.nodal_force == pytest.approx(cold.nodal_force, abs=1e-3 * force)


@pytest.fixture(scope="module")
def usual():
    """Return a model with the default tolerance, and two spheres in a dish under 2.5 kN."""
    model = contact_model("lattice", resolution=1.5e-3)
    bodies = pair(condyles(), dished_insert(), material("polyethylene"))
    state = model.prepare(bodies)
    return model, state, model.press(state, 2500.0, above(y=0.03)).pose


def residual(state, result, start):
    """Return the largest residual in the solid, relative to the contact forces."""
    problem = state.problem
    applied = np.zeros_like(problem.solid.nodes)
    applied[problem.contact_nodes] = result.nodal_force
    field = problem.operator.solve(applied + start.loads)
    outside = (applied - problem.solid.internal_force(field)).ravel()[~problem.held]
    return np.linalg.norm(outside) / np.linalg.norm(applied)


def test_at_near_poses_the_residual_is_measured_in_the_region_alone(usual, monkeypatch):
    """At far poses or under a larger force the whole solid is measured."""
    model, state, pose = usual
    measured, forces = [], type(state.problem.solid).forces
    monkeypatch.setattr(
        type(state.problem.solid), "forces", lambda *given: measured.append(1) or forces(*given)
    )
    probe = model.probe(state)
    probe.at(pose)
    for step in range(1, 6):
        measured.clear()
        near_pose = moved(pose, np.array([2e-5 * step, 0.0, 0.0, 3e-4 * step, 0.0, 0.0]))
        result, start = probe.evaluated(near_pose)
        assert not measured
        assert residual(state, result, start) < 1.2 * model.settings.force_tolerance
        whole = model.evaluate(state, near_pose).nodal_force
        assert np.linalg.norm(result.nodal_force - whole) < 2e-3 * np.linalg.norm(whole)
    for twist in ([3e-3, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, -3e-5, 0.0, 0.0, 0.0, 0.0]):
        probe = model.probe(state)
        probe.at(pose)
        measured.clear()
        probe.at(moved(pose, np.array(twist)))
        assert measured


def test_at_far_poses_the_region_alone_would_miss_the_residual(usual):
    model, state, pose = usual
    _, start = model.evaluate_from(state, pose)
    result, end = model.evaluate_from(state, moved(pose, np.array([3e-3, *[0.0] * 5])), start, True)
    assert residual(state, result, end) > 2 * model.settings.force_tolerance


def test_a_press_near_its_start_begins_with_the_last_change_and_evaluates_the_region(
    usual, monkeypatch
):
    model, state, pose = usual
    probe, start, passes, alone = model.probe(state), None, [], []
    for step in range(4):
        at = moved(pose, np.array([1e-4 * step, 0.0, 0.0, 0.0, 0.0, 0.0]))
        turned = moved(at, np.array([0.0, 0.0, 0.0, 3e-4, 0.0, 0.0]))
        _, start = model.press_from(state, 800.0, at, start)
        with monkeypatch.context() as context:
            context.delattr(type(state.problem.solid), "forces")
            result, end = probe.pressed(800.0, turned, start)
            alone.append(model.probe(state).pressed(800.0, turned, start)[0].iterations)
        passes.append(result.iterations)
        assert residual(state, result, end) < 1.2 * model.settings.force_tolerance
        whole = model.press(state, 800.0, turned).nodal_force
        assert np.linalg.norm(result.nodal_force - whole) < 2e-3 * np.linalg.norm(whole)
    assert sum(passes) < sum(alone)
